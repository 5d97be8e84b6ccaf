"""What is left: whether residuals still depend on anything, without a model of what."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy import special

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.budget import Component
from fisheye_svp_ros.diagnosis.choice import SIGNIFICANCE
from fisheye_svp_ros.diagnosis.doubt import confident
from fisheye_svp_ros.diagnosis.evidence import Evidence, swept
from fisheye_svp_ros.diagnosis.refit import Fitted
from fisheye_svp_ros.diagnosis.residuals import ripples, standardised_squares

_VARIABLE = {'image': 'image', 'landmark': 'landmark', 'board': 'landmark', 'frame': 'frame'}
_TOLERATED = 1.2  # a stated sigma is an estimate, too: of a detector, or of a person
_FEWEST = 200  # numbers beyond the poses' own: of fewer no test of structure says anything


class Structure(NamedTuple):
    """One variable that residuals may depend on: the test's p-value (corrected) and its share.

    share: the part of the misfit that goes with it.
    """

    variable: str
    p_value: float
    share: float


def remaining_structure(
    evidence: Evidence, fitted: Fitted, components: Sequence[Component], known_noise: bool
) -> list[Structure]:
    """Return the variables that residuals depend on beyond chance.

    Random components by the variable they live on; smooth fields over others, tested beside the
    components; the scatter.  known_noise: whether the table states sigma, so that the size itself
    can be tested.
    """
    found: dict[str, Structure] = {}
    for part in components:
        name = _VARIABLE[part.name.partition('_')[0]]
        old = found.get(name, Structure(name, 1.0, 0.0))
        found[name] = Structure(name, min(old.p_value, part.p_value), old.share + part.share)
    full = evidence.full
    if full.rows - full.poses - evidence.own < _FEWEST:
        return list(found.values())
    tests = [*_field_tests(evidence), *_scatter_tests(fitted, known_noise)]
    tests.append(('image', float(special.ndtr(-ripples(fitted))), 0.0))
    for name, p, share in tests:
        corrected = min(1.0, p * len(tests))
        if corrected < SIGNIFICANCE and name not in found:
            found[name] = Structure(name, corrected, share)
    return list(found.values())


def _field_tests(evidence: Evidence) -> Iterator[tuple[str, float, float]]:
    own = np.arange(evidence.own)
    remaining = swept(evidence.information, own)
    total = float((evidence.linear.residual**2).sum())
    for name, columns in evidence.probes.items():
        score = confident(evidence, evidence.score(remaining, columns), own, columns)
        explained = (score.statistic - score.rank) * evidence.variances.sigma**2
        yield name, score.p_value, max(explained, 0.0) / total


def _scatter_tests(fitted: Fitted, known_noise: bool) -> Iterator[tuple[str, float, float]]:
    """Tests of the size of residuals, not of their sign."""
    linear = fitted.linear
    e2 = standardised_squares(fitted)
    used = linear.used
    # A normal quantile of the heaviest numbers: points in pairs, leverages estimated.
    largest = float(e2[used].max())
    p = min(1.0, used.sum() * float(special.chdtrc(1, largest)))
    yield 'outliers', p, largest / float(e2.sum())
    theta = linear.data.blocks(np.nan_to_num(linear.scene.theta)[..., None] * np.ones(2))
    yield 'scatter_vs_theta', _trend(e2[used], theta[used] ** 2), 0.0
    labels = np.broadcast_to(np.arange(used.shape[0])[:, None], used.shape)[used]
    if labels.any():
        yield 'scatter_vs_frame', _groups(e2[used], labels), 0.0
    if known_noise:
        eq = fitted.factored.equations
        freedom = eq.rows - eq.poses - len(fitted.solution.values)
        squares = fitted.solution.variance * freedom
        larger = special.chdtrc(freedom, squares / _TOLERATED**2)
        smaller = special.chdtr(freedom, squares * _TOLERATED**2)
        yield 'size', 2 * float(min(larger, smaller)), 0.0


def _trend(e2: Array, z: Array) -> float:
    """Koenker's studentised Breusch-Pagan test of e2 against one variable."""
    centred = e2 - e2.mean(), z - z.mean()
    spread = float((centred[0] ** 2).sum() * (centred[1] ** 2).sum())
    r2 = float((centred[0] * centred[1]).sum()) ** 2 / max(spread, 1e-300)
    return float(special.chdtrc(1, len(e2) * r2))


def _groups(e2: Array, labels: Index) -> float:
    """Koenker's test against group membership."""
    counts = np.bincount(labels)
    sums = np.bincount(labels, weights=e2 - e2.mean())
    explained = float((sums**2 / np.maximum(counts, 1)).sum())
    statistic = explained / max(float(e2.var()), 1e-300)
    return float(special.chdtrc(int((counts > 0).sum()) - 1, statistic))
