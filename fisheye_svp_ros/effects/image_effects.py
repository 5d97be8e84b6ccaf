"""Effects on the image plane: focal length, principal point, pixels, elements off the axis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Effect, Parameter, PlaneEffect, Scene
from fisheye_svp_ros.optics.lens import Lens


class FocalLengthEffect(PlaneEffect):
    """A relative change of the focal length."""

    name = 'focal_length'
    headline = 'The focal length is wrong'
    meaning = 'The focal length differs from the one assumed.'
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


class PrincipalPointEffect(Effect):
    """A shift of the whole image."""

    name = 'principal_point'
    headline = 'The principal point is wrong'
    meaning = 'The principal point differs from the one assumed.'
    stage = 'image'
    signature = 'residuals with a constant part that no rotation of the camera absorbs'
    to_separate = 'landmarks over the whole field of view; views turned about the axis'

    parameters = (Parameter('cx', 'px', 10.0), Parameter('cy', 'px', 10.0))

    def columns(self, scene: Scene) -> Array:
        return np.broadcast_to(np.eye(2), (*scene.uv.shape, 2))

    def extend(self, lens: Lens, values: Array) -> Lens:
        return replace(lens, cx=lens.cx + float(values[0]), cy=lens.cy + float(values[1]))


class AspectEffect(PlaneEffect):
    """A relative difference between fx and fy, their mean kept."""

    name = 'aspect'
    headline = 'The aspect of the pixels is wrong'
    meaning = 'The pixels are not square.'
    signature = 'residuals outward along one image axis and inward along the other'
    to_separate = 'views turned about the axis by 45 and 90 degrees'

    parameters = (Parameter('relative', '1', 0.01),)

    def plane_columns(self, scene: Scene) -> Array:
        return np.asarray((scene.normalized_uv() * [0.5, -0.5])[..., None])

    def extend(self, lens: Lens, values: Array) -> Lens:
        half = float(values[0]) / 2
        return replace(lens, fx=lens.fx * (1 + half), fy=lens.fy * (1 - half))

    def rescale_values(self, values: Array, ratio: float) -> Array:
        return values


class SkewEffect(PlaneEffect):
    """A shear: u grows with v."""

    name = 'skew'
    headline = 'The image axes are not at right angles'
    meaning = 'The pixel axes are not square to each other.'
    signature = (
        'residuals like a shear of the image: outward along one diagonal, inward along the other'
    )
    to_separate = 'views turned about the axis by 45 and 90 degrees'

    parameters = (Parameter('shear', '1', 0.01),)

    def plane_columns(self, scene: Scene) -> Array:
        column = np.zeros((*scene.uv.shape, 1))
        column[..., 0, 0] = scene.normalized_uv()[..., 1]
        return column


class DecenteringEffect(PlaneEffect):
    """Brown and Conrady p1, p2, in image points over the focal length."""

    name = 'decentering'
    headline = 'The lens is decentered'
    meaning = 'Lens elements are not centered on one axis.'
    signature = (
        'residuals that grow with the square of the image height, strongest along one diameter'
    )
    to_separate = 'landmarks over the whole field of view, to its edge, on all sides'

    parameters = (Parameter('p1', '1', 0.005), Parameter('p2', '1', 0.005))

    def plane_columns(self, scene: Scene) -> Array:
        x, y = np.moveaxis(scene.normalized_uv(), -1, 0)
        r2 = x * x + y * y
        p1 = np.stack([2 * x * y, r2 + 2 * y * y], axis=-1)
        p2 = np.stack([r2 + 2 * x * x, 2 * x * y], axis=-1)
        return np.stack([p1, p2], axis=-1)


class SensorTiltEffect(PlaneEffect):
    """Tilts about the image axes; first order, with the focal length as the image distance."""

    name = 'sensor_tilt'
    headline = 'The sensor is tilted'
    meaning = 'The sensor is not square to the optical axis.'
    signature = (
        'residuals along the radius, outward on one side of the image and inward on the other'
    )
    to_separate = 'landmarks over the whole field of view, to its edge, on all sides'

    parameters = (Parameter('about_x', 'rad', 0.01), Parameter('about_y', 'rad', 0.01))

    def plane_columns(self, scene: Scene) -> Array:
        m = scene.normalized_uv()
        return np.stack([m * m[..., 1:], -m * m[..., :1]], axis=-1)
