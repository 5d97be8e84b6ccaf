"""The pixels are not square."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Effect, Parameter, Scene


@dataclass(frozen=True)
class AspectEffect(Effect):
    """A relative difference between fx and fy, their mean kept."""

    name: ClassVar[str] = 'aspect'
    stage: ClassVar[str] = 'image'
    signature: ClassVar[str] = (
        'residuals outward along one image axis and inward along the other'
    )
    confused_with: ClassVar[str] = 'skew turned by 45 degrees, sensor_tilt in few views'
    to_separate: ClassVar[str] = (
        'views turned about the axis by 45 and 90 degrees'
    )

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter('relative', '1', 0.01),)

    def columns(self, scene: Scene) -> Array:
        halves = np.array([scene.lens.fx, -scene.lens.fy]) / 2
        return np.asarray((scene.normalised() * halves)[..., None])
