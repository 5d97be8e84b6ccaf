"""The variance budget: of so many px^2, how much is lens, target, frame and noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from itertools import combinations
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Index
from fisheye_svp_ros.diagnosis.choice import SIGNIFICANCE
from fisheye_svp_ros.diagnosis.evidence import Evidence, Placed, pseudo_inverse, swept
from fisheye_svp_ros.diagnosis.mixed import factored
from fisheye_svp_ros.diagnosis.random_effects import NAMES, STAGE_OF
from fisheye_svp_ros.diagnosis.reml import GONE
from fisheye_svp_ros.diagnosis.score_tests import component_traces
from fisheye_svp_ros.diagnosis.similar_views import SimilarViews
from fisheye_svp_ros.effects.catalogue import CATALOGUE

REPEATED = 'frame_similar'
STAGES = ('lens', 'target', 'frame', 'noise')
_OF_FRAMES = {'focal_drift', 'session_step', 'rolling_shutter', 'stereo_time_offset', 'rig_flex',
              'dot_centroid', 'detector_bias'}
_OF_STAGE = {'target': 'target', 'noise': 'noise'}


class Component(NamedTuple):
    """One part of the misfit.

    sd_px: of a coordinate; share: of all, named_share: what of it has a name; p_value: of its
    being there at all.
    """

    name: str
    stage: str
    sd_px: float
    share: float
    named_share: float
    p_value: float


def stage_of(effect: str) -> str:
    """Return the stage of the budget that an effect belongs to."""
    if effect in _OF_FRAMES:
        return 'frame'
    return _OF_STAGE.get(CATALOGUE[effect].stage, 'lens')


def cause_squares(evidence: Evidence, causes: Sequence[Placed]) -> dict[str, float]:
    """Return the mean squared displacement of each cause, px^2, poses and intrinsics taken out.

    What causes do together is shared between them by Shapley's value: the mean, over all orders,
    of what each adds to those before it.  None is negative, even where two undo each other, and
    the sum is what all of them do.

    Source: Lindeman, Merenda and Gold, Introduction to Bivariate and Multivariate Analysis (1980),
    section 4.3.
    """
    nothing = np.full(len(NAMES), GONE)
    f = factored(
        evidence.full.trimmed(nothing < GONE), nothing, evidence.variances.weight
    )
    every = np.zeros(evidence.own)
    named = [columns for _, columns, _ in causes]
    for _, columns, values in causes:
        every[columns] = values * evidence.scale[columns]
    rest = np.setdiff1d(np.arange(evidence.own), _joined(named))
    remaining = swept(f.information, rest)[: evidence.own, : evidence.own]
    signal = remaining @ every

    @cache
    def explained(some: tuple[int, ...]) -> float:
        mine = _joined([named[one] for one in some])
        inverse, _ = pseudo_inverse(remaining[np.ix_(mine, mine)])
        return float(signal[mine] @ inverse @ signal[mine])

    px2, count = _px2(evidence), len(causes)
    squares = {}
    for one, (effect, _, _) in enumerate(causes):
        others = [other for other in range(count) if other != one]
        added = [np.mean([explained(tuple(sorted((*some, one)))) - explained(some)
                          for some in combinations(others, size)]) for size in range(count)]
        squares[effect.name] = max(float(np.mean(added)), 0.0) * px2
    return squares


def _joined(columns: Sequence[Index]) -> Index:
    return np.concatenate([np.zeros(0, dtype=np.int64), *columns])


def _px2(evidence: Evidence) -> float:
    """Return the factor from whitened squares to px^2 a point."""
    weight = evidence.linear.weight[evidence.linear.weight > 0]
    return float(2 / evidence.full.rows * np.mean(1 / weight**2))


def budget(
    evidence: Evidence, squares: Mapping[str, float], p_values: Mapping[str, float],
    causes: Mapping[str, float], repeated: SimilarViews | None = None,
) -> list[Component]:
    """Return all parts: of the catalogue (p-values by name), random components, noise.

    squares: of the effects that were found (`cause_squares`); causes: their p-values; p_values:
    of the random components that are there; repeated: what of the noise comes again in similar
    views.
    """
    px, variances = _px2(evidence), evidence.variances
    traces = component_traces(evidence.full, evidence.variances)
    parts: list[tuple[str, str, float, bool, float]] = []
    for stage in STAGES[:3]:
        there = [name for name in squares if stage_of(name) == stage]
        if there:
            size = sum(squares[name] for name in there)
            parts.append((f'named_{stage}', stage, size, True, min(causes[n] for n in there)))
    for i, name in enumerate(NAMES):
        if traces.get(name, 0.0) > 0:
            size = float(variances.tau[i] ** 2 * traces[name]) * px
            parts.append((name, STAGE_OF[name], size, False, p_values.get(name, 1.0)))
    freedom = evidence.full.rows - evidence.full.poses - evidence.own
    noise = variances.sigma**2 * freedom * px
    if repeated is not None:
        parts.append((REPEATED, 'frame', repeated.share * noise, False, repeated.p_value))
        noise *= 1 - repeated.share
    parts.append(('noise', 'noise', noise, False, 0.0))
    total = sum(size for _, _, size, _, _ in parts)
    return [
        Component(name, stage, float(np.sqrt(size / 2)), size / total, known * size / total, p)
        for name, stage, size, known, p in parts
    ]


def found_components(components: list[Component]) -> list[Component]:
    """Return the random components that are there beyond chance."""
    held = [c for c in components if c.name in (*NAMES, REPEATED)]
    return [c for c in held if c.p_value * len(NAMES) < SIGNIFICANCE]


def stage_shares(components: list[Component]) -> dict[str, tuple[float, float]]:
    """Return the share of each stage and what of it has a name."""
    return {
        stage: (
            sum(c.share for c in components if c.stage == stage),
            sum(c.named_share for c in components if c.stage == stage),
        )
        for stage in STAGES
    }


def noise_px(evidence: Evidence) -> float:
    """Return the standard deviation of the noise of one coordinate, px."""
    weight = evidence.linear.weight[evidence.linear.weight > 0]
    return float(evidence.variances.sigma * np.sqrt(np.mean(1 / weight**2)))
