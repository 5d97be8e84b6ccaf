"""The viewpoint moves along the axis with the incidence angle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Effect, Parameter, Scene
from fisheye_svp_ros.optics.curves import Gennery
from fisheye_svp_ros.optics.lens import Lens

SHIFT_SIGMA = 4e-3  # m: of e0 before any data; fisheye lenses that were measured have 1 to 6 mm


@dataclass(frozen=True)
class ViewpointShiftEffect(Effect):
    """A Gennery shift e0 + e1 theta^2 + ... on top of the lens (s0 is part of the pose)."""

    order: int = 1

    name = 'viewpoint_shift'
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
        """Return those of a shift of such a size at the edge of the field, of each higher order.

        Of e0 a wider one: a shift larger than known ones is to be named, and not something else.
        """
        edge = scene.lens.max_incidence ** (2.0 * np.arange(1, self.order))
        return np.array([self.parameters[0].large, *(SHIFT_SIGMA / edge)])

    def columns(self, scene: Scene) -> Array:
        shift = Gennery().columns(scene.theta)[..., 1 : 1 + self.order]
        return np.stack([shift, np.zeros_like(shift)], axis=-2)

    def curved(self, lens: Lens, values: Array) -> Lens:
        return lens.with_shift(Gennery(0.0, *map(float, values)))
