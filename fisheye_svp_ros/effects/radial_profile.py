"""The image-height curve differs from the one assumed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Effect, Parameter, Scene
from fisheye_svp_ros.effects.ray_curves import ChebyshevHeight


@dataclass(frozen=True)
class RadialProfileEffect(Effect):
    """A smooth change of h(theta), px, as sums of Chebyshev polynomials of theta / theta_max."""

    terms: int = 2
    theta_max: float = field(default=1.5707963, metadata={'key': False})

    name: ClassVar[str] = 'radial_profile'
    stage: ClassVar[str] = 'ray'
    signature: ClassVar[str] = (
        'residuals along the radius that depend on the angle alone, not on the range'
    )
    confused_with: ClassVar[str] = 'focal_length, viewpoint_shift at one single range'
    to_separate: ClassVar[str] = (
        'views of the same angles at clearly different ranges'
    )

    @classmethod
    def candidates(cls, scene: Scene) -> Sequence[Effect]:
        return [cls(terms, round(scene.theta_max, 6)) for terms in (1, 2, 4, 8)]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(f'h{i + 1}', 'px', 10.0) for i in range(self.terms))

    def columns(self, scene: Scene) -> Array:
        height = ChebyshevHeight(self.theta_max, (0.0,) * self.terms).columns(scene.theta)
        return np.stack([np.zeros_like(height), height], axis=-2)

    def height(self, values: Array) -> ChebyshevHeight:
        """Return the curve that adds to the lens's image height, px."""
        return ChebyshevHeight(self.theta_max, tuple(map(float, values)))
