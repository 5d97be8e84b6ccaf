"""The focal length drifts smoothly with time (temperature)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Effect, Parameter, PlaneEffect, Scene, require_time


@dataclass(frozen=True)
class FocalDriftEffect(PlaneEffect):
    """A relative change of the focal length as a polynomial of time, constant left out.

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

    name = 'focal_drift'
    of_recording = True
    of_frames = True
    when_untestable = (
        'give the time of each frame (a column t, s): drifts, jumps and motion during the '
        'exposure become testable'
    )
    signature = 'residuals in proportion to the image height that change smoothly with time'
    to_separate = 'a longer recording with the temperature noted; frames well spread in time'

    @classmethod
    def candidates(cls, scene: Scene) -> Sequence[Effect]:
        t = require_time(scene, 5)
        bare = cls(3, float(t.min()), float(np.ptp(t)))
        means = tuple(bare._polynomials(t).mean(axis=0).tolist())
        return [replace(bare, degree=degree, means=means[:degree]) for degree in (1, 2, 3)]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(f'relative_t{i + 1}', '1', 0.01) for i in range(self.degree))

    def plane_columns(self, scene: Scene) -> Array:
        powers = np.nan_to_num(self._polynomials(scene.times))
        return np.asarray(scene.normalized_uv()[..., None] * powers[:, None, None, :])

    def _polynomials(self, t: Array) -> Array:
        x = np.clip(2 * (t - self.start) / self.duration - 1, -1, 1)
        powers = np.polynomial.legendre.legvander(x, self.degree)[..., 1:]
        return np.asarray(powers - (self.means or 0.0))
