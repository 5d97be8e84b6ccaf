"""A camera that was calibrated in air, and what it photographs through a port."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fisheye_svp_ros.effects.forward import ForwardModel, project_corrected
from fisheye_svp_ros.optics.curves import KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.optics.ports import Port
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.scene.observations import Landmarks, Observations
from fisheye_svp_ros.simulate.simulation import simulate

AIR = Lens(
    'air',
    1280,
    960,
    420.0,
    421.0,
    640.0,
    478.0,
    KannalaBrandt(-0.02, 0.003, -0.001, 0.0),
    np.radians(85),
)


def photographs(
    lens: Lens,
    port: Port | None,
    frames: int = 8,
    noise: float = 0.1,
    seed: int = 0,
    reach: float = 0.7,
) -> Observations:
    """Return photographs of a board of 7 x 5 corners at 0.3 to 1.2 m.

    reach: largest angle, rad, of its middle from the axis.
    """
    rng, wet = np.random.default_rng(seed), replace(lens, port=port)
    x, y = np.meshgrid(np.arange(7), np.arange(5))
    board = 0.07 * np.stack([x.ravel() - 3.0, y.ravel() - 2.0, 0.0 * x.ravel()], axis=-1)
    poses: list[Pose] = []
    while len(poses) < frames:
        angle, azimuth = rng.uniform(0, reach), rng.uniform(0, 2 * np.pi)
        away = np.exp(rng.uniform(np.log(0.3), np.log(1.2)))
        place = away * np.array(
            [np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)]
        )
        pose = Pose(rotation_from_vector(rng.normal(size=3) * [0.4, 0.4, 1.0]), place).inverse()
        if project_corrected(wet, pose.into_body(board)).valid.mean() > 0.7:
            poses.append(pose)
    landmarks = Landmarks(np.arange(len(board)), board)
    return simulate(ForwardModel(wet), landmarks, Pose.stack(poses), noise, rng)
