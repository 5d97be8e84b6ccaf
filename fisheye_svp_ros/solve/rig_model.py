"""Cameras that keep their places in a body, as one camera of all their points.

What solves, examines and weighs the poses of one camera so does that of a rig: landmarks, tags,
priors and outliers are those of the body, whichever camera sees them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.forward import ForwardModel, LinearViews, ModelPart
from fisheye_svp_ros.optics.camera import Image, Rays
from fisheye_svp_ros.pose import Pose, cross_matrix
from fisheye_svp_ros.scene.observations import Views


class RigModel(ForwardModel):
    """The cameras of a rig.  Its views (S, N) hold the points of each camera, one after the other.

    models (C,); places (C,): of the cameras in the body, whose pose is solved for; widths (C,):
    how many of the N points are of each.
    """

    def __init__(
        self, models: Sequence[ForwardModel], places: Pose, widths: Sequence[int]
    ) -> None:
        super().__init__(replace(models[0].lens, corrections={}, target={}), ())
        self._models, self._places, self._widths = tuple(models), places, tuple(widths)

    @property
    def is_lens_only(self) -> bool:
        """See ForwardModel."""
        return False

    def parts(self, views: Views) -> list[ModelPart]:
        """See ForwardModel."""
        ends, plain = np.cumsum([0, *self._widths]), views._replace(landmark_covariance=None)
        found = []
        for i, model in enumerate(self._models):
            if not self._widths[i]:
                continue
            own = plain.take_points(np.arange(ends[i], ends[i + 1]))
            own = own._replace(camera=np.full(len(views.frame), i))
            found.append(ModelPart(model, self._places.take(i), own))
        return found

    def neglecting(self) -> ForwardModel | None:
        """See ForwardModel."""
        others = [model.neglecting() for model in self._models]
        if not any(others):
            return None
        models = [other or model for other, model in zip(others, self._models, strict=True)]
        return RigModel(models, self._places, self._widths)

    def seeing(self, views: Views) -> ForwardModel:
        """See ForwardModel."""
        models = list(self._models)
        for part in self.parts(views):
            models[int(part.views.camera[0])] = part.model.seeing(part.views)
        return self._with(models)

    def without_motion(self) -> ForwardModel:
        """See ForwardModel."""
        return self._with([model.without_motion() for model in self._models])

    def _with(self, models: Sequence[ForwardModel]) -> ForwardModel:
        same = all(new is old for new, old in zip(models, self._models, strict=True))
        return self if same else RigModel(models, self._places, self._widths)

    def predict(self, pose: Pose, views: Views, limited: bool = True) -> Image:
        """See ForwardModel."""
        seen = [
            part.model.predict(_camera_pose(pose, part), part.views, limited)
            for part in self.parts(views)
        ]
        return Image(*(np.concatenate(fields, axis=1) for fields in zip(*seen, strict=True)))

    def back_project(self, uv: Array) -> Rays:
        """Return the rays of image points (S, N, 2), px, in the body."""
        rays, ends = [], np.cumsum([0, *self._widths])
        for i, model in enumerate(self._models):
            if not self._widths[i]:
                continue
            own, place = model.back_project(uv[:, ends[i] : ends[i + 1]]), self._places.take(i)
            direction = own.direction @ place.rotation.T
            origin = own.origin @ place.rotation.T + place.position
            rays.append(own._replace(direction=direction, origin=origin))
        return Rays(*(np.concatenate(fields, axis=1) for fields in zip(*rays, strict=True)))

    def d_pose(self, linear: LinearViews, views: Views) -> Array:
        """See ForwardModel."""
        return linear.d_pose

    def _linearize(self, pose: Pose, views: Views, limited: bool) -> LinearViews:
        uv, valid, columns = [], [], []
        for part in self.parts(views):
            camera = _camera_pose(pose, part)
            linear = part.model._linearize(camera, part.views, limited)
            d_camera = part.model.d_pose(linear, part.views)
            # The body turns about its origin: a camera off it also moves.
            arm = cross_matrix(camera.position - pose.position)[:, None]
            d_turn = d_camera[..., 3:] - d_camera[..., :3] @ arm
            columns.append(np.concatenate([d_camera[..., :3], d_turn], axis=-1))
            uv.append(linear.uv)
            valid.append(linear.valid)
        image = np.concatenate(uv, axis=1)
        d_pose, inside = np.concatenate(columns, axis=1), np.concatenate(valid, axis=1)
        return LinearViews(
            image, inside, d_pose, image, image, self.lens, pose, views.points, limited
        )


def _camera_pose(pose: Pose, part: ModelPart) -> Pose:
    return pose.compose(part.place.broadcast_to(*pose.shape))
