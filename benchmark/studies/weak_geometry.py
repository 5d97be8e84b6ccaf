"""Whether poses of weak geometry lie in their ellipsoids: `make study NAME=weak_geometry`.

500 poses of each of six geometries, image points with .5 px of noise on u and on v, a lens of
1280 x 960 px (Kannala-Brandt, f 330 px). `held`: covariances as `localize` and the localizer give
them; `linear`: the inverse of the normal equations; `cv2`: `solvePnP` (SQPNP, then
`solvePnPRefineLM`) of undistorted points, with the covariance by the Jacobian of `projectPoints`.
Goal: 99.9 % ellipsoids hold in at least 98.5 %, 95 % ones in 93 to 97 %.

Writes docs/results/pose_covariance.md.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from benchmark import study
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.optics.curves import KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, rotation_from_vector, vector_from_rotation
from fisheye_svp_ros.scene.observations import Views, views_of
from fisheye_svp_ros.solve.localization import localize
from fisheye_svp_ros.solve.weak_geometry import (
    CHI2_95,
    CHI2_999,
    hold_weak_geometry,
    is_ambiguous,
    squared_distances,
)

SIGMA = 0.5  # px
DISTORTION = (0.03, -0.01, 0.002, -0.0005)
LENS = Lens('made', 1280, 960, 330.0, 331.0, 640.5, 479.5, KannalaBrandt(*DISTORTION), 1.5)
PAGE = study.RESULTS / 'pose_covariance.md'
_LEGEND = """\
Three columns: share of true poses within the 95 and the 99.9 % ellipsoid. chi2 per dof:
held / linear / cv2. Time: over that of the linear solution, batch, NumPy or Numba as
`FISHEYE_SVP_ENGINE` has it.
"""


class Geometry(NamedTuple):
    """Landmarks (N, 3), m, and the target in the camera: rotation vector, place, m."""

    name: str
    points: Array
    turn: tuple[float, float, float]
    place: tuple[float, float, float]


class Coverage(NamedTuple):
    """Shares of poses within their 95 % and 99.9 % ellipsoids, and Mahalanobis squared a dof."""

    of_95: float
    of_999: float
    chi2_per_dof: float


def geometries() -> list[Geometry]:
    """Return the six geometries."""
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(9.0), np.arange(6.0))
    board = 0.025 * np.stack([x.ravel() - 4, y.ravel() - 2.5, 0 * x.ravel()], axis=-1)
    tag = 0.05 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    directions = rng.normal(size=(30, 3))
    directions[:, 2] = np.abs(directions[:, 2]) + 0.6
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    room = directions * rng.uniform(1, 3, (30, 1))
    wall = np.pad(rng.uniform(-1.5, 1.5, (20, 2)), ((0, 0), (0, 1)))
    three = np.array([[-1.0, -0.6, 0], [1.2, -0.5, 0.2], [0.1, 1.0, 0.1], [0.15, 0.9, 0.15]])
    return [
        Geometry('board 9 x 6 x 25 mm, frontal, .5 m', board, (0, 0, 0), (0, 0, 0.5)),
        Geometry('the same board, frontal, 1.5 m', board, (0, 0, 0), (0, 0, 1.5)),
        Geometry('tag of 10 cm, tilted by 45 degrees, 1 m', tag, (0.785, 0, 0), (0, 0, 1)),
        Geometry('room, 30 landmarks at 1 to 3 m', room, (0, 0, 0), (0, 0, 0)),
        Geometry('one wall, 20 landmarks, 2 m', wall, (0.3, 0.4, 0), (0, 0, 2)),
        Geometry('three points and one beside the third, 2 m', three, (0.2, 0.2, 0), (0, 0, 2)),
    ]


def draw_views(model: ForwardModel, geometry: Geometry, count: int) -> tuple[Views, Pose]:
    """Return noisy views and true poses, turned about the viewing axis at random."""
    rng = np.random.default_rng(1)
    spin = np.zeros((count, 3))
    spin[:, 2] = rng.uniform(-np.pi, np.pi, count)
    turn = rotation_from_vector(spin)
    place = turn @ np.array(geometry.place, dtype=float)
    rotation = turn @ rotation_from_vector(np.array(geometry.turn, dtype=float))
    true = Pose(rotation, place).inverse()
    views = views_of(np.tile(geometry.points, (count, 1, 1)))
    uv = model.predict(true, views).uv + rng.normal(0, SIGMA, views.uv.shape)
    return views_of(views.points, uv, np.full(uv.shape[:2], 1 / SIGMA)), true


def coverage(squares: Array) -> Coverage:
    """Summarize Mahalanobis squares (S,)."""
    return Coverage(
        float((squares < CHI2_95).mean()),
        float((squares < CHI2_999).mean()),
        float(squares.mean()) / 6,
    )


def opencv_squares(views: Views, true: Pose) -> Array:
    """Return Mahalanobis squares (S,) of solvePnP, in its own parameters."""
    camera = np.array([[LENS.fx, 0, LENS.cx], [0, LENS.fy, LENS.cy], [0, 0, 1]])
    target, squares = true.inverse(), []
    for i in range(len(views.frame)):
        points, uv = views.points[i], views.uv[i]
        flat = cv2.fisheye.undistortPoints(uv[:, None], camera, np.array(DISTORTION), P=camera)
        found, turn, shift = cv2.solvePnP(points, flat, camera, None, flags=cv2.SOLVEPNP_SQPNP)
        if not found:
            squares.append(np.inf)
            continue
        turn, shift = cv2.solvePnPRefineLM(points, flat, camera, None, turn, shift)
        jacobian = cv2.projectPoints(points, turn, shift, camera, None)[1][:, :6] / SIGMA
        known = vector_from_rotation(target.rotation[i])
        # Of the two vectors of the same rotation, the nearer one.
        longer = known - 2 * np.pi * known / max(np.linalg.norm(known), 1e-9)
        off = min((turn.ravel() - one for one in (known, longer)), key=np.linalg.norm)
        off = np.concatenate([off, shift.ravel() - target.position[i]])
        squares.append(float(((jacobian @ off) ** 2).sum()))
    return np.array(squares)


def trial(geometry: Geometry, count: int) -> list[object]:
    """Return a row of the table."""
    model = ForwardModel(LENS)
    views, true = draw_views(model, geometry, count)
    start = time.process_time()
    linear = localize(model, views)
    middle = time.process_time()
    held = hold_weak_geometry(model, views, linear)
    ratio = 1 + (time.process_time() - middle) / (middle - start)
    off = held.pose.difference(true)[:, None]
    results = [
        coverage(squares_)
        for squares_ in (
            squared_distances(off, held.covariance)[:, 0],
            squared_distances(off, linear.covariance)[:, 0],
            opencv_squares(views, true),
        )
    ]
    cells = [f'{100 * one.of_95:.1f} / {100 * one.of_999:.1f}' for one in results]
    chi2 = ' / '.join(f'{one.chi2_per_dof:.3g}' for one in results)
    ambiguous = f'{100 * is_ambiguous(held).mean():.0f}'
    return [geometry.name, *cells, chi2, ambiguous, f'{ratio:.2f}']


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the study and write its page."""
    options = {'poses': (500, 'of each geometry')}
    asked = study.parser('studies.weak_geometry', __doc__, PAGE, workers=False, **options)
    args = asked.parse_args(arguments)
    rows = [trial(geometry, args.poses) for geometry in geometries()]
    header = (
        'geometry | held: 95 / 99.9 %, % | linear, % | cv2, % | chi2 per dof | ambiguous, % | time'
    )
    page = study.page(
        'Covariances of poses',
        __doc__,
        f'make study NAME=weak_geometry ARGS="--poses {args.poses}"',
        study.table(header, rows, numbers=True),
        _LEGEND.splitlines(),
    )
    write_text(args.output, page)
    sys.stdout.write(page)


if __name__ == '__main__':
    main()
