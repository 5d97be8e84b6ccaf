"""Causes that move no prediction: wrong ids, quantisation, noise that grows with the angle."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import optimize, stats

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.criticism.model import Data, Linearised, State
from fisheye_svp_ros.criticism.projection import Nuisance
from fisheye_svp_ros.criticism.structure import standardised_squares
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.effects.noise_vs_angle import NoiseVsAngleEffect
from fisheye_svp_ros.observations import Views
from fisheye_svp_ros.solve.localization import MIN_POINTS, localize

_GROSS = 8.0  # robust standard deviations beyond which a point cannot belong to its landmark
_GATE = 6.0  # and within which it belongs to another one
_ROUNDS = 6


class Gross(NamedTuple):
    """Gross errors of a table: outlying rows of it, and which of them fit another landmark."""

    rows: Index
    swapped: Mask


class NoiseCause(NamedTuple):
    """A cause without a pattern: value, standard error, p-value."""

    value: float
    stderr: float
    p_value: float


def find_gross_errors(data: Data, state_lens: State) -> tuple[Data, Gross]:
    """Return the data without gross errors, and what they were.

    Views are localized again and again without the points that lie far from their prediction, on
    the scale of the median residual, and with those that have come back to it.
    """
    model = ForwardModel(state_lens.lens, state_lens.terms)
    views = data.views
    kept = views.used
    far = np.zeros_like(kept)
    for _ in range(_ROUNDS):
        solved = localize(model, views._replace(weight=np.where(kept, views.weight, 0.0)))
        predicted = model.linearise(solved.pose, views).uv
        offset = np.linalg.norm(views.uv - predicted, axis=-1)
        scale = 1.0 / 1.1774 * np.nanmedian(np.where(views.used, offset, np.nan))
        far = views.used & ~(offset < _GROSS * scale)
        enough = (views.used & ~far).sum(axis=1) >= MIN_POINTS
        # A view that would lose nearly all its points keeps the better half of them.
        half = offset <= np.nanmedian(np.where(views.used, offset, np.nan), axis=1)[:, None]
        trial = np.where(enough[:, None], views.used & ~far, views.used & half)
        if np.array_equal(trial, kept):
            break
        kept = trial
    swapped = _fits_another(model, solved.pose, views, far, _GATE * scale)
    rows = views.row[far]
    order = np.argsort(rows)
    clean = data.views._replace(
        weight=np.where(far, 0.0, views.weight), row=np.where(far, -1, views.row)
    )
    return replace(data, views=clean), Gross(rows[order], swapped[far][order])


def quantisation_step(uv: Array) -> float:
    """Return the largest step of which all coordinates (M, 2) are multiples, px; 0 for none."""
    values = np.unique(uv.ravel())
    gaps = np.diff(values)
    if len(values) < 8 or not len(gaps):
        return 0.0
    step = float(gaps[gaps > 1e-9].min(initial=np.inf))
    offsets = (values - values[0]) / step
    return step if np.abs(offsets - np.round(offsets)).max() < 0.02 else 0.0


def noise_growth(linear: Linearised, nuisance: Nuisance) -> NoiseCause:
    """Fit sigma(theta) = sigma0 exp(growth theta^2) to the residuals (likelihood-ratio test)."""
    used = linear.rows.used
    e2 = standardised_squares(linear, nuisance)[used]
    theta = linear.data.blocks(np.nan_to_num(linear.scene.theta)[..., None] * np.ones(2))[used]
    z = theta**2 - (theta**2).mean()

    def deviance(growth: float) -> float:
        # With z centred the mean of log sigma does not change: only the scale is profiled out.
        return float(len(z) * np.log(np.mean(e2 * np.exp(-2 * growth * z))))

    best = optimize.minimize_scalar(deviance, bounds=(-3.0, 3.0), method='bounded')
    gain = deviance(0.0) - float(best.fun)
    stderr = 1 / np.sqrt(2 * float((z**2).sum()))
    return NoiseCause(float(best.x), float(stderr), float(stats.chi2.sf(max(gain, 0.0), 1)))


def with_noise_growth(state: State, growth: float) -> State:
    """Return the state with weights for noise that grows with the angle."""
    term = (NoiseVsAngleEffect(), np.array([growth]))
    return replace(state, terms=(*state.terms, term))


def _fits_another(
    model: ForwardModel, pose: object, views: Views, far: Mask, gate: float
) -> Mask:
    """Which far points (S, N) lie where another landmark of the table is predicted."""
    ids, first = np.unique(views.landmark[views.used], return_index=True)
    points = views.points[views.used][first]
    swapped = np.zeros_like(far)
    for view in np.flatnonzero(far.any(axis=1)):
        single = views.take(slice(view, view + 1))._replace(
            points=points[None], board=np.zeros((1, len(ids)), dtype=np.int64),
            landmark=ids[None], t=np.full((1, len(ids)), np.nan),
            uv=np.zeros((1, len(ids), 2)), row=np.arange(len(ids))[None],
        )
        seen = model.linearise(pose.take(slice(view, view + 1)), single).uv[0]  # type: ignore
        for point in np.flatnonzero(far[view]):
            other = ids != views.landmark[view, point]
            off = np.linalg.norm(seen - views.uv[view, point], axis=-1)
            swapped[view, point] = bool(np.nanmin(np.where(other, off, np.inf)) < gate)
    return swapped
