"""Some image points carry the id of another landmark."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from fisheye_svp_ros.effects.base import Effect, NoiseEffect, Parameter, Scene


@dataclass(frozen=True)
class WrongIdsEffect(NoiseEffect):
    """A part of the observations is swapped with others of the same view."""

    name: ClassVar[str] = 'wrong_ids'
    signature: ClassVar[str] = 'a few huge residuals that end where another landmark is predicted'
    confused_with: ClassVar[str] = 'landmark_survey where one landmark is always mistaken'
    to_separate: ClassVar[str] = 'look at the named image points; match the ids again'

    @classmethod
    def candidates(cls, scene: Scene) -> Sequence[Effect]:
        return [cls()]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter('fraction', '1', 0.02),)
