"""Cameras whose photographs are not of the same moments: each view is a frame of its own then."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fisheye_svp_ros.diagnosis.adjustment import fit, start, start_poses
from fisheye_svp_ros.diagnosis.inputs import free_names
from fisheye_svp_ros.diagnosis.model import Data, Linearised, State
from fisheye_svp_ros.diagnosis.noise import between_cameras
from fisheye_svp_ros.diagnosis.residuals import rms_px
from fisheye_svp_ros.diagnosis.search import with_effect
from fisheye_svp_ros.effects.base import Untestable
from fisheye_svp_ros.effects.rig_flex import RigFlexEffect
from fisheye_svp_ros.effects.stereo_time_offset import StereoTimeOffsetEffect
from fisheye_svp_ros.optics.lens import Lens

FEWEST = 5  # frames that two cameras saw: of fewer, the others hardly predict one by the rig
_UNRELATED = 0.05  # of the image, by which half of the views contradict a rig: none is there
LOOSE = 2.0  # times the misfit that each camera has by itself: they do not stand still
_EXPLAINED = 1.1  # times that misfit, if an effect of a rig is all that moves them


def each_alone(data: Data) -> Data:
    """Return the data with a pose for every view, whatever rig the cameras are said to be."""
    return replace(data, frame_of=np.arange(len(data.frame_of)))


def posed_alone(data: Data) -> bool:
    """Whether there are frames of several cameras that `each_alone` has taken apart."""
    views = len(data.views.frame)
    return data.frames == views > len(np.unique(data.views.frame))


def without_rig(data: Data) -> bool:
    """Whether no frame has several views, so that nothing says how the cameras stand."""
    return data.frames == len(data.views.frame)


def few_shared(data: Data) -> bool:
    """Whether several cameras saw so few frames that what they say of a rig is no measure."""
    shared = int((np.bincount(data.frame_of) > 1).sum())
    return data.cameras > 1 and data.poses is None and shared < FEWEST


def stands_elsewhere(test: Data, state: State) -> bool:
    """Whether the cameras do not stand as in a state fitted to other frames."""
    if without_rig(test):
        return False
    alone = each_alone(test)
    together, own = (rms_px(Linearised(data, start_poses(data, state), ()))
                     for data in (test, alone))
    return together > LOOSE * own


def unrelated(data: Data, state: State) -> bool:
    """Whether no rig explains where the cameras stand in most frames that several of them saw."""
    if data.cameras < 2 or data.poses is not None:
        return False
    misfit, _ = between_cameras(data, state, state.cameras.localize(data.views))
    several = np.isfinite(misfit)
    extent = float(np.ptp(data.views.uv[data.views.used], axis=0).max())
    return bool(several.any() and
                np.quantile(misfit[several], 0.5, method='higher') > _UNRELATED * extent)


def loose(data: Data, lenses: Sequence[Lens], base: State, free: Sequence[str]) -> bool:
    """Whether the cameras do not keep their places, beyond what any effect of a rig allows.

    lenses: as they were given; base: the fit of the data as a rig's.
    """
    if data.poses is not None or without_rig(data):
        return False
    alone = each_alone(data)

    def misfits(free: Sequence[str], together: State) -> tuple[float, float]:
        posed = fit(alone, start(alone, lenses[0], lenses[1:]), free)
        return rms_px(Linearised(data, together, ())), rms_px(Linearised(alone, posed, ()))

    whole, own = misfits(free, base)
    if whole < LOOSE * own:
        return False
    # Lenses that are wrong look like a rig that moves: they get what they want first.
    every = free_names(dict(zip(base.labels, lenses, strict=True)), True)
    base = fit(data, base, every)
    whole, own = misfits(every, base)
    if whole < LOOSE * own:
        return False
    scene = Linearised(data, base, ()).scene
    for kind in (RigFlexEffect, StereoTimeOffsetEffect):
        try:
            effect = kind.candidates(scene)[-1]
        except Untestable:
            continue
        base = with_effect(base, effect, np.zeros(len(effect.parameters)))
    return rms_px(Linearised(data, fit(data, base, every), ())) > _EXPLAINED * own
