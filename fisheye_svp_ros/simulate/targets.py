"""Targets of several boards: a cube seen from outside, a room from inside."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.forward import project
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, identity, rotation_from_vector
from fisheye_svp_ros.simulate.board_views import placed_in_sight
from fisheye_svp_ros.simulate.render import Placed, Print

_TRIES = 400  # a view
_LEAST = 2  # boards of which something is seen
_INSIDE = 0.3  # of half the room: how far from its middle the camera comes


def board(printed: Print) -> tuple[Placed, ...]:
    """Return one board, its own frame that of the target."""
    return (Placed(printed, identity()),)


def cube(printed: Print) -> tuple[Placed, ...]:
    """Return six boards on the faces of a cube, its middle the origin."""
    return _box(printed, outside=True)


def room(printed: Print) -> tuple[Placed, ...]:
    """Return six boards on the walls of a room, its middle the origin."""
    return _box(printed, outside=False)


TARGETS: dict[str, Callable[[Print], tuple[Placed, ...]]] = {'cube': cube, 'room': room}


def _box(printed: Print, outside: bool) -> tuple[Placed, ...]:
    half = printed.size * (max(printed.columns, printed.rows) + 1 + 2 * printed.margin) / 2
    boards = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            normal = sign * np.eye(3)[axis]
            into = -normal if outside else normal
            right = np.eye(3)[(axis + 1) % 3]
            turn = np.stack([right, np.cross(into, right), into], axis=-1)
            middle = turn @ printed.corners.mean(axis=0)
            boards.append(Placed(printed, Pose(turn, half * normal - middle)))
    return tuple(boards)


def visible(lens: Lens, boards: tuple[Placed, ...], camera: Pose) -> tuple[Array, Array]:
    """Return image points (B, N, 2), px, of the corners of boards, and whether they are seen."""
    uv, seen = [], []
    for board in boards:
        points = board.true_corners()
        image = project(lens, camera.into_body(points))
        front = board.pose.into_body(camera.position[None])[0, 2] < 0
        inside = (image.uv > -0.5).all(axis=-1) & (
            image.uv < np.array([lens.width, lens.height]) - 0.5).all(axis=-1)
        uv.append(image.uv)
        seen.append(image.valid & inside & front)
    return np.stack(uv), np.stack(seen)


def target_views(
    lens: Lens, kind: str, boards: tuple[Placed, ...], count: int, ranges: tuple[float, float],
    rng: np.random.Generator,
) -> Pose:
    """Return `count` poses of the camera in a target's frame from which two boards are seen.

    ranges: nearest and furthest, m, to the middle of a cube; in a room the camera stays inside.
    Raises GeometryError where too few poses do.
    """
    found: list[Pose] = []
    half = max(float(np.abs(board.pose.position).max()) for board in boards)
    for _ in range(count * _TRIES):
        if kind == 'room':
            camera = Pose(rotation_from_vector(rng.normal(size=3)),
                          _INSIDE * half * rng.uniform(-1, 1, 3))
        else:
            turn, place = placed_in_sight(lens, ranges, rng)
            camera = Pose(turn @ rotation_from_vector(rng.normal(size=3)), place).inverse()
        if (visible(lens, boards, camera)[1].sum(axis=1) > 3).sum() >= _LEAST:
            found.append(camera)
        if len(found) == count:
            return Pose(*(np.stack(part) for part in zip(*found, strict=True)))
    raise GeometryError(f'lens {lens.name!r} does not see two boards of the {kind} at '
                        f'{ranges[0]:g} to {ranges[1]:g} m; choose other ranges')
