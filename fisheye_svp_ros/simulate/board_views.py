"""Poses from which a camera sees a whole board, all over its image."""

from __future__ import annotations

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.forward import project
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.simulate.render import Print

_TRIES = 400  # a view
_EDGE, _SPACING = 8.0, 9.0  # px, least distance from the image's edge and between corners
_TILT = np.radians(50.0)


def board_views(
    lens: Lens, printed: Print, count: int, ranges: tuple[float, float], rng: np.random.Generator
) -> Pose:
    """Return `count` poses of the camera in the board's frame, the board in sight as a whole.

    ranges: nearest and furthest, m, to the middle of the board.
    Raises GeometryError where the board does not fit into the image.
    """
    corners, middle = printed.true_corners(), printed.corners.mean(axis=0)
    found: list[Pose] = []
    for _ in range(count * _TRIES):
        board, place = placed_in_sight(lens, ranges, rng)
        camera = Pose(board, place - board @ middle).inverse()
        if _whole(lens, camera.into_body(corners), printed):
            found.append(camera)
        if len(found) == count:
            return Pose(*(np.stack(part) for part in zip(*found, strict=True)))
    raise GeometryError(f'lens {lens.name!r} does not see the whole board at {ranges[0]:g} to '
                        f'{ranges[1]:g} m; choose a smaller board or other ranges')


def placed_in_sight(
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
    return np.asarray(towards @ rotation_from_vector(tilt)
                      @ rotation_from_vector(np.array([0.0, 0.0, roll])))


def _whole(lens: Lens, points: Array, printed: Print) -> bool:
    image = project(lens, points)
    if not image.valid.all():
        return False
    uv = image.uv
    inside = (uv > _EDGE).all() and (uv < (lens.width - _EDGE, lens.height - _EDGE)).all()
    grid = uv.reshape(printed.rows, printed.columns, 2)
    steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1)]
    right, down = grid[1:, 1:] - grid[1:, :-1], grid[1:, 1:] - grid[:-1, 1:]
    front = right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0] > 0
    return bool(inside and min(steps) > _SPACING and front.all())
