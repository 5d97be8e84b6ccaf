"""Rows: projection of points, with and without the derivatives by the pose."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from benchmark.speed import engines
from benchmark.speed.compiled import Kernel, MrcalCore
from benchmark.speed.harness import Row, Side, require
from benchmark.speed.peers import camera_matrix
from benchmark.speed.scenes import points, shift_lens, svp_lens
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import identity
from fisheye_svp_ros.scene.observations import views_of

KERNEL = 'hand-written C'
MRCAL = "mrcal's CAHVORE core"
OPENCV = 'cv2.fisheye.projectPoints'
_UNIT = ('ns a point', 1e-9)
_WIDEST = {'shift': np.radians(100.0), 'svp': np.radians(80.0)}


def rows(count: int = 100_000, repeats: int = 15) -> list[Row]:
    """Return the rows about `count` points."""
    return [_project(count, repeats), _project_with_pose(count, repeats), _svp(count, repeats)]


def _project(count: int, repeats: int) -> Row:
    lens, seen = shift_lens(), points(count, _WIDEST['shift'])
    exact = project(lens, seen).uv

    def ours() -> Array:
        return project(lens, seen).uv

    def kernel() -> Side:
        compiled = Kernel(lens)
        return Side(KERNEL, lambda: compiled.project(seen), count, _off(exact))

    def mrcal() -> Side:
        core = MrcalCore(lens)
        own = core.prepared(seen)
        return Side(MRCAL, lambda: core.project(own), count, _off(exact))

    return engines.row(
        'Projection, ShiftVP',
        _UNIT,
        engines.sides(ours, work=count, error=_off(exact)) | {KERNEL: kernel, MRCAL: mrcal},
        repeats,
        [('numpy', MRCAL, 1.3), ('numba', MRCAL, 4.5), ('numba', KERNEL, 1 / 1.5)],
        'px',
    )


def _linearized(lens: Lens, seen: Array) -> tuple[Callable[[], Array], Callable[[], Side], Array]:
    """Return projection with derivatives by the pose, ours and as a kernel, and its result."""
    model, pose = ForwardModel(lens), identity(1)
    views = views_of(seen, np.zeros((1, len(seen), 2)))
    exact = model.linearize(pose, views).uv[0]

    def ours() -> Array:
        return model.linearize(pose, views).uv[0]

    def kernel() -> Side:
        compiled = Kernel(lens)
        return Side(
            KERNEL, lambda: compiled.linearize(seen, *pose.take(0))[0], len(seen), _off(exact)
        )

    return ours, kernel, exact


def _project_with_pose(count: int, repeats: int) -> Row:
    lens, seen = shift_lens(), points(count, _WIDEST['shift'])
    ours, kernel, exact = _linearized(lens, seen)

    def mrcal() -> Side:
        core = MrcalCore(lens)
        own = core.prepared(seen)
        return Side(
            MRCAL,
            lambda: core.project_with_gradient(own)[0],
            count,
            _off(exact),
            note='differentiates by the point only, by automatic differentiation',
        )

    return engines.row(
        'Projection with derivatives by the pose, ShiftVP',
        _UNIT,
        engines.sides(ours, work=count, error=_off(exact)) | {KERNEL: kernel, MRCAL: mrcal},
        repeats,
        [('numpy', MRCAL, 2.0), ('numba', MRCAL, 6.0)],
        'px',
    )


def _svp(count: int, repeats: int) -> Row:
    lens, seen = svp_lens(), points(count, _WIDEST['svp'])
    ours, kernel, exact = _linearized(lens, seen)

    def opencv() -> Side:
        require('cv2')
        import cv2

        matrix, k = camera_matrix(lens)
        still = np.zeros(3)
        return Side(
            OPENCV,
            lambda: cv2.fisheye.projectPoints(seen[:, None], still, still, matrix, k)[0][:, 0],
            count,
            _off(exact),
            note='differentiates by the intrinsics, too',
        )

    return engines.row(
        'Projection with derivatives by the pose, SVP Kannala-Brandt',
        _UNIT,
        engines.sides(ours, work=count, error=_off(exact)) | {KERNEL: kernel, OPENCV: opencv},
        repeats,
        [('numpy', OPENCV, 1.8), ('numba', OPENCV, 4.0)],
        'px',
    )


def _off(exact: Array) -> Callable[[Array], float]:
    return lambda uv: float(np.abs(uv - exact).max())
