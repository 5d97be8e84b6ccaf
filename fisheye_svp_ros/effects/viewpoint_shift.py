"""The viewpoint moves along the axis with the incidence angle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Effect, Parameter, Scene
from fisheye_svp_ros.optics.curves import Gennery
from fisheye_svp_ros.optics.lens import Lens


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
        """Return those of a large shift, each order by what it does at the edge of the field."""
        large = np.array([parameter.large for parameter in self.parameters])
        return np.asarray(large / scene.lens.max_incidence ** (2.0 * np.arange(self.order)))

    def columns(self, scene: Scene) -> Array:
        shift = Gennery().columns(scene.theta)[..., 1 : 1 + self.order]
        return np.stack([shift, np.zeros_like(shift)], axis=-2)

    def with_curves(self, lens: Lens, values: Array) -> Lens:
        return lens.with_shift(Gennery(0.0, *map(float, values)))
