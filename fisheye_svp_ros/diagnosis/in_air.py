"""What a calibration in air left open of a lens, and the lens as photographs under water want it.

Photographs in air seldom fill the image as those through a port do: beyond them the curve of a
lens may be anything.  Its file says how sure it is; within that it may move.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.diagnosis.adjustment import Prior, fit, start
from fisheye_svp_ros.diagnosis.lens_errors import LensErrors
from fisheye_svp_ros.diagnosis.model import Data, Linearised, State, intrinsic_names, is_shared
from fisheye_svp_ros.diagnosis.noise import find_gross_errors, set_aside
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.optics.lens import Lens, field_of_view
from fisheye_svp_ros.solve.lens_adjustment import parameter_values

_KNOWN = 0.01  # of an image height, beside what the focal length is off by
_SAMPLES = 200
_GROWS = 1.25  # from fit to fit: the field whose points are taken in
_FEWEST = 8  # points of a view
_LEAST = 1e-8  # eigenvalue of correlations, beside what numbers hold
_MEDIAN = 0.6745  # of the size of a normal number
_FAR = 4.0  # standard deviations, rms, that no intrinsics are off
_INDEX = 0.1  # standard deviation of an index before anything is known of the medium


@dataclass(frozen=True)
class InAir:
    """How sure the intrinsics of a lens are: names, covariance (K, K) of their values."""

    lens: Lens
    names: tuple[str, ...]
    covariance: Array

    @classmethod
    def of(cls, lens: Lens) -> InAir | None:
        """Return what a lens file from `calibrate` or `diagnose` tells; None if it is nothing.

        Raises LensError for half of it, or what cannot be.
        """
        if lens.uncertainty is not None:
            errors = LensErrors.of(lens)
            known, whole = errors.names, errors.covariance
        elif (said := lens.calibration or {}).get('covariance') is None:
            return None
        else:
            known, whole = _said(lens, said)
        at = [i for i, name in enumerate(known) if name in ('f', *intrinsic_names(lens))]
        names = tuple(known[i] for i in at)
        return cls(lens, names, whole[np.ix_(at, at)]) if {'f', 'fx'} & set(names) else None

    @property
    def focal(self) -> float:
        """Relative standard error of the focal length."""
        at = next(i for i, name in enumerate(self.names) if name in ('f', 'fx'))
        return float(np.sqrt(self.covariance[at, at])) / self.lens.fx

    @property
    def reach(self) -> float:
        """Distance from the principal point, px, up to which the curve is known."""
        lens = self.lens
        theta = np.linspace(0.0, lens.max_incidence, _SAMPLES)[1:]
        height = lens.image_height.value_and_slope(theta)[0]
        by = {'f': height, 'fx': height, **dict(zip(
            lens.image_height.coefficient_names, lens.fx * lens.image_height.columns(theta).T,
            strict=True))}
        columns = np.stack([by.get(name, np.zeros_like(theta)) for name in self.names], axis=-1)
        spread = np.sqrt(np.einsum('tk,kl,tl->t', columns, self.covariance, columns))
        open_ = spread > (self.focal + _KNOWN) * lens.fx * height
        return float(lens.fx * height[np.argmax(open_)]) if open_.any() else np.inf

    def behind(
        self, everything: Data, lens: Lens, place: tuple[str, ...], index: str
    ) -> Lens | None:
        """Return the lens with the intrinsics that photographs behind its port call for.

        They move within what is known of them, beside the port's `place` and the medium's `index`;
        the field whose points are taken in grows, for beyond it nothing is known of the curve.
        None if they are far from what is known.  Raises GeometryError where a view cannot be
        posed.
        """
        names, reach = (*place, index, *self.names), self.reach
        while near := self.within(everything, reach):
            data, _ = find_gross_errors(near, start(near, lens))
            state = fit(data, start(data, lens), place)
            state = fit(data, state, names, self._prior(data, state, index))
            lens = replace(state.lens, max_incidence=field_of_view(state.lens))
            if near.views.used.sum() == everything.views.used.sum():
                break
            reach *= _GROWS
        return lens if self.unlikely(lens) < _FAR**2 * len(self.names) else None

    def within(self, data: Data, reach: float) -> Data | None:
        """Return the points up to a distance from the principal point, px; None if too few."""
        off = np.linalg.norm(data.views.uv - [self.lens.cx, self.lens.cy], axis=-1)
        inside = data.views.used & (off <= reach)
        whole = (inside | ~data.views.used).all(axis=1, keepdims=True)
        inside &= whole | (inside.sum(axis=1, keepdims=True) >= _FEWEST)
        return set_aside(data, ~inside) if inside.any() else None

    def unlikely(self, lens: Lens) -> float:
        """Return how unlikely the intrinsics of a lens are: squares of standard deviations."""
        found, own = (np.array(parameter_values(one, self.names)) for one in (lens, self.lens))
        return float(((self._root @ (found - own)) ** 2).sum())

    @property
    def _root(self) -> Array:
        """What values are off, times this (K, K), is of unit covariance."""
        size = np.sqrt(np.maximum(np.diag(self.covariance), 1e-300))
        values, vectors = np.linalg.eigh(self.covariance / np.outer(size, size))
        return np.asarray((vectors / np.sqrt(np.maximum(values, _LEAST))).T / size)

    def _prior(self, data: Data, state: State, index: str) -> Prior:
        """Return what is known of index and intrinsics, beside rows as noisy as a fit's."""
        linear = Linearised(data, state, ())
        noise = float(np.median(np.abs(linear.residual[linear.used]))) / _MEDIAN
        others = sum(len(values) for effect, values in state.terms if is_shared(effect))
        mean = np.concatenate([[state.lens.parameters[index]],
                               parameter_values(self.lens, self.names),
                               np.zeros(others)])
        root = np.zeros((1 + len(self.names), len(mean)))
        root[0, 0] = 1 / _INDEX
        root[1:, 1:1 + len(self.names)] = self._root
        return Prior(mean, noise * root)


def _said(lens: Lens, said: Mapping[str, Any]) -> tuple[tuple[str, ...], Array]:
    """Return names and covariance (K, K) from the `calibration` block of a lens file."""
    try:
        names, whole = tuple(said['stderr']), np.array(said['covariance'], dtype=float)
        right = whole.shape == (len(names), len(names)) and np.isfinite(whole).all()
        if not (right and (np.diag(whole) >= 0).all()):
            raise ValueError
    except (KeyError, TypeError, ValueError) as cause:
        raise LensError(f'lens {lens.name!r}: calibration: covariance is no matrix of finite '
                        'numbers, a row and a column for each name in stderr; calibrate anew, or '
                        'leave it out') from cause
    return names, whole
