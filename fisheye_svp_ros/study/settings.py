"""The parameter tables of the nodes of a sweep; the offline sweep reads the same."""

from __future__ import annotations

from dataclasses import dataclass

from fisheye_svp_ros.io.parameters import parameter
from fisheye_svp_ros.simulate.scenario import Scenario


@dataclass(frozen=True)
class Settings:
    """Parameters that every node has."""

    wait_for_subscribers: int = parameter(
        0,
        'Publish nothing before this number of subscribers listens to the image points (true '
        'poses, if a camera publishes images) or, of a solver, the results',
        span=(0, 1000),
    )
    folder: str = parameter(
        '',
        'Folder of the files that `scenario` or a new parameter value may name while the node '
        'runs; empty: no files, only names in config/',
        fixed=True,
    )


@dataclass(frozen=True)
class CameraSettings(Settings):
    """Parameters of every camera."""

    rate: float = parameter(10.0, 'Sets per second', 'Hz', (1e-3, 1e4))
    repeat: bool = parameter(True, 'Start again after the last set; otherwise the node ends')
    lock_step: str = parameter(
        '',
        'Result topics, separated by blanks: each set waits, in place of `rate`, until all '
        'have answered the previous one. Empty: do not wait',
    )
    world_frame: str = parameter('world', 'Frame id of the world', fixed=True, frame=True)
    camera_frame: str = parameter(
        '',
        'Frame id of the camera; in a rig with the prefix left_ or right_. Empty: '
        'camera_optical_frame; in the namespace front, front_camera_optical_frame',
        fixed=True,
        frame=True,
    )
    publish_tf: bool = parameter(
        False,
        'Publish the true pose on tf2, from `world_frame` to the frame of the camera with '
        'the suffix _true',
        fixed=True,
    )


@dataclass(frozen=True)
class SyntheticCameraSettings(CameraSettings, Scenario):
    """Parameters of the synthetic camera."""


@dataclass(frozen=True)
class SolverSettings(Settings):
    """Parameters of every node that solves."""

    lens: str = parameter(
        '',
        'Lens to solve with: a file, or a name in config/lenses (a rig takes the first two '
        'cameras of a file or folder); `camera_info`: from that topic; empty: from '
        '`scenario`',
        file=True,
    )
    svp: str = parameter(
        'auto',
        'Solve with the single-viewpoint approximation of the lens; auto: true for a lens '
        'from `scenario`, false for a lens named by the parameter `lens`',
        choices=('auto', 'true', 'false'),
    )
    sigma_px: float = parameter(
        1.0, 'Standard deviation of an image point, for the covariance', 'px', (1e-6, 1e3)
    )
    # Fast DDS tells every 3 s what it has sent, and what was lost last comes after that.
    patience: float = parameter(
        4.0,
        'Longest time that image points wait for messages of their stamp on other topics',
        's',
        (0.0, 3600.0),
    )
    true_pose_gap: float = parameter(
        0.1,
        'Largest time between two true poses that are interpolated for a set between them; '
        '0: use only a true pose with the stamp of the set',
        's',
        (0.0, 60.0),
    )
    strict: bool = parameter(
        False,
        'Refuse a set for one point without a finite value or of an unknown landmark, which is '
        'left out otherwise',
    )
    backlog: int = parameter(
        0,
        'Largest number of sets that wait to be solved; beyond it the oldest are dropped and '
        'counted. 0: 1 with base_frame, as the newest pose counts for a robot; otherwise 100',
        span=(0, 10_000),
    )
    lifecycle: bool = parameter(
        False,
        'Run as a managed node: `configure` loads the lens, `activate` subscribes',
        fixed=True,
    )

    @property
    def from_rectified_images(self) -> bool:
        """Whether image points are those of rectified images, which `P` of a camera_info has."""
        return False

    @property
    def solves_svp(self) -> bool:
        """Whether to solve without the viewpoint shift of the lens."""
        return self.svp == 'true' or (self.svp == 'auto' and not self.lens)

    @property
    def most_waiting(self) -> int:
        """How many sets may wait to be solved."""
        return self.backlog or 100

    @property
    def sync_tolerance(self) -> float:
        """How far apart the stamps of one set may be, s."""
        return 0.0


@dataclass(frozen=True)
class RigSettings(SolverSettings):
    """Parameters of every node that solves for two cameras."""

    approximate_sync: bool = parameter(
        False, 'Also pair image points of the two cameras whose stamps differ'
    )
    approximate_sync_tolerance_seconds: float = parameter(
        0.005,
        'With approximate_sync, the largest difference; choose less than half the time '
        'between two images',
        's',
        (0.0, 10.0),
    )

    @property
    def sync_tolerance(self) -> float:
        """How far apart the stamps of one set may be, s."""
        return self.approximate_sync_tolerance_seconds if self.approximate_sync else 0.0


@dataclass(frozen=True)
class GateSettings(SolverSettings):
    """Parameters of every node whose result a robot acts on."""

    gate: float = parameter(
        0.0,
        'Largest root mean square of the residuals, in units of `sigma_px`; a set above it has '
        'a result with the reason, but no pose and no transform. 0: no limit',
        span=(0.0, 1e6),
    )


@dataclass(frozen=True)
class RobotSettings(GateSettings):
    """Parameters of every node that poses a robot."""

    publish_tf: bool = parameter(
        False,
        'Publish the estimated pose on tf2, from the frame of the landmarks to that of the '
        'camera; only if no other node publishes the latter',
        fixed=True,
    )
    detections_rectified: bool = parameter(
        False,
        'With lens:=camera_info: image points or detections are those of rectified images '
        '(image_rect, as apriltag_ros takes by default); P of camera_info then is the lens',
        fixed=True,
    )
    base_frame: str = parameter(
        '',
        'Frame id of the base of a robot: publish its pose on ~/base_pose, the camera in it being '
        'looked up on /tf_static and /tf. Empty: do not',
        fixed=True,
        frame=True,
    )
    odom_frame: str = parameter(
        '',
        'Frame id of the odometry: publish on /tf where it stands in the frame of the landmarks, '
        'as amcl does; needs base_frame and odometry on /tf. Empty: do not',
        fixed=True,
        frame=True,
    )
    transform_tolerance: float = parameter(
        1.0,
        'With odom_frame: time by which the transform is dated after the image, as of amcl; it is '
        'sent again, dated after the odometry, while no pose is found',
        's',
        (0.0, 60.0),
        fixed=True,
    )
    transform_gap: float = parameter(
        0.25,
        'With base_frame: largest time between two transforms on /tf that are interpolated for an '
        'image between them; across a longer gap nothing is published',
        's',
        (0.0, 60.0),
        fixed=True,
    )
    max_std_m: float = parameter(
        0.2,
        'With base_frame: largest standard deviation of the position of the base, in any '
        'direction; a pose above it has a result with the reason, but no ~/base_pose and no '
        'transform. 0: no limit',
        'm',
        (0.0, 1e6),
        fixed=True,
    )
    max_std_rad: float = parameter(
        0.1,
        'The same of its rotation. 0: no limit',
        'rad',
        (0.0, 1e3),
        fixed=True,
    )
    allow_ambiguous: bool = parameter(
        False,
        'With base_frame: also publish poses beside which a second one fits (`ambiguous`)',
        fixed=True,
    )
    max_innovation: float = parameter(
        5.0,
        'With odom_frame: largest distance of a pose from where odometry carries most of those '
        'before it, in standard deviations of both; above it there is no transform. 0: no limit',
        span=(0.0, 1e6),
        fixed=True,
    )
    odom_error: float = parameter(
        0.05,
        'Error of the odometry as a share of the way and of the angle, for max_innovation',
        span=(0.0, 10.0),
        fixed=True,
    )

    tag_map: str = parameter(
        '',
        'Map of tags (`fisheye-svp map`, or tags.yaml of apriltag_ros): tags on the topic '
        '`detections` (of a rig NAME/detections) then stand for `image_points`, the map for '
        '`landmarks`; its errors are in the covariances. Empty: neither',
        file=True,
        fixed=True,
    )
    detections: str = parameter(
        'apriltag_msgs',
        'Type of `detections`: AprilTagDetectionArray (four corners a tag, in raw images), or '
        'Detection2DArray of vision_msgs (the middle of a tag); image_points: the topic of that '
        'name, of the detector of this package',
        choices=('apriltag_msgs', 'vision_msgs', 'image_points'),
        fixed=True,
    )
    max_hamming: int = parameter(
        1,
        'Largest number of bits that the detector corrected in a tag of `detections` '
        '(apriltag_msgs); others are left out and counted',
        span=(0, 255),
        fixed=True,
    )
    min_decision_margin: float = parameter(
        10.0,
        'Smallest decision margin of a tag of `detections` (apriltag_msgs), where one is stated; '
        'others are left out and counted',
        span=(0.0, 1e6),
        fixed=True,
    )
    map_frame: str = parameter('map', 'Frame id of the tag map', fixed=True, frame=True)
    readout_time: float = parameter(
        0.03,
        'Time that a rolling shutter takes from the first row to the last, the stamp being that '
        'of the middle; where the motion of the camera then moves a pose by more than its '
        'covariance states, that is told and added. 0: a global shutter',
        's',
        (0.0, 1.0),
    )
    planar: bool = parameter(
        False,
        'With base_frame: the base drives on a plane, so that its height '
        '(planar_height) and its tilt (none) are known before an image; one tag then seldom '
        'leaves a second pose',
        fixed=True,
    )
    planar_height: float = parameter(
        0.0,
        'Height of base_frame over the plane z = 0 of the landmarks',
        'm',
        (-1e4, 1e4),
        fixed=True,
    )
    planar_std_m: float = parameter(
        0.02, 'Standard deviation of that height', 'm', (1e-6, 1e3), fixed=True
    )
    planar_std_rad: float = parameter(
        0.02, 'Standard deviation of roll and pitch of the base', 'rad', (1e-6, 3.0), fixed=True
    )

    @property
    def from_rectified_images(self) -> bool:
        """See SolverSettings."""
        return self.detections_rectified

    @property
    def most_waiting(self) -> int:
        """How many sets may wait to be solved."""
        return self.backlog or (1 if self.base_frame else 100)


@dataclass(frozen=True)
class LocalizerSettings(RobotSettings):
    """Parameters of the localizer."""

    camera_frame: str = parameter(
        '',
        'Frame id of the estimated camera; empty: that of the image points',
        fixed=True,
        frame=True,
    )
    model_error: bool = parameter(
        False,
        'Include the errors of the lens in the covariance of the pose, besides `sigma_px`; '
        'the lens file must state them, as those of `calibrate` and `diagnose` do',
    )


@dataclass(frozen=True)
class StereoCalibratorSettings(GateSettings, RigSettings):
    """Parameters of the stereo calibrator."""

    publish_tf: bool = parameter(
        False,
        'Publish the rig on tf2 (static), from the frame of the right camera to that of '
        'the left one',
        fixed=True,
    )

    views: int = parameter(
        10,
        'Calibrate from this number of the latest sets of a scenario, or from fewer if there '
        'are no more',
        span=(1, 1000),
    )
    output: str = parameter('rig.yaml', 'File that the service save writes', fixed=True)


@dataclass(frozen=True)
class RigLocalizerSettings(RobotSettings, RigSettings):
    """Parameters of the rig localizer."""

    rig: str = parameter(
        '',
        'Rig: `rig.yaml` of `calibrate` or its folder, or a camchain; its cameras are heard on '
        'NAME/image_points, and the lenses are those of `lens` in this order',
        file=True,
        fixed=True,
    )


@dataclass(frozen=True)
class StereoDepthSettings(RigSettings):
    """Parameters of stereo depth."""

    rig: str = parameter(
        'true',
        'Rig to measure with: `true`: the true one; `topic`: the latest on the topic '
        '`rig` (stereo calibrator); or a file of `calibrate`, Kalibr, Basalt, OpenCV, or '
        'a URDF',
        file=True,
    )
    optimal: bool = parameter(
        False,
        'Find the point of least reprojection error instead of the one halfway between the '
        'two rays',
    )
