"""The forward model: landmarks and poses through target, pose, ray, image and detector."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.effects.base import Effect, NoiseEffect, Scene
from fisheye_svp_ros.effects.catalogue import load_effects
from fisheye_svp_ros.effects.flat_port import FlatPortEffect
from fisheye_svp_ros.effects.radial_profile import RadialProfileEffect
from fisheye_svp_ros.effects.ray_curves import SumOfHeights, SumOfShifts
from fisheye_svp_ros.effects.viewpoint_shift import ViewpointShiftEffect
from fisheye_svp_ros.optics import engines
from fisheye_svp_ros.optics.camera import Image, LinearImage, Rays, back_project, project
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, identity, rotation_from_vector
from fisheye_svp_ros.scene.observations import Views, views_of

Term = tuple[Effect, Array]


@dataclass(frozen=True)
class LinearViews:
    """Predicted image points of views and their derivatives.

    uv (S, N, 2), px; valid (S, N); d_pose (S, N, 2, 6), px/m and px/rad, by the small change of
    `pose.Pose.retract`; ideal, optical (S, N, 2), px: uv before image effects, and before detector
    effects; lens, pose (S,), points (S, N, 3), m: what was seen, after target and pose effects.
    """

    uv: Array
    valid: Mask
    d_pose: Array
    ideal: Array
    optical: Array
    lens: Lens
    pose: Pose
    points: Array
    limited: bool

    @cached_property
    def d_target(self) -> Array:
        """Derivatives (S, N, 2, 3) by the places of the points in the world, px/m."""
        return -self.d_pose[..., :3]

    @cached_property
    def image(self) -> LinearImage:
        """The lens's own derivatives."""
        d_point = self.d_target @ self.pose.rotation[:, None]
        local = self.pose.into_body(self.points)
        return LinearImage(self.lens, local, self.limited, self.ideal, self.valid, d_point)


class ForwardModel:
    """A lens with its effects, ready to predict and to be solved with."""

    def __init__(self, lens: Lens, terms: Sequence[Term] | None = None) -> None:
        """Take the effects of the lens, or others in their place.

        `plain`: what the lens's own curves do is all there is.
        Raises LensError for an effect that is unknown or incomplete.
        """
        self.terms = load_effects(lens.effects, lens.name) if terms is None else tuple(terms)
        self.lens = _extended(lens, self.terms)
        self.plain = not self._of('target', 'pose', 'image', 'detector')

    @property
    def noise_terms(self) -> list[tuple[NoiseEffect, Array]]:
        """The effects that move no prediction, and their values."""
        return [(e, values) for e, values in self.terms if isinstance(e, NoiseEffect)]

    def predict(self, pose: Pose, views: Views, limited: bool = True) -> Image:
        """Predict image points of views (S, N) from poses (S,) of the camera in the world.

        limited: refuse points outside the field of view, as a camera does.
        """
        if self.plain:
            return project(self.lens, pose.into_body(views.points), limited)
        linear = self._through(pose, views, limited)
        return Image(linear.uv, linear.valid)

    def linearise(self, pose: Pose, views: Views) -> LinearViews:
        """Predict and differentiate; angles past the field of view are allowed (a solver).

        The derivatives leave out that image and detector effects vary over the image: a part in
        a hundred of a pixel step, which a solver does not notice.
        """
        return self._through(pose, views, limited=False)

    def back_project(self, uv: Array) -> Rays:
        """Return the rays of image points (S, N, 2), px, in the camera frame."""
        if not self._of('image', 'detector'):
            return back_project(self.lens, uv)
        ideal = uv
        views = views_of(np.zeros((*uv.shape[:-1], 3)), uv)
        pose = identity(len(uv))
        for _ in range(4):
            scene = Scene(views, self.lens, pose, ideal)
            ideal = uv - self._moved(scene, 'image') - self._moved(scene, 'detector')
        return back_project(self.lens, ideal)

    def scene(self, pose: Pose, views: Views, linear: LinearViews) -> Scene:
        """Return what effects may look at once the views are linearised."""
        return Scene(views, self.lens, pose, linear.ideal, linear.image.incidence)

    def noise_scale(self, scene: Scene) -> Array | float:
        """Factor (S, N) on the standard deviation of the noise of each point."""
        scale: Array | float = 1.0
        for effect, values in self.noise_terms:
            scale = scale * effect.noise_scale(scene, values)
        return scale

    def effect_columns(self, effect: Effect, scene: Scene, linear: LinearViews) -> Array:
        """Derivatives (S, N, 2, P) of image points by the parameters of an effect."""
        if effect.stage == 'detector':
            scene = replace(scene, uv=linear.optical)
        columns = effect.columns(scene)
        if effect.stage in ('image', 'detector'):
            return columns
        if effect.stage == 'ray':
            per_px = linear.image.d_height / _focal(self.lens)
            stage = np.stack([linear.image.d_shift, per_px], axis=-1)
        else:
            stage = {'target': linear.d_target, 'pose': linear.d_pose}[effect.stage]
        return np.asarray(stage @ columns)

    def _through(self, pose: Pose, views: Views, limited: bool) -> LinearViews:
        points = self._seen_points(pose, views)
        ideal, valid, d_pose = engines.linearise_views(self.lens, *pose, points, limited)
        linear = LinearViews(
            ideal, valid, d_pose, ideal, ideal, self.lens, pose, points, limited
        )
        if not self._of('image', 'detector'):
            return linear
        uv = [ideal]
        for stage in ('image', 'detector'):
            scene = Scene(views, self.lens, pose, uv[-1], linear.image.incidence)
            uv.append(uv[-1] + self._moved(scene, stage))
        return replace(linear, uv=uv[2], optical=uv[1])

    def _seen_points(self, pose: Pose, views: Views) -> Array:
        """Return the points (S, N, 3), m, where target and pose effects make them be seen."""
        points = views.points
        if self._of('target', 'pose'):
            points = points + self._moved(Scene(views, self.lens, pose, views.uv), 'target')
        if self._of('pose'):
            # When a row was exposed depends on where the point is seen: predict that first.
            seen = project(self.lens, pose.into_body(points), limited=False).uv
            move = np.asarray(self._moved(Scene(views, self.lens, pose, seen), 'pose'))
            turn = rotation_from_vector(-move[..., 3:])
            place = pose.position[..., None, :]
            points = place + (turn @ (points - place - move[..., :3])[..., None])[..., 0]
        return points

    def _of(self, *stages: str) -> list[Term]:
        return [term for term in self.terms if term[0].stage in stages]

    def _moved(self, scene: Scene, stage: str) -> Array | float:
        parts = [effect.displacement(scene, values) for effect, values in self._of(stage)]
        return np.sum(parts, axis=0) if parts else 0.0


def _focal(lens: Lens) -> float:
    return (lens.fx + lens.fy) / 2


def _extended(lens: Lens, terms: Sequence[Term]) -> Lens:
    """Return the lens with the curves that its ray effects add."""
    shifts = tuple(
        effect.shift(values) for effect, values in terms
        if isinstance(effect, ViewpointShiftEffect | FlatPortEffect)
    )
    heights = tuple(
        effect.height(values) for effect, values in terms
        if isinstance(effect, RadialProfileEffect)
    )
    if shifts:
        lens = replace(lens, viewpoint_shift=SumOfShifts(lens.viewpoint_shift, shifts))
    if heights:
        curve = SumOfHeights(lens.image_height, _focal(lens), heights)
        limit = min(lens.max_incidence, curve.limit)
        lens = replace(lens, image_height=curve, max_incidence=limit)
    return lens
