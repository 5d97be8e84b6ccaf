"""An effect that single cameras of a rig have, each with parameters of its own."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Self

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.effects.base import DIMENSIONS, Effect, Parameter, Scene


@dataclass(frozen=True)
class RigEffect(Effect):
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
    def cameras(self) -> tuple[str, ...]:
        return tuple(label for _, label, _ in self.parts)

    @property
    def form(self) -> Effect:
        return self.parts[0][2]

    @property
    def of_recording(self) -> bool:
        return any(effect.of_recording for _, _, effect in self.parts)

    @property
    def per_frame(self) -> bool:
        return any(effect.per_frame for _, _, effect in self.parts)

    def holds_for(self, t: Array, known: Array) -> bool:
        return all(effect.holds_for(t, known) for _, _, effect in self.parts)

    def prior_sigma(self, scene: Scene) -> Array:
        scenes = {number: camera for _, number, camera in scene.cameras}
        return np.concatenate(
            [effect.prior_sigma(scenes[number]) for number, _, effect in self.parts]
        )

    def columns(self, scene: Scene) -> Array:
        columns = np.zeros((*scene.uv.shape[:2], DIMENSIONS[self.stage], len(self.parameters)))
        for rows, number, seen in scene.cameras:
            for form, slots in self.forms_of_camera(number):
                block = np.zeros((*seen.uv.shape[:2], *columns.shape[2:]))
                block[..., slots] = form.columns(seen)
                columns[rows] = block
        return columns

    def forms_of_camera(self, camera: int) -> Iterator[tuple[Effect, Index]]:
        start = 0
        for number, _, effect in self.parts:
            stop = start + len(effect.parameters)
            if number == camera:
                yield effect, np.arange(start, stop)
            start = stop

    def merge_with(self, other: Self) -> Effect:
        merged = {number: (label, effect) for number, label, effect in self.parts}
        for number, label, effect in other.parts:
            if number in merged:
                effect = merged[number][1].merge_with(effect)
            merged[number] = label, effect
        return type(self)(tuple((number, *merged[number]) for number in sorted(merged)))


@cache
def rig_kind(kind: type[Effect]) -> type[RigEffect]:
    """Return the class of an effect's forms by camera; it has the effect's name."""
    words = {name: getattr(kind, name) for name in Effect.__annotations__ if hasattr(kind, name)}
    return type(f'Rig{kind.__name__}', (RigEffect,), words)


def assign_camera(effect: Effect, camera: int, label: str) -> Effect:
    """Return an effect as that of one camera; `merge_with` joins those of several."""
    return rig_kind(type(effect))(((camera, label, effect),))
