"""The detector pulls points towards a sub-pixel phase."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Effect, Parameter, Scene


@dataclass(frozen=True)
class DetectorBiasEffect(Effect):
    """A bias that repeats with every pixel (peak locking): sine and cosine of the phase."""

    order: int = 1

    name = 'detector_bias'
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
