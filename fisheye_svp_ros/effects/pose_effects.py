"""Effects on the pose of a camera at the moment of a point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Effect, Parameter, Scene, require_cameras, require_motion


class RollingShutterEffect(Effect):
    """The read-out time from the first row to the last; motion from neighbors without a pause."""

    name = 'rolling_shutter'
    headline = 'Rows are exposed one after the other'
    meaning = 'The rows of the image are exposed one after the other while the camera moves.'
    stage = 'pose'
    of_motion = True
    of_frames = True
    when_untestable = (
        'give the time of each frame (a column t, s): motion during the exposure becomes testable'
    )
    signature = (
        'residuals that grow with the distance from the middle row and with the camera speed'
    )
    to_separate = 'the same scene from a tripod: the residuals vanish when nothing moves'

    @classmethod
    def candidates(cls, scene: Scene) -> Sequence[Effect]:
        require_motion(scene)
        return [cls()]

    parameters = (Parameter('readout', 's', 0.05),)

    def columns(self, scene: Scene) -> Array:
        fraction = scene.uv[..., 1] / scene.lens.height - 0.5
        return np.asarray((fraction[..., None] * scene.twist[:, None, :])[..., None])

    def resize_values(self, values: Array, scale: float, rows: float) -> Array:
        return values * rows


class StereoTimeOffsetEffect(Effect):
    """A delay of every camera but the first; motion from the neighboring frames."""

    name = 'stereo_time_offset'
    meaning = 'The second camera of a rig exposes later than its stamp says.'
    stage = 'pose'
    of_motion = True
    of_frames = True
    signature = 'residuals of one camera against the other that grow with the speed of the rig'
    to_separate = 'the same scene with the rig at rest; a flash of light visible to both cameras'

    @classmethod
    def candidates(cls, scene: Scene) -> Sequence[Effect]:
        require_cameras(scene)
        require_motion(scene)
        return [cls()]

    parameters = (Parameter('delay', 's', 0.05),)

    def columns(self, scene: Scene) -> Array:
        later = scene.twist * (scene.views.camera > 0)[:, None]
        return np.broadcast_to(later[:, None, :, None], (*scene.uv.shape[:2], 6, 1))


@dataclass(frozen=True)
class RigFlexEffect(Effect):
    """The turn of the second camera in the rig: a polynomial of time, or one for each frame.

    degree: of the polynomial, 0 for a turn of its own in each frame, the mean of them taken away.
    """

    degree: int = 1
    frames: tuple[int, ...] = field(default=(), metadata={'key': False})

    name = 'rig_flex'
    headline = 'The rig bends'
    meaning = 'The rig bends: the pose of its second camera changes.'
    stage = 'pose'
    of_recording = True
    of_frames = True
    signature = 'residuals of one camera against the other that differ from frame to frame'
    to_separate = 'a stiffer rig; frames with the rig unloaded and loaded'

    @classmethod
    def candidates(cls, scene: Scene) -> Sequence[Effect]:
        require_cameras(scene)
        seen, count = np.unique(scene.views.frame, return_counts=True)
        frames, shared = (tuple(map(int, part)) for part in (seen, seen[count > 1]))
        forms = [cls(1, frames), cls(2, frames), cls(0, shared)]
        return [form for form in forms if form.degree < len(form.frames)]

    def holds_for(self, t: Array, known: Array) -> bool:
        return False  # the frames of another table have numbers of their own

    @property
    def per_frame(self) -> bool:
        return not self.degree

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Degree 0 stands for a turn of its own in each frame."""
        labels = [f't{i + 1}' for i in range(self.degree)] or [f'f{f}' for f in self.frames]
        return tuple(Parameter(f'{a}_{label}', 'rad', 0.01) for label in labels for a in 'xyz')

    def report_values(self, values: Array) -> Array:
        """Take the mean of single frames away: that is how the rig stands."""
        if self.degree:
            return values
        turns = values.reshape(len(self.frames), 3, *values.shape[1:])
        return np.asarray(turns - turns.mean(axis=0)).reshape(values.shape)

    def columns(self, scene: Scene) -> Array:
        order = np.searchsorted(self.frames, scene.views.frame)
        if self.degree:
            x = 2 * order / max(len(self.frames) - 1, 1) - 1
            amounts = np.polynomial.legendre.legvander(x, self.degree)[:, 1:]
        else:
            in_frame = scene.views.frame[:, None] == np.array(self.frames)
            amounts = np.where(
                in_frame.any(axis=1, keepdims=True), in_frame - 1 / len(self.frames), 0.0
            )
        turn = scene.pose.rotation * (scene.views.camera > 0)[:, None, None]
        turns = amounts[:, None, :, None] * turn[:, :, None, :]
        turns = turns.reshape(len(order), 3, len(self.parameters))
        columns = np.concatenate([np.zeros_like(turns), turns], axis=1)
        return np.broadcast_to(columns[:, None], (*scene.uv.shape[:2], *columns.shape[1:]))
