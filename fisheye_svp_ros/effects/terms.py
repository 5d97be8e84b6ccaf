"""The terms of a model: effects with their values, and where their columns stand."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from math import prod

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.effects.base import Effect, NoiseEffect, Scene


@dataclass(frozen=True, eq=False)
class ModelTerm:
    """An effect in a model, of one camera, of a pair or of a rig.

    values (P,): of its parameters; columns (P,): theirs among those that all frames share; none
    before the model is linearized.
    """

    effect: Effect
    values: Array
    columns: Index = field(default_factory=lambda: np.empty(0, dtype=np.int64))

    @property
    def name(self) -> str:
        """The name of the effect."""
        return self.effect.name

    def displacement(self, scene: Scene) -> Array:
        """Displacement (S, N, D) at the effect's stage."""
        return self.effect.displacement(scene, self.values)


def camera_terms(terms: Iterable[ModelTerm], camera: int) -> tuple[ModelTerm, ...]:
    """Return what acts in the views of one camera, with that camera's values."""
    return tuple(
        ModelTerm(form, np.asarray(term.values)[own])
        for term in terms
        for form, own in term.effect.forms_of_camera(camera)
    )


def noise_scale(terms: Sequence[ModelTerm], scene: Scene) -> Array | float:
    """Return the factor (S, N) of noise effects on the standard deviation of the noise."""
    return prod(
        term.effect.noise_scale(scene, term.values)
        for term in terms
        if isinstance(term.effect, NoiseEffect)
    )
