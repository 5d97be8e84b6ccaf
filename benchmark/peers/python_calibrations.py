"""What else the package index offers: lensboy, calibsense and ds-msp, called as libraries."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import redirect_stdout
from io import StringIO
from multiprocessing import get_context
from typing import Any

import cv2
import numpy as np

from benchmark.peers.calibrations import (
    ANGLES,
    PLANE_LIMIT,
    Fit,
    Fitted,
    NotHereError,
    board_points,
    fisheye_projection,
    fit_within,
    nominal_places,
    pinhole_matrix,
    warped_places,
)
from benchmark.peers.sets import Grid, Set
from fisheye_svp_ros.arrays import Array, Index


def installed(fit: Fit) -> Fit:
    """Return a fit that says so where its tool is not installed."""

    def checked(data: Set, grid: Grid, focal: float) -> list[Fitted]:
        try:
            return fit(data, grid, focal)
        except ImportError as reason:
            raise NotHereError(f'not installed ({reason})') from reason

    return checked


def grid_numbers(points: Array, grid: Grid) -> Index:
    """Return the numbers of points (N, 3) of a flat board, row by row over the whole grid."""
    column, row = np.rint(points[:, :2] / grid.spacing).astype(int).T
    return np.asarray(row * grid.width + column)


def calibsense_fisheye(
    data: Set, grid: Grid, focal: float, angles: Sequence[float] = ANGLES
) -> list[Fitted]:
    """Fit calibsense's Kannala-Brandt, which `cv2.fisheye` solves, with its standard errors.

    By kind: from the noise of all points, and from the scatter between views, where it has enough.
    """
    import calibsense as cs

    start = pinhole_matrix(data, focal)
    lens = cs.FisheyeKannalaBrandt(focal, focal, *start[:2, 2], np.zeros(4))
    board = cs.Checkerboard(grid.width, grid.width, 1e3 * grid.spacing)

    def fit(limit: float) -> Fitted:
        views = [
            cs.ViewObservations(f'{number}', grid_numbers(points, grid), uv)
            for number, (points, uv) in enumerate(
                zip(*board_points(data.train, grid, start, limit), strict=True)
            )
        ]
        session = cs.CalibrationSession(
            cs.ObservationSet(board, data.size, tuple(views)),
            cs.CalibrationRecord(lens, data.size),
        )
        try:
            found = cs.instrument(session, cs.RefitOptions(model='fisheye'))
        except cs.CalibSenseError as reason:
            raise RuntimeError(str(reason)) from reason
        camera, known = found.camera, found.covariance
        errors = {'of points': known.intrinsic_std()[:4]}
        if known.robust is not None and known.robust.usable:
            errors['between views'] = known.robust.std()[:4]
        return Fitted(
            fisheye_projection(camera.camera_matrix, camera.distortion),
            nominal_places,
            before=PLANE_LIMIT,
            intrinsics=camera.to_vector()[:4],
            errors=errors,
        )

    return fit_within(fit, angles)


def ds_msp_model(name: str) -> Fit:
    """Return what fits a camera model of ds-msp with its robust loss, boards flat."""

    def fit(data: Set, grid: Grid, focal: float) -> list[Fitted]:
        from ds_msp.calib import calibrate
        from ds_msp.models.registry import model_class, seed_from_K

        start = pinhole_matrix(data, focal)
        points, seen = board_points(data.train, grid, start)
        model = calibrate(
            seed_from_K(model_class(name), start),
            points,
            seen,
            [np.ones(len(uv), bool) for uv in seen],
        )['model']

        def project(xyz: Array) -> Array:
            uv, valid = model.project(xyz)
            return np.where(valid[:, None], uv, np.nan)

        return [Fitted(project, nominal_places)]

    return installed(fit)


def lensboy_model(config: Callable[[Any, Set], Any]) -> Fit:
    """Return what fits a model of lensboy with its warped board; it needs no start."""

    def fit(data: Set, grid: Grid, focal: float) -> list[Fitted]:
        import lensboy

        start = pinhole_matrix(data, focal)
        row, column = np.divmod(np.arange(grid.width**2), grid.width)
        square = grid.spacing * np.stack([column, row, 0.0 * row], axis=-1)
        on_board = np.unique([c + grid.width * r for c, r in grid.places.values()])

        frames = [
            lensboy.Frame(np.searchsorted(on_board, grid_numbers(points, grid)), uv)
            for points, uv in zip(*board_points(data.train, grid, start), strict=True)
        ]
        # In a process of its own, which may crash: splines do where a fit diverges.
        with ProcessPoolExecutor(1, mp_context=get_context('spawn')) as pool:
            try:
                camera, warp = pool.submit(
                    _lensboy_fit, square[on_board], frames, config(lensboy, data)
                ).result()
            except (cv2.error, BrokenProcessPool, RuntimeError, ValueError) as reason:
                raise NotHereError(f'finds no lens: {reason}') from reason
        board = warp.warp_target(square).reshape(grid.width, grid.width, 3)

        def project(xyz: Array) -> Array:
            before = np.isfinite(xyz).all(axis=1) & (xyz[:, 2] > 0)
            uv = np.full((len(xyz), 2), np.nan)
            if before.any():
                uv[before] = camera.project_points(xyz[before])
            return uv

        return [
            Fitted(project, lambda table: warped_places(table, grid, board), before=PLANE_LIMIT)
        ]

    return installed(fit)


def _lensboy_fit(*asked: Any) -> tuple[Any, Any]:
    """Return camera and warp as lensboy fits them, which prints each of its passes."""
    import lensboy

    with redirect_stdout(StringIO()):
        found = lensboy.calibrate_camera(*asked)
    return found.camera_model, found.target_warp


def _opencv(terms: str) -> Callable[[Any, Set], Any]:
    return lambda lensboy, data: lensboy.OpenCVConfig(
        *data.size[::-1], included_distortion_coefficients=getattr(lensboy.OpenCVConfig, terms)
    )


def _splined(lensboy: Any, data: Set) -> Any:
    return lensboy.PinholeSplinedConfig(*data.size[::-1], 16, 11)


PYTHON_PEERS: dict[str, Fit] = {
    'lensboy, rational': lensboy_model(_opencv('RADIAL_6')),
    'lensboy, 14 coefficients': lensboy_model(_opencv('FULL_14')),
    'lensboy, splined 16 x 11': lensboy_model(_splined),
    'calibsense, fisheye': installed(calibsense_fisheye),
    'ds-msp, Kannala-Brandt': ds_msp_model('kb'),
    'ds-msp, double sphere': ds_msp_model('ds'),
    'ds-msp, EUCM': ds_msp_model('eucm'),
    'ds-msp, DS+': ds_msp_model('dsplus'),
}
