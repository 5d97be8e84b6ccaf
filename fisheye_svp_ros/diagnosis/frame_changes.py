"""How a camera differs from frame to frame, and what that costs the rays of a single frame.

Changes of a focal length or a center hide in the poses: of 1 % in the focal length a tenth is
left in the image, and rays 60 deg off the axis are off by 10 mrad.  So they are judged as angles,
by the predicted coefficients, not by what they leave.  Shapes of a board that differ from frame to
frame are errors of the target, and no part of this.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.diagnosis.causes import Cause
from fisheye_svp_ros.diagnosis.evaluation import Evaluation
from fisheye_svp_ros.diagnosis.random_effects import BEND, NAMES
from fisheye_svp_ros.diagnosis.variance_budget import Component, significant_components
from fisheye_svp_ros.effects.recording_effects import FocalDriftEffect, SessionStepEffect
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.solve.ray_errors import (
    RANGES,
    points_on_rays,
    typical_points,
    without_motion,
)

_FOCAL, _CENTER = 'frame_focal', 'frame_centre'
_WARP = ('frame_linear', 'frame_quadratic')
_SHAPELESS = ('frame_bumps',)
_STEP = 1e-4
_NEAR_RANGE = RANGES.index(1.0)


class FrameChanges(NamedTuple):
    """What the F frames of a camera have of their own.

    focal (F,): relative focal lengths; center (F, 2), px; each about its mean.
    focal_error, center_error, warp_error: rms angles, rad, by which the rays of one frame differ
    from those of the lens at 1 m, by its focal length, its center, and smooth warps of its image;
    shapeless_error: the same of fields that are finer than that.  As for `RayError`, a motion of
    the camera frame is a convention, and taken out.
    """

    focal: Array
    center: Array
    focal_error: float
    center_error: float
    warp_error: float
    shapeless_error: float

    @property
    def ray_error(self) -> float:
        """Rms angle, rad, by which rays of a single frame differ from those of the lens."""
        return float(np.hypot.reduce([self.focal_error, self.center_error, self.warp_error]))


def find_frame_changes(
    evaluation: Evaluation, causes: Sequence[Cause], components: Sequence[Component]
) -> FrameChanges:
    """Return what named causes and significant random effects change from frame to frame."""
    sizes = {part.name: part.sd_px for part in significant_components(components)}
    # What a bend that is not quite quadratic leaves looks like a warp of the image.
    warps = [name for name in _WARP if sizes.get(name, 0.0) > sizes.get(BEND, 0.0)]
    linear = evaluation.null.linear
    focal, center = _named_changes(evaluation, causes)
    half = _half_extent(evaluation)
    if _FOCAL in sizes:
        focal = focal + evaluation.fitted.frame_coefficients(_FOCAL).sum(axis=1) / half
    if _CENTER in sizes:
        own = evaluation.fitted.frame_coefficients(_CENTER)
        center = center + own.reshape(len(own), -1, 2).sum(axis=1)
    focal, center = focal - focal.mean(), center - center.mean(axis=0)
    lens, views = linear.state.lens, linear.data.views
    by_focal, by_center = _ray_responses(lens, typical_points(views.uv[views.used]))
    return FrameChanges(
        focal,
        center,
        float(focal.std()) * by_focal,
        float(np.sqrt(center.var(axis=0) @ by_center**2)),
        _field_rms(evaluation, warps) / lens.fx,
        _field_rms(evaluation, [name for name in _SHAPELESS if name in sizes]) / lens.fx,
    )


def _ray_responses(lens: Lens, uv: Array) -> tuple[float, Array]:
    """Return the rms angle, rad, of rays at 1 m by a relative change of f, and by px of u and v.

    Per unit; uv (G, 2), px: the image points of the rays.
    """
    steps = [
        replace(lens, fx=(1 + _STEP) * lens.fx, fy=(1 + _STEP) * lens.fy),
        replace(lens, cx=lens.cx + _STEP),
        replace(lens, cy=lens.cy + _STEP),
    ]
    points = points_on_rays(lens, uv)
    moves = np.stack([points_on_rays(step, uv) - points for step in steps], axis=-1) / _STEP
    there = np.isfinite(moves).all(axis=(0, 2, 3))
    angles = without_motion(points[:, there], moves[:, there])[_NEAR_RANGE]
    sizes = np.sqrt((angles**2).sum(axis=1).mean(axis=0))
    return float(sizes[0]), np.asarray(sizes[1:])


def _field_rms(evaluation: Evaluation, names: Sequence[str]) -> float:
    """Return the rms, px, of the image fields that frames are predicted to have of their own."""
    if not names:
        return 0.0
    columns = evaluation.fitted.random.columns
    mine = np.isin(columns.group_label, [NAMES.index(name) for name in names])
    own = evaluation.fitted.frame_coefficients(*names)
    rows = np.einsum('fmb,fb->fm', columns.group[..., mine], own)
    weight, used = evaluation.null.linear.row_weight, evaluation.null.linear.row_mask
    return float(np.sqrt(2 * ((rows[used] / weight[used]) ** 2).mean()))


def _half_extent(evaluation: Evaluation) -> float:
    """Return half the larger extent of the points, px: the unit of `random_effects`."""
    views = evaluation.null.linear.data.views
    return float(np.ptp(views.uv[views.used], axis=0).max()) / 2


def _named_changes(evaluation: Evaluation, causes: Sequence[Cause]) -> tuple[Array, Array]:
    """Return what named causes add to focal lengths (F,), relative, and centers (F, 2), px."""
    linear = evaluation.null.linear
    count = linear.data.frames
    focal, center = np.zeros(count), np.zeros((count, 2))
    named = {cause.effect for cause in causes}
    first = linear.data.first_views
    for term in linear.state.terms:
        effect, values = term.effect, term.values
        if effect.name not in named:
            continue
        if isinstance(effect, SessionStepEffect):
            steps = values.reshape(-1, 3)
            after = effect.step_design(linear.scene)[first]
            focal, center = focal + after @ steps[:, 0], center + after @ steps[:, 1:]
        elif isinstance(effect, FocalDriftEffect):
            focal = focal + effect.relative_change(linear.scene)[first] @ values
    return focal, center
