"""The forward model: landmarks and poses through target, pose, ray, image and detector."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.camera import Image, LinearImage, Rays, back_project, project
from fisheye_svp_ros.camera import project_with_jacobian as _linear
from fisheye_svp_ros.lens import Lens
from fisheye_svp_ros.observations import Views
from fisheye_svp_ros.pose import Pose


class LinearViews(NamedTuple):
    """Predicted image points of views and their derivatives.

    uv (S, N, 2), px; valid (S, N); d_pose (S, N, 2, 6), px/m and px/rad, by the small change of
    `pose.Pose.retract`; d_target (S, N, 2, 3), px/m; image: the lens's own derivatives.
    """

    uv: Array
    valid: Mask
    d_pose: Array
    d_target: Array
    image: LinearImage


class ForwardModel:
    """A lens with its effects, ready to predict and to be solved with."""

    def __init__(self, lens: Lens) -> None:
        self.lens = lens

    def predict(self, pose: Pose, views: Views, limited: bool = True) -> Image:
        """Predict image points of views (S, N) from poses (S,) of the camera in the world.

        limited: refuse points outside the field of view, as a camera does.
        """
        return project(self.lens, pose.into_body(views.points), limited)

    def linearise(self, pose: Pose, views: Views) -> LinearViews:
        """Predict and differentiate; angles past the field of view are allowed (a solver)."""
        image = _linear(self.lens, pose.into_body(views.points), limited=False)
        # Columns by the camera's place and turn share d_point R^T (see pose.Pose.retract).
        d_target = image.d_point @ np.swapaxes(pose.rotation, -1, -2)[..., None, :, :]
        arm = views.points - pose.position[..., None, :]
        d_turn = np.cross(d_target, arm[..., None, :])
        d_pose = np.concatenate([-d_target, d_turn], axis=-1)
        return LinearViews(image.uv, image.valid, d_pose, d_target, image)

    def back_project(self, uv: Array) -> Rays:
        """Return the rays of image points (..., 2), px, in the camera frame."""
        return back_project(self.lens, uv)
