"""Intrinsics that change within a recording: smoothly, or at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import (
    Effect,
    Parameter,
    PlaneEffect,
    Scene,
    Untestable,
)

_MAX_STARTS = 32  # starts at pauses, and as many more, evenly spread
_MIN_INSTANTS = 5
_PAUSE = 2.0  # times the median time between instants
_STEP = (('relative', '1', 0.01), ('cx', 'px', 5.0), ('cy', 'px', 5.0))


@dataclass(frozen=True)
class FocalDriftEffect(PlaneEffect):
    """A relative change of the focal length as a polynomial of time, constant left out.

    Of the number of the frame where no time is known (timed: whether it is).

    Before and after the frames that it was found on it stays as it was at their ends, since a
    polynomial says nothing of other times.
    means (degree,): what of each Legendre polynomial is a constant, its mean over the frames where
    they are known: the lens's own focal length is then that of the whole recording, and not that
    of a time in a pause.
    """

    degree: int = 1
    start: float = field(default=0.0, metadata={'key': False})
    duration: float = field(default=1.0, metadata={'key': False})
    means: tuple[float, ...] = field(default=(), metadata={'key': False})
    timed: bool = field(default=True, metadata={'key': False})

    name = 'focal_drift'
    headline = 'The focal length drifts'
    meaning = 'The focal length drifts smoothly with time (temperature).'
    of_recording = True
    of_frames = True
    signature = 'residuals in proportion to the image height that change smoothly with time'
    to_separate = 'a longer recording with the temperature noted; frames well spread in time'

    @classmethod
    def candidates(cls, scene: Scene) -> Sequence[Effect]:
        timed = bool(np.isfinite(scene.times).all())
        t = scene.times if timed else scene.views.frame.astype(float)
        if len(np.unique(t)) < _MIN_INSTANTS:
            raise Untestable('fewer than five frames')
        bare = cls(3, float(t.min()), float(np.ptp(t)), timed=timed)
        means = tuple(bare._polynomials(t).mean(axis=0).tolist())
        return [replace(bare, degree=degree, means=means[:degree]) for degree in (1, 2, 3)]

    def holds_for(self, t: Array, known: Array) -> bool:
        return self.timed and super().holds_for(t, known)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(f'relative_t{i + 1}', '1', 0.01) for i in range(self.degree))

    def plane_columns(self, scene: Scene) -> Array:
        powers = self.relative_change(scene)
        return np.asarray(scene.normalized_uv()[..., None] * powers[:, None, None, :])

    def relative_change(self, scene: Scene) -> Array:
        """Return the derivatives (S, degree) of the relative focal length of each view."""
        instant = scene.times if self.timed else scene.views.frame.astype(float)
        return np.asarray(np.nan_to_num(self._polynomials(instant)))

    def _polynomials(self, t: Array) -> Array:
        x = np.clip(2 * (t - self.start) / self.duration - 1, -1, 1)
        powers = np.polynomial.legendre.legvander(x, self.degree)[..., 1:]
        return np.asarray(powers - (self.means or 0.0))


@dataclass(frozen=True)
class SessionStepEffect(Effect):
    """From each of the given instants (or frames, where no time is known) on, other intrinsics.

    Every step adds to the ones before it.
    means: the shares of frames after each start, where intrinsics are fitted, too: the lens's own
    are then those of the mean frame, and not those of the first session.
    """

    starts: tuple[float, ...] = ()
    timed: bool = field(default=True, metadata={'key': False})
    means: tuple[float, ...] = field(default=(), metadata={'key': False})

    name = 'session_step'
    headline = 'The intrinsics jump between groups of frames'
    meaning = 'The intrinsics jump between two groups of frames (a knock, a refocus).'
    stage = 'image'
    # A step after the first few frames is hardly more than intrinsics that are wrong throughout.
    asked_after = ('focal_length', 'principal_point')
    of_recording = True
    abrupt = True
    of_frames = True
    signature = 'residuals that change at one frame and keep their new pattern'
    to_separate = 'frames taken in turns before and after the suspected event, of the same scene'

    @classmethod
    def candidates(cls, scene: Scene) -> Sequence[Effect]:
        timed = bool(np.isfinite(scene.times).all())
        instants = np.unique(scene.times if timed else scene.views.frame.astype(float))
        if len(instants) < 6:
            raise Untestable('fewer than six frames')
        return [cls((float(start),), timed) for start in _step_instants(instants)]

    def beside_intrinsics(self, scene: Scene) -> Effect:
        return replace(self, means=tuple(self.step_design(scene).mean(axis=0).tolist()))

    def holds_for(self, t: Array, known: Array) -> bool:
        return self.timed and super().holds_for(t, known)

    def merge_with(self, other: Self) -> Effect:
        means: dict[float, float] = {}
        for step in (self, other):
            none = (0.0,) * len(step.starts)
            means |= zip(step.starts, step.means or none, strict=True)
        return replace(self, starts=tuple(means), means=tuple(means.values()))

    def rescale_values(self, values: Array, ratio: float) -> Array:
        return np.asarray((values.reshape(-1, len(_STEP)) / [ratio, 1.0, 1.0]).ravel())

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(
            Parameter(f'step{i + 1}.{name}', unit, large)
            for i in range(len(self.starts))
            for name, unit, large in _STEP
        )

    def columns(self, scene: Scene) -> Array:
        focal = np.array([scene.lens.fx, scene.lens.fy])
        growth = (scene.normalized_uv() * focal)[..., None]
        shift = np.broadcast_to(np.eye(2), (*scene.uv.shape, 2))
        step = np.concatenate([growth, shift], axis=-1)
        after = self.step_design(scene) - (self.means or 0.0)
        columns = step[..., None, :] * after[:, None, None, :, None]
        return np.asarray(columns.reshape(*scene.uv.shape, len(self.parameters)))

    def step_design(self, scene: Scene) -> Array:
        """Return 1.0 where views (S,) come after the starts (K,), 0.0 where before: (S, K)."""
        instant = scene.times if self.timed else scene.views.frame
        return np.asarray(instant[:, None] >= np.array(self.starts), dtype=float)


def _step_instants(instants: Array) -> Array:
    """Return the instants to ask for: of a recording of many every few, and those after pauses."""
    starts, pauses = instants[2:-1], np.diff(instants)[1:-1]
    if len(starts) <= 2 * _MAX_STARTS:
        return starts
    after = np.argsort(-pauses, kind='stable')[:_MAX_STARTS]
    after = after[pauses[after] > _PAUSE * np.median(pauses)]
    spread = np.linspace(0, len(starts) - 1, _MAX_STARTS).round().astype(int)
    return np.asarray(starts[np.union1d(after, spread)])
