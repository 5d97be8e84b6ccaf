"""One simulated scenario: the table of its parameters, and what they stand for.

The synthetic camera and the offline sweep read the same table, so they compute the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import LensError, ParameterError
from fisheye_svp_ros.io.landmark_files import environment, load_landmarks
from fisheye_svp_ros.io.lens_files import cameras_in, load_lens
from fisheye_svp_ros.io.parameters import Sweep, parameter, rows, with_values
from fisheye_svp_ros.io.readers import read_poses
from fisheye_svp_ros.io.rig_files import load_cameras
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import (
    Pose,
    rotation_from_quaternion,
    rotation_from_vector,
    vector_from_rotation,
)
from fisheye_svp_ros.scene.observations import STEREO, Landmarks, Observations
from fisheye_svp_ros.scene.rigs import BASELINE, STYLES, calibration_poses, rig_from_angle
from fisheye_svp_ros.scene.table_checks import MAX_NOISE
from fisheye_svp_ros.simulate.simulation import (
    add_noise,
    blank_views,
    predict_points,
    simulate,
    simulate_rig,
    simulate_stereo,
)

MONO = 'mono'
CALIBRATION = 'calibration'
# Sweeping one of these may name a file that cannot be read: found out before anything runs.
_READ_FILES = ('lens', 'environment', 'poses_file', 'rig_file')


@dataclass(frozen=True)
class Scenario:
    """Parameters of a scenario; all but `poses` can be swept."""

    lens: str = parameter('fish214', 'Lens: a file, or a name in config/lenses', file=True)
    shift_scale: float = parameter(
        1.0, 'Factor on the viewpoint shift of the lens. 0: an SVP lens', span=(0.0, 100.0)
    )
    environment: str = parameter(
        'whole', 'Landmarks: whole, inner or outer, or a CSV with landmark, x, y, z', file=True
    )
    radius: float = parameter(
        2.0, 'Distance of the landmarks of whole, inner and outer', 'm', (1e-3, 1e6)
    )
    style: str = parameter(
        MONO,
        'One camera, or a stereo rig with the cameras left and right',
        choices=(MONO, *STYLES),
    )
    baseline: float = parameter(BASELINE, 'Distance between the two cameras', 'm', (1e-6, 1e3))
    vergence: float = parameter(
        0.0,
        'Additional inward turn of the left camera, beyond that of the style',
        'rad',
        (-1.6, 1.6),
    )
    poses: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0),
        'x, y, z, qx, qy, qz, qw of the camera (right camera of a rig) in the world, one pose '
        'after the other',
        'm',
    )
    poses_file: str = parameter(
        '',
        'Poses CSV instead of `poses`. `calibration`: ten poses to calibrate a rig from',
        file=True,
    )
    trajectory_steps: int = parameter(
        0,
        '0: jump from pose to pose. n: move smoothly from each pose to the next in n steps',
        span=(0, 1_000_000),
    )
    noise_px: float = parameter(
        0.0, 'Standard deviation of the noise of image points', 'px', (0.0, MAX_NOISE)
    )
    seed: int = parameter(0, 'Seed of the noise', span=(0, 2**31 - 1))
    rig_file: str = parameter(
        '',
        'Cameras instead of `lens` and `style`: a folder or file with their lenses and '
        'relative poses, as `calibrate` writes it. `poses` are those of the first camera',
        file=True,
    )


_SETS_PER_BLOCK = 1000  # sets that are simulated at once

SCALARS = tuple(
    row.name
    for row in rows(Scenario)
    if not isinstance(row.default, tuple) and row.name != 'rig_file'
)


class Simulation(NamedTuple):
    """What the cameras of a scenario see.

    lens: of the first camera; lenses: of each; observations: one frame a set; poses: of each
    camera in the world, (P,), one a set, in the order of `observations.cameras`; rig: the left
    camera in the right one, None for one camera, and for those of a file.
    """

    lens: Lens
    landmarks: Landmarks
    observations: Observations
    poses: tuple[Pose, ...]
    rig: Pose | None
    lenses: tuple[Lens, ...]


def simulate_scenario(
    scenario: Scenario, number: int = 0, repetition: int = 0, lens: Lens | None = None
) -> Simulation:
    """Simulate all sets of a scenario.

    number: of the scenario in its sweep; repetition: of the sweep; each draws noise of its own;
    lens: in place of the file that the scenario names.
    Raises FisheyeSvpError for a lens, landmarks or poses that
    cannot be used.
    """
    return _simulate_poses(
        scenario,
        scenario_poses(scenario),
        noise_generator(scenario.seed, number, repetition),
        lens,
    )


def simulate_in_pieces(
    scenario: Scenario, number: int = 0, repetition: int = 0
) -> Iterator[tuple[int, int, Simulation]]:
    """Yield a scenario as pieces of bounded length: the first set, how many there are, the piece.

    A scenario of one piece is what `simulate_scenario` returns.
    """
    rng = noise_generator(scenario.seed, number, repetition)
    poses, steps = _given_poses(scenario), scenario.trajectory_steps
    sets = (len(poses.position) - 1) * max(steps, 1) + 1
    for first in range(0, sets, _SETS_PER_BLOCK):
        numbers = np.arange(first, min(first + _SETS_PER_BLOCK, sets))
        piece = _interpolate_poses(poses, steps, numbers) if steps else poses.take(numbers)
        yield first, sets, _simulate_poses(scenario, piece, rng)


def _simulate_poses(
    scenario: Scenario, poses: Pose, rng: np.random.Generator, lens: Lens | None = None
) -> Simulation:
    if scenario.rig_file:
        return _simulate_rig(scenario, poses, rng)
    lens = (
        true_lens(scenario.lens, scenario.shift_scale)
        if lens is None
        else (_scale_shift(lens, scenario.shift_scale))
    )
    landmarks, rig = scenario_landmarks(scenario), scenario_rig(scenario)
    model, sigma = ForwardModel(lens), scenario.noise_px
    if rig is None:
        seen = simulate(model, landmarks, poses, sigma, rng)
        return Simulation(lens, landmarks, seen, (poses,), None, (lens,))
    seen = simulate_stereo(model, model, landmarks, rig, poses, sigma, rng)
    return Simulation(lens, landmarks, seen, (poses.compose(rig), poses), rig, (lens, lens))


def _simulate_rig(scenario: Scenario, poses: Pose, rng: np.random.Generator) -> Simulation:
    """Simulate the cameras of a file; poses (P,) of the first of them."""
    names, lenses, places = scenario_cameras(scenario.rig_file)
    lenses = tuple(_scale_shift(lens, scenario.shift_scale) for lens in lenses)
    landmarks, count = scenario_landmarks(scenario), len(poses.position)
    posed = tuple(poses.compose(places.take(i).broadcast_to(count)) for i in range(len(names)))
    seen = simulate_rig(
        [ForwardModel(lens) for lens in lenses], landmarks, posed, scenario.noise_px, rng, names
    )
    return Simulation(lenses[0], landmarks, seen, posed, None, lenses)


def scenario_cameras(rig: str) -> tuple[tuple[str, ...], tuple[Lens, ...], Pose]:
    """Return names, lenses and places (C,) in the first one of the cameras of a file or folder.

    Raises LensError where it does not hold all of them.
    """
    path = lens_path(rig)
    return _cameras_of(path, _version(path / 'rig.yaml' if path.is_dir() else path))


@lru_cache(maxsize=8)
def _cameras_of(path: Path, version: int) -> tuple[tuple[str, ...], tuple[Lens, ...], Pose]:
    names, places = load_cameras(path)
    held = cameras_in(path)
    missing = [name for name in names if name not in held]
    if missing:
        raise LensError(f'{path}: the rig has the camera {missing[0]}, which has no lens')
    return names, tuple(load_lens(f'{path}#{name}') for name in names), places


def noise_generator(seed: int, number: int, repetition: int = 0) -> np.random.Generator:
    """Return the source of a scenario's noise: its own for each scenario and repetition."""
    return np.random.default_rng([seed, number, repetition])


def check_sweep(base: Scenario, sweep: Sweep) -> None:
    """Raise FisheyeSvpError where a sweep names a lens, landmarks or poses that are unusable."""
    for name in _READ_FILES:
        for value in sweep.lists.get(name, ()):
            next(simulate_in_pieces(with_values(base, {name: value})))
    next(simulate_in_pieces(with_values(base, sweep.point(0))))


def scalars(scenario: Scenario) -> dict[str, Any]:
    """Return the parameters of a scenario that are single values, as `scenario` tells them.

    Cameras of a file have lenses of their own: no solver takes that of a scenario for them.
    """
    values = {name: getattr(scenario, name) for name in SCALARS}
    if scenario.rig_file:
        del values['lens'], values['style']
        values['rig_file'] = scenario.rig_file
    return values


def camera_names(style: str, rig: str = '') -> tuple[str, ...]:
    """Return the names of the cameras that a style has, or the rig of a file."""
    if rig:
        return scenario_cameras(rig)[0]
    return ('',) if style == MONO else STEREO


def true_lens(lens: str, shift_scale: float = 1.0) -> Lens:
    """Return the lens of a scenario, its viewpoint shift scaled."""
    path = lens_path(lens)
    return _true_lens(path, _version(path), shift_scale)


@lru_cache(maxsize=64)
def _true_lens(path: Path, version: int, shift_scale: float) -> Lens:
    return _scale_shift(load_lens(path), shift_scale)


def _scale_shift(lens: Lens, shift_scale: float) -> Lens:
    """Return a lens, its viewpoint shift scaled."""
    shift = lens.viewpoint_shift
    if shift is None or shift_scale == 1.0:
        return lens
    return replace(lens, viewpoint_shift=shift.scale_by(shift_scale) if shift_scale else None)


def model_of(lens: str, shift_scale: float, svp: bool) -> ForwardModel:
    """Return the forward model of a lens given by file or name.

    Raises LensError where there is none.
    """
    loaded = true_lens(lens, shift_scale)
    return ForwardModel(loaded.approximate() if svp else loaded)


def scenario_landmarks(scenario: Scenario) -> Landmarks:
    """Return the landmarks of a scenario, m, in the world."""
    path = Path(scenario.environment)
    return _load_landmarks(scenario.environment, _version(path), scenario.radius)


@lru_cache(maxsize=64)
def _load_landmarks(name: str, version: int, radius: float) -> Landmarks:
    return load_landmarks(name) if name.endswith('.csv') else environment(name, radius)


def _version(path: Path) -> int:
    """Return what changes with a file, so that nothing stale is kept; 0 where there is none."""
    return path.stat().st_mtime_ns if path.is_file() else 0


def scenario_rig(scenario: Scenario) -> Pose | None:
    """Return the left camera in the right one; None for a single camera."""
    if scenario.style == MONO:
        return None
    return rig_from_angle(STYLES[scenario.style] + scenario.vergence, scenario.baseline)


def scenario_poses(scenario: Scenario) -> Pose:
    """Return the poses (P,) of the (right) camera in the world, one a set."""
    poses, steps = _given_poses(scenario), scenario.trajectory_steps
    if not steps:
        return poses
    return _interpolate_poses(poses, steps, np.arange((len(poses.position) - 1) * steps + 1))


def _given_poses(scenario: Scenario) -> Pose:
    if scenario.poses_file == CALIBRATION:
        return calibration_poses(scenario.baseline)
    if scenario.poses_file:
        return read_poses(scenario.poses_file).pose
    return _listed_poses(scenario.poses)


def _listed_poses(numbers: tuple[float, ...]) -> Pose:
    if not numbers or len(numbers) % 7:
        raise ParameterError(f'poses holds {len(numbers)} numbers; seven a pose are needed')
    table = np.array(numbers).reshape(-1, 7)
    norm = np.linalg.norm(table[:, 3:], axis=1)
    if np.any(np.abs(norm - 1) > 1e-3):
        bad = int(np.argmax(np.abs(norm - 1)))
        raise ParameterError(f'poses: the quaternion of pose {bad} has norm {norm[bad]:g}, not 1')
    return Pose(rotation_from_quaternion(table[:, 3:]), table[:, :3])


def _interpolate_poses(poses: Pose, steps: int, numbers: Index) -> Pose:
    """Return some (N,) of the poses on the way: straight lines, turns about a fixed axis.

    numbers: of the poses, `steps` from each of the given ones to the next.
    """
    last = len(poses.position) - 1
    start = np.minimum(numbers // steps, max(last - 1, 0))
    before, after = poses.take(start), poses.take(np.minimum(start + 1, last))
    part = ((numbers - start * steps) / steps)[:, None]
    turn = vector_from_rotation(after.rotation @ np.swapaxes(before.rotation, -1, -2))
    way = Pose(
        rotation_from_vector(part * turn) @ before.rotation,
        before.position + part * (after.position - before.position),
    )
    done = numbers >= last * steps
    way.rotation[done], way.position[done] = poses.rotation[last], poses.position[last]
    return way


class ScenarioBatch(NamedTuple):
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


class _ScenarioScene(NamedTuple):
    row: int
    scenario: Scenario
    landmarks: Landmarks
    poses: Pose


def simulate_batches(scenarios: Sequence[Scenario], first: int) -> Iterator[ScenarioBatch]:
    """Simulate scenarios, those of equal shape together; first: number of the first in its sweep.

    Raises FisheyeSvpError as `simulate_scenario` does.
    """
    groups: dict[tuple[object, ...], list[_ScenarioScene]] = {}
    cache: dict[tuple[object, ...], Pose] = {}
    for row, scenario in enumerate(scenarios):
        where = (scenario.poses, scenario.poses_file, scenario.trajectory_steps, scenario.baseline)
        if where not in cache:
            cache[where] = scenario_poses(scenario)
        scene = _ScenarioScene(row, scenario, scenario_landmarks(scenario), cache[where])
        shape = len(scene.landmarks.ids), len(scene.poses.position)
        key = (scenario.lens, scenario.shift_scale, scenario.style == MONO, *shape)
        groups.setdefault(key, []).append(scene)
    for scenes in groups.values():
        yield _simulate_batch(scenes, first)


def _simulate_batch(scenes: Sequence[_ScenarioScene], first: int) -> ScenarioBatch:
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
        seen = (
            part.reshape(*shape, -1) for part in predict_points(model, camera.reshape(flat), views)
        )
        uv.append(
            np.stack(
                [
                    add_noise(model, (ideal, scale), scene.scenario.noise_px, rng)
                    for scene, rng, ideal, scale in zip(scenes, noise, *seen, strict=True)
                ]
            )
        )
    row = np.array([scene.row for scene in scenes])
    return ScenarioBatch(row, one.lens, one.shift_scale, landmark, points, rig, cameras, tuple(uv))
