"""Rows: calibration of a stereo rig from views of a board."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial

import numpy as np

from benchmark.speed import engines
from benchmark.speed.harness import Row, Side, require
from benchmark.speed.peers import TOLERANCE
from benchmark.speed.rig_adjustment import gtsam_rig, mrcal_pose, mrcal_rig, opencv_rig, scipy_rig
from benchmark.speed.scenes import StereoScene, stereo, svp_lens
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.optics.curves import Stereographic
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.solve.stereo_calibration import calibrate_stereo

OPENCV = 'cv2.fisheye.stereoCalibrate'
_EXACT = 1e-14
_PEERS = {
    OPENCV: ('cv2', opencv_rig, 'finds its own start'),
    'GTSAM': ('gtsam', gtsam_rig, 'two custom factors a view, with the hand-written C'),
    'SciPy': ('scipy', partial(scipy_rig, tolerance=TOLERANCE), 'dense, with the hand-written C'),
}


def rows(views: int = 10, repeats: int = 15) -> list[Row]:
    """Return the rows about a rig and `views` poses."""
    return [_kannala_brandt(views, repeats), _stereographic(views, repeats)]


def _kannala_brandt(views: int, repeats: int) -> Row:
    scene = stereo(svp_lens(), views)
    off = _off(scene)
    makers = _ours(scene, off)
    makers |= {name: partial(_peer, name, *peer, scene, off) for name, peer in _PEERS.items()}
    return _row(
        scene,
        'SVP Kannala-Brandt',
        makers,
        repeats,
        [('numpy', OPENCV, 4), ('numba', OPENCV, 20), ('numpy, own start', OPENCV, 1.5)],
    )


def _stereographic(views: int, repeats: int) -> Row:
    scene = stereo(replace(svp_lens(), image_height=Stereographic()), views)
    off = _off(scene)
    with ExitStack() as stack:

        def mrcal() -> Side:
            run = stack.enter_context(mrcal_rig(scene))
            run()  # if it ends by itself, its row is left out
            return Side(
                'mrcal',
                run,
                1.0,
                lambda answer: off(mrcal_pose(answer)),
                lambda answer: float(answer['seconds']),
                'in a process of its own that reports its own time',
            )

        makers = _ours(scene, off)
        return _row(
            scene,
            'SVP stereographic',
            makers | {'mrcal': mrcal},
            repeats,
            [('numba', 'mrcal', 3.0)],
        )


def _peer(
    name: str,
    module: str,
    solve: Callable[[StereoScene], Pose],
    note: str,
    scene: StereoScene,
    off: Callable[[Pose], float],
) -> Side:
    require(module)
    return Side(name, lambda: solve(scene), error=off, note=note)


def _ours(scene: StereoScene, off: Callable[[Pose], float]) -> dict[str, Callable[[], Side]]:
    """Return sides that begin where the peers begin, and sides that find their own start."""
    model = ForwardModel(scene.lens)
    given = scene.pose.take(None), scene.rig.take(None)

    def run(start: tuple[Pose, Pose] | None) -> Pose:
        return calibrate_stereo(model, model, scene.left, scene.right, start=start).rig.take(0)

    return {
        **engines.sides(partial(run, given), error=off),
        **engines.sides(partial(run, None), ', own start', error=off),
    }


def _off(scene: StereoScene) -> Callable[[Pose], float]:
    exact = scipy_rig(scene, _EXACT, exact=True)
    return lambda rig: float(np.linalg.norm(rig.position - exact.position))


def _row(
    scene: StereoScene,
    lens: str,
    makers: dict[str, Callable[[], Side]],
    repeats: int,
    goals: list[tuple[str, str, float]],
) -> Row:
    views, board = len(scene.left.uv), len(scene.board)
    title = f'Stereo calibration, {views} × {board}, {6 * views + 6} unknowns, {lens}'
    return engines.row(title, ('ms', 1e-3), makers, repeats, goals)
