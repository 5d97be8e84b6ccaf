"""What a calibration in air left open of a lens, and the lens as photographs under water want it.

Photographs in air seldom fill the image as those through a port do: beyond them the curve of a
lens may be anything.  Its file says how sure it is; within that it may move.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.diagnosis.lens_errors import LensErrors
from fisheye_svp_ros.diagnosis.model import (
    Data,
    Linearised,
    Prior,
    State,
    fit,
    intrinsic_names,
    is_shared,
    start,
)
from fisheye_svp_ros.diagnosis.noise import find_gross_errors, set_aside
from fisheye_svp_ros.optics.lens import INTRINSICS, Lens, field_of_view

_KNOWN = 0.01  # of an image height, beside what the focal length is off by
_SAMPLES = 200
_GROWS = 1.25  # from fit to fit: the field whose points are taken in
_FEWEST = 8  # points of a view
_LEAST = 1e-8  # eigenvalue of correlations, beside what numbers hold
_MEDIAN = 0.6745  # of the size of a normal number
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

        Raises LensError where it holds half of what a diagnosis writes.
        """
        names, said = intrinsic_names(lens), lens.calibration or {}
        known, covariance = tuple(said.get('stderr', ())), said.get('covariance')
        if lens.uncertainty is not None:
            errors = LensErrors.of(lens)
            known, covariance = errors.names, errors.covariance
        whole = np.zeros(0) if covariance is None else np.array(covariance, dtype=float)
        square = whole.shape == (len(known), len(known)) and bool(np.isfinite(whole).all())
        if not (square and set(names) <= set(known)):
            return None
        at = [known.index(name) for name in names]
        return cls(lens, names, whole[np.ix_(at, at)])

    @property
    def focal(self) -> float:
        """Relative standard error of the focal length."""
        return float(np.sqrt(self.covariance[0, 0])) / self.lens.fx

    @property
    def reach(self) -> float:
        """Distance from the principal point, px, up to which the curve is known."""
        lens = self.lens
        theta = np.linspace(0.0, lens.max_incidence, _SAMPLES)[1:]
        height = lens.image_height.value_and_slope(theta)[0]
        columns = np.column_stack([height, np.zeros((len(theta), len(INTRINSICS) - 1)),
                                   lens.fx * lens.image_height.columns(theta)])
        spread = np.sqrt(np.einsum('tk,kl,tl->t', columns, self.covariance, columns))
        open_ = spread > (self.focal + _KNOWN) * lens.fx * height
        return float(lens.fx * height[np.argmax(open_)]) if open_.any() else np.inf

    def behind(self, everything: Data, lens: Lens, place: tuple[str, ...], index: str) -> Lens:
        """Return the lens with the intrinsics that photographs behind its port call for.

        They move within what is known of them, beside the port's `place` and the medium's `index`;
        the field whose points are taken in grows, for beyond it nothing is known of the curve.
        Raises GeometryError where a view cannot be posed.
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
        return lens

    def within(self, data: Data, reach: float) -> Data | None:
        """Return the points up to a distance from the principal point, px; None if too few."""
        off = np.linalg.norm(data.views.uv - [self.lens.cx, self.lens.cy], axis=-1)
        inside = data.views.used & (off <= reach)
        whole = (inside | ~data.views.used).all(axis=1, keepdims=True)
        inside &= whole | (inside.sum(axis=1, keepdims=True) >= _FEWEST)
        return set_aside(data, ~inside) if inside.any() else None

    def unlikely(self, lens: Lens) -> float:
        """Return how unlikely the intrinsics of a lens are: squares of standard deviations."""
        return float(((self._root @ (self._values(lens) - self._values(self.lens)))**2).sum())

    def _values(self, lens: Lens) -> Array:
        return np.array([lens.parameters[name] for name in self.names])

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
        mean = np.concatenate([[state.lens.parameters[index]], self._values(self.lens),
                               np.zeros(others)])
        root = np.zeros((1 + len(self.names), len(mean)))
        root[0, 0] = 1 / _INDEX
        root[1:, 1:1 + len(self.names)] = self._root
        return Prior(mean, noise * root)
