"""What is left: whether residuals still depend on anything, without a model of what."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy import stats

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.correlation import (
    both_axes,
    frame_fields,
    monomials,
    neighbour_correlation,
    share,
)
from fisheye_svp_ros.diagnosis.model import Linearised
from fisheye_svp_ros.diagnosis.projection import Nuisance, score
from fisheye_svp_ros.diagnosis.screening import single_landmarks

_FIELD = 4  # degree of the smooth field over the image
_CURVE = 5  # degree of smooth curves over an angle, a range, the time


class Structure(NamedTuple):
    """One variable that residuals may depend on: the test's p-value (corrected) and its size.

    share: the part of the residual's sum of squares that goes with it, less what chance gives.
    """

    variable: str
    p_value: float
    share: float

    @property
    def of_mean(self) -> bool:
        """Whether it speaks of a pattern, not of scatter alone."""
        return self.variable in (*_PLACES, *_TIMES, 'landmark', 'neighbour_correlation')

    @property
    def weighty(self) -> float:
        """How much of its share a cause must explain beside it.

        Half of a pattern in time: fields of their own in every frame hold a lot of any remainder.
        What neighbours have in common is no noise either.
        """
        whole = (*_PLACES, 'landmark', 'neighbour_correlation')
        return 1.0 * (self.variable in whole) + 0.5 * (self.variable in _TIMES)


_PLACES = ('image', 'theta', 'range', 'pixel_phase')
_TIMES = ('time', 'frame')


def remaining_structure(
    linear: Linearised, nuisance: Nuisance, known_noise: bool
) -> list[Structure]:
    """Test residuals for structure over every variable; Bonferroni over the variables.

    known_noise: whether the table states sigma, so that the size itself can be tested.
    """
    tests = list(_mean_tests(linear, nuisance))
    tests += list(_scatter_tests(linear, nuisance, known_noise))
    return [
        Structure(name, min(1.0, p * len(tests)), share) for name, p, share in tests
    ]


def mean_fields(linear: Linearised) -> dict[str, Array]:
    """Generic smooth fields (F, M, P) over each variable, at the image stage."""
    scene, views = linear.scene, linear.data.views
    m = scene.normalised()
    scale = max(float(np.nanmax(np.abs(m[views.used]))), 1e-9)
    x, y = np.moveaxis(np.nan_to_num(m / scale), -1, 0)
    theta = np.nan_to_num(scene.theta / scene.theta_max)
    distance = np.linalg.norm(scene.pose.into_body(views.points), axis=-1)
    near = np.where(views.used, 1 / np.maximum(distance, 1e-6), 0.0)
    near = near / max(near.max(), 1e-9)
    radial, tangential = _polar(x, y)
    fields = {
        'image': both_axes(monomials(x, y, _FIELD)),
        'theta': _along(radial, _powers(theta)) + _along(tangential, _powers(theta)),
        'range': [
            direction * (near**i * theta**j)[..., None]
            for direction in (radial, tangential) for i in (1, 2) for j in (1, 2, 3)
        ],
        'pixel_phase': _phases(linear.linear.optical),
    }
    t = scene.times
    if np.isfinite(t).all() and np.ptp(t) > 0:
        when = (2 * (t - t.min()) / np.ptp(t) - 1)[:, None] * np.ones_like(x)
        fields['time'] = [
            field * (when**i)[..., None]
            for field in both_axes(monomials(x, y, 1)) for i in (1, 2, 3)
        ]
    return {
        name: linear.whitened(np.stack(columns, axis=-1)) for name, columns in fields.items()
    }


def _mean_tests(linear: Linearised, nuisance: Nuisance) -> Iterator[tuple[str, float, float]]:
    fields = mean_fields(linear)
    for name, columns in fields.items():
        result = score(nuisance, columns)
        yield name, result.p_value, share(nuisance, result.statistic, result.rank)
    yield 'frame', *frame_fields(linear, nuisance)
    if nuisance.frame_basis is not None:
        yield 'landmark', *_landmark_test(linear, nuisance)
    coefficient, p = neighbour_correlation(linear, nuisance)
    yield 'neighbour_correlation', p, max(coefficient, 0.0)


def _scatter_tests(
    linear: Linearised, nuisance: Nuisance, known_noise: bool
) -> Iterator[tuple[str, float, float]]:
    """Tests of the size of residuals, not of their sign."""
    e2 = standardised_squares(linear, nuisance)
    used = linear.rows.used
    largest = float(e2[used].max())
    p = min(1.0, used.sum() * float(stats.chi2.sf(largest, 1)))
    yield 'outliers', p, largest / nuisance.misfit
    theta = linear.data.blocks(np.nan_to_num(linear.scene.theta)[..., None] * np.ones(2))
    yield 'scatter_vs_theta', _trend(e2[used], theta[used] ** 2), 0.0
    labels = np.broadcast_to(np.arange(used.shape[0])[:, None], used.shape)[used]
    yield 'scatter_vs_frame', _groups(e2[used], labels), 0.0
    if known_noise:
        size = nuisance.misfit, nuisance.freedom
        yield 'size', 2 * float(min(stats.chi2.sf(*size), stats.chi2.cdf(*size))), 0.0


def standardised_squares(linear: Linearised, nuisance: Nuisance) -> Array:
    """Squared residuals (F, M) over their expected squares: each about 1."""
    rows = np.arange(nuisance.residual.size)
    leverage = nuisance.leverage(rows, rows).reshape(nuisance.shape)
    variance = nuisance.misfit / max(nuisance.freedom, 1)
    return np.asarray(nuisance.residual**2 / np.maximum(1 - leverage, 0.05) / variance)


def _trend(e2: Array, z: Array) -> float:
    """Koenker's studentised Breusch-Pagan test of e2 against one variable."""
    centred = e2 - e2.mean(), z - z.mean()
    spread = float((centred[0] ** 2).sum() * (centred[1] ** 2).sum())
    r2 = float((centred[0] * centred[1]).sum()) ** 2 / max(spread, 1e-300)
    return float(stats.chi2.sf(len(e2) * r2, 1))


def _groups(e2: Array, labels: Index) -> float:
    """Koenker's test against group membership."""
    counts = np.bincount(labels)
    sums = np.bincount(labels, weights=e2 - e2.mean())
    explained = float((sums**2 / np.maximum(counts, 1)).sum())
    statistic = explained / max(float(e2.var()), 1e-300)
    return float(stats.chi2.sf(statistic, int((counts > 0).sum()) - 1))


def _landmark_test(linear: Linearised, nuisance: Nuisance) -> tuple[float, float]:
    """Displacements of single landmarks, summed over the landmarks."""
    found = single_landmarks(linear, nuisance)
    statistic = sum(result.statistic for _, result, _ in found)
    rank = sum(result.rank for _, result, _ in found)
    if not found:
        return 1.0, 0.0
    # Poses take up part of what all landmarks do together; the sum errs to the small side.
    variance = nuisance.misfit / nuisance.freedom
    z = (statistic / variance - rank) / np.sqrt(2 * rank)
    return float(stats.norm.sf(z)), share(nuisance, statistic, rank)


def _along(direction: Array, scalars: list[Array]) -> list[Array]:
    return [direction * scalar[..., None] for scalar in scalars]


def _powers(theta: Array) -> list[Array]:
    return [theta**i for i in range(1, _CURVE + 1)]


def _polar(x: Array, y: Array) -> tuple[Array, Array]:
    norm = np.maximum(np.hypot(x, y), 1e-9)
    radial = np.stack([x / norm, y / norm], axis=-1)
    return radial, np.stack([-radial[..., 1], radial[..., 0]], axis=-1)


def _phases(uv: Array) -> list[Array]:
    phase = 2 * np.pi * np.nan_to_num(uv)
    columns = []
    for harmonic in (1, 2):
        for wave in (np.sin(harmonic * phase), np.cos(harmonic * phase)):
            for axis in (0, 1):
                column = np.zeros_like(wave)
                column[..., axis] = wave[..., axis]
                columns.append(column)
    return columns
