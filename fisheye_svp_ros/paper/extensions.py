"""Past the paper: other solvers than SVP, and the range at which noise hides the SVP error."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.paper.lens_evaluation import (
    LensEvaluation,
    evaluate,
    landmarks_at,
    localize_environments,
    measure,
)
from fisheye_svp_ros.paper.tables import STYLE_NAMES
from fisheye_svp_ros.pose import PAPER_FROM_OPTICAL, Pose, rotation_from_vector
from fisheye_svp_ros.scene.observations import RADII, SPREADS, views_of
from fisheye_svp_ros.scene.rigs import BASELINE
from fisheye_svp_ros.solve.bundle_adjustment import adjust_lens
from fisheye_svp_ros.solve.localization import localize

CALIBRATION_NOISE = 0.2  # px
POSE_SETS = 40
_TILT, _ROLL = np.radians(12.0), np.radians(20.0)
_ASIDE, _BACK = 0.05, (-0.03, 0.12)  # m
_FREE = ('f', 'cx', 'cy', 'e0', 'e1', 'e2')
NOISES = (0.1, 0.2, 0.3, 0.4, 0.5)  # px
_RANGES = np.geomspace(0.2, 200.0, 28)  # m
_STEREO_RANGES = np.geomspace(0.2, 20.0, 10)  # m


class Crossings(NamedTuple):
    """Ranges, m, (5 noises) by row, at which an SVP error drops under the noise.

    NaN: above the noise up to the farthest range; 0: below it from the nearest.  lens, quantity,
    where: names; quantity: position (|z error| against its standard deviation), residual (mean
    residual against the noise) or Error2 (against the noise of one image point).
    """

    lens: str
    quantity: str
    where: str
    ranges: Array


def pose_sets(count: int = POSE_SETS) -> list[Pose]:
    """Return sets of ten random poses (10,) of the right camera, the same at every call.

    Tilts of up to some 25 degrees, rolls of some 20; the rig within 0.05 m of the axis of the
    landmarks, 0.03 m before to 0.12 m behind their center.
    """
    rng = np.random.default_rng(0)
    sets = []
    for _ in range(count):
        turns = rng.standard_normal((10, 3)) * [_TILT, _TILT, _ROLL]
        places = rng.uniform(-_ASIDE, _ASIDE, (10, 3))
        places[:, 2] = rng.uniform(*_BACK, 10)
        rotation = rotation_from_vector(turns) @ PAPER_FROM_OPTICAL
        sets.append(Pose(rotation, places + rotation[..., 0] * BASELINE / 2))
    return sets


def scaled_shift(lens: Lens, factor: float) -> Lens:
    """Return the lens with its viewpoint shift multiplied."""
    shift = lens.viewpoint_shift
    if shift is None:
        return lens
    return replace(lens, viewpoint_shift=shift.scale_by(factor))


def calibrated_shift(lens: Lens) -> Lens:
    """Return the lens as a calibration from 30 noisy views gives it, with `_FREE` to be found.

    Ten random poses among Whole at each radius, 0.2 px of noise, fixed seed.  s0 is kept: with
    free poses it cannot be told from where the camera's origin is said to be.
    """
    poses = pose_sets(len(RADII))
    right = Pose.concatenate(poses)
    points = np.repeat(
        np.stack([landmarks_at('whole', radius) for radius in RADII]),
        len(poses[0].position),
        axis=0,
    )
    exact = ForwardModel(lens).predict(right, views_of(points))
    noise = CALIBRATION_NOISE * np.random.default_rng(0).standard_normal(exact.uv.shape)
    views = views_of(points, exact.uv + noise)
    start = lens.svp()
    pose = localize(ForwardModel(start), views, right).pose
    svp = scaled_shift(lens, 0.0).with_parameters(['s0'], [lens.parameters['s0']])
    return adjust_lens(svp, views, pose, _FREE).lens


VARIANTS: dict[str, Callable[[Lens], Lens]] = {
    'SVP': Lens.svp,
    'ShiftVP': lambda lens: lens,
    'shift at 90 %': lambda lens: scaled_shift(lens, 0.9),
    'shift at 110 %': lambda lens: scaled_shift(lens, 1.1),
    'shift at 70 %': lambda lens: scaled_shift(lens, 0.7),
    'shift at 130 %': lambda lens: scaled_shift(lens, 1.3),
    'shift calibrated': calibrated_shift,
}


def evaluate_variant(lens: Lens, variant: str) -> LensEvaluation:
    """Evaluate a lens with the solver that a variant believes in."""
    return evaluate(lens, VARIANTS[variant](lens))


def crossings(lens: Lens) -> list[Crossings]:
    """Return at which ranges the SVP errors of a lens drop under the noise."""
    found = []
    for spread in SPREADS:
        points = np.stack([landmarks_at(spread, radius) for radius in _RANGES.tolist()])
        localized = localize_environments(lens, points)
        deviation = 1e3 * np.sqrt(localized.solved.covariance[:, 2, 2])  # mm for 1 px
        error = np.abs(localized.rows[:, 2])
        found.append(
            Crossings(lens.name, 'position', spread, _drops_under(_RANGES, error / deviation))
        )
        found.append(
            Crossings(lens.name, 'residual', spread, _drops_under(_RANGES, localized.rows[:, -1]))
        )
    for style in STYLE_NAMES:
        error2 = np.array(
            [measure(lens, radius, style).metrics['error2_px'] for radius in _STEREO_RANGES]
        )
        found.append(Crossings(lens.name, 'Error2', style, _drops_under(_STEREO_RANGES, error2)))
    return found


def _drops_under(ranges: Array, error: Array) -> Array:
    """Return the ranges beyond which an error (R,), px, stays under each of NOISES.

    Between two ranges the error is taken as a power of the range.
    """
    sums = np.zeros(len(NOISES))
    for i, noise in enumerate(NOISES):
        above = np.flatnonzero(error > noise)
        if not above.size:
            continue
        last = above[-1]
        if last == len(ranges) - 1:
            sums[i] = np.nan
            continue
        low, high = np.log(error[last : last + 2])
        along = (low - np.log(noise)) / (low - high)
        sums[i] = ranges[last] * (ranges[last + 1] / ranges[last]) ** along
    return sums
