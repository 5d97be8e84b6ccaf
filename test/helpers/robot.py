"""A camera on a robot's flange, before a board: what it sees, and what the robot states."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.optics.curves import KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.simulate.simulation import simulate
from fisheye_svp_ros.solve.hand_eye import Transforms
from helpers.targets import plane, poses_around

LENS = Lens('made', 1280, 960, 300.0, 300.0, 650.0, 470.0, KannalaBrandt(-0.03), 1.7)
TRUTH = Transforms(
    Pose(rotation_from_vector(np.array([0.3, -0.4, 0.5])), np.array([0.05, -0.02, 0.08])),
    Pose(rotation_from_vector(np.array([1.0, 0.3, -0.2])), np.array([0.6, -0.1, 0.4])),
    1.001,
)


def robot(
    seed: int,
    frames: int = 18,
    noise: tuple[float, float] = (3e-4, 1e-3),
    lens: Lens = LENS,
    truth: Transforms = TRUTH,
    fixed_camera: bool = False,
) -> tuple[Observations, Pose, dict[int, Pose]]:
    """Return observations, poses of the camera (F,), and the robot's poses of its flange.

    noise: of the robot, m and rad; fixed_camera: the robot carries the target, so that the truth
    is of the camera in the base, and of the target in the flange.
    """
    rng = np.random.default_rng(seed)
    camera = poses_around(plane(), frames, rng, widest=1.1)
    table = simulate(ForwardModel(lens), plane(), camera, 0.1, rng)
    stated = truth.flange(camera)
    stated = stated.inverse() if fixed_camera else stated
    stated = Pose(stated.rotation, stated.position / truth.scale).retract(
        rng.normal(size=(frames, 6)) * np.repeat(noise, 3)
    )
    return (
        replace(table, sigma=np.full(len(table), np.nan)),
        camera,
        {i: stated.take(i) for i in range(frames)},
    )
