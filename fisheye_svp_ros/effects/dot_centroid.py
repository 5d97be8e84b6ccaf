"""The centroid of a dot's image is not the image of its center."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Effect, Parameter, Scene, Untestable
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.scene.boards import spacing

_RIM = 12  # points on the rim of the dot whose image is taken as a polygon
_RIM_SCALE = np.sqrt(3 / (2 + np.cos(2 * np.pi / _RIM)))  # gives the polygon the disc's moments
_PROBE = 0.02  # radius of the probing dot over its distance: small, yet far above rounding


@dataclass(frozen=True)
class DotCentroidEffect(Effect):
    """Bias of the centroid of a flat round dot, in proportion to its radius squared."""

    name = 'dot_centroid'
    stage = 'image'
    of_target = True  # it is the target's dots that are so large
    of_frames = True
    signature = 'residuals across tilted boards that grow with the size of the dot in the image'
    to_separate = 'dots of half the size, or corners instead of dots'

    @classmethod
    def candidates(cls, scene: Scene) -> Sequence[Effect]:
        if not any(board.flat for board in scene.boards):
            raise Untestable('no landmarks lie on a flat board, so no dot has a known plane')
        return [cls()]

    parameters = (Parameter('radius_squared', 'm^2', 1e-4, positive=True),)

    def is_implausible(self, values: Array, scene: Scene) -> bool:
        """Whether the dots would reach the centres of their neighbours on every board."""
        views = scene.views
        places = [views.points[views.used & (views.board == board.id)]
                  for board in scene.boards if board.flat]
        apart = [spacing(np.unique(np.round(points, 9), axis=0)) for points in places]
        return bool(values[0] > max(apart) ** 2)

    def columns(self, scene: Scene) -> Array:
        views = scene.views
        column = np.zeros((*views.points.shape[:2], 2, 1))
        in_camera = scene.pose.into_body(views.points)
        distance = np.linalg.norm(in_camera, axis=-1)
        for board in scene.boards:
            mine = views.used & (views.board == board.id)
            if not board.flat or not mine.any():
                continue
            radius = _PROBE * distance[mine]
            angle = 2 * np.pi * np.arange(_RIM) / _RIM
            rim = np.cos(angle)[:, None] * board.axes[0] + np.sin(angle)[:, None] * board.axes[1]
            turned = rim @ scene.pose.rotation[np.nonzero(mine)[0]]
            points = in_camera[mine][:, None] + (_RIM_SCALE * radius)[:, None, None] * turned
            centre = project(scene.lens, in_camera[mine], limited=False).uv
            bias = _polygon_centroid(project(scene.lens, points, limited=False).uv) - centre
            column[mine] = np.nan_to_num(bias / (radius**2)[:, None])[..., None]
        return column


def _polygon_centroid(corners: Array) -> Array:
    """Centroids (M, 2) of polygons (M, K, 2)."""
    middle = corners.mean(axis=1, keepdims=True)
    a = corners - middle
    b = np.roll(a, -1, axis=1)
    doubled = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    moment = ((a + b) * doubled[..., None]).sum(axis=1) / 3
    return np.asarray(middle[:, 0] + moment / doubled.sum(axis=1)[:, None])
