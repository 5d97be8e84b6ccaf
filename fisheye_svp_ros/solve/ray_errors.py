"""How far the rays of a lens are off: expected angles at several ranges, with intervals.

A change of the camera frame that is common to all ranges is a convention, and taken out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.optics.lens import Lens

RANGES = (0.3, 1.0, 5.0)  # m
_STEP = 1e-3  # of a standard error
_SAMPLES = 1000
_POINTS = 300  # image points that stand for all


class RayError(NamedTuple):
    """Expected rms of the angles, rad, over image points at one range, and its 95 % interval."""

    range_m: float
    value: float
    low: float
    high: float

    def in_mrad(self) -> dict[str, float]:
        """Return the numbers by name, angles in mrad."""
        return {'range_m': self.range_m, 'value': 1e3 * self.value, 'low': 1e3 * self.low,
                'high': 1e3 * self.high}


class RayModel(NamedTuple):
    """Rays of a lens and how its parameters move them.

    points (R, G, 3), m: of G image points at the ranges (R,); columns (R, G, 3, K): what each
    parameter moves them by over the range, rad, without what a motion of the camera frame does;
    covariance (K, K) of the parameters; ranges (R,), m.
    """

    points: Array
    columns: Array
    covariance: Array
    ranges: tuple[float, ...] = RANGES

    @property
    def sd(self) -> Array:
        """Standard deviation (R, G), rad, of each ray."""
        squares = np.einsum('rgik,kl,rgil->rg', self.columns, self.covariance, self.columns)
        return np.asarray(np.sqrt(squares))

    def errors(self, difference: Array | None = None) -> list[RayError]:
        """Return the expected error at each range.

        difference (R, G, 3), rad: of a lens to this one; None for this lens itself.
        """
        draws, (ranges, points, _, count) = self._draw_parameters(0), self.columns.shape
        columns = self.columns.reshape(ranges, 3 * points, count)
        if difference is not None:
            columns = np.concatenate([columns, difference.reshape(ranges, -1, 1)], axis=-1)
            draws = np.concatenate([draws, np.ones((1, _SAMPLES))])
        # The mean square over the points is a quadratic form of the parameters.
        form = np.swapaxes(columns, -1, -2) @ columns / points
        rms = np.sqrt(np.maximum((draws * (form @ draws)).sum(axis=1), 0.0))
        return [RayError(range_m, float(np.sqrt((one**2).mean())),
                         *np.quantile(one, (0.025, 0.975)).tolist())
                for range_m, one in zip(self.ranges, rms, strict=True)]

    def sample(self, at: int, seed: int = 0) -> Array:
        """Return errors (G, 3, samples), rad, at one of the ranges, drawn by the covariance."""
        return np.asarray(self.columns[at] @ self._draw_parameters(seed))

    def _draw_parameters(self, seed: int) -> Array:
        values, vectors = np.linalg.eigh(self.covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        return np.asarray(root @ np.random.default_rng(seed).standard_normal(
            (len(root), _SAMPLES)))


def typical_points(uv: Array) -> Array:
    """Return some image points (G, 2) that stand for all (N, 2), in their order."""
    step = max(1, len(uv) // _POINTS)
    return uv[::step]


def ray_model(
    lens_of: Callable[[Array], Lens], covariance: Array, uv: Array,
    ranges: tuple[float, ...] = RANGES,
) -> tuple[RayModel, Mask]:
    """Return how parameters move the rays of image points, and which points (G,) have rays.

    lens_of: makes a lens of changes (K,) of its parameters; covariance (K, K) of these; uv (G, 2),
    px; ranges: m.
    """
    count = len(covariance)
    base = points_on_rays(lens_of(np.zeros(count)), uv, ranges)
    there = np.isfinite(base).all(axis=(0, 2))
    sides = []
    for k, error in enumerate(np.sqrt(np.maximum(np.diag(covariance), 0.0))):
        step = np.zeros(count)
        step[k] = _STEP * error
        if not step.any():
            sides.append(np.zeros_like(base))
            continue
        one, other = (points_on_rays(lens_of(sign * step), uv, ranges) for sign in (1, -1))
        there &= np.isfinite(one).all(axis=(0, 2)) & np.isfinite(other).all(axis=(0, 2))
        sides.append((one - other) / (2 * step[k]))
    columns = np.zeros((*base[:, there].shape, count))
    for k, side in enumerate(sides):
        columns[..., k] = without_motion(base[:, there], side[:, there])
    return RayModel(base[:, there], columns, covariance, ranges), np.asarray(there)


def points_on_rays(lens: Lens, uv: Array, ranges: Sequence[float] = RANGES) -> Array:
    """Return the points (R, G, 3), m, that image points (G, 2), px, see at ranges; NaN: none."""
    rays = ForwardModel(lens).back_project(uv[None]).reshape((len(uv),))
    origin = np.where(rays.valid[:, None], rays.origin, np.nan)
    along = (origin * rays.direction).sum(axis=-1)
    rest = (origin**2).sum(axis=-1) - along**2
    away = np.sqrt(np.array(ranges)[:, None] ** 2 - rest) - along
    return np.asarray(origin + away[..., None] * rays.direction)


def without_motion(points: Array, change: Array) -> Array:
    """Return changes (R, G, 3), m, of points over their range, rad, without a rigid motion.

    The motion is that of least squares over all ranges together, of the angles.
    """
    distance = np.linalg.norm(points, axis=-1, keepdims=True)
    x, y, z = np.moveaxis(points, -1, 0)
    zero = np.zeros_like(x)
    turns = np.stack([[zero, -z, y], [z, zero, -x], [-y, x, zero]])  # of unit rotations
    turns = np.moveaxis(turns, (0, 1), (-1, -2))
    shifts = np.broadcast_to(np.eye(3), (*points.shape, 3))
    motion = (np.concatenate([turns, shifts], axis=-1) / distance[..., None]).reshape(-1, 6)
    angles = (change / distance).reshape(-1)
    fitted = motion @ np.linalg.lstsq(motion, angles, rcond=None)[0]
    left = (angles - fitted).reshape(points.shape)
    along = points / distance
    return np.asarray(left - along * (left * along).sum(axis=-1, keepdims=True))
