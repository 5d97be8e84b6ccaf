"""The intrinsics jump between two groups of frames (a knock, a refocus)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Effect, Parameter, Scene, Untestable


@dataclass(frozen=True)
class SessionStepEffect(Effect):
    """From one frame on, focal length and principal point are others."""

    first_frame: int = 0

    name: ClassVar[str] = 'session_step'
    stage: ClassVar[str] = 'image'
    signature: ClassVar[str] = (
        'residuals that change at one frame and keep their new pattern'
    )
    confused_with: ClassVar[str] = 'focal_drift, landmark_survey of landmarks seen in one group only'
    to_separate: ClassVar[str] = (
        'frames taken in turns before and after the suspected event, of the same scene'
    )

    @classmethod
    def candidates(cls, scene: Scene) -> Sequence[Effect]:
        frames = np.unique(scene.views.frame)
        if len(frames) < 6:
            raise Untestable('fewer than six frames')
        return [cls(int(frame)) for frame in frames[2:-1]]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (
            Parameter('relative', '1', 0.01),
            Parameter('cx', 'px', 5.0),
            Parameter('cy', 'px', 5.0),
        )

    def columns(self, scene: Scene) -> Array:
        focal = np.array([scene.lens.fx, scene.lens.fy])
        growth = (scene.normalised() * focal)[..., None]
        shift = np.broadcast_to(np.eye(2), (*scene.uv.shape, 2))
        after = scene.views.frame >= self.first_frame
        return np.concatenate([growth, shift], axis=-1) * after[:, None, None, None]
