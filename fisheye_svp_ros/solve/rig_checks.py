"""Whether cameras keep their places: where no rig explains them each view is posed by itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fisheye_svp_ros.arrays import Mask
from fisheye_svp_ros.effects.base import Untestable
from fisheye_svp_ros.effects.pose_effects import RigFlexEffect, StereoTimeOffsetEffect
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.solve.bundle_adjustment import adjust
from fisheye_svp_ros.solve.initial_rig import initial_state, localize_cameras, localize_frames
from fisheye_svp_ros.solve.outliers import cross_camera_offsets
from fisheye_svp_ros.solve.rig_state import (
    Linearization,
    RigState,
    RigViews,
    free_parameters,
    with_effect,
)

MIN_SHARED_FRAMES = 5  # of two cameras: of fewer, others hardly predict one by the rig
MAX_RIG_RATIO = 2.0  # times the rms that each camera has by itself: they do not stand still
_UNRELATED_SHARE = 0.05  # of the image, by which half of the views contradict a rig: none is there
_EXPLAINED_RATIO = 1.1  # times that rms, if an effect of a rig is all that moves them


def unpair_cameras(data: RigViews) -> RigViews:
    """Return the data with a pose for every view, whatever rig the cameras are said to be."""
    return replace(data, frame_of=np.arange(len(data.frame_of)))


def is_exchanged(rig: Pose) -> bool:
    """Whether the left camera stands to the right, seen by both; rig: the left in the right one.

    Cameras that stand one above or behind the other, or back to back, have no left and right.
    """
    left, right = rig.position, rig.inverse().position
    return bool(min(left[0], -right[0]) > np.linalg.norm(left) / 2)


def is_unpaired(data: RigViews) -> bool:
    """Whether there are frames of several cameras that `unpair_cameras` has taken apart."""
    views = len(data.views.frame)
    return data.frames == views > len(np.unique(data.views.frame))


def has_no_rig(data: RigViews) -> bool:
    """Whether no frame has several views, so that nothing says how the cameras stand."""
    return data.frames == len(data.views.frame)


def has_few_shared_frames(data: RigViews) -> bool:
    """Whether several cameras saw so few frames that what they say of a rig is no measure."""
    shared = int((np.bincount(data.frame_of) > 1).sum())
    return data.cameras > 1 and data.poses is None and shared < MIN_SHARED_FRAMES


def rig_differs(test: RigViews, state: RigState) -> bool:
    """Whether the cameras do not stand as in a state fitted to other frames."""
    if has_no_rig(test):
        return False
    alone = unpair_cameras(test)
    together, own = (
        Linearization(data, localize_frames(data, state), ()).rms_px for data in (test, alone)
    )
    return together > MAX_RIG_RATIO * own


def is_unrelated(data: RigViews, state: RigState) -> bool:
    """Whether no rig explains where the cameras stand in most frames that several of them saw."""
    if data.cameras < 2 or data.poses is not None:
        return False
    several, contradicted = contradicted_views(data, state)
    return bool(several.any() and 2 * contradicted.sum() >= several.sum())


def contradicted_views(data: RigViews, state: RigState) -> tuple[Mask, Mask]:
    """Return which views (S,) other cameras share, and which of them a rig does not explain."""
    misfit, _ = cross_camera_offsets(data, state, localize_cameras(state.model, data.views))
    several = np.isfinite(misfit)
    extent = float(np.ptp(data.views.uv[data.views.used], axis=0).max())
    return several, several & (misfit > _UNRELATED_SHARE * extent)


def rig_is_inconsistent(
    data: RigViews, lenses: Sequence[Lens], base: RigState, free: Sequence[str]
) -> bool:
    """Whether the cameras do not keep their places, beyond what any effect of a rig allows.

    lenses: as they were given; base: the fit of the data as a rig's.
    """
    if data.poses is not None or has_no_rig(data):
        return False
    alone = unpair_cameras(data)

    def misfits(free: Sequence[str], together: RigState) -> tuple[float, float]:
        posed = adjust(alone, initial_state(alone, lenses[0], lenses[1:]), free)
        return Linearization(data, together, ()).rms_px, Linearization(alone, posed, ()).rms_px

    whole, own = misfits(free, base)
    if whole < MAX_RIG_RATIO * own:
        return False
    # Lenses that are wrong look like a rig that moves: they get what they want first.
    every = free_parameters(dict(zip(base.labels, lenses, strict=True)), True)
    base = adjust(data, base, every)
    whole, own = misfits(every, base)
    if whole < MAX_RIG_RATIO * own:
        return False
    scene = Linearization(data, base, ()).scene
    for kind in (RigFlexEffect, StereoTimeOffsetEffect):
        try:
            effect = kind.candidates(scene)[-1]
        except Untestable:
            continue
        base = with_effect(base, effect, np.zeros(len(effect.parameters)))
    return Linearization(data, adjust(data, base, every), ()).rms_px > _EXPLAINED_RATIO * own
