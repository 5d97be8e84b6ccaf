"""Many scenarios at once: what `simulate_scenario` computes one by one, with the same noise."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.landmarks import Landmarks
from fisheye_svp_ros.simulate.scenario import (
    MONO,
    Scenario,
    noise_generator,
    scenario_landmarks,
    scenario_poses,
    scenario_rig,
    true_lens,
)
from fisheye_svp_ros.simulate.simulation import Prediction, add_noise, blank_views, predict_points


class Batch(NamedTuple):
    """S scenarios of one lens and as many cameras, with P sets of N landmarks each.

    row (S,): which of the scenarios; landmark (S, N); points (S, N, 3), m; rig (S,), None for
    one camera; by camera: poses (S, P) in the world and uv (S, P, N, 2), px, NaN where unseen.
    """

    row: Index
    lens: str
    shift_scale: float
    landmark: Index
    points: Array
    rig: Pose | None
    poses: tuple[Pose, ...]
    uv: tuple[Array, ...]


class _Scene(NamedTuple):
    row: int
    scenario: Scenario
    landmarks: Landmarks
    poses: Pose


def simulate_batches(scenarios: Sequence[Scenario], first: int) -> Iterator[Batch]:
    """Simulate scenarios, those of equal shape together; first: number of the first in its sweep.

    Raises FisheyeSvpError as `simulate_scenario` does.
    """
    groups: dict[tuple[object, ...], list[_Scene]] = {}
    known: dict[tuple[object, ...], Pose] = {}
    for row, scenario in enumerate(scenarios):
        where = (scenario.poses, scenario.poses_file, scenario.trajectory_steps, scenario.baseline)
        if where not in known:
            known[where] = scenario_poses(scenario)
        scene = _Scene(row, scenario, scenario_landmarks(scenario), known[where])
        shape = len(scene.landmarks.ids), len(scene.poses.position)
        key = (scenario.lens, scenario.shift_scale, scenario.style == MONO, *shape)
        groups.setdefault(key, []).append(scene)
    for scenes in groups.values():
        yield _simulate(scenes, first)


def _simulate(scenes: Sequence[_Scene], first: int) -> Batch:
    one = scenes[0].scenario
    poses = Pose.stack([scene.poses for scene in scenes])
    rigs = [rig for scene in scenes if (rig := scenario_rig(scene.scenario)) is not None]
    rig = Pose.stack(rigs) if rigs else None
    cameras = (poses,) if rig is None else (poses.compose(rig.take(np.s_[:, None])), poses)
    landmark = np.stack([scene.landmarks.ids for scene in scenes])
    points = np.stack([scene.landmarks.points for scene in scenes])
    model = ForwardModel(true_lens(one.lens, one.shift_scale))
    noise = [noise_generator(scene.scenario.seed, first + scene.row) for scene in scenes]
    shape = (*poses.shape, landmark.shape[1])
    flat = shape[0] * shape[1]
    sets = np.repeat(np.arange(shape[0]), shape[1])
    uv = []
    for number, camera in enumerate(cameras):
        views = blank_views(landmark[sets], points[sets], flat)
        views = views._replace(camera=views.camera + number)
        seen = predict_points(model, camera.reshape(flat), views)
        ideal = Prediction(seen.uv.reshape(*shape, 2), seen.scale.reshape(*shape, 1))
        uv.append(np.stack([
            add_noise(model, Prediction(*parts), scene.scenario.noise_px, rng)
            for scene, rng, *parts in zip(scenes, noise, *ideal, strict=True)
        ]))
    row = np.array([scene.row for scene in scenes])
    return Batch(row, one.lens, one.shift_scale, landmark, points, rig, cameras, tuple(uv))
