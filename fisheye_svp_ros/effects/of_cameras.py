"""An effect of single cameras of a rig, each with parameters of its own."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Self

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Effect, Parameter, Scene, Term


@dataclass(frozen=True)
class OfCameras(Effect):
    """Forms of one effect by camera: its number in the rig, its name and the form."""

    parts: tuple[tuple[int, str, Effect], ...] = ()

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(
            parameter._replace(name=f'{label}.{parameter.name}')
            for _, label, effect in self.parts
            for parameter in effect.parameters
        )

    @property
    def key(self) -> str:
        forms = ', '.join(f'{label}: {effect.key}' for _, label, effect in self.parts)
        return f'{self.name}({forms})'

    @property
    def kinds(self) -> tuple[str, ...]:
        return tuple(f'{label}.{self.name}' for _, label, _ in self.parts)

    @property
    def of_recording(self) -> bool:
        return any(effect.of_recording for _, _, effect in self.parts)

    @property
    def per_frame(self) -> bool:
        return any(effect.per_frame for _, _, effect in self.parts)

    def holds_for(self, t: Array, known: Array) -> bool:
        return all(effect.holds_for(t, known) for _, _, effect in self.parts)

    def prior_sigma(self, scene: Scene) -> Array:
        own = {number: one for _, number, one in scene.cameras}
        return np.concatenate(
            [effect.prior_sigma(own[number]) for number, _, effect in self.parts]
        )

    def columns(self, scene: Scene) -> Array:
        """Every camera has a scene of its own: see `of_camera`."""
        raise NotImplementedError('an effect of single cameras is asked camera by camera')

    def of_camera(self, camera: int, values: Array) -> Term | None:
        """Return the form of one camera with its values (out of all), None if it has none."""
        start = 0
        for number, _, effect in self.parts:
            stop = start + len(effect.parameters)
            if number == camera:
                return effect, values[start:stop]
            start = stop
        return None

    def merge_with(self, other: Self) -> Effect:
        known = {number: (label, effect) for number, label, effect in self.parts}
        for number, label, effect in other.parts:
            if number in known:
                effect = known[number][1].merge_with(effect)
            known[number] = label, effect
        return type(self)(tuple((number, *known[number]) for number in sorted(known)))


@cache
def of_cameras(kind: type[Effect]) -> type[OfCameras]:
    """Return the class of an effect's forms by camera; it has the effect's name."""
    words = {
        name: getattr(kind, name)
        for name in (
            'name',
            'stage',
            'rarer_than',
            'asked_after',
            'to_separate',
            'abrupt',
            'of_frames',
        )
    }
    return type(f'{kind.__name__}OfCameras', (OfCameras,), words)


def by_camera(camera: int, label: str, effects: Iterable[Effect]) -> Sequence[OfCameras]:
    """Return effects as those of one camera."""
    return [of_cameras(type(effect))(((camera, label, effect),)) for effect in effects]


def combine_cameras(effects: Sequence[OfCameras]) -> OfCameras:
    """Return forms of one effect of different cameras as one, its parameters in their order."""
    return type(effects[0])(tuple(part for effect in effects for part in effect.parts))


def camera_terms(terms: Iterable[Term], camera: int) -> tuple[Term, ...]:
    """Return what acts in the views of one camera."""
    found = []
    for effect, values in terms:
        if isinstance(effect, OfCameras):
            own = effect.of_camera(camera, np.asarray(values))
            found += [] if own is None else [own]
        else:
            found.append((effect, values))
    return tuple(found)
