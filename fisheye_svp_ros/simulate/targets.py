"""Targets of one board or several, and poses from which a camera sees them all over its image."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import islice

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.forward import project_corrected
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, identity, rotation_from_vector
from fisheye_svp_ros.simulate.render import BoardPose, Print

_TRIES = 400  # a view
_EDGE, _SPACING = 8.0, 9.0  # px, least distance from the image's edge and between corners
_TILT = np.radians(50.0)
_MIN_BOARDS = 2  # boards of which something is seen
_CAMERA_RANGE = 0.3  # of half the room: how far from its middle the camera comes


def board(printed: Print) -> tuple[BoardPose, ...]:
    """Return one board, its own frame that of the target."""
    return (BoardPose(printed, identity()),)


def _box(printed: Print, outside: bool) -> tuple[BoardPose, ...]:
    """Return six boards on the faces of a cube or the walls of a room, its middle the origin."""
    half = printed.size * (max(printed.columns, printed.rows) + 1 + 2 * printed.margin) / 2
    boards = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            normal = sign * np.eye(3)[axis]
            into = -normal if outside else normal
            right = np.eye(3)[(axis + 1) % 3]
            turn = np.stack([right, np.cross(into, right), into], axis=-1)
            middle = turn @ printed.corners.mean(axis=0)
            boards.append(BoardPose(printed, Pose(turn, half * normal - middle)))
    return tuple(boards)


TARGETS: dict[str, Callable[[Print], tuple[BoardPose, ...]]] = {
    'cube': partial(_box, outside=True),
    'room': partial(_box, outside=False),
}


def visible(lens: Lens, boards: tuple[BoardPose, ...], camera: Pose) -> tuple[Array, Array]:
    """Return image points (B, N, 2), px, of the corners of boards, and whether they are seen."""
    uv, seen = [], []
    for board in boards:
        points = board.true_corners()
        image = project_corrected(lens, camera.into_body(points))
        front = board.pose.into_body(camera.position[None])[0, 2] < 0
        inside = (image.uv > -0.5).all(axis=-1) & (
            image.uv < np.array([lens.width, lens.height]) - 0.5
        ).all(axis=-1)
        uv.append(image.uv)
        seen.append(image.valid & inside & front)
    return np.stack(uv), np.stack(seen)


def board_views(
    lens: Lens, printed: Print, count: int, ranges: tuple[float, float], rng: np.random.Generator
) -> Pose:
    """Return `count` poses of the camera in the board's frame, the board in sight as a whole.

    ranges: nearest and furthest, m, to the middle of the board.
    Raises GeometryError where the board does not fit into the image.
    """
    corners, middle = printed.true_corners(), printed.corners.mean(axis=0)

    def draw() -> Pose:
        turn, place = _placed_in_sight(lens, ranges, rng)
        return Pose(turn, place - turn @ middle).inverse()

    def sees(camera: Pose) -> bool:
        return _contains(lens, camera.into_body(corners), printed)

    return _draw_poses(
        count,
        draw,
        sees,
        (
            f'lens {lens.name!r} does not see the whole board at {ranges[0]:g} to '
            f'{ranges[1]:g} m; '
            'choose a smaller board or other ranges'
        ),
    )


def target_views(
    lens: Lens,
    kind: str,
    boards: tuple[BoardPose, ...],
    count: int,
    ranges: tuple[float, float],
    rng: np.random.Generator,
) -> Pose:
    """Return `count` poses of the camera in a target's frame from which two boards are seen.

    ranges: nearest and furthest, m, to the middle of a cube; in a room the camera stays inside.
    Raises GeometryError where too few poses do.
    """
    half = max(float(np.abs(board.pose.position).max()) for board in boards)

    def draw() -> Pose:
        if kind == 'room':
            return Pose(
                rotation_from_vector(rng.normal(size=3)),
                _CAMERA_RANGE * half * rng.uniform(-1, 1, 3),
            )
        turn, place = _placed_in_sight(lens, ranges, rng)
        return Pose(turn @ rotation_from_vector(rng.normal(size=3)), place).inverse()

    def boards_visible(camera: Pose) -> bool:
        return bool((visible(lens, boards, camera)[1].sum(axis=1) > 3).sum() >= _MIN_BOARDS)

    where = (
        'from inside it; take a lens with a larger field of view'
        if kind == 'room'
        else f'at {ranges[0]:g} to {ranges[1]:g} m; choose other ranges'
    )
    return _draw_poses(
        count,
        draw,
        boards_visible,
        (f'lens {lens.name!r} does not see two boards of the {kind} {where}'),
    )


def _draw_poses(
    count: int, draw: Callable[[], Pose], good: Callable[[Pose], bool], wrong: str
) -> Pose:
    """Return the first `count` poses drawn that are good; raise GeometryError for too few."""
    drawn = (draw() for _ in range(count * _TRIES))
    poses = [*islice(filter(good, drawn), count)]
    if len(poses) < count:
        raise GeometryError(wrong)
    return Pose.stack(poses)


def _placed_in_sight(
    lens: Lens, ranges: tuple[float, float], rng: np.random.Generator
) -> tuple[Array, Array]:
    """Return the turn (3, 3) of a board towards the camera, and a place (3,), m, in its sight."""
    # Evenly over the sphere, so that the outer part of the image gets its share.
    cosine = rng.uniform(np.cos(lens.max_incidence), 1.0)
    azimuth, distance = rng.uniform(0, 2 * np.pi), np.exp(rng.uniform(*np.log(ranges)))
    sine = np.sqrt(1 - cosine**2)
    sight = np.array([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine])
    return _facing(sight, rng), distance * sight


def _facing(sight: Array, rng: np.random.Generator) -> Array:
    """Return the turn (3, 3) of a board that looks back along `sight`, tilted and rolled."""
    across = np.cross([0.0, 0.0, 1.0], sight)
    angle = np.arctan2(np.linalg.norm(across), sight[2])
    towards = rotation_from_vector(angle * across / max(float(np.linalg.norm(across)), 1e-12))
    axis, roll = rng.uniform(0, 2 * np.pi, 2)
    tilt = _TILT * np.sqrt(rng.uniform()) * np.array([np.cos(axis), np.sin(axis), 0.0])
    return np.asarray(
        towards @ rotation_from_vector(tilt) @ rotation_from_vector(np.array([0.0, 0.0, roll]))
    )


def _contains(lens: Lens, points: Array, printed: Print) -> bool:
    image = project_corrected(lens, points)
    if not image.valid.all():
        return False
    uv = image.uv
    inside = (uv > _EDGE).all() and (uv < (lens.width - _EDGE, lens.height - _EDGE)).all()
    grid = uv.reshape(printed.rows, printed.columns, 2)
    steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1)]
    right, down = grid[1:, 1:] - grid[1:, :-1], grid[1:, 1:] - grid[:-1, 1:]
    front = right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0] > 0
    return bool(inside and min(steps) > _SPACING and front.all())
