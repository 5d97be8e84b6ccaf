"""The forward model: landmarks and poses through target, pose, pupil, ray, image and detector.

Of one lens, or of the lenses of a rig: then each view is that of its camera.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask, gather_rows
from fisheye_svp_ros.effects.base import (
    Effect,
    ModelTerm,
    NoiseEffect,
    PupilEffect,
    Scene,
    camera_terms,
)
from fisheye_svp_ros.effects.catalogue import load_effects
from fisheye_svp_ros.effects.extension import Target, curved_lens
from fisheye_svp_ros.optics import camera, engines
from fisheye_svp_ros.optics.camera import Image, Incidence, LinearImage, Rays, lens_columns
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, identity, rotation_from_vector
from fisheye_svp_ros.scene.observations import Views, views_of

_STEP = 1e-6  # px
_PUPIL_STEPS = 3  # of the angle at which a ray comes, each nearer by the motion over the range


class ModelPart(NamedTuple):
    """What one camera of a rig sees: its model, its place in the body, its points as views."""

    model: ForwardModel
    place: Pose
    views: Views


class CameraViews(NamedTuple):
    """The views (rows of all) of one camera of a rig, linearized."""

    rows: Index
    camera: int
    linear: LinearViews


@dataclass(frozen=True)
class LinearViews:
    """Predicted image points of views and their derivatives.

    uv (S, N, 2), px; valid (S, N); d_pose (S, N, 2, 6), px/m and px/rad, by the small change of
    `pose.Pose.retract`; ideal, optical (S, N, 2), px: uv before image effects, and before detector
    effects; lens, pose (S,), points (S, N, 3), m: what was seen, after target and pose effects;
    cameras: of a rig whose lenses differ, the same camera by camera.
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
    cameras: tuple[CameraViews, ...] = ()

    @cached_property
    def d_target(self) -> Array:
        """Derivatives (S, N, 2, 3) by the places of the points in the world, px/m."""
        return -self.d_pose[..., :3]

    @cached_property
    def image(self) -> LinearImage:
        """The lens's own derivatives; of a rig each camera has its own."""
        d_point = self.d_target @ self.pose.rotation[:, None]
        local = self.pose.into_body(self.points)
        return LinearImage(self.lens, local, self.limited, self.ideal, self.valid, d_point)


class ForwardModel:
    """A lens with its effects, or those of a rig, ready to predict and to be solved with.

    cameras: of a rig whose lenses differ, the model of each camera.
    """

    def __init__(
        self, lens: Lens | Sequence[Lens], terms: Sequence[ModelTerm] | None = None
    ) -> None:
        """Take the corrections of the lens and of its target, or other effects in their place.

        One lens, and its effects, is that of every camera.
        Raises LensError for an effect that is unknown or incomplete.
        """
        self.cameras: tuple[ForwardModel, ...] = ()
        if not isinstance(lens, Lens):
            if len(lens) > 1:
                self.cameras = tuple(
                    ForwardModel(single, None if terms is None else camera_terms(terms, i))
                    for i, single in enumerate(lens)
                )
                terms = ()
            lens = lens[0]
        corrections = load_effects(lens.corrections, lens.name) if terms is None else terms
        self.terms = tuple(corrections)
        self._target = Target.from_entries(lens.target, lens.name) if terms is None else None
        self._given = lens
        self.lens = curved_lens(lens, self.terms)

    def camera(self, number: int) -> ForwardModel:
        """Return the model of one camera."""
        return self.cameras[number] if self.cameras else self

    def split(self, views: Views) -> Iterator[tuple[Index, int, ForwardModel]]:
        """Yield the views (rows of all), number and model of each camera; of one lens all."""
        if not self.cameras:
            yield np.arange(len(views.frame)), 0, self
            return
        for number in np.unique(views.camera).tolist():
            yield np.flatnonzero(views.camera == number), number, self.cameras[number]

    def parts(self, views: Views) -> list[ModelPart]:
        """Return what each camera sees of views whose poses are those of one body."""
        return [ModelPart(self, identity(), views)]

    def neglecting(self) -> ForwardModel | None:
        """Return the model with what its lens leaves out; None where that is nothing known."""
        return None if self.lens.neglected is None else ForwardModel(self.lens.neglected)

    @property
    def is_lens_only(self) -> bool:
        """Whether what the lens's own curves do is all there is, of one lens."""
        bare = not self.cameras and self._target is None
        return bare and not self._acts('target', 'pose', 'pupil', 'image', 'detector')

    def seeing(self, views: Views) -> ForwardModel:
        """Return the model without corrections of a target that none of the views shows."""
        if self._target is None or self._target.landmark_mask(views).any():
            return self
        return ForwardModel(self._given, self.terms)

    def without_motion(self) -> ForwardModel:
        """Return the model of a camera that does not move; itself where that is the same."""
        kept = tuple(term for term in self.terms if not term.effect.of_motion)
        if len(kept) == len(self.terms):
            return self
        model = copy(self)
        model.terms = kept
        return model

    def terms_for(self, views: Views) -> tuple[ModelTerm, ...]:
        """Return the corrections of the lens, and of its target if any of the views shows it."""
        target = self.seeing(views)._target
        return self.terms if target is None else (*self.terms, *target.terms)

    def assign_boards(self, views: Views) -> Views:
        """Return views with the landmarks of the lens's target on the boards that they are of."""
        return views if self._target is None else self._target.assign_boards(views)

    @property
    def noise_terms(self) -> list[tuple[NoiseEffect, Array]]:
        """The effects that move no prediction, and their values."""
        return [(t.effect, t.values) for t in self.terms if isinstance(t.effect, NoiseEffect)]

    def project(self, points: Array) -> Image:
        """Project points (..., 3), m, in the camera frame."""
        shape, flat = points.shape[:-1], points.reshape(1, -1, 3)
        uv, valid = self.predict(identity(1), views_of(flat))
        return Image(uv.reshape(*shape, 2), valid.reshape(shape))

    def predict(self, pose: Pose, views: Views, limited: bool = True) -> Image:
        """Predict image points of views (S, N) from poses (S,) of the camera in the world.

        limited: refuse points outside the field of view, as a camera does.
        """
        if self.is_lens_only:
            return camera.project(self.lens, pose.into_body(views.points), limited)
        linear = self._linearize(pose, views, limited)
        return Image(linear.uv, linear.valid)

    def linearize(self, pose: Pose, views: Views) -> LinearViews:
        """Predict and differentiate; angles past the field of view are allowed (a solver).

        The derivatives leave out that image and detector effects vary over the image: `d_pose` and
        `through` have it for a solver, which else does not come to rest where points have errors.
        """
        return self._linearize(pose, views, limited=False)

    def d_pose(self, linear: LinearViews, views: Views) -> Array:
        """Return derivatives (S, N, 2, 6) by the pose, with how effects vary over the image."""
        return self.transform_columns(linear, views, linear.d_pose)

    def transform_columns(self, linear: LinearViews, views: Views, columns: Array) -> Array:
        """Return columns (S, N, 2, P) that move ideal image points as they move measured ones."""
        if self.cameras:
            return gather_rows(
                [
                    (
                        rows,
                        self.cameras[i].transform_columns(part, views.take(rows), columns[rows]),
                    )
                    for rows, i, part in linear.cameras
                ]
            )
        for stage, before, after in (
            ('image', linear.ideal, linear.optical),
            ('detector', linear.optical, linear.uv),
        ):
            if self._acts(stage):
                columns = columns + self._slope(linear, views, stage, before, after) @ columns
        return columns

    def _slope(
        self, linear: LinearViews, views: Views, stage: str, before: Array, after: Array
    ) -> Array:
        """Return the derivatives (S, N, 2, 2) of the displacements of a stage by image points.

        before, after (S, N, 2), px: image points without them and with them.
        """
        scene = Scene(views, self.lens, linear.pose, before, linear.image.incidence)
        moves = [
            self._displace(replace(scene, uv=before + step), stage) - (after - before)
            for step in _STEP * np.eye(2)
        ]
        return np.stack(moves, axis=-1) / _STEP

    def back_project(self, uv: Array) -> Rays:
        """Return the rays of image points (S, N, 2), px, in the camera frame."""
        if not self._acts('image', 'detector'):
            return self._move_origins(camera.back_project(self.lens, uv))
        ideal = uv
        views = views_of(np.zeros((*uv.shape[:-1], 3)), uv)
        pose = identity(len(uv))
        for _ in range(4):
            scene = Scene(views, self.lens, pose, ideal)
            ideal = uv - self._displace(scene, 'image') - self._displace(scene, 'detector')
        return self._move_origins(camera.back_project(self.lens, ideal))

    def _move_origins(self, rays: Rays) -> Rays:
        """Return rays that start where a pupil that moves sideways has them start."""
        if not self._acts('pupil'):
            return rays
        return rays._replace(origin=rays.origin + self._pupil(rays.theta))

    def _pupil(self, theta: Array) -> Array:
        """Return by what rays of angles (...) start beside the axis, in the camera frame, m."""
        columns = [
            term.effect.origin_columns(theta) @ term.values
            for term in self.terms
            if isinstance(term.effect, PupilEffect)
        ]
        return np.asarray(np.sum(columns, axis=0))

    def scene(self, pose: Pose, views: Views, linear: LinearViews) -> Scene:
        """Return what effects may look at once the views are linearized."""
        if not self.cameras:
            return Scene(views, self.lens, pose, linear.ideal, linear.image.incidence)
        parts = tuple(
            (rows, i, self.cameras[i].scene(pose.take(rows), views.take(rows), part))
            for rows, i, part in linear.cameras
        )
        rays = [(rows, part.image.incidence) for rows, _, part in linear.cameras]
        unit = gather_rows([(rows, np.moveaxis(ray.unit, 0, -1)) for rows, ray in rays])
        incidence = Incidence(
            gather_rows([(rows, ray.theta) for rows, ray in rays]),
            np.moveaxis(unit, -1, 0),
            gather_rows([(rows, ray.valid.astype(float)) for rows, ray in rays]) > 0,
        )
        return Scene(views, self.lens, pose, linear.ideal, incidence, parts)

    def effect_columns(self, effect: Effect, scene: Scene, linear: LinearViews) -> Array:
        """Derivatives (S, N, 2, P) of image points by the parameters of an effect."""
        if self.cameras:
            return self._effect_columns_by_camera(effect, scene, linear)
        if effect.stage == 'detector':
            scene = replace(scene, uv=linear.optical)
        columns = effect.columns(scene)
        if effect.stage in ('image', 'detector'):
            return columns
        if effect.stage == 'ray':
            per_px = linear.image.d_height / self.lens.focal
            stage = np.stack([linear.image.d_shift, per_px], axis=-1)
        else:
            stage = {
                'target': linear.d_target,
                'pose': linear.d_pose,
                'pupil': -linear.image.d_point,
            }[effect.stage]
        return np.asarray(stage @ columns)

    def _effect_columns_by_camera(
        self, effect: Effect, scene: Scene, linear: LinearViews
    ) -> Array:
        count = len(effect.parameters)
        columns = np.zeros((*linear.uv.shape, count))
        for (rows, number, part), (_, _, seen) in zip(linear.cameras, scene.cameras, strict=True):
            model = self.cameras[number]
            for form, slots in effect.forms_of_camera(number):
                block = np.zeros((*part.uv.shape, count))
                block[..., slots] = model.effect_columns(form, seen, part)
                columns[rows] = block
        return columns

    def lens_columns(self, linear: LinearViews, names: Sequence[Sequence[str]]) -> Array:
        """Derivatives (S, N, 2, K) by named parameters of each lens (K: of all in turn)."""
        if not self.cameras:
            return lens_columns(self.lens, linear.image, names[0])
        ends = np.cumsum([0, *map(len, names)])
        columns = np.zeros((*linear.uv.shape, ends[-1]))
        for rows, i, part in linear.cameras:
            block = np.zeros((*part.uv.shape, ends[-1]))
            block[..., ends[i] : ends[i + 1]] = self.cameras[i].lens_columns(
                part, names[i : i + 1]
            )
            columns[rows] = block
        return columns

    def _linearize(self, pose: Pose, views: Views, limited: bool) -> LinearViews:
        if self.cameras:
            return self._by_camera(pose, views, limited)
        views = self.assign_boards(views)
        points = self._seen_points(pose, views)
        ideal, valid, d_pose = engines.linearize_views(self.lens, *pose, points, limited)
        linear = LinearViews(ideal, valid, d_pose, ideal, ideal, self.lens, pose, points, limited)
        if not self._acts('image', 'detector'):
            return linear
        uv = [ideal]
        for stage in ('image', 'detector'):
            scene = Scene(views, self.lens, pose, uv[-1], linear.image.incidence)
            uv.append(uv[-1] + self._displace(scene, stage))
        return replace(linear, uv=uv[2], optical=uv[1])

    def _by_camera(self, pose: Pose, views: Views, limited: bool) -> LinearViews:
        parts = tuple(
            CameraViews(rows, i, model._linearize(pose.take(rows), views.take(rows), limited))
            for rows, i, model in self.split(views)
        )
        uv, d_pose, ideal, optical, points = (
            gather_rows([(rows, getattr(part, name)) for rows, _, part in parts])
            for name in ('uv', 'd_pose', 'ideal', 'optical', 'points')
        )
        valid = gather_rows([(rows, part.valid.astype(float)) for rows, _, part in parts]) > 0
        return LinearViews(
            uv, valid, d_pose, ideal, optical, self.lens, pose, points, limited, parts
        )

    def _seen_points(self, pose: Pose, views: Views) -> Array:
        """Return the points (S, N, 3), m, where target and pose effects make them be seen."""
        points = views.points
        if self._acts('target', 'pose'):
            points = points + self._displace(Scene(views, self.lens, pose, views.uv), 'target')
        if self._acts('pose'):
            # When a row was exposed depends on where the point is seen: predict that first.
            seen = camera.project(self.lens, pose.into_body(points), limited=False).uv
            move = np.asarray(self._displace(Scene(views, self.lens, pose, seen), 'pose'))
            turn = rotation_from_vector(-move[..., 3:])
            place = pose.position[..., None, :]
            points = place + (turn @ (points - place - move[..., :3])[..., None])[..., 0]
        if self._acts('pupil'):
            local, off = pose.into_body(points), np.zeros(3)
            for _ in range(_PUPIL_STEPS):
                theta = camera.incidence(self.lens, local - off, limited=False).theta
                off = np.nan_to_num(self._pupil(theta))
            points = points - off @ np.swapaxes(pose.rotation, -1, -2)
        return points

    def _acts(self, *stages: str) -> bool:
        """Whether there is any effect at some stages."""
        terms = self.terms if self._target is None else (*self.terms, *self._target.terms)
        return any(term.effect.stage in stages for term in terms)

    def _displace(self, scene: Scene, stage: str) -> Array | float:
        moved: Array | float = 0.0
        for term in self.terms:
            if term.effect.stage == stage:
                moved = moved + term.displacement(scene)
        return moved if self._target is None else moved + self._target.displacement(scene, stage)


def project_corrected(lens: Lens, points: Array) -> Image:
    """Project points (..., 3), m, in the camera frame through a lens with its corrections."""
    return ForwardModel(lens).project(points)


def back_project_corrected(lens: Lens, uv: Array) -> Rays:
    """Return the rays of image points (..., 2), px, through a lens with its corrections."""
    rays = ForwardModel(lens).back_project(uv.reshape(1, -1, 2))
    return rays.reshape(uv.shape[:-1])
