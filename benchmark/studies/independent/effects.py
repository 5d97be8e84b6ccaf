"""The effects of the catalog, each formulated by what causes it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from benchmark.studies.independent.camera import Array
from benchmark.studies.independent.formation import Departure
from benchmark.studies.independent.scene import Scene

Rng = np.random.Generator
Form = Callable[[float], Departure]
BOARDS = ('board', 'cube')


@dataclass(frozen=True)
class Effect:
    """How an effect is drawn; `draw` returns the departure as a function of the amount.

    `limit` is the largest amount, in `unit`, that anybody would believe.  The displacement grows
    like amount**power.  What is `direct` takes the size for its amount.  `stereo`, `moving` and
    `fitted` say what the scene must be, None that it does not matter.
    `stage` says where it sits; where the design leaves that open, either place.
    """

    stage: str
    unit: str
    limit: float
    draw: Callable[[Rng, Scene], Form]
    kinds: tuple[str, ...] = ('board', 'cube', 'world')
    stereo: bool | None = None
    moving: bool | None = None
    fitted: bool | None = None
    not_kannala: bool = False
    widest: float = 2.0
    power: float = 1.0
    direct: bool = False


def center_of(scene: Scene) -> Array:
    return np.array([scene.lens.cx, scene.lens.cy])


def image_radius(scene: Scene) -> float:
    lens = scene.lens
    return lens.fx * float(lens.unit_height(np.array(lens.theta_max)))


def viewpoint_shift(rng: Rng, scene: Scene) -> Form:
    """Gennery's s(θ) with e0, and e1, e2 of random shares."""
    sign, e1, e2 = rng.choice([-1, 1]), rng.uniform(-0.3, 0.3), rng.uniform(-0.1, 0.1)

    def shift(theta: Array) -> Array:
        safe = np.maximum(theta, 1e-6)
        return (safe / np.sin(safe) - 1) * (1 + e1 * theta**2 + e2 * theta**4)

    return lambda a: Departure(
        pupil=lambda t, _: sign * a * shift(t)[:, None] * np.array([0.0, 0.0, 1.0])
    )


def pupil_decentering(rng: Rng, scene: Scene) -> Form:
    """The entrance pupil moves sideways, as the square of the angle or of its sine."""
    phi, even = rng.uniform(0, 2 * np.pi), rng.random() < 0.5
    towards = np.array([np.cos(phi), np.sin(phi), 0.0])

    def growth(theta: Array) -> Array:
        return np.asarray(theta**2 if even else np.sin(theta) ** 2)

    return lambda a: Departure(pupil=lambda t, _: a * growth(t)[:, None] * towards)


def radial_profile(rng: Rng, scene: Scene) -> Form:
    """h(θ) departs by a random odd polynomial without its linear term."""
    share = rng.normal(size=3) * [1, 0.7, 0.4]
    edge = scene.lens.theta_max
    return lambda a: Departure(
        profile=lambda t: a * sum(c * (t / edge) ** (2 * i + 3) for i, c in enumerate(share))
    )


def focal_length(rng: Rng, scene: Scene) -> Form:
    """All image heights are larger or smaller by one factor."""
    sign = rng.choice([-1, 1])
    return lambda a: Departure(focal=np.full((len(scene.frame), 2), 1 + sign * a))


def principal_point(rng: Rng, scene: Scene) -> Form:
    """The axis meets the sensor elsewhere."""
    phi = rng.uniform(0, 2 * np.pi)
    return lambda a: Departure(
        center=np.broadcast_to(a * np.array([np.cos(phi), np.sin(phi)]), (len(scene.frame), 2))
    )


def aspect(rng: Rng, scene: Scene) -> Form:
    """Pixels are not square."""
    sign = rng.choice([-1, 1])
    return lambda a: Departure(
        focal=np.tile([1 + sign * a / 2, 1 - sign * a / 2], (len(scene.frame), 1))
    )


def skew(rng: Rng, scene: Scene) -> Form:
    """Rows and columns of the sensor are not at right angles."""
    sign, middle = rng.choice([-1, 1]), center_of(scene)
    return lambda a: Departure(
        field=lambda uv: sign * a * (uv[:, 1:] - middle[1]) * np.array([1.0, 0.0])
    )


def decentering(rng: Rng, scene: Scene) -> Form:
    """A lens element is off the axis: thrice as much along the radius as across (Conrady)."""
    phi, middle, radius = rng.uniform(0, 2 * np.pi), center_of(scene), image_radius(scene)
    p = np.array([np.cos(phi), np.sin(phi)])

    def field(uv: Array) -> Array:
        q = (uv - middle) / radius
        return (q**2).sum(1)[:, None] * p + 2 * (q @ p)[:, None] * q

    return lambda a: Departure(field=lambda uv: a * field(uv))


def sensor_tilt(rng: Rng, scene: Scene) -> Form:
    """The sensor is turned about a line through the principal point; exit pupil 1 to 3 f away."""
    phi, middle = rng.uniform(0, 2 * np.pi), center_of(scene)
    away = scene.lens.fx * rng.uniform(1, 3)
    axis = np.array([np.cos(phi), np.sin(phi), 0.0])

    def tilted(uv: Array, a: float) -> Array:
        plane = Rotation.from_rotvec(a * axis).as_matrix()
        ray = np.c_[uv - middle, np.full(len(uv), away)]
        meet = ray * (away * plane[2, 2] / (ray @ plane[:, 2]))[:, None] - [0, 0, away]
        return meet @ plane[:, :2] - (uv - middle)

    return lambda a: Departure(field=lambda uv: tilted(uv, a))


def flat_port(rng: Rng, scene: Scene) -> Form:
    """A plane window of glass or acrylic before the lens."""
    index = rng.uniform(1.45, 1.55)
    return lambda a: Departure(window=(a, index))


def _over_time(scene: Scene) -> Array:
    times = scene.track.times
    return (times - times[0]) / (times[-1] - times[0])


def focal_drift(rng: Rng, scene: Scene) -> Form:
    """The focal length follows a smooth curve in time."""
    t = _over_time(scene)
    curve = rng.normal() * t + rng.normal() * np.sin(
        np.pi * rng.uniform(0.8, 2) * t + rng.uniform(0, 2 * np.pi)
    )
    curve = ((curve - curve.mean()) / curve.std())[scene.frame]
    return lambda a: Departure(focal=(1 + a * curve)[:, None] * np.ones(2))


def thermal_drift(rng: Rng, scene: Scene) -> Form:
    """The focal length settles, as a camera warms up."""
    curve = rng.choice([-1, 1]) * np.exp(-_over_time(scene) / rng.uniform(0.1, 0.6))
    curve = ((curve - curve.mean()) / curve.std())[scene.frame]
    return lambda a: Departure(focal=(1 + a * curve)[:, None] * np.ones(2))


def session_step(rng: Rng, scene: Scene) -> Form:
    """From some frame on the lens sits differently: focal length and center have jumped."""
    after = (np.arange(scene.frames) >= scene.frames * rng.uniform(0.3, 0.7))[scene.frame]
    zoom, move = rng.normal(), rng.normal(size=2) * image_radius(scene) / 2
    return lambda a: Departure(
        focal=1 + a * zoom * after[:, None] * np.ones(2), center=a * after[:, None] * move
    )


def landmark_survey(rng: Rng, scene: Scene) -> Form:
    """One to four landmarks are not where they are said to be."""
    moved = np.zeros((len(scene.target.points), 3))
    often = np.bincount(scene.landmark, minlength=len(moved))
    bad = rng.choice(np.flatnonzero(often >= np.median(often)), rng.integers(1, 5), replace=False)
    towards = rng.normal(size=(len(bad), 3))
    if scene.target.kind != 'world':
        towards = np.einsum('nij,ni->nj', scene.target.axes[bad], towards * [1, 1, 0.3])
    moved[bad] = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    return lambda a: Departure(landmarks=a * moved)


def landmark_scale(rng: Rng, scene: Scene) -> Form:
    """Printer or tape stretched the target along one of its directions."""
    target = scene.target
    if target.kind == 'world':
        along = np.eye(3)[rng.integers(3)]
        return lambda a: Departure(landmarks=a * (target.points @ along)[:, None] * along)
    which = rng.integers(2)
    along = target.axes[:, which]
    return lambda a: Departure(landmarks=a * target.half * target.local[:, which, None] * along)


def target_shape(rng: Rng, scene: Scene) -> Form:
    """Every board is bowed across a random direction, twisted a little and warped."""
    target, height = scene.target, np.zeros(len(scene.target.points))
    for board in np.unique(target.board):
        on = target.board == board
        phi = rng.uniform(0, np.pi)
        p = target.local[on] @ [np.cos(phi), np.sin(phi)]
        q = target.local[on] @ [-np.sin(phi), np.cos(phi)]
        bow, twist = rng.choice([-1, 1]) * rng.uniform(0.5, 1), rng.normal(0, 0.3)
        warp = rng.normal(0, 0.25) * p**2 + rng.normal(0, 0.25) * q**2
        height[on] = bow * p**2 + twist * p * q + warp * p
    return lambda a: Departure(landmarks=a * height[:, None] * target.axes[:, 2])


def board_pose(rng: Rng, scene: Scene) -> Form:
    """The boards of one target are glued on askew: each is turned and moved a little."""
    target, moved = scene.target, np.zeros((len(scene.target.points), 3))
    for board in np.unique(target.board):
        on = target.board == board
        arm = target.points[on] - target.points[on].mean(0)
        moved[on] = np.cross(rng.normal(size=3) / target.half, arm) + rng.normal(size=3)
    return lambda a: Departure(landmarks=a * moved)


def dot_centroid(rng: Rng, scene: Scene) -> Form:
    """Targets are discs; the detector takes the center of gravity of their images."""
    return lambda a: Departure(dot=a * scene.target.spacing)


def detector_bias(rng: Rng, scene: Scene) -> Form:
    """Pixel locking: a bias that depends on where in the pixel the point lies."""
    half, share = rng.choice([0.0, 0.5]), rng.uniform(-0.2, 0.2)

    def lock(uv: Array) -> Array:
        phase = 2 * np.pi * (uv - half)
        return np.sin(phase) + share * np.sin(2 * phase)

    return lambda a: Departure(lock=lambda uv: a * lock(uv))


def rolling_shutter(rng: Rng, scene: Scene) -> Form:
    """Rows are exposed one after the other while the camera moves; `t` is the middle row's."""
    rows = scene.lens.height
    return lambda a: Departure(delay=lambda uv: a * (uv[:, 1] / rows - 0.5))


def stereo_time_offset(rng: Rng, scene: Scene) -> Form:
    """The right camera takes its picture later, or earlier, than it says."""
    sign = rng.choice([-1, 1])
    return lambda a: Departure(delay=lambda uv: sign * a * scene.camera)


def rig_flex(rng: Rng, scene: Scene) -> Form:
    """The bar between the cameras bends and twists, from frame to frame or slowly."""
    flex = np.zeros((scene.frames, 6))
    flex[:, :3] = rng.normal(size=(scene.frames, 3))
    if rng.random() < 0.5:
        t = _over_time(scene)[:, None]
        flex[:, :3] = np.sin(2 * np.pi * (t * rng.uniform(0.5, 1.5, 3) + rng.uniform(size=3)))
    flex[:, 3:] = 0.05 * np.cross(flex[:, :3], [1, 0, 0])
    return lambda a: Departure(flex=a * flex)


def wrong_ids(rng: Rng, scene: Scene) -> Form:
    """Neighbors in some views exchange their names."""

    def swap(size: float) -> Departure:
        rows: list[tuple[int, int]] = []
        wanted = max(1, round(5 * size))
        while len(rows) < wanted:
            first = rng.integers(len(scene.frame))
            view = np.flatnonzero(
                (scene.frame == scene.frame[first]) & (scene.camera == scene.camera[first])
            )
            away = np.linalg.norm(
                scene.target.points[scene.landmark[view]]
                - scene.target.points[scene.landmark[first]],
                axis=1,
            )
            second = view[np.argsort(away)[rng.integers(1, 4)]]
            if not {int(first), int(second)} & {row for pair in rows for row in pair}:
                rows.append((int(first), int(second)))
        return Departure(swaps=np.array(rows))

    return swap


def noise_vs_angle(rng: Rng, scene: Scene) -> Form:
    """The detector is worse towards the edge of the picture, by 1 + size·(θ-dependent, rms 1)."""
    points = scene.target.points[scene.landmark] - scene.track.centers[scene.frame]
    axis = scene.track.turns[scene.frame].apply([0, 0, 1])
    cosine = np.einsum('ij,ij->i', points, axis) / np.linalg.norm(points, axis=1)
    growth = np.arccos(cosine.clip(-1, 1)) ** rng.uniform(2, 4)
    growth = growth / np.sqrt(np.mean(growth**2))
    return lambda size: Departure(spread=1 + size * growth)


def quantisation(rng: Rng, scene: Scene) -> Form:
    """Coordinates are written in steps; the amount is the step."""
    return lambda a: Departure(lattice=a)


STEPS = (1.0, 0.5, 0.25, 0.2, 0.1, 0.05)

EFFECTS: dict[str, Effect] = {
    'viewpoint_shift': Effect('lens', 'm', 0.03, viewpoint_shift),
    'radial_profile': Effect('lens', 'px', 30.0, radial_profile, not_kannala=True),
    'focal_length': Effect('lens', '1', 0.1, focal_length, fitted=False),
    'principal_point': Effect('lens', 'px', 25.0, principal_point, fitted=False),
    'aspect': Effect('lens', '1', 0.03, aspect, fitted=False),
    'skew': Effect('lens', '1', 0.02, skew),
    'decentering': Effect('lens', 'px', 20.0, decentering),
    'sensor_tilt': Effect('lens', 'rad', 0.1, sensor_tilt),
    'pupil_decentering': Effect('lens', 'm', 0.03, pupil_decentering),
    'flat_port': Effect('lens', 'm', 0.03, flat_port, widest=1.35),
    'focal_drift': Effect('lens or frame', '1', 0.05, focal_drift),
    'session_step': Effect('lens or frame', '1', 0.05, session_step),
    'landmark_survey': Effect('target', 'm', 0.05, landmark_survey),
    'landmark_scale': Effect('target', '1', 0.03, landmark_scale),
    'target_shape': Effect('target', 'm', 0.02, target_shape, kinds=BOARDS),
    'board_pose': Effect('target', 'm', 0.02, board_pose, kinds=('cube',)),
    'dot_centroid': Effect('target or frame', '1', 0.45, dot_centroid, kinds=BOARDS, power=2.0),
    'detector_bias': Effect('lens or noise', 'px', 0.14, detector_bias),
    'rolling_shutter': Effect('frame', 's', 0.05, rolling_shutter, moving=True),
    'stereo_time_offset': Effect('frame', 's', 0.05, stereo_time_offset, stereo=True, moving=True),
    'rig_flex': Effect('frame', 'rad', 0.03, rig_flex, stereo=True),
    'wrong_ids': Effect('noise', 'pairs', 5, wrong_ids, direct=True),
    'quantisation': Effect('noise', 'px', 1.0, quantisation, direct=True),
    'noise_vs_angle': Effect('noise', '1', 1.0, noise_vs_angle, direct=True),
}
