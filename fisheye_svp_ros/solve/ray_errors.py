"""How far the rays of a lens are off: expected angles at several ranges, with intervals.

A change of the camera frame that is common to all ranges is a convention, and taken out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import hypot, inf, prod
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Mask, symmetric_root
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import cross_matrix

RANGES = (0.3, 1.0, 5.0)  # m
MAX_RAY_ERROR = 1e-3  # rad at 1 m: 1 mm, with which robots dock and grasp; more is worth a word
_STEP = 1e-3  # of a standard error
SAMPLES = 1000
_POINTS = 300  # image points that stand for all
_STEP_PX = 0.01
_CELLS = 48  # of a map, along the longer side of the image


class RayError(NamedTuple):
    """Expected rms of the angles, rad, over image points at one range, and its 95 % interval.

    value: the mean over what the errors may be.
    """

    range_m: float
    value: float
    low: float
    high: float

    def in_quadrature(self, more: float) -> RayError:
        """Return the error with an independent one, rad, beside it."""
        sizes = (self.value, self.low, self.high)
        return RayError(self.range_m, *(hypot(size, more) for size in sizes))

    def in_mrad(self) -> dict[str, float]:
        """Return the numbers by name, angles in mrad."""
        return {
            'range_m': self.range_m,
            'value': 1e3 * self.value,
            'low': 1e3 * self.low,
            'high': 1e3 * self.high,
        }


class RayModel(NamedTuple):
    """Rays of a lens and how its parameters move them.

    points (R, G, 3), m: of G image points at the ranges (R,); columns (R, G, 3, K): what each
    parameter moves them by over the range, rad, without what a motion of the camera frame does;
    covariance (K, K) of the parameters; ranges (R,), m; others (K, SAMPLES): by what they may be
    off beside that, drawn, where this is not normal; freedom: degrees of freedom of what the
    covariance was estimated from (Student's t); datum: how many of the points, the first ones,
    the camera frame is fitted to, None: all.
    """

    points: Array
    columns: Array
    covariance: Array
    ranges: tuple[float, ...] = RANGES
    others: Array | None = None
    freedom: float = inf
    datum: int | None = None

    @property
    def sd(self) -> Array:
        """Standard deviation (R, G), rad, of each ray."""
        squares = np.einsum('rgik,kl,rgil->rg', self.columns, self.covariance, self.columns)
        return np.asarray(np.sqrt(squares))

    def errors(self, difference: Array | None = None) -> list[RayError]:
        """Return the expected error at each range, of this lens or one that differs from it.

        difference: see `draw_sizes`.
        """
        return [
            RayError(
                range_m,
                float(sizes.mean()),
                *np.quantile(sizes, (0.025, 0.975)).tolist(),
            )
            for range_m, sizes in zip(self.ranges, self.draw_sizes(difference), strict=True)
        ]

    def draw_sizes(self, difference: Array | None = None) -> Array:
        """Return what the rms over the points may be at each range, (R, SAMPLES), rad.

        difference (R, G, 3), rad: of a lens to this one; None for this lens itself.
        """
        draws, (ranges, points, _, count) = self._draw_parameters(0), self.columns.shape
        columns = self.columns.reshape(ranges, 3 * points, count)
        if difference is not None:
            columns = np.concatenate([columns, difference.reshape(ranges, -1, 1)], axis=-1)
            draws = np.concatenate([draws, np.ones((1, SAMPLES))])
        # The mean square over the points is a quadratic form of the parameters.
        form = np.swapaxes(columns, -1, -2) @ columns / points
        return np.asarray(np.sqrt(np.maximum((draws * (form @ draws)).sum(axis=1), 0.0)))

    def with_field(
        self, lens: Lens, uv: Array, bumps: Array, covariance: Array, cross: Array
    ) -> RayModel:
        """Return the model with the errors of an image field beside those of the parameters.

        lens: whose rays these are, at image points uv (G, 2), px; bumps (G, Q): what a coefficient
        moves u or v of each by; covariance (2 Q, 2 Q), px^2: of these, u and v of each bump in
        turn; cross (K, 2 Q): with the parameters.
        """
        steps = _STEP_PX * np.eye(2)
        # A field that moves an image point takes the ray from where it was.
        slope = np.stack(
            [
                (
                    points_on_rays(lens, uv - step, self.ranges)
                    - points_on_rays(lens, uv + step, self.ranges)
                )
                / (2 * _STEP_PX)
                for step in steps
            ],
            axis=-1,
        )
        moves = (slope[..., None, :] * bumps[:, None, :, None]).reshape(*self.points.shape, -1)
        columns = np.concatenate(
            [self.columns, without_motion(self.points, moves, self.datum)], axis=-1
        )
        return self._replace(
            columns=columns, covariance=np.block([[self.covariance, cross], [cross.T, covariance]])
        )

    def sample(self, at: int, seed: int = 0) -> Array:
        """Return errors (G, 3, samples), rad, at one of the ranges, drawn by the covariance."""
        return np.asarray(self.columns[at] @ self._draw_parameters(seed))

    def _draw_parameters(self, seed: int) -> Array:
        errors = np.sqrt(np.maximum(np.diag(self.covariance), 1e-300))
        # Of correlations: rounding of what is large is none of what is small.
        root = errors[:, None] * symmetric_root(self.covariance / np.outer(errors, errors))
        rng = np.random.default_rng(seed)
        draws = root @ rng.standard_normal((len(root), SAMPLES))
        if self.freedom < inf:  # the size of all errors is uncertain, and common to them
            draws *= np.sqrt(self.freedom / rng.chisquare(self.freedom, SAMPLES))
        if self.others is not None:
            draws[: len(self.others)] += self.others
        return np.asarray(draws)


def typical_points(uv: Array) -> Array:
    """Return some image points (G, 2) that stand for all (N, 2), in their order."""
    step = max(1, len(uv) // _POINTS)
    return uv[::step]


def ray_model(
    lens_of: Callable[[Array], Lens],
    covariance: Array,
    uv: Array,
    ranges: tuple[float, ...] = RANGES,
    others: Array | None = None,
    freedom: float = inf,
    datum: int | None = None,
) -> tuple[RayModel, Mask]:
    """Return how parameters move the rays of image points, and which points (G,) have rays.

    lens_of: makes a lens of changes (K,) of its parameters; covariance (K, K) of these; uv (G, 2),
    px; ranges: m; others, freedom: as in `RayModel`; datum: of all points (G,), as there.
    """
    count = len(covariance)
    base = points_on_rays(lens_of(np.zeros(count)), uv, ranges)
    visible: Mask = np.asarray(np.isfinite(base).all(axis=(0, 2)))
    sides = []
    variance = np.maximum(np.diag(covariance), 0.0)
    if others is not None:
        variance = variance + (others**2).mean(axis=1)
    for k, error in enumerate(np.sqrt(variance)):
        step = np.zeros(count)
        step[k] = _STEP * error
        if not step.any():
            sides.append(np.zeros_like(base))
            continue
        forward, backward = (points_on_rays(lens_of(sign * step), uv, ranges) for sign in (1, -1))
        visible &= np.isfinite(forward).all(axis=(0, 2)) & np.isfinite(backward).all(axis=(0, 2))
        sides.append((forward - backward) / (2 * step[k]))
    points = base[:, visible]
    moves = (
        np.stack([side[:, visible] for side in sides], axis=-1)
        if sides
        else (np.zeros((*points.shape, 0)))
    )
    first = None if datum is None else int(visible[:datum].sum())
    columns = without_motion(points, moves, first)
    model = RayModel(points, columns, covariance, ranges, others, freedom, first)
    return model, np.asarray(visible)


class RayMap(NamedTuple):
    """What is known of the rays of a whole image.

    u (C,), v (R,), px: of a grid; sd (N, R, C), rad: rms of what the ray of a pixel may be off at
    N ranges, NaN where there is none; ranges (N,), m; uv (G, 2), px: image points.
    """

    u: Array
    v: Array
    sd: Array
    ranges: tuple[float, ...]
    uv: Array


def map_rays(
    rays_of: Callable[[Array, tuple[float, ...], int], tuple[RayModel, Mask]],
    uv: Array,
    size: tuple[int, int],
) -> RayMap:
    """Return how well the rays of an image are known, near and far.

    rays_of: makes the model of points, at ranges, with the first ones as `datum`; uv (G, 2), px:
    the image points, which hold the camera frame; size: width and height, px.
    """
    pitch = max(size) / _CELLS
    u, v = (np.linspace(0.0, side - 1.0, round(side / pitch) + 1) for side in size)
    grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    typical, ranges = typical_points(uv), (RANGES[0], RANGES[-1])
    model, visible = rays_of(np.concatenate([typical, grid]), ranges, len(typical))
    of_grid = np.flatnonzero(visible[len(typical) :])
    sd = np.full((len(ranges), len(grid)), np.nan)
    for k in range(len(ranges)):
        drawn = model.sample(k)[int(visible[: len(typical)].sum()) :]
        sd[k, of_grid] = np.sqrt((drawn**2).sum(axis=1).mean(axis=-1))
    return RayMap(u, v, sd.reshape(len(ranges), len(v), len(u)), ranges, uv)


def points_on_rays(lens: Lens, uv: Array, ranges: Sequence[float] = RANGES) -> Array:
    """Return the points (R, G, 3), m, that image points (G, 2), px, see at ranges; NaN: none."""
    rays = ForwardModel(lens).back_project(uv[None]).reshape((len(uv),))
    return points_at(np.where(rays.valid[:, None], rays.origin, np.nan), rays.direction, ranges)


def points_at(origin: Array, direction: Array, ranges: Sequence[float] = RANGES) -> Array:
    """Return the points (R, G, 3), m, of rays, both (G, 3), at ranges from the camera frame."""
    along = (origin * direction).sum(axis=-1)
    miss2 = (origin**2).sum(axis=-1) - along**2
    away = np.sqrt(np.array(ranges)[:, None] ** 2 - miss2) - along
    return np.asarray(origin + away[..., None] * direction)


def without_motion(points: Array, change: Array, datum: int | None = None) -> Array:
    """Return changes (R, G, 3, ...), m, of points over their range, rad, without a rigid motion.

    Of the components across the rays: along them nothing is seen.  The motion is that of least
    squares over all ranges together, of the angles; datum: as in `RayModel`.
    """
    return _split_motion(points, change, datum)[1]


def motion_of(points: Array, change: Array) -> Array:
    """Return that motion (6, ...), m and rad: what `Pose.retract` does to the identity."""
    return _split_motion(points, change)[0]


def _split_motion(points: Array, change: Array, datum: int | None = None) -> tuple[Array, Array]:
    distance = np.linalg.norm(points, axis=-1, keepdims=True)
    along = (points / distance)[..., None]

    def across_rays(moves: Array) -> Array:
        angles = moves / distance[..., None]
        return np.asarray(angles - along * (along * angles).sum(axis=-2, keepdims=True))

    shifts = np.broadcast_to(np.eye(3), (*points.shape, 3))
    motion = across_rays(np.concatenate([shifts, -cross_matrix(points)], axis=-1))
    angles = across_rays(change.reshape(*points.shape, prod(change.shape[3:])))
    rows = points[:, :datum].size
    fixed, moved = (array[:, :datum].reshape(rows, array.shape[-1]) for array in (motion, angles))
    motion_fit = np.asarray(np.linalg.lstsq(fixed, moved, rcond=None)[0], dtype=float)
    left = angles - motion @ motion_fit
    return motion_fit.reshape(6, *change.shape[3:]), left.reshape(change.shape)
