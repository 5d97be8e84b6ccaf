"""Effects on the curves of a lens, and of ports in front of it."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Self

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import (
    Effect,
    Parameter,
    PlaneEffect,
    PupilEffect,
    Scene,
    Untestable,
)
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.optics.curves import FlatPort, Gennery
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.optics.ports import DomeGlass

_MAX_TERMS = 8  # polynomials


@dataclass(frozen=True)
class ViewpointShiftEffect(Effect):
    """A Gennery shift e0 + e1 theta^2 + ... on top of the lens (s0 is part of the pose)."""

    order: int = 1

    name = 'viewpoint_shift'
    headline = 'The viewpoint of the lens shifts with the angle'
    meaning = 'The viewpoint moves along the axis with the incidence angle.'
    stage = 'ray'
    signature = 'residuals along the radius that grow with the angle and with 1 / range'
    to_separate = (
        'views of the same angles at clearly different ranges, the nearest as near as possible; '
        'a target of known flatness'
    )

    @classmethod
    def candidates(cls, scene: Scene) -> Sequence[Effect]:
        return [cls(order) for order in (1, 2, 3)]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(f'e{i}', 'm', 0.01) for i in range(self.order))

    def prior_sigma(self, scene: Scene) -> Array:
        """Return those of a large shift, each order by what it does at the edge of the field."""
        large = np.array([parameter.large for parameter in self.parameters])
        return np.asarray(large / scene.lens.max_incidence ** (2.0 * np.arange(self.order)))

    def columns(self, scene: Scene) -> Array:
        shift = Gennery().columns(scene.theta)[..., 1 : 1 + self.order]
        return np.stack([shift, np.zeros_like(shift)], axis=-2)

    def with_curves(self, lens: Lens, values: Array) -> Lens:
        return lens.with_shift(Gennery(0.0, *map(float, values)))


class PupilDecenteringEffect(PupilEffect):
    """The entrance pupil moves sideways: by e0_x, e0_y times the angle's part of a Gennery shift.

    The same curve as that of a shift along the axis, which a sideways one adds to.
    """

    name = 'pupil_decentering'
    headline = 'The entrance pupil moves sideways with the angle'
    meaning = 'The entrance pupil moves sideways with the incidence angle.'
    rarer_than = 'decentering'
    signature = (
        'residuals towards one side that grow with the angle and with 1 / range, like those of a '
        'decentered lens at one range'
    )
    to_separate = (
        'views of the same angles at clearly different ranges, on all sides, the nearest as near '
        'as possible'
    )

    parameters = (Parameter('e0_x', 'm', 0.01), Parameter('e0_y', 'm', 0.01))

    def prior_sigma(self, scene: Scene) -> Array:
        return np.array([parameter.large for parameter in self.parameters])

    def origin_columns(self, theta: Array) -> Array:
        growth = Gennery().columns(theta)[..., 1]
        return np.asarray(growth[..., None, None] * np.eye(3)[:, :2])


@dataclass(frozen=True)
class RadialProfileEffect(Effect):
    """A smooth change of h(theta), px, as sums of Chebyshev polynomials of theta / theta_max.

    first: of the polynomials; those before it do what the lens's own coefficients do.
    """

    terms: int = 2
    theta_max: float = field(default=1.5707963, metadata={'key': False})
    first: int = field(default=1, metadata={'key': False})

    name = 'radial_profile'
    headline = 'The image-height curve of the lens is wrong'
    meaning = 'The image-height curve differs from the one assumed.'
    stage = 'ray'
    signature = 'residuals along the radius that depend on the angle alone, not on the range'
    to_separate = 'views of the same angles at clearly different ranges'

    @classmethod
    def candidates(cls, scene: Scene) -> Sequence[Effect]:
        coefficient_count, limit = (
            len(scene.lens.image_height.coefficient_names),
            round(scene.theta_max, 6),
        )
        finest = cls(_MAX_TERMS, limit, coefficient_count % _MAX_TERMS + 1)
        return [*(cls(terms, limit) for terms in (1, 2, 4)), finest]

    def merge_with(self, other: Self) -> Effect:
        return replace(
            other, terms=max(self.terms, other.terms), first=min(self.first, other.first)
        )

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(f'h{i}', 'px', 10.0) for i in range(self.first, self.terms + 1))

    def columns(self, scene: Scene) -> Array:
        height = ChebyshevHeight(self.theta_max, (0.0,) * self.terms).columns(scene.theta)
        height = height[..., self.first - 1 :]
        return np.stack([np.zeros_like(height), height], axis=-2)

    def with_curves(self, lens: Lens, values: Array) -> Lens:
        every = np.concatenate([np.zeros(self.first - 1), values])
        change = ChebyshevHeight(self.theta_max, tuple((every / lens.focal).tolist()))
        return replace(lens, image_height=lens.image_height.plus(change))

    def rescale_values(self, values: Array, ratio: float) -> Array:
        return values * ratio


@dataclass(frozen=True)
class ChebyshevHeight:
    """A change of image height h/f: x times a Chebyshev sum in x = theta / theta_max.

    Zero on the axis; the linear term (a change of focal length) is left out.
    """

    theta_max: float
    values: tuple[float, ...]

    def columns(self, theta: Array) -> Array:
        """Derivatives (..., K) by the values."""
        x = theta / self.theta_max
        basis = np.polynomial.chebyshev.chebvander(2 * x * x - 1, len(self.values))
        # T_k(2x^2 - 1) x, less its value at the axis times x: odd in x and without a linear term.
        signs = (-1.0) ** np.arange(1, len(self.values) + 1)
        return np.asarray((basis[..., 1:] - signs) * x[..., None] / 2)

    def value_and_slope(self, theta: Array) -> tuple[Array, Array]:
        """Return the change and its derivative by theta."""
        x, series = theta / self.theta_max, self._series()
        z = 2 * x * x - 1
        inner = np.polynomial.chebyshev.chebval(z, series)
        slope = np.polynomial.chebyshev.chebval(z, np.polynomial.chebyshev.chebder(series))
        return x * inner / 2, (inner + 4 * x * x * slope) / (2 * self.theta_max)

    @property
    def powers(self) -> tuple[float, ...]:
        """Factors of theta^3, theta^5, ... of the same polynomial."""
        inner = self._series() @ _shifted_chebyshev(len(self.values) + 1)
        scaled = zip(inner[1:].tolist(), itertools.count(3, 2), strict=False)
        return tuple(factor / (2 * self.theta_max**power) for factor, power in scaled)

    def _series(self) -> Array:
        signs = (-1.0) ** np.arange(1, len(self.values) + 1)
        return np.concatenate([[-float(np.dot(signs, self.values))], self.values])


@cache
def _shifted_chebyshev(count: int) -> Array:
    """Return the factors (count, count) of 1, s, s^2 ... in T_0(2s - 1), T_1(2s - 1) ..."""
    factors, z = np.zeros((count, count)), np.polynomial.Polynomial([-1.0, 2.0])
    for order in range(count):
        factors[order, : order + 1] = np.polynomial.Chebyshev.basis(order)(z).coef
    return factors


@dataclass(frozen=True)
class FlatPortEffect(Effect):
    """A window of unknown thickness and given refractive index, square to the axis, in air.

    Where the medium behind it is another one, the port is a part of the lens (`optics.ports`), and
    a diagnosis names it under the same name (`diagnosis.checks.medium`).
    """

    refractive_index: float = 1.5

    name = 'flat_port'
    headline = 'The camera looks through a port'
    meaning = 'The lens looks through a plane window, with air or another medium behind it.'
    stage = 'ray'
    rarer_than = 'viewpoint_shift'
    signature = (
        'residuals along the radius that grow with the angle and with 1 / range, bounded by the '
        'thickness'
    )
    to_separate = 'views beyond 60 degrees at clearly different ranges; inspect the housing'

    @classmethod
    def candidates(cls, scene: Scene) -> Sequence[Effect]:
        if scene.theta_max >= np.pi / 2:
            raise Untestable('rays beyond 90 degrees cannot have come through a plane window')
        return [cls()]

    parameters = (Parameter('thickness', 'm', 0.005, positive=True),)

    def columns(self, scene: Scene) -> Array:
        shift = FlatPort(1.0, self.refractive_index).columns(scene.theta)[..., :1]
        return np.stack([shift, np.zeros_like(shift)], axis=-2)

    def with_curves(self, lens: Lens, values: Array) -> Lens:
        return lens.with_shift(FlatPort(float(values[0]), self.refractive_index))


@dataclass(frozen=True)
class DomePortEffect(PlaneEffect):
    """A spherical shell in air: place of its center beside the axis, in the camera frame.

    radius: of the inner face, m; thickness of the glass, m, and its index.  To first order in the
    place c a ray of direction d turns by a share of c - (c.d) d; along the axis lens curve and
    focal length take that up.  Tested where the user says that there is a dome.
    Source: Snell's law at both faces, as in `optics.ports.DomeGlass`, for small angles.
    """

    radius: float = 0.05
    thickness: float = 0.004
    glass_index: float = 1.5

    name = 'dome_port'
    headline = 'The camera is beside the center of its dome'
    meaning = 'The lens looks through a dome, away from its center.'
    signature = (
        'residuals that grow with the square of the angle, strongest along one diameter, at all '
        'ranges alike'
    )
    to_separate = (
        'check whether the camera is behind a dome; if so, calibrate with --port '
        'dome:RADIUSmm:GLASSmm --medium air'
    )

    parameters = (Parameter('x', 'm', 0.01), Parameter('y', 'm', 0.01))

    def plane_columns(self, scene: Scene) -> Array:
        assert scene.incidence is not None, 'asked before the ray stage'
        theta, unit = scene.theta, np.moveaxis(scene.incidence.unit, 0, -1)
        height, slope = scene.lens.image_height.value_and_slope(theta)
        sine = np.sin(theta)
        across = np.where(sine > 1e-9, height / np.maximum(sine, 1e-9), slope)
        outer = self.radius + self.thickness
        turn = (1 - 1 / self.glass_index) * self.thickness / (self.radius * outer)
        along = unit[..., :, None] * unit[..., None, :]
        radial, tangential = slope * np.cos(theta), np.eye(2) - along
        return turn * (radial[..., None, None] * along + across[..., None, None] * tangential)

    def extend(self, lens: Lens, values: Array) -> Lens:
        if lens.port is not None:
            raise LensError(f'lens {lens.name!r} already has a port; {self.key} cannot be added')
        x, y = map(float, values)
        return replace(
            lens, port=DomeGlass(self.radius, 1.0, x, y, 0.0, self.thickness, self.glass_index)
        )
