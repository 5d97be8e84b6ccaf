"""The lens looks through a plane window, with air or another medium behind it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Effect, Parameter, Scene, Untestable
from fisheye_svp_ros.optics.curves import FlatPort
from fisheye_svp_ros.optics.lens import Lens


@dataclass(frozen=True)
class FlatPortEffect(Effect):
    """A window of unknown thickness and given refractive index, square to the axis, in air.

    Where the medium behind it is another one, the port is a part of the lens (`optics.ports`), and
    a diagnosis names it under the same name (`diagnosis.medium`).
    """

    refractive_index: float = 1.5

    name = 'flat_port'
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
