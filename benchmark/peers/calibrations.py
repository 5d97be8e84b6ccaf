"""What a user would take instead: OpenCV's calibrations, and mrcal's."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from benchmark.peers.sets import Grid, Project, Set, one_board_a_frame
from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.scene.observations import Observations

MRCAL = 'mrcal-calibrate-cameras'
PLANE_LIMIT = 89.0  # degrees: models of x / z end here
ANGLES = (180.0, 85.0, 80.0, 75.0, 70.0, 65.0, 60.0)  # degrees
_FEWEST = 12  # points in a view for OpenCV to start from
_MOST_LEFT_OUT = 10
_TERMS = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-10)


class NotHereError(Exception):
    """A tool that this machine has not, or that finds no lens for a set."""


@dataclass(frozen=True)
class Fitted:
    """A lens as a tool has it.

    project: how it projects; places: where it believes the landmarks (N, 3) of a table to be;
    before: degrees, the incidence angle at which its model ends; intrinsics: fx, fy, cx, cy, px;
    errors: their standard errors (4,) as the tool states them, by kind; curve: its coefficients
    (4,), of a Kannala-Brandt curve.
    """

    project: Project
    places: Callable[[Observations], Array]
    note: str = ''
    before: float = 180.0
    intrinsics: Array = field(default_factory=lambda: np.full(4, np.nan))
    errors: dict[str, Array] = field(default_factory=dict)
    curve: Array = field(default_factory=lambda: np.full(4, np.nan))


Fit = Callable[[Set, Grid, float], list[Fitted]]


def views(table: Observations, grid: Grid) -> Iterator[tuple[int, Index, Array]]:
    """Yield the board views of a table: number, rows and columns (N, 2), image points (N, 2)."""
    split = one_board_a_frame(table)
    for number in split.frames:
        mine = split.frame == number
        steps = np.array([grid.places[one] for one in split.landmark[mine].tolist()])
        yield int(number), steps, split.uv[mine]


def fit_within(fit: Callable[[float], Fitted], angles: Sequence[float]) -> list[Fitted]:
    """Return the lenses fitted to the points within each of several angles, degrees."""
    found, reason = [], ''
    for limit in angles:
        try:
            one = fit(limit)
        except (cv2.error, ArithmeticError, RuntimeError, ValueError) as failure:
            reason = str(failure).strip().splitlines()[0]
            continue
        note = f'fitted to the points within {limit:.0f}°' * (limit < 180)
        found.append(replace(one, note='; '.join(filter(None, (one.note, note)))))
    if not found:
        raise NotHereError(f'finds no lens: {reason}')
    return found


def opencv_fisheye(data: Set, grid: Grid, focal: float) -> list[Fitted]:
    """Fit `cv2.fisheye`: Kannala-Brandt with four coefficients, boards flat.

    To all points, and to those within narrower angles: where rays come near 90 degrees it fails,
    or ends far off.
    """
    of = cv2 if hasattr(cv2, 'CALIB_FIX_SKEW') else cv2.fisheye  # where OpenCV 5, and 4, has them
    flags = of.CALIB_USE_INTRINSIC_GUESS + of.CALIB_RECOMPUTE_EXTRINSIC + of.CALIB_FIX_SKEW
    start = pinhole_matrix(data, focal)

    def fit(limit: float) -> Fitted:
        points, seen = board_points(data.train, grid, start, limit)
        _, matrix, curve, _, _ = cv2.fisheye.calibrate(
            [one[None] for one in points],
            [one[None] for one in seen],
            data.size,
            start.copy(),
            np.zeros(4),
            flags=flags,
            criteria=_TERMS,
        )
        return Fitted(
            fisheye_projection(matrix, curve),
            nominal_places,
            before=PLANE_LIMIT,
            intrinsics=matrix[[0, 1, 0, 1], [0, 1, 2, 2]],
            curve=curve.ravel(),
        )

    return fit_within(fit, ANGLES)


def fisheye_projection(matrix: Array, curve: Array) -> Project:
    """Return the projection of `cv2.fisheye` by a matrix (3, 3) and four coefficients."""
    zero = np.zeros(3)

    def project(xyz: Array) -> Array:
        seen, _ = cv2.fisheye.projectPoints(xyz[:, None], zero, zero, matrix, curve)
        return np.asarray(seen[:, 0])

    return project


def opencv_rational(data: Set, grid: Grid, focal: float) -> list[Fitted]:
    """Fit `cv2.calibrateCamera` with the rational model, boards flat."""
    flags = cv2.CALIB_USE_INTRINSIC_GUESS + cv2.CALIB_RATIONAL_MODEL
    start = pinhole_matrix(data, focal)
    points, seen = board_points(data.train, grid, start)
    try:
        _, matrix, curve, _, _, errors, *_ = cv2.calibrateCameraExtended(
            [one.astype(np.float32) for one in points],
            [one.astype(np.float32) for one in seen],
            data.size,
            start,
            np.zeros(8),
            flags=flags,
            criteria=_TERMS,
        )
    except cv2.error as failure:
        raise NotHereError(f'finds no lens: {failure.err}') from failure

    def project(xyz: Array) -> Array:
        zero = np.zeros(3)
        return np.asarray(cv2.projectPoints(xyz, zero, zero, matrix, curve)[0][:, 0])

    return [
        Fitted(
            project,
            nominal_places,
            before=PLANE_LIMIT,
            intrinsics=matrix[[0, 1, 0, 1], [0, 1, 2, 2]],
            errors={'': errors[:4].ravel()},
        )
    ]


def pinhole_matrix(data: Set, focal: float) -> Array:
    """Return a matrix (3, 3) of a focal length, px, with its center in the middle."""
    width, height = data.size
    return np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])


def nominal_places(table: Observations) -> Array:
    """Return the landmarks (N, 3) as the table has them."""
    return table.xyz


def board_points(
    table: Observations, grid: Grid, matrix: Array, limit: float = 180.0
) -> tuple[list[Array], list[Array]]:
    """Return points on flat boards and their images, up to an angle."""
    points, seen = [], []
    for _, steps, uv in views(table, grid):
        near = np.hypot(*(uv - matrix[:2, 2]).T) < matrix[0, 0] * np.radians(limit)
        if near.sum() >= _FEWEST:
            points.append(grid.spacing * np.column_stack([steps, 0 * near])[near])
            seen.append(uv[near])
    return points, seen


def mrcal_model(model: str) -> Fit:
    """Return what fits a lens model of mrcal, with its board warp, by its own command."""

    def fit(data: Set, grid: Grid, focal: float) -> list[Fitted]:
        try:
            import mrcal
        except ImportError as reason:
            raise NotHereError(f'not installed ({reason})') from reason
        with tempfile.TemporaryDirectory() as folder:
            left_out = _run_mrcal(Path(folder), model, data, grid, focal)
            found = mrcal.cameramodel(str(Path(folder, 'camera-0.cameramodel')))
        warp = found.optimization_inputs()['calobject_warp']
        board = mrcal.ref_calibration_object(
            grid.width, grid.width, grid.spacing, calobject_warp=warp
        )
        lens = found.intrinsics()
        note = f'{left_out} board views left out: it finds no start for them' if left_out else ''
        return [
            Fitted(
                lambda xyz: np.asarray(mrcal.project(xyz, *lens)),
                lambda table: warped_places(table, grid, board),
                note,
                PLANE_LIMIT if 'OPENCV' in model else 180.0,
            )
        ]

    return fit


def _run_mrcal(folder: Path, model: str, data: Set, grid: Grid, focal: float) -> int:
    """Have mrcal write its camera to a folder; return how many views it cannot start from."""
    command = shutil.which(MRCAL, path=str(Path(sys.executable).parent)) or MRCAL
    left_out: set[int] = set()
    while len(left_out) < _MOST_LEFT_OUT:
        (folder / 'corners.vnl').write_text(vnlog(data.train, grid, left_out))
        told = subprocess.run(
            [
                command,
                '--corners-cache',
                folder / 'corners.vnl',
                '--lensmodel',
                model,
                '--focal',
                f'{focal:.0f}',
                '--imagersize',
                *map(str, data.size),
                '--object-spacing',
                str(grid.spacing),
                '--object-width-n',
                str(grid.width),
                '--outdir',
                folder,
                'view*.png',
            ],
            capture_output=True,
            text=True,
            check=False,
        )
        if not told.returncode:
            return len(left_out)
        reason = told.stderr.strip().splitlines()[-1]
        view = re.search(r'initial extrinsics.*view(\d+)[.]png', reason)
        if view is None:
            raise NotHereError(f'finds no lens: {reason}')
        left_out.add(int(view[1]))
    raise NotHereError(f'finds no start for {len(left_out)} views and more')


def vnlog(table: Observations, grid: Grid, left_out: Collection[int] = ()) -> str:
    """Return corners as mrcal reads them: all points of the grid in every view, `-` unseen."""
    lines = ['# filename x y level']
    for number, steps, uv in views(table, grid):
        if number in left_out:
            continue
        seen = {tuple(step): point for step, point in zip(steps.tolist(), uv, strict=True)}
        for row in range(grid.width):
            for column in range(grid.width):
                point = seen.get((column, row))
                where = '0 0 -' if point is None else f'{point[0]:.6f} {point[1]:.6f} 0'
                lines.append(f'view{number:07d}.png {where}')
    return '\n'.join(lines) + '\n'


def warped_places(table: Observations, grid: Grid, board: Array) -> Array:
    """Return the landmarks (N, 3) where mrcal's warped board, (row, column, 3), has them.

    The board lies on the nominal landmarks as well as a flat one can.
    """
    places = np.empty((len(table), 3))
    for number in np.unique(table.board):
        mine = table.board == number
        steps = np.array([grid.places[one] for one in table.landmark[mine].tolist()])
        flat = grid.spacing * np.column_stack([steps, np.zeros(len(steps))])
        nominal = table.xyz[mine]
        left, _, right = np.linalg.svd(
            (flat - flat.mean(axis=0)).T @ (nominal - nominal.mean(axis=0))
        )
        turn = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
        places[mine] = (board[steps[:, 1], steps[:, 0]] - flat.mean(axis=0)) @ turn
        places[mine] += nominal.mean(axis=0)
    return places


_SPLINED = 'LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx={}_Ny={}_fov_x_deg=200'
PEERS: dict[str, Fit] = {
    'OpenCV, fisheye': opencv_fisheye,
    'OpenCV, rational': opencv_rational,
    'mrcal, OPENCV8': mrcal_model('LENSMODEL_OPENCV8'),
    **{
        f'mrcal, splined {x} x {y}': mrcal_model(_SPLINED.format(x, y))
        for x, y in ((10, 7), (16, 11), (30, 18))
    },
    'mrcal, CAHVORE': mrcal_model('LENSMODEL_CAHVORE_linearity=0.37'),
}
