"""Replays measured observations as the topics of a camera."""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Index
from fisheye_svp_ros.errors import ObservationError, ParameterError
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.parameters import parameter
from fisheye_svp_ros.io.readers import read_observations, read_poses
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.nodes.camera import CameraNode, rows_by_frame
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.rectify.maps import svp_equivalent
from fisheye_svp_ros.scene.observations import Landmarks, Observations
from fisheye_svp_ros.study.settings import CameraSettings

_NAMESPACE = re.compile('[A-Za-z_][A-Za-z0-9_]*')


@dataclass(frozen=True)
class MeasuredCameraSettings(CameraSettings):
    """Parameters of the measured camera."""

    observations: str = parameter(
        '', 'Observations: a CSV file, a folder of ORPC files, a recording', file=True
    )
    true_poses: str = parameter(
        '', 'Poses CSV with the true pose of each frame. Empty: unknown', file=True
    )
    lens: str = parameter(
        '',
        'Lens for `camera_info` and `scenario`: a file, or a name in config/lenses. Empty: '
        'unknown',
        file=True,
    )


class Recording(NamedTuple):
    """What is replayed: rows by frame and camera, stamps by frame (ns; empty: now)."""

    observations: Observations
    landmarks: Landmarks
    rows: dict[tuple[int, str], Index]
    stamps: dict[int, int]
    poses: dict[int, Pose]
    lens: Lens | None


class MeasuredCamera(CameraNode):
    """Publishes one set a frame, under the time of the frame where the data has one."""

    NAME = 'measured_camera'
    SETTINGS = MeasuredCameraSettings
    settings: MeasuredCameraSettings

    def __init__(self, node_name: str | None = None, **options: Any) -> None:
        super().__init__(node_name, **options)
        self._recording: Recording
        self.start()

    def prepare(self, settings: MeasuredCameraSettings) -> Recording:
        """Read the files; refuse settings with which there is nothing to replay."""
        super().prepare(settings)
        if not settings.observations:
            raise ParameterError('observations is empty; name the file to replay')
        table = read_observations(settings.observations)
        for name in table.cameras:
            if name and not _NAMESPACE.fullmatch(name):
                raise ObservationError(f'camera {name!r} cannot name a namespace')
        lens = load_lens(lens_path(settings.lens)) if settings.lens else None
        return Recording(
            observations=table,
            landmarks=table.landmarks(),
            rows=rows_by_frame(table),
            stamps=frame_stamps(table),
            poses=_true_poses(settings.true_poses, table),
            lens=None if lens is None else svp_equivalent(lens),
        )

    def configure(self, recording: Recording) -> None:
        """Start over with another recording."""
        for name in recording.observations.cameras:
            self.camera(name, bool(recording.poses))
        self._recording = recording
        self.publish_landmarks(recording.landmarks, 0)
        frames = recording.observations.frames.tolist()
        self.play(itertools.cycle(frames) if self.settings.repeat else iter(frames))

    def stamp_of(self, step: int) -> int:
        """Return the time of a frame where the data has one."""
        stamps = self._recording.stamps
        return stamps[step] if stamps else super().stamp_of(step)

    def publish_set(self, step: int, stamp: int) -> None:
        """Publish a frame."""
        recording, settings = self._recording, self.settings
        place = {'frame': step, 'source': settings.observations}
        self.tag(stamp, {**place, **({'lens': settings.lens} if settings.lens else {})})
        for name in recording.observations.cameras:
            rows = recording.rows.get((step, name))
            if rows is not None:
                seen = recording.observations.take(rows)
                self.camera(name, bool(recording.poses)).publish(
                    stamp, seen, recording.poses.get(step), recording.lens
                )


def frame_stamps(table: Observations) -> dict[int, int]:
    """Return the time of each frame, ns; empty where a frame has none, or not one of its own."""
    stamps = {}
    for frame in table.frames.tolist():
        t = table.t[table.frame == frame]
        stamps[frame] = round(float(t.min()) * 1e9) if np.isfinite(t).all() else -1
    distinct = len(set(stamps.values())) == len(stamps)
    return stamps if distinct and min(stamps.values()) >= 0 else {}


def _true_poses(path: str, table: Observations) -> dict[int, Pose]:
    if not path:
        return {}
    if len(table.cameras) > 1:
        raise ParameterError('true_poses is for the observations of one camera; leave it empty')
    frame, pose = read_poses(path)
    return {number: pose.take(i) for i, number in enumerate(frame.tolist())}
