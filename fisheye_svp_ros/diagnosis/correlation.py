"""Whether residuals are independent, and what it means for tests if they are not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.spatial import cKDTree

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.model import Linearised
from fisheye_svp_ros.diagnosis.projection import Nuisance
from fisheye_svp_ros.diagnosis.projection import p_value as p_value_of
from fisheye_svp_ros.effects.base import Untestable
from fisheye_svp_ros.effects.landmark_survey import LandmarkSurveyEffect

# Neighbours must be this improbable under independence before tests are made more cautious.
_DEPENDENT = 1e-3


@dataclass(frozen=True)
class Correlation:
    """Neighbour correlation of residuals and the inflation of sums that follows from it.

    coefficient: mean product of neighbours' residuals over the variance; p_value: of independence
    of neighbours, or of points that share a frame; inflation: of a test's directions (F, M, R).
    """

    coefficient: float
    p_value: float
    inflation: Callable[[Array], float]

    @property
    def dependent(self) -> bool:
        """Whether the residuals of neighbours agree more than chance allows."""
        return self.p_value < _DEPENDENT


def judge_correlation(linear: Linearised, generic: Array) -> Correlation:
    """Judge the residuals of a model that has everything in it: generic (F, M, P), and a survey.

    What is still alike among neighbours then is no effect of the catalogue.  Sums over frames and
    over landmarks are compared with what independence predicts (two-way clusters: Cameron,
    Gelbach and Miller, J. Business & Economic Statistics 29(2), 2011).
    """
    saturated = Nuisance(linear, generic)
    coefficient, p_value = neighbour_correlation(linear, saturated)
    p_value = min(p_value, frame_fields(linear, saturated)[0])
    if p_value >= _DEPENDENT:
        return Correlation(coefficient, p_value, lambda _: 1.0)
    survey = everywhere(linear)
    if survey is not None and saturated.frame_basis is not None:
        saturated = Nuisance(linear, generic, survey)
    landmark = np.unique(linear.rows.landmark, return_inverse=True)[1].reshape(saturated.shape)
    variance = saturated.misfit / max(saturated.freedom, 1)

    def inflation(directions: Array) -> float:
        weighted = directions * saturated.residual[..., None]
        rank = max(directions.shape[-1], 1)
        by_frame = (weighted.sum(axis=1) ** 2).sum() / rank / variance
        sums = np.zeros((landmark.max() + 1, directions.shape[-1]))
        np.add.at(sums, landmark, weighted)
        by_landmark = (sums**2).sum() / rank / variance
        return float(max(1.0, by_frame, by_frame + by_landmark - 1.0))

    return Correlation(coefficient, p_value, inflation)


def everywhere(linear: Linearised) -> LandmarkSurveyEffect | None:
    """Return the survey of all landmarks where the data are many enough to bear it."""
    try:
        survey = LandmarkSurveyEffect.candidates(linear.scene)[0]
    except Untestable:
        return None
    enough = linear.rows.used.sum() > 4 * len(survey.parameters)
    return survey if enough and isinstance(survey, LandmarkSurveyEffect) else None


def neighbour_correlation(linear: Linearised, nuisance: Nuisance) -> tuple[float, float]:
    """Return the mean product of nearest neighbours' residuals over the variance, and its p-value.

    The fit itself makes residuals of neighbours disagree a little (the hat matrix); that is
    allowed for.
    """
    first, second = neighbours(linear)
    if len(first) < 10:
        return 0.0, 1.0
    e = nuisance.residual.ravel()
    variance = nuisance.misfit / max(nuisance.freedom, 1)
    products = 0.0
    expected = 0.0
    for axis in (0, 1):
        products += float((e[first + axis] * e[second + axis]).sum())
        expected -= variance * float(nuisance.leverage(first + axis, second + axis).sum())
    count = 2 * len(first)
    z = (products - expected) / (variance * np.sqrt(count))
    return (products - expected) / variance / count, float(stats.norm.sf(z))


def frame_fields(linear: Linearised, nuisance: Nuisance) -> tuple[float, float]:
    """Test for smooth second-degree fields over the image, each frame with one of its own.

    Returns the p-value of their sum and their share of the misfit.
    """
    x, y = np.moveaxis(np.nan_to_num(linear.scene.normalised()), -1, 0)
    field = linear.whitened(np.stack(both_axes(monomials(x, y, 2)), axis=-1))
    free = nuisance.frame_basis
    if free is not None:
        field = field - free @ (np.swapaxes(free, -1, -2) @ field)
    norms = np.sqrt((field**2).sum(axis=1, keepdims=True))
    u, s, _ = np.linalg.svd(field / np.maximum(norms, 1e-12), full_matrices=False)
    u = u * (s > 1e-3)[:, None, :]
    statistic = float((np.einsum('fmr,fm->fr', u, nuisance.residual) ** 2).sum())
    # The shared parameters take their part out of these directions: count what is left.
    taken = np.einsum('fmr,fmk->frk', u, nuisance.shared_basis)
    rank = round(float((s > 1e-3).sum() - (taken**2).sum()))
    rank = max(rank, 1)
    return p_value_of(nuisance, statistic, rank), share(nuisance, statistic, rank)


def share(nuisance: Nuisance, statistic: float, rank: int) -> float:
    """Return the part of the misfit that a statistic holds, less what chance gives its rank."""
    return float(max(statistic / nuisance.misfit - rank / max(nuisance.freedom, 1), 0.0))


def monomials(x: Array, y: Array, degree: int) -> list[Array]:
    """Return x^i y^j up to a degree, the constant first."""
    return [x**i * y ** (total - i) for total in range(degree + 1) for i in range(total + 1)]


def both_axes(scalars: list[Array]) -> list[Array]:
    """Return fields (..., 2): each scalar (...) along u, and along v."""
    zero = np.zeros_like(scalars[0])
    pairs = [pair for s in scalars for pair in ((s, zero), (zero, s))]
    return [np.stack(pair, axis=-1) for pair in pairs]


def neighbours(linear: Linearised) -> tuple[Index, Index]:
    """Return pairs of rows (u of each point) that are nearest to each other in the same view."""
    views = linear.data.views
    offset = linear.data.blocks(
        np.broadcast_to(np.arange(views.uv[..., 0].size).reshape(*views.uv.shape[:2], 1),
                        views.uv.shape).astype(float) + 1
    ).astype(np.int64)
    row_of = np.full(views.uv[..., 0].size + 1, -1)
    flat = offset.ravel()[::2]
    row_of[flat] = 2 * np.arange(len(flat))
    pairs = []
    for view in range(len(views.uv)):
        mine = np.flatnonzero(linear.weight[view] > 0)
        if len(mine) < 3:
            continue
        seen = views.uv[view, mine]
        nearest = np.asarray(cKDTree(seen).query(seen, k=2)[1])[:, 1]
        both = np.sort(np.stack([mine, mine[nearest]], axis=1), axis=1)
        pairs.append(np.unique(both, axis=0) + view * views.uv.shape[1] + 1)
    if not pairs:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    rows = row_of[np.concatenate(pairs)]
    return rows[:, 0], rows[:, 1]
