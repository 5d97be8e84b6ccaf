"""Rows: self-localization of one view and of many."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from benchmark.speed import engines
from benchmark.speed.adjustment import exact_view, scipy_pose
from benchmark.speed.harness import Row, Side, require
from benchmark.speed.peers import LOCALIZERS, Solve
from benchmark.speed.scenes import Scene, localization, shift_lens, svp_lens
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.solve.localization import localize

_CHECKED = 50  # views whose answers are compared
_EXACT = 1e-14
_UNIT = ('µs each', 1e-6)
_NOTES = {
    'poselib': 'tolerances 1e-10, no robust loss',
    'pycolmap': 'gradient tolerance 1e-10; ends by a looser one of its own',
    'cv2.fisheye.solvePnP': 'another optimum: least squares in the undistorted plane',
    'GTSAM': 'one custom factor a view, with the hand-written C',
    'SciPy': "least_squares, method 'lm', tolerances 1e-10, with the hand-written C",
}
_ANY_LENS = ('GTSAM', 'SciPy')


def rows(many: int = 10_000, looped: int = 100, repeats: int = 7) -> list[Row]:
    """Return the rows about one view and about `many`; the peers loop over `looped` of them."""
    svp, shift = svp_lens(), shift_lens()
    return [
        _one(localization(svp, looped), repeats),
        _many(
            'SVP Kannala-Brandt',
            localization(svp, many),
            looped,
            repeats,
            [
                ('numpy', 'poselib', 1.3),
                ('numpy', 'GTSAM', 15.0),
                ('numba', 'poselib', 4.0),
                ('numba', 'GTSAM', 40.0),
            ],
        ),
        _many('ShiftVP', localization(shift, many), looped, repeats, []),
    ]


def _one(scene: Scene, repeats: int) -> Row:
    model, truth = ForwardModel(scene.lens), _exact_positions(scene)
    views = [scene.views.take([i]) for i in range(len(truth))]
    starts = [scene.start.take([i]) for i in range(len(views))]

    def ours() -> Array:
        return np.concatenate(
            [
                localize(model, view, start).pose.position
                for view, start in zip(views, starts, strict=True)
            ]
        )

    makers = engines.sides(ours, work=len(views), error=_off(truth))
    makers |= _peers(scene, len(views), truth)
    return engines.row(
        'One localization at a time, SVP Kannala-Brandt',
        _UNIT,
        makers,
        repeats,
        [('numba', 'poselib', 2.5)],
    )


def _many(
    lens: str, scene: Scene, looped: int, repeats: int, goals: list[tuple[str, str, float]]
) -> Row:
    model, truth = ForwardModel(scene.lens), _exact_positions(scene)
    total = len(scene.views.uv)

    def ours() -> Array:
        return localize(model, scene.views, scene.start).pose.position

    makers = engines.sides(ours, work=total, error=_off(truth))
    makers |= _peers(scene, min(looped, total), truth)
    return engines.row(f'{total} localizations, {lens}', _UNIT, makers, repeats, goals)


def _peers(scene: Scene, looped: int, truth: Array) -> dict[str, Callable[[], Side]]:
    def make(name: str, module: str, prepare: Callable[[Scene], Solve]) -> Side:
        require(module)
        first = scene._replace(
            views=scene.views.take(slice(looped)), start=scene.start.take(slice(looped))
        )
        solve = prepare(first)

        def run() -> Array:
            return np.stack([solve(i).position for i in range(looped)])

        return Side(name, run, looped, _off(truth), note=_NOTES[name])

    return {
        name: partial(make, name, *peer)
        for name, peer in LOCALIZERS.items()
        if scene.lens.viewpoint_shift is None or name in _ANY_LENS
    }


def _exact_positions(scene: Scene) -> Array:
    views = [exact_view(scene.lens, scene.landmarks, uv) for uv in scene.views.uv[:_CHECKED]]
    return np.stack(
        [
            scipy_pose(view, scene.start.take(i), _EXACT, exact=True).position
            for i, view in enumerate(views)
        ]
    )


def _off(truth: Array) -> Callable[[Array], float]:
    def error(positions: Array) -> float:
        return float(
            np.linalg.norm(positions[: len(truth)] - truth[: len(positions)], axis=1).max()
        )

    return error
