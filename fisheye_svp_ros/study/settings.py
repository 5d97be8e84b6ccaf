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
        'Publish nothing until this number of subscribers listens. A camera counts those of '
        'its image points (of its true poses, if it publishes images), a solver those of its '
        'results',
        span=(0, 1000),
    )
    folder: str = parameter(
        '',
        'Folder of the files that `scenario` or a new parameter value may name while the node '
        'runs. Empty: no files, only names in config/',
        fixed=True,
    )


@dataclass(frozen=True)
class CameraSettings(Settings):
    """Parameters of every camera."""

    rate: float = parameter(10.0, 'Sets per second', 'Hz', (1e-3, 1e4))
    repeat: bool = parameter(True, 'Start again after the last set. Otherwise, the node ends')
    lock_step: str = parameter(
        '',
        'Result topics, separated by blanks. Instead of following `rate`, each set waits until '
        'all of these have answered the previous one. Empty: do not wait',
    )
    world_frame: str = parameter('world', 'Frame id of the world', fixed=True, frame=True)
    camera_frame: str = parameter(
        '',
        'Frame id of the camera, with the prefix left_ or right_ in a rig. Empty: '
        'camera_optical_frame, or front_camera_optical_frame in the namespace front',
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
        'Lens to solve with: a file, or a name in config/lenses. A rig takes the first two '
        'cameras of a file or folder. `camera_info`: from that topic. Empty: from `scenario`',
        file=True,
    )
    svp: str = parameter(
        'auto',
        'Solve with the single-viewpoint approximation of the lens. auto: true for a lens from '
        '`scenario`, false for a lens named by the parameter `lens`',
        choices=('auto', 'true', 'false'),
    )
    sigma_px: float = parameter(
        1.0, 'Standard deviation of an image point, for the covariance', 'px', (1e-6, 1e3)
    )
    # Fast DDS tells every 3 s what it has sent, and what was lost last comes after that.
    patience: float = parameter(
        4.0,
        'Longest time that image points wait for messages with their stamp on other topics',
        's',
        (0.0, 3600.0),
    )
    true_pose_gap: float = parameter(
        0.1,
        'Largest time between two true poses that are interpolated for a set between them. 0: '
        'use only a true pose with the stamp of the set',
        's',
        (0.0, 60.0),
    )
    strict: bool = parameter(
        False,
        'Refuse a set that has a point without a finite value or of an unknown landmark. '
        'Otherwise, such points are left out',
    )
    backlog: int = parameter(
        0,
        'Largest number of sets that wait to be solved. Beyond it, the oldest are dropped and '
        'counted. 0: with base_frame 1, because a robot needs the newest pose, otherwise 100',
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
        'With approximate_sync, the largest difference. Choose less than half the time between '
        'two images',
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
        'Largest root mean square of the residuals, in units of `sigma_px`. A set above it has '
        'a result with the reason, but no pose and no transform. 0: no limit',
        span=(0.0, 1e6),
    )


@dataclass(frozen=True)
class RobotSettings(GateSettings):
    """Parameters of every node that poses a robot."""

    publish_tf: bool = parameter(
        False,
        'Publish the estimated pose on tf2, from the frame of the landmarks to that of the '
        'camera. Use it only if no other node publishes the frame of the camera',
        fixed=True,
    )
    detections_rectified: bool = parameter(
        False,
        'With lens:=camera_info: image points or detections come from rectified images '
        '(image_rect, the default of apriltag_ros). The lens is then P of camera_info',
        fixed=True,
    )
    base_frame: str = parameter(
        '',
        'Frame id of the base of a robot: publish its pose on ~/base_pose. The pose of the '
        'camera in the base is looked up on /tf_static and /tf. Empty: do not',
        fixed=True,
        frame=True,
    )
    odom_frame: str = parameter(
        '',
        'Frame id of the odometry: publish its pose in the frame of the landmarks on /tf, as '
        'amcl does. Needs base_frame, and odometry on /tf. Empty: do not',
        fixed=True,
        frame=True,
    )
    transform_tolerance: float = parameter(
        1.0,
        'With odom_frame: time by which the transform is dated after the image, as in amcl. '
        'While no pose is found, it is sent again, dated after the odometry',
        's',
        (0.0, 60.0),
        fixed=True,
    )
    transform_gap: float = parameter(
        0.25,
        'With base_frame: largest time between two transforms on /tf that are interpolated for '
        'an image between them. Across a longer gap, nothing is published',
        's',
        (0.0, 60.0),
        fixed=True,
    )
    max_std_m: float = parameter(
        0.2,
        'With base_frame: largest standard deviation of the position of the base, in any '
        'direction. A pose above it has a result with the reason, but no ~/base_pose and no '
        'transform. 0: no limit',
        'm',
        (0.0, 1e6),
        fixed=True,
    )
    max_std_rad: float = parameter(
        0.1,
        'The same for its rotation. 0: no limit',
        'rad',
        (0.0, 1e3),
        fixed=True,
    )
    allow_ambiguous: bool = parameter(
        False,
        'With base_frame: also publish poses to which there is an alternative (`ambiguous`)',
        fixed=True,
    )
    max_innovation: float = parameter(
        5.0,
        'With odom_frame: largest distance of a pose from the one that earlier poses and '
        'odometry predict, in standard deviations. Above it, there is no transform. 0: no limit',
        span=(0.0, 1e6),
        fixed=True,
    )
    odom_error: float = parameter(
        0.05,
        'Error of the odometry as a share of the distance and of the angle, for max_innovation',
        span=(0.0, 10.0),
        fixed=True,
    )

    tag_map: str = parameter(
        '',
        'Map of tags, from `fisheye-svp map` or tags.yaml of apriltag_ros. The topic '
        '`detections` (of a rig NAME/detections) then replaces `image_points`, and the map '
        'replaces `landmarks`. The covariances include its errors. Empty: no map',
        file=True,
        fixed=True,
    )
    detections: str = parameter(
        'apriltag_msgs',
        'Type of `detections`. AprilTagDetectionArray: four corners per tag, in raw images. '
        'Detection2DArray of vision_msgs: the center of each tag. image_points: the topic of '
        'that name, from the detector of this package',
        choices=('apriltag_msgs', 'vision_msgs', 'image_points'),
        fixed=True,
    )
    max_hamming: int = parameter(
        1,
        'Largest number of bits that the detector corrected in a tag of `detections` '
        '(apriltag_msgs). Other tags are left out and counted',
        span=(0, 255),
        fixed=True,
    )
    min_decision_margin: float = parameter(
        10.0,
        'Smallest decision margin of a tag of `detections` (apriltag_msgs), if one is stated. '
        'Other tags are left out and counted',
        span=(0.0, 1e6),
        fixed=True,
    )
    map_frame: str = parameter('map', 'Frame id of the tag map', fixed=True, frame=True)
    readout_time: float = parameter(
        0.03,
        'Longest time that a rolling shutter may take from the first row to the last, if the lens '
        'does not model it. The stamp is that of the middle row. Residuals estimate the time, and '
        'the covariance holds its effect on the pose. A warning comes only if that effect exceeds '
        'what noise does. 0: a global shutter',
        's',
        (0.0, 1.0),
    )
    planar: bool = parameter(
        False,
        'With base_frame: the base drives on a plane, so its height (planar_height) and its '
        'tilt (zero) are known in advance. A single tag then seldom leaves a second pose',
        fixed=True,
    )
    planar_height: float = parameter(
        0.0,
        'Height of base_frame above the plane z = 0 of the landmarks',
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
        'Frame id of the estimated camera. Empty: that of the image points',
        fixed=True,
        frame=True,
    )
    model_error: bool = parameter(
        False,
        'Include the errors of the lens in the covariance of the pose, in addition to '
        '`sigma_px`. The lens file must state them, as those of `calibrate` and `diagnose` do',
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
        'Calibrate from this number of the latest sets of a scenario, or from all if there are '
        'fewer',
        span=(1, 1000),
    )
    output: str = parameter('rig.yaml', 'File that the service save writes', fixed=True)


@dataclass(frozen=True)
class RigLocalizerSettings(RobotSettings, RigSettings):
    """Parameters of the rig localizer."""

    rig: str = parameter(
        '',
        'Rig: `rig.yaml` of `calibrate` or its folder, or a camchain. The node subscribes to '
        'NAME/image_points for each camera. The lenses are those of `lens`, in this order',
        file=True,
        fixed=True,
    )


@dataclass(frozen=True)
class StereoDepthSettings(RigSettings):
    """Parameters of stereo depth."""

    rig: str = parameter(
        'true',
        'Rig to measure with. `true`: the true one. `topic`: the latest on the topic `rig` '
        '(stereo calibrator). Or a file of `calibrate`, Kalibr, Basalt, or OpenCV, or a URDF',
        file=True,
    )
    optimal: bool = parameter(
        False,
        'Find the point with the smallest reprojection error instead of the one halfway '
        'between the two rays',
    )
