"""The focal length differs from the one assumed."""

from __future__ import annotations

from dataclasses import dataclass, replace

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Parameter, PlaneEffect, Scene
from fisheye_svp_ros.optics.lens import Lens


@dataclass(frozen=True)
class FocalLengthEffect(PlaneEffect):
    """A relative change of the focal length."""

    name = 'focal_length'
    signature = 'residuals along the radius in proportion to the image height'
    to_separate = 'landmarks over the whole field of view; a calibration of this very camera'

    parameters = (Parameter('relative', '1', 0.02),)

    def plane_columns(self, scene: Scene) -> Array:
        return scene.normalized_uv()[..., None]

    def extend(self, lens: Lens, values: Array) -> Lens:
        growth = 1 + float(values[0])
        return replace(lens, fx=lens.fx * growth, fy=lens.fy * growth)

    def rescale_values(self, values: Array, ratio: float) -> Array:
        return values
