"""What a landmark errs by alike in similar views: paper that lies anew, light, a detector.

What everything else leaves of the residuals, as a Gaussian process over how a landmark is seen,
and when; each landmark has one for itself, the parameters are those of all.

Source: Rasmussen and Williams, Gaussian Processes for Machine Learning (2006), eq. 2.23
(prediction), 2.30 (likelihood), 5.12 (each value predicted from the others).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
import scipy
from scipy import special

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.diagnosis.effect_tests import SIGNIFICANCE
from fisheye_svp_ros.diagnosis.random_effects import NAMES
from fisheye_svp_ros.solve.rig_state import Linearization

_RATIOS = (0.3, 3.0)  # of the noise's variance: where the search starts
_REACHES = (0.1, 0.4)  # the same, of what separates views
_LASTING = (0.02, 1.0)  # the same, of the time that the data span
_SEARCH_RANGE = 30.0  # times a start: as far as the search goes
_LIKELIHOOD_TOLERANCE = 1e-7  # of the log likelihood
_MOST_VIEWS, _MOST_CUBES = 150, 3e8  # of a landmark, and of all: what the parameters are read from
_MAX_KERNEL_SIZE = 4e6  # numbers in one kernel


class LandmarkViews(NamedTuple):
    """The views of each landmark by each camera, padded.

    key (L, 2): camera and landmark; row (L, V): of the points (S N), -1 where there is none;
    seen (L, V, 7): how it is seen, by direction and logarithm of what a step of it in space does
    to the image; t (L, V), s.
    """

    key: Index
    row: Index
    seen: Array
    t: Array

    @property
    def mask(self) -> Mask:
        """Which places (L, V) hold a view."""
        return self.row >= 0

    def take(self, landmarks: Index | slice, views: slice = slice(None)) -> LandmarkViews:
        """Return some of the landmarks, and so many views of each."""
        at = landmarks, views
        return LandmarkViews(self.key[landmarks], self.row[at], self.seen[at], self.t[at])

    @classmethod
    def gather(cls, linear: Linearization) -> LandmarkViews:
        """Gather the views of a linearization."""
        views = linear.data.views
        used = np.flatnonzero(views.used)
        camera = np.broadcast_to(linear.data.camera_of[:, None], views.used.shape)
        label = np.stack([camera.ravel()[used], views.landmark.ravel()[used]], axis=1)
        key, group = np.unique(label, axis=0, return_inverse=True)
        order, counts = np.argsort(group.ravel(), kind='stable'), np.bincount(group.ravel())
        place = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
        row = np.full((len(key), int(counts.max())), -1)
        row[group.ravel()[order], place] = used[order]
        columns = np.nan_to_num(linear.linear.d_target).reshape(-1, 6)
        size = np.maximum(np.linalg.norm(columns, axis=1, keepdims=True), 1e-300)
        seen = np.concatenate([columns / size, np.log(size)], axis=1)
        return cls(key, row, seen[row], views.t.ravel()[row])


class SimilarViews(NamedTuple):
    """A fitted process of known views.

    variance, px^2 on the axis: it grows with the angle as the noise does; reach, in units of
    `LandmarkViews.seen`; lasting, s, infinite where times are not known; weights (L, V, 2): of
    known views in predictions; cross_predictions (S, N, 2): what the others of its landmark
    predict of each view, px; share: of what noise seemed to be; p_value.
    """

    known: LandmarkViews
    variance: float
    reach: float
    lasting: float
    weights: Array
    cross_predictions: Array
    share: float
    p_value: float

    def predict(self, linear: Linearization) -> Array:
        """Return what is predicted of other views (S, N, 2), px, zero where none is like them."""
        other, known = LandmarkViews.gather(linear), self.known
        _, label = np.unique(np.concatenate([other.key, known.key]), axis=0, return_inverse=True)
        mine, theirs = np.split(label.ravel(), [len(other.key)])
        _, here, there = np.intersect1d(mine, theirs, return_indices=True)
        predicted = np.zeros((*other.row[here].shape, 2))
        for some in _batches(len(here), predicted.shape[1] * known.row.shape[1]):
            between = _ViewDistances.measure(other.take(here[some]), known.take(there[some]))
            predicted[some] = (
                self.variance
                * between.kernel(self.reach, self.lasting)
                @ self.weights[there[some]]
            )
        return _in_px(linear, other.row[here], predicted)


class _ViewDistances(NamedTuple):
    """What separates views: squares (L, V, W) of how they are seen, and times (L, V, W), s."""

    squares: Array
    times: Array

    @classmethod
    def measure(cls, some: LandmarkViews, other: LandmarkViews) -> _ViewDistances:
        squares = (some.seen**2).sum(axis=-1)[..., None] + (other.seen**2).sum(axis=-1)[:, None]
        squares -= 2 * some.seen @ np.swapaxes(other.seen, -1, -2)
        return cls(np.maximum(squares, 0.0), np.abs(some.t[..., None] - other.t[:, None]))

    def kernel(self, reach: float, lasting: float) -> Array:
        """Return the correlations (L, V, W)."""
        exponent = self.squares / (2 * reach**2)
        if np.isfinite(lasting):
            # A view whose time nobody knows is like none.
            exponent = exponent + np.nan_to_num(self.times / lasting, nan=np.inf)
        return np.asarray(np.exp(-exponent))


@dataclass(frozen=True)
class _Process:
    """What the likelihood is made of: residual (L, V, 2), zero for padding, and noise (L, V).

    The noise is its variance, 1 for padding; both px on the axis.
    """

    between: _ViewDistances
    there: Mask
    residual: Array
    noise: Array

    @classmethod
    def from_views(cls, known: LandmarkViews, residual: Array, noise: Array) -> _Process:
        return cls(_ViewDistances.measure(known, known), known.mask, residual, noise)

    def covariance(self, variance: float, reach: float, lasting: float) -> Array:
        """Return the covariance (L, V, V)."""
        both = self.there[:, :, None] & self.there[:, None]
        process = np.where(both, variance * self.between.kernel(reach, lasting), 0.0)
        return np.asarray(process + self.noise[..., None] * np.eye(both.shape[1]))

    def log_likelihood(self, variance: float, reach: float, lasting: float) -> float:
        """Return the log likelihood but for a constant, the scale of all variances at its best."""
        covariance = self.covariance(variance, reach, lasting)
        root = np.linalg.cholesky(covariance)
        log_det = 2 * float(np.log(np.einsum('lvv->lv', root)).sum())
        squares = float((self.residual * np.linalg.solve(covariance, self.residual)).sum())
        return float(-log_det - self.there.sum() * np.log(max(squares, 1e-300)))

    def maximize_likelihood(
        self, starts: Sequence[tuple[float, ...]]
    ) -> tuple[float, float, float]:
        """Return variance, reach and lasting of the highest likelihood."""

        def loss(logarithms: Array) -> float:
            return -self.log_likelihood(*_unpack_parameters(logarithms))

        start = min(np.log(starts), key=loss)
        around = [(x - np.log(_SEARCH_RANGE), x + np.log(_SEARCH_RANGE)) for x in start]
        return _unpack_parameters(
            scipy.optimize.minimize(
                loss,
                start,
                method='L-BFGS-B',
                bounds=around,
                options={'ftol': _LIKELIHOOD_TOLERANCE},
            ).x
        )


def similar_views(linear: Linearization, whitened: Array) -> SimilarViews | None:
    """Fit the process to residuals (F, M) from which all that was predicted is taken out.

    None where no landmark is seen twice, or nothing repeats beyond chance.  Of many landmarks and
    views some say what the parameters are; what is predicted rests on all.
    """
    data, known = linear.data, LandmarkViews.gather(linear)
    count, views = known.row.shape
    if views < 2:
        return None
    # A detector's sigma is of its noise, and not of what comes again.
    sigma = 1 / np.where(data.views.used, data.views.weight, 1.0)
    residual = np.where(
        known.mask[..., None],
        (data.by_view(whitened) * sigma[..., None]).reshape(-1, 2)[known.row],
        0.0,
    )
    noise = np.where(known.mask, (sigma**2).ravel()[known.row], 1.0)
    typical = float(noise[known.mask].mean())
    few = slice(min(views, _MOST_VIEWS))
    every = int(np.ceil(count * float(few.stop) ** 3 / _MOST_CUBES))
    process = _Process.from_views(
        known.take(slice(None, None, every), few), residual[::every, few], noise[::every, few]
    )
    span = float(np.ptp(known.t[known.mask]))
    lasting = [(span * part,) for part in _LASTING] if span > 0 else [()]
    starts = [
        (ratio * typical, reach, *lasts)
        for ratio, reach, lasts in product(_RATIOS, _REACHES, lasting)
    ]
    found = process.maximize_likelihood(starts)
    gain = process.log_likelihood(*found) - process.log_likelihood(0.0, *found[1:])
    p = float(special.chdtrc(len(starts[0]), max(2 * gain, 0.0)))
    if p * len(NAMES) > SIGNIFICANCE:
        return None
    weights, own = np.zeros((2, *residual.shape))
    for some in _batches(count, views**2):
        one = _Process.from_views(known.take(some), residual[some], noise[some])
        inverse = np.linalg.inv(one.covariance(*found))
        weights[some] = inverse @ one.residual
        own[some] = one.residual - weights[some] / np.einsum('lvv->lv', inverse)[..., None]
    return SimilarViews(
        known, *found, weights, _in_px(linear, known.row, own), found[0] / (typical + found[0]), p
    )


def _batches(landmarks: int, size: int) -> Iterator[slice]:
    """Yield landmarks in parts whose kernels, of such a size each, there is room for."""
    step = max(int(_MAX_KERNEL_SIZE // max(size, 1)), 1)
    return (slice(start, start + step) for start in range(0, landmarks, step))


def _unpack_parameters(logarithms: Array) -> tuple[float, float, float]:
    """Return variance, reach and lasting; without times, a process that lasts."""
    variance, reach, lasting = [*np.exp(logarithms), np.inf][:3]
    return float(variance), float(reach), float(lasting)


def _in_px(linear: Linearization, row: Index, values: Array) -> Array:
    """Return values (L, V, 2), on the axis, of rows (L, V) as (S, N, 2), px, zero elsewhere."""
    placed, there = np.zeros((linear.weight.size, 2)), row >= 0
    placed[row[there]] = values[there]
    grown = linear.data.views.weight / np.where(linear.weight > 0, linear.weight, 1.0)
    return placed.reshape(*linear.weight.shape, 2) * grown[..., None]
