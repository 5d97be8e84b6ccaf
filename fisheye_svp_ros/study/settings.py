"""The parameter tables of the nodes of a sweep; the offline sweep reads the same."""

from __future__ import annotations

from dataclasses import dataclass

from fisheye_svp_ros.io.parameters import parameter
from fisheye_svp_ros.simulate.scenario import Scenario


@dataclass(frozen=True)
class Settings:
    """Parameters that every node has."""

    wait_for_subscribers: int = parameter(
        0, 'Hold back what this node has to tell until so many listen to its image points (a '
        'camera; to its true pose, where it photographs) or results (a solver), so that nobody '
        'misses the first', span=(0, 1000)
    )
    folder: str = parameter(
        '', 'Folder below which files may be named while the node runs, by `scenario` or a new '
        'value of a parameter; empty: none, only names in config/', fixed=True
    )


@dataclass(frozen=True)
class CameraSettings(Settings):
    """Parameters of every camera."""

    rate: float = parameter(10.0, 'Sets a second', 'Hz', (1e-3, 1e4))
    repeat: bool = parameter(True, 'Start over after the last set; otherwise the node ends')
    lock_step: str = parameter(
        '', 'Result topics, separated by blanks: each set waits until all of them have answered '
        'the one before; then `rate` does not count. Empty: do not wait'
    )
    world_frame: str = parameter('world', 'Frame id of the world', fixed=True)
    camera_frame: str = parameter(
        '', 'Frame id of the camera; those of a rig have left_ and right_ before it. Empty: '
        'camera_optical_frame, after the namespace where there is one: front_camera_optical_frame',
        fixed=True
    )
    publish_tf: bool = parameter(
        False, 'Publish the true pose on tf2: `world_frame` to the frame of the camera with _true '
        'after it', fixed=True
    )


@dataclass(frozen=True)
class SyntheticCameraSettings(CameraSettings, Scenario):
    """Parameters of the synthetic camera."""


@dataclass(frozen=True)
class SolverSettings(Settings):
    """Parameters of every node that solves."""

    lens: str = parameter(
        '', 'Lens to solve with: a file, or a name in config/lenses; of a file or folder with '
        'several cameras a rig takes the first two; `camera_info`: what that topic says; empty: '
        'the one that `scenario` names', file=True
    )
    svp: str = parameter(
        'auto', 'Solve with the single-viewpoint approximation of the lens; auto: of one that '
        '`scenario` names, but with a lens named here as it stands',
        choices=('auto', 'true', 'false')
    )
    sigma_px: float = parameter(
        1.0, 'Standard deviation of an image point, for the covariance', 'px', (1e-6, 1e3)
    )
    # Fast DDS tells every 3 s what it has sent, and what was lost last comes after that.
    patience: float = parameter(
        4.0, 'How long image points wait for what shares their stamp on other topics', 's',
        (0.0, 3600.0)
    )
    true_pose_gap: float = parameter(
        0.1, 'Two true poses of other stamps may be so far apart for a set between them to be '
        'interpolated; 0: only a true pose of its own stamp counts', 's', (0.0, 60.0)
    )
    backlog: int = parameter(
        100, 'Sets that may wait to be solved; beyond them the oldest are dropped and counted',
        span=(1, 10_000)
    )
    lifecycle: bool = parameter(
        False, 'Be a managed node: `configure` loads the lens, `activate` listens', fixed=True
    )

    @property
    def solves_svp(self) -> bool:
        """Whether to solve without the viewpoint shift of the lens."""
        return self.svp == 'true' or (self.svp == 'auto' and not self.lens)

    @property
    def sync_tolerance(self) -> float:
        """How far apart the stamps of one set may be, s."""
        return 0.0


@dataclass(frozen=True)
class RigSettings(SolverSettings):
    """Parameters of every node that solves for two cameras."""

    approximate_sync: bool = parameter(
        False, 'Pair image points of the two cameras whose stamps differ'
    )
    approximate_sync_tolerance_seconds: float = parameter(
        0.005, 'With approximate_sync, by how much they may: less than half the time between two '
        'images', 's', (0.0, 10.0)
    )

    @property
    def sync_tolerance(self) -> float:
        """How far apart the stamps of one set may be, s."""
        return self.approximate_sync_tolerance_seconds if self.approximate_sync else 0.0


@dataclass(frozen=True)
class LocalizerSettings(SolverSettings):
    """Parameters of the localizer."""

    publish_tf: bool = parameter(
        False, 'Publish the estimated pose on tf2: frame of the landmarks to that of the camera; '
        'only where no other node publishes the latter', fixed=True
    )
    camera_frame: str = parameter(
        '', 'Frame id of the estimated camera; empty: that of the image points', fixed=True
    )
    model_error: bool = parameter(
        False, 'Covariance of the pose with what the lens file says of the lens\'s own errors, '
        'beside `sigma_px`: `uncertainty`, as `diagnose` writes it'
    )


@dataclass(frozen=True)
class StereoCalibratorSettings(RigSettings):
    """Parameters of the stereo calibrator."""

    publish_tf: bool = parameter(
        False, 'Publish the rig on tf2, statically: frame of the right camera to that of '
        'the left one', fixed=True
    )

    views: int = parameter(
        10, 'Calibrate from this many of the last sets of a scenario, or as many as there are',
        span=(1, 1000)
    )


@dataclass(frozen=True)
class StereoDepthSettings(RigSettings):
    """Parameters of stereo depth."""

    rig: str = parameter(
        'true', 'The rig to measure with: `true`: the true one; `topic`: the latest on the topic '
        '`rig`, as the stereo calibrator publishes it; or a file: of `calibrate`, Kalibr, Basalt, '
        'OpenCV, a URDF', file=True
    )
    optimal: bool = parameter(
        False, 'Find the point of least reprojection error rather than the one halfway between '
        'the two rays'
    )
