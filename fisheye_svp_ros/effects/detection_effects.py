"""Effects of detection: bias of the detected points, their scatter, grid and ids."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Effect, NoiseEffect, Parameter, Scene, Untestable
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.scene.boards import spacing

_RIM = 12  # points on the rim of the dot whose image is taken as a polygon
_RIM_SCALE = np.sqrt(3 / (2 + np.cos(2 * np.pi / _RIM)))  # gives the polygon the disc's moments
_PROBE = 0.02  # radius of the probing dot over its distance: small, yet far above rounding


class DotCentroidEffect(Effect):
    """Bias of the centroid of a flat round dot, in proportion to its radius squared."""

    name = 'dot_centroid'
    meaning = "The centroid of a dot's image is not the image of its center."
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
        """Whether the dots would reach the centers of their neighbors on every board."""
        views = scene.views
        places = [
            views.points[views.used & (views.board == board.id)]
            for board in scene.boards
            if board.flat
        ]
        apart = [spacing(np.unique(np.round(points, 9), axis=0)) for points in places]
        return bool(values[0] > max(apart) ** 2)

    def columns(self, scene: Scene) -> Array:
        views = scene.views
        column = np.zeros((*views.points.shape[:2], 2, 1))
        in_camera = scene.pose.into_body(views.points)
        distance = np.linalg.norm(in_camera, axis=-1)
        for board in scene.boards:
            on_board = views.used & (views.board == board.id)
            if not board.flat or not on_board.any():
                continue
            radius = _PROBE * distance[on_board]
            angle = 2 * np.pi * np.arange(_RIM) / _RIM
            rim = np.cos(angle)[:, None] * board.axes[0] + np.sin(angle)[:, None] * board.axes[1]
            turned = rim @ scene.pose.rotation[np.nonzero(on_board)[0]]
            points = in_camera[on_board][:, None] + (_RIM_SCALE * radius)[:, None, None] * turned
            center = project(scene.lens, in_camera[on_board], limited=False).uv
            bias = _polygon_centroid(project(scene.lens, points, limited=False).uv) - center
            column[on_board] = np.nan_to_num(bias / (radius**2)[:, None])[..., None]
        return column


def _polygon_centroid(corners: Array) -> Array:
    """Centroids (M, 2) of polygons (M, K, 2)."""
    middle = corners.mean(axis=1, keepdims=True)
    a = corners - middle
    b = np.roll(a, -1, axis=1)
    doubled = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    moment = ((a + b) * doubled[..., None]).sum(axis=1) / 3
    return np.asarray(middle[:, 0] + moment / doubled.sum(axis=1)[:, None])


@dataclass(frozen=True)
class DetectorBiasEffect(Effect):
    """A bias that repeats with every pixel (peak locking): sine and cosine of the phase."""

    order: int = 1

    name = 'detector_bias'
    meaning = 'The detector pulls points towards a sub-pixel phase.'
    stage = 'detector'
    of_frames = True
    signature = 'residuals that repeat with the fractional part of the image point'
    to_separate = 'another detector, or the same images magnified'

    @classmethod
    def candidates(cls, scene: Scene) -> Sequence[Effect]:
        return [cls(1), cls(2)]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        if self.order == 1:
            return (Parameter('sine', 'px', 0.1),)
        names = ('u_sine', 'u_cosine', 'v_sine', 'v_cosine')
        return tuple(Parameter(name, 'px', 0.1) for name in names)

    def columns(self, scene: Scene) -> Array:
        phase = 2 * np.pi * scene.uv
        if self.order == 1:
            return np.sin(phase)[..., None]
        columns = np.zeros((*phase.shape, 4))
        columns[..., 0, 0], columns[..., 0, 1] = np.sin(phase[..., 0]), np.cos(phase[..., 0])
        columns[..., 1, 2], columns[..., 1, 3] = np.sin(phase[..., 1]), np.cos(phase[..., 1])
        return columns

    def resize_values(self, values: Array, scale: float, rows: float) -> Array | None:
        return values if scale == 1 else None  # other pixels have other phases


class WrongIdsEffect(NoiseEffect):
    """A part of the observations is swapped with others of the same view."""

    name = 'wrong_ids'
    meaning = 'Some image points carry the id of another landmark.'
    signature = 'a few huge residuals that end where another landmark is predicted'
    to_separate = 'check the named image points; match the ids again'

    parameters = (Parameter('fraction', '1', 0.02),)

    def record_points(self, uv: Array, values: Array, rng: np.random.Generator) -> Array:
        swapped = uv.copy()
        for view, seen in enumerate(np.asarray(np.isfinite(uv).all(axis=-1))):
            points = rng.permutation(np.flatnonzero(seen))
            pairs = points[: len(points) // 2 * 2].reshape(-1, 2)
            pairs = pairs[rng.random(len(pairs)) < values[0]]
            swapped[view, pairs] = uv[view, pairs[:, ::-1]]
        return swapped


class QuantisationEffect(NoiseEffect):
    """u and v are whole multiples of a step."""

    name = 'quantisation'
    meaning = 'Image points are rounded to a grid.'
    # Values on a lattice repeat with the place within a pixel by themselves.
    hides = ('detector_bias',)
    hidden_structure = ('pixel_phase',)
    signature = 'every image point is a multiple of one step'
    to_separate = 'store the image points with more digits, or refine to sub-pixel'

    parameters = (Parameter('step', 'px', 1.0),)

    def record_points(self, uv: Array, values: Array, rng: np.random.Generator) -> Array:
        return np.asarray(np.round(uv / values[0]) * values[0])


class NoiseVsAngleEffect(NoiseEffect):
    """sigma(theta) = sigma(0) exp(growth theta^2)."""

    name = 'noise_vs_angle'
    meaning = 'The scatter of the detector grows with the incidence angle.'
    signature = 'residuals without a pattern whose scatter grows towards the edge'
    to_separate = 'repeat the same view without moving anything: the scatter stays'

    parameters = (Parameter('growth', '1/rad^2', 0.5),)

    def noise_scale(self, scene: Scene, values: Array) -> Array:
        return np.asarray(np.exp(np.nan_to_num(values[0] * scene.theta**2)))
