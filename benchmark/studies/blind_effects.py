"""Effects to hide: every one of the catalogue, made by what causes it.

Not by the catalogue's own columns: a bowed board is bent round a cylinder, rows are exposed one
after the other, a window refracts by Snell's law, the area of a dot's image is integrated.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from benchmark.studies import blind_optics as optics
from benchmark.studies.blind_scene import Hidden, Needs, Scene, World, moved, plane_of
from benchmark.studies.boards import Rng, unit
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.pose import Pose, rotation_from_vector


def landmark_survey(scene: Scene, rng: Rng) -> Hidden:
    """One to three landmarks are not where they are said to be."""
    often = np.flatnonzero(scene.seen.sum(axis=0) >= len(scene.frame) // 3)
    chosen = rng.choice(often, int(rng.integers(1, 4)), replace=False)
    moves = np.zeros(scene.points.shape)
    moves[chosen] = [unit(rng, 3) * rng.uniform(0.6, 1.0) for _ in chosen]
    ids = scene.landmark[chosen]

    def truth(amount: float) -> Mapping[str, float]:
        return {
            f'{number}.{axis}': float(amount * moves[slot, i])
            for number, slot in zip(ids, chosen, strict=True)
            for i, axis in enumerate('xyz')
        }

    return Hidden(1e-4, world=moved(moves), detail=f'landmarks {ids}', truth=truth)


def landmark_scale(scene: Scene, rng: Rng) -> Hidden:
    """The target is stretched along its own axes; a uniform scale cannot be seen."""
    arms = scene.points - scene.points.mean(axis=0)
    return Hidden(1e-4, world=moved(arms * unit(rng, 3)))


def target_shape(scene: Scene, rng: Rng) -> Hidden:
    """One board, or all, bent round a cylinder, round a sphere, or twisted; amount: m of rise."""
    kind = str(rng.choice(['cylinder', 'sphere', 'twist']))
    labels = np.unique(scene.board)
    chosen = labels if rng.integers(2) else rng.choice(labels, 1)
    angle = rng.uniform(0, np.pi)

    def bent(place: Array, rise: float) -> Array:
        """Move points (M, 2) of a flat board, m, to (M, 3)."""
        size = np.abs(place).max()
        if kind == 'twist':
            return np.column_stack([place, rise * place[:, 0] * place[:, 1] / size**2])
        radius = size**2 / 2 / rise  # of the circle with that rise over half the board
        way = np.array([np.cos(angle), np.sin(angle)])
        across = place @ way if kind == 'cylinder' else np.linalg.norm(place, axis=1)
        reach = radius * np.sin(across / radius) - across
        if kind == 'sphere':
            way = place / np.maximum(across, 1e-12)[:, None]
        flat = place + reach[:, None] * way
        return np.column_stack([flat, radius * (1 - np.cos(across / radius))])

    def world(world: World, amount: float) -> World:
        points = scene.points.copy()
        for label in chosen:
            mine = scene.board == label
            centre, axes = plane_of(scene.points[mine])
            place = (scene.points[mine] - centre) @ axes[:2].T
            points[mine] = centre + bent(place, amount) @ axes
        return replace(world, points=world.points + (points - scene.points))

    return Hidden(1e-4, world=world, detail=f'{kind}, boards {chosen}')


def board_pose(scene: Scene, rng: Rng) -> Hidden:
    """One board is shifted and turned."""
    label = int(rng.choice(np.unique(scene.board)))
    mine = scene.board == label
    centre = scene.points[mine].mean(axis=0)
    size = np.linalg.norm(scene.points[mine] - centre, axis=1).max()
    shift, turn = unit(rng, 3) * rng.uniform(0.2, 1.0), unit(rng, 3) * rng.uniform(0.2, 1.0)

    def world(world: World, amount: float) -> World:
        pose = Pose(rotation_from_vector(turn * amount / size), centre + shift * amount)
        arms = scene.points[mine] - centre
        points = world.points.copy()
        points[:, mine] += pose.position + arms @ pose.rotation.T - scene.points[mine]
        return replace(world, points=points)

    return Hidden(1e-4, world=world, detail=f'board {label}')


def dot_centroid(scene: Scene, rng: Rng) -> Hidden:
    """The detector gives the centroid of the area of a dot's image; amount: the radius, m."""
    corners = 24
    angle = 2 * np.pi * np.arange(corners) / corners
    # A polygon of the same area as the disc.
    reach = np.sqrt(2 * np.pi / corners / np.sin(2 * np.pi / corners))
    rims = np.empty((len(scene.points), corners, 3))
    for label in np.unique(scene.board):
        mine = scene.board == label
        axes = plane_of(scene.points[mine])[1]
        rims[mine] = reach * np.stack([np.cos(angle), np.sin(angle)], axis=-1) @ axes[:2]
    return Hidden(
        5e-3,
        world=lambda w, a: replace(w, dots=a * rims),
        truth=lambda a: {'radius_squared': a * a},
    )


def rolling_shutter(scene: Scene, rng: Rng) -> Hidden:
    sign = rng.choice([-1.0, 1.0])
    return Hidden(
        1e-4,
        world=lambda w, a: replace(w, readout=sign * a),
        truth=lambda a: {'readout': sign * a},
    )


def stereo_time_offset(scene: Scene, rng: Rng) -> Hidden:
    sign, second = rng.choice([-1.0, 1.0]), scene.camera > 0
    return Hidden(
        1e-4,
        world=lambda w, a: replace(w, times=w.times + sign * a * second),
        truth=lambda a: {'delay': sign * a},
    )


def rig_flex(scene: Scene, rng: Rng) -> Hidden:
    """The second camera turns: steadily, with a slow swing, or anew in every frame."""
    kind = str(rng.choice(['steadily', 'swinging', 'anew in every frame']))
    count = len(scene.times)
    when = np.linspace(-1, 1, count)
    amounts = {
        'steadily': when,
        'swinging': np.sin(1.5 * when + rng.uniform(0, 2 * np.pi)),
        'anew in every frame': rng.normal(size=count),
    }[kind]
    turns = np.outer(amounts, unit(rng, 3))
    if kind == 'anew in every frame':
        turns = rng.normal(size=(count, 3))
    turns = turns[scene.frame] * (scene.camera > 0)[:, None]

    def world(world: World, amount: float) -> World:
        bent = world.rig.rotation @ rotation_from_vector(amount * turns)
        return replace(world, rig=world.rig._replace(rotation=bent))

    lasting = kind != 'anew in every frame'
    return Hidden(1e-5, world=world, detail=kind, lasting=lasting)


def wrong_ids(scene: Scene, rng: Rng) -> Hidden:
    """One pair of image points or more swap their ids: the amount only adds to their number."""

    def recorded(uv: Array, amount: float, rng: Rng) -> Array:
        uv = uv.copy()
        for _ in range(1 + rng.poisson(4 * amount / scene.noise)):
            view = int(rng.integers(len(uv)))
            pair = rng.choice(np.flatnonzero(scene.seen[view]), 2, replace=False)
            uv[view, pair] = uv[view, pair[::-1]]
        return uv

    return Hidden(recorded=recorded)


def quantisation(scene: Scene, rng: Rng) -> Hidden:
    """Rounded to a step whose own error, step / sqrt(12), is the amount."""

    def recorded(uv: Array, amount: float, rng: Rng) -> Array:
        step = np.sqrt(12) * amount
        return np.asarray(np.round(uv / step) * step)

    return Hidden(recorded=recorded)


def noise_vs_angle(scene: Scene, rng: Rng) -> Hidden:
    power = float(rng.uniform(1.5, 3.0))
    return Hidden(
        0.1,
        scatter=lambda theta, a, _: (1 + a * theta**power)[..., None],
        detail=f'power {power:.1f}',
    )


HIDDEN: dict[str, tuple[Callable[[Scene, Rng], Hidden], Needs]] = {
    'viewpoint_shift': (optics.viewpoint_shift, Needs()),
    'radial_profile': (optics.radial_profile, Needs()),
    'focal_length': (optics.focal_length, Needs(fixed_intrinsics=True)),
    'principal_point': (optics.principal_point, Needs(fixed_intrinsics=True)),
    'aspect': (optics.aspect, Needs(fixed_intrinsics=True)),
    'skew': (optics.skew, Needs()),
    'decentering': (optics.decentering, Needs()),
    'sensor_tilt': (optics.sensor_tilt, Needs()),
    'flat_port': (optics.flat_port, Needs(window=True)),
    'focal_drift': (optics.focal_drift, Needs()),
    'session_step': (optics.session_step, Needs()),
    'landmark_survey': (landmark_survey, Needs()),
    'landmark_scale': (landmark_scale, Needs()),
    'target_shape': (target_shape, Needs(boards=True)),
    'board_pose': (board_pose, Needs(boards=True)),
    'dot_centroid': (dot_centroid, Needs(boards=True)),
    'detector_bias': (optics.detector_bias, Needs()),
    'rolling_shutter': (rolling_shutter, Needs()),
    'stereo_time_offset': (stereo_time_offset, Needs(stereo=True)),
    'rig_flex': (rig_flex, Needs(stereo=True)),
    'wrong_ids': (wrong_ids, Needs()),
    'quantisation': (quantisation, Needs()),
    'noise_vs_angle': (noise_vs_angle, Needs()),
}
