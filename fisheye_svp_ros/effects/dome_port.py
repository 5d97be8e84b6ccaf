"""The lens looks through a dome, away from its center."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Parameter, PlaneEffect, Scene
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.optics.ports import DomeGlass


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
        radial, other = slope * np.cos(theta), np.eye(2) - along
        return turn * (radial[..., None, None] * along + across[..., None, None] * other)

    def extend(self, lens: Lens, values: Array) -> Lens:
        if lens.port is not None:
            raise LensError(f'lens {lens.name!r} already has a port; {self.key} cannot be added')
        x, y = map(float, values)
        return replace(lens, port=DomeGlass(
            self.radius, 1.0, x, y, 0.0, self.thickness, self.glass_index))
