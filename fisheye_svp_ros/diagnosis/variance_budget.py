"""The variance budget: of so many px^2, how much is lens, target, frame and noise; what remains.

Random components and what has a name, with p-values; then whether residuals still depend on
anything, without a model of what; last, whether the noise grows with the incidence angle.  What no
static field has taken up is no noise: it errs by the same wherever a point falls on the same place
of the image, and landmarks of another color err in proportion to the image height.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from itertools import combinations
from typing import NamedTuple

import numpy as np
import scipy
from scipy import special

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.effect_tests import SIGNIFICANCE, EffectTests
from fisheye_svp_ros.diagnosis.fitted_model import MIN_PAIRS, FittedModel
from fisheye_svp_ros.diagnosis.null_model import NullModel
from fisheye_svp_ros.diagnosis.random_effects import NAMES, STAGE_OF
from fisheye_svp_ros.diagnosis.similar_views import SimilarViews
from fisheye_svp_ros.effects.base import ModelTerm
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.mixed_model import (
    component_p_values,
    component_squares,
    eliminate,
    factor_equations,
    no_variances,
    pseudo_inverse,
)
from fisheye_svp_ros.solve.outliers import Outliers

REPEATED_COMPONENT = 'frame_similar'
STAGES = ('lens', 'target', 'frame', 'noise')
_VARIABLE_OF = {'image': 'image', 'landmark': 'landmark', 'board': 'landmark', 'frame': 'frame'}
_SIGMA_TOLERANCE = 1.2  # a stated sigma is an estimate, too: of a detector, or of a person
_MIN_FREEDOM = 200  # numbers beyond the poses' own: of fewer no test of structure says anything
_LARGEST_SQUARE = 20.0  # of a standardized residual: an outlier counts no more
_LANDMARK_SIGMAS = 2.6  # standard errors of the growth, within landmarks
_ACROSS_SIGMAS, _ACROSS_SHARE = 2.0, 0.5  # of that across the radius; its share of the growth
_CLOSEST_PAIRS = 500
_RING = 10  # points of nearly the same height
_MIN_REST = 0.2  # of a variance, beside the leverage
_PLACE_SIGMAS = 2.0  # and of that between points on the same place


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


def cause_squares(null: NullModel, causes: Sequence[ModelTerm]) -> dict[str, float]:
    """Return the mean squared displacement of each cause, px^2, poses and intrinsics taken out.

    What causes do together is shared between them by Shapley's value: the mean, over all orders,
    of what each adds to those before it.  None is negative, even where two undo each other, and
    the sum is what all of them do.

    Source: Lindeman, Merenda and Gold, Introduction to Bivariate and Multivariate Analysis (1980),
    section 4.3.
    """
    nothing = no_variances(len(NAMES), len(null.variances.weight))
    f = factor_equations(null.full.select(nothing.alive), nothing.lam, null.variances.weight)
    every = np.zeros(null.column_count)
    owner = np.full(null.column_count, -1)
    for number, cause in enumerate(causes):
        every[cause.columns] = cause.values * null.scale[cause.columns]
        owner[cause.columns] = number
    rest = np.flatnonzero(owner < 0)
    remaining = eliminate(f.information, rest)[: null.column_count, : null.column_count]
    signal = remaining @ every

    @cache
    def explained_square(some: tuple[int, ...]) -> float:
        mine = np.flatnonzero(np.isin(owner, some))
        return float(signal[mine] @ pseudo_inverse(remaining[np.ix_(mine, mine)]) @ signal[mine])

    px2, count = _px2(null), len(causes)
    squares = {}
    for number, cause in enumerate(causes):
        others = [other for other in range(count) if other != number]
        added = [
            np.mean(
                [
                    explained_square(tuple(sorted((*some, number)))) - explained_square(some)
                    for some in combinations(others, size)
                ]
            )
            for size in range(count)
        ]
        squares[cause.name] = max(float(np.mean(added)), 0.0) * px2
    return squares


def _px2(null: NullModel) -> float:
    """Return the factor from whitened squares to px^2 a point."""
    weight = null.linear.weight[null.linear.weight > 0]
    return float(2 / null.full.rows * np.mean(1 / weight**2))


def variance_budget(
    null: NullModel,
    fitted: FittedModel,
    squares: Mapping[str, float],
    p_values: Mapping[str, float],
    repeated: SimilarViews | None = None,
) -> list[Component]:
    """Return all parts: what is named, random components, noise.

    fitted: of the null model; squares: of the effects that were found (`cause_squares`); p_values:
    of effects and of the random components that are there, by name; repeated: what of the noise
    comes again in similar views.
    """
    px2, variances = _px2(null), null.variances
    added = component_squares(null.full, fitted.factored, variances)
    parts: list[tuple[str, str, float, bool, float]] = []
    for stage in STAGES[:3]:
        there = [name for name in squares if CATALOGUE[name].budget_stage() == stage]
        if there:
            size = sum(squares[name] for name in there)
            parts.append((f'named_{stage}', stage, size, True, min(p_values[n] for n in there)))
    for name, sum_of_squares in zip(NAMES, added.tolist(), strict=True):
        if sum_of_squares > 0:
            size = variances.sigma**2 * sum_of_squares * px2
            parts.append((name, STAGE_OF[name], size, False, p_values.get(name, 1.0)))
    noise = 2 * scatter_px(null) ** 2
    if repeated is not None:
        size = repeated.share * noise
        parts.append((REPEATED_COMPONENT, 'frame', size, False, repeated.p_value))
        noise *= 1 - repeated.share
    parts.append(('noise', 'noise', noise, False, 0.0))
    total = sum(size for _, _, size, _, _ in parts)
    return [
        Component(name, stage, float(np.sqrt(size / 2)), size / total, known * size / total, p)
        for name, stage, size, known, p in parts
    ]


def component_significance(null: NullModel) -> dict[str, float]:
    """Return the p-values of the random components that have a variance, by name."""
    p_values = component_p_values(null.equations_of(null.included_columns), null.variances)
    return {
        name: float(p)
        for name, p, alive in zip(NAMES, p_values, null.variances.alive, strict=True)
        if alive
    }


def significant_components(components: Sequence[Component]) -> list[Component]:
    """Return the random components that are there beyond chance."""
    held = [c for c in components if c.name in (*NAMES, REPEATED_COMPONENT)]
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


def noise_px(null: NullModel) -> float:
    """Return the standard deviation of the noise of one coordinate, px."""
    weight = null.linear.weight[null.linear.weight > 0]
    return float(null.variances.sigma * np.sqrt(np.mean(1 / weight**2)))


def scatter_px(null: NullModel) -> float:
    """Return the standard deviation of what noise leaves of a fitted coordinate, px."""
    return float(np.sqrt(null.variances.sigma**2 * null.freedom * _px2(null) / 2))


class Structure(NamedTuple):
    """One variable that residuals may depend on: the test's p-value (corrected) and its share.

    share: the part of the misfit that goes with it.
    """

    variable: str
    p_value: float
    share: float


def remaining_structure(
    tests: EffectTests, fitted: FittedModel, components: Sequence[Component], known_noise: bool
) -> list[Structure]:
    """Return the variables that residuals depend on beyond chance.

    Random components by the variable they live on; smooth fields over others, tested beside the
    components; the scatter.  known_noise: whether the table states sigma, so that the size itself
    can be tested.
    """
    found: dict[str, Structure] = {}
    for part in components:
        name = _VARIABLE_OF[part.name.partition('_')[0]]
        old = found.get(name, Structure(name, 1.0, 0.0))
        found[name] = Structure(name, min(old.p_value, part.p_value), old.share + part.share)
    if tests.null.freedom < _MIN_FREEDOM:
        return list(found.values())
    p_values = [*_field_tests(tests), *_scatter_tests(fitted, known_noise)]
    p_values.append(('image', float(special.ndtr(-fitted.place_correlation())), 0.0))
    for name, p, share in p_values:
        corrected = min(1.0, p * len(p_values))
        if corrected < SIGNIFICANCE and name not in found:
            found[name] = Structure(name, corrected, share)
    return list(found.values())


def _field_tests(tests: EffectTests) -> Iterator[tuple[str, float, float]]:
    null = tests.null
    remaining = eliminate(null.information, null.included_columns)
    total = float((null.linear.residual**2).sum())
    for name, columns in null.fixed.fields.items():
        score = tests.adjust_p_value(
            tests.score(remaining, columns), null.included_columns, columns
        )
        explained = (score.statistic - score.rank) * null.variances.sigma**2
        yield name, score.p_value, max(explained, 0.0) / total


def _scatter_tests(fitted: FittedModel, known_noise: bool) -> Iterator[tuple[str, float, float]]:
    """Tests of the size of residuals, not of their sign."""
    linear = fitted.linear
    e2 = fitted.standardized_squares()
    used = linear.row_mask
    # A normal quantile of the heaviest numbers: points in pairs, leverages estimated.
    largest = float(e2[used].max())
    p = min(1.0, used.sum() * float(special.chdtrc(1, largest)))
    yield 'outliers', p, largest / float(e2.sum())
    theta = linear.data.blocks(np.nan_to_num(linear.scene.theta)[..., None] * np.ones(2))
    yield 'scatter_vs_theta', _trend_p_value(e2[used], theta[used] ** 2), 0.0
    if (frame := np.nonzero(used)[0]).any():
        yield 'scatter_vs_frame', _group_p_value(e2[used], frame), 0.0
    if known_noise:
        eq = fitted.factored.equations
        freedom = eq.rows - eq.group_rank - len(fitted.solution.values)
        squares = fitted.solution.variance * freedom
        larger = special.chdtrc(freedom, squares / _SIGMA_TOLERANCE**2)
        smaller = special.chdtr(freedom, squares * _SIGMA_TOLERANCE**2)
        yield 'size', 2 * float(min(larger, smaller)), 0.0


def _trend_p_value(e2: Array, z: Array) -> float:
    """Koenker's studentised Breusch-Pagan test of e2 against one variable."""
    centerd = e2 - e2.mean(), z - z.mean()
    spread = float((centerd[0] ** 2).sum() * (centerd[1] ** 2).sum())
    r2 = float((centerd[0] * centerd[1]).sum()) ** 2 / max(spread, 1e-300)
    return float(special.chdtrc(1, len(e2) * r2))


def _group_p_value(e2: Array, labels: Index) -> float:
    """Koenker's test against group membership."""
    counts = np.bincount(labels)
    sums = np.bincount(labels, weights=e2 - e2.mean())
    explained = float((sums**2 / np.maximum(counts, 1)).sum())
    statistic = explained / max(float(e2.var()), 1e-300)
    return float(special.chdtrc(int((counts > 0).sum()) - 1, statistic))


def add_outliers(left: list[Structure], outliers: Outliers, observations: int) -> list[Structure]:
    """Return what remains, with outliers that are no mere wrong ids."""
    far = len(outliers.rows) - outliers.swap_count
    if not far:
        return left
    rest = [s for s in left if s.variable != 'outliers']
    return [*rest, Structure('outliers', 0.0, far / observations)]


class NoiseGrowth(NamedTuple):
    """Noise that changes: value, standard error, p-value; variance (F, M): over the mean one."""

    value: float
    stderr: float
    p_value: float
    variance: Array


def noise_growth(fitted: FittedModel) -> NoiseGrowth:
    """Fit sigma(theta) = sigma0 exp(growth theta^2) to residuals (likelihood ratio).

    There is none where the same landmarks do not scatter more at larger angles, or points of
    different frames on the same place do not: some landmarks, or places, err more than others.
    Nor where they do so along the radius alone, as ripples of a lens and its colors make them.
    """
    linear = fitted.linear
    used = linear.row_mask
    errors, landmark = _scatter(fitted)
    theta = linear.data.blocks(np.nan_to_num(linear.scene.theta)[..., None] * np.ones(2))
    every = theta**2 - (theta[used] ** 2).mean()
    z, e2 = every[used], np.minimum(errors.ravel() ** 2, _LARGEST_SQUARE)
    value, gain = _fit_growth(e2, z)
    # Heavier tails than the normal distribution's scatter the squares more.
    tails = max(float(e2.var()) / 2, 1.0)
    stderr = float(np.sqrt(tails / 2 / (z**2).sum()))
    sign, pairs = np.sign(value), fitted.point_pairs()
    frame, across = np.nonzero(used)[0], _fit_growth(e2[1::2], z[1::2])[0]
    confirmed = (
        sign * across > _ACROSS_SHARE * abs(value)
        and sign * _growth_within(e2, z, np.repeat(landmark, 2), frame) > _LANDMARK_SIGMAS
        and sign * _growth_within(e2[1::2], z[1::2], landmark, frame[1::2]) > _ACROSS_SIGMAS
        and sign * _growth_on_places(errors, z[::2], *pairs) > _PLACE_SIGMAS
    )
    p = float(special.chdtrc(1, max(gain / tails, 0.0))) if confirmed else 1.0
    level = float(np.mean(e2 * np.exp(-2 * value * z)))
    return NoiseGrowth(value, stderr, p, level * np.exp(2 * value * every))


def _fit_growth(e2: Array, z: Array) -> tuple[float, float]:
    """Return the likeliest growth of squares (M,) with centered z (M,), and twice its log odds."""

    def deviance(growth: float) -> float:
        # The mean of log sigma does not change: only the scale is profiled out.
        return float(len(z) * np.log(np.mean(e2 * np.exp(-2 * growth * z))))

    best = scipy.optimize.minimize_scalar(deviance, bounds=(-3.0, 3.0), method='bounded')
    return float(best.x), deviance(0.0) - float(best.fun)


def _scatter(fitted: FittedModel) -> tuple[Array, Index]:
    """Return standardized residuals (N, 2) along and across the radius, and landmarks (N,).

    What a lens does to each color, a magnification of each landmark's own, and its static radial
    error, however fine, are taken out.
    """
    linear = fitted.linear
    used = linear.row_mask
    errors = fitted.standardized_residuals[used].reshape(-1, 2)
    centers = np.array([[lens.cx, lens.cy] for lens in linear.state.lenses])
    center = centers[np.minimum(linear.data.camera_of, len(centers) - 1)][:, None]
    arm = linear.data.blocks(np.nan_to_num(linear.linear.uv - center))[used].reshape(-1, 2)
    landmark, camera = (
        linear.data.blocks(of[..., None] * np.ones(2))[used][::2].astype(np.int64)
        for of in (
            linear.data.views.landmark,
            np.broadcast_to(linear.data.camera_of[:, None], linear.weight.shape),
        )
    )
    height = np.maximum(np.linalg.norm(arm, axis=1), 1e-9)
    radial = (errors * arm).sum(axis=1) / height
    across = (errors[:, 1] * arm[:, 0] - errors[:, 0] * arm[:, 1]) / height
    return np.stack(
        [_without_profile(_without_colors(radial, height, landmark), height, camera), across],
        axis=-1,
    ), landmark


def _without_colors(radial: Array, height: Array, landmark: Index) -> Array:
    """Return radial residuals (N,) without a part in proportion to the height, by landmark."""
    along, square = (np.bincount(landmark, weights=of) for of in (height * radial, height**2))
    factor = along / np.maximum(square, 1e-300)
    leverage = np.clip(height**2 / np.maximum(square, 1e-300)[landmark], 0.0, 0.8)
    return np.asarray((radial - factor[landmark] * height) / np.sqrt(1 - leverage))


def _without_profile(radial: Array, height: Array, camera: Index) -> Array:
    """Return radial residuals (N,) without a line through those of nearly the same height."""
    order, left = np.lexsort((height, camera)), radial.copy()
    for ring in np.array_split(order, max(len(order) // _RING, 1)):
        line = np.linalg.qr(np.stack([np.ones(len(ring)), height[ring]], axis=1))[0]
        rest = np.maximum(1 - (line**2).sum(axis=1), _MIN_REST)
        left[ring] = (radial[ring] - line @ (line.T @ radial[ring])) / np.sqrt(rest)
    return left


def _growth_within(e2: Array, z: Array, group: Index, frame: Index) -> float:
    """Return how squares e2 (M,) grow with z within groups (M,), in standard errors.

    What one frame (M,) contributes counts as one observation: its points may err together.
    """
    count = np.maximum(np.bincount(group), 1)
    mean, middle = ((np.bincount(group, weights=of) / count)[group] for of in (e2, z))
    products = np.bincount(frame, weights=(e2 / np.maximum(mean, 1e-300) - 1) * (z - middle))
    return float(products.sum() / max(np.sqrt((products**2).sum()), 1e-300))


def _growth_on_places(errors: Array, z: Array, pairs: Index, frame: Index) -> float:
    """Return how the scatter (N, 2) of points on the same place grows with z (N,), as above.

    A static field cancels in their differences.
    """
    if len(pairs) < MIN_PAIRS:
        return 0.0
    one, other = pairs[:_CLOSEST_PAIRS].T
    squares = np.minimum((errors[one] - errors[other]) ** 2 / 2, _LARGEST_SQUARE).mean(axis=1)
    middle = (z[one] + z[other]) / 2
    return _growth_within(squares, middle, np.zeros(len(one), dtype=np.int64), frame[one])
