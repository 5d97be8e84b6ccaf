"""Effects to hide in the lens, the image and the detector, made by what causes them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from benchmark.studies.blind_scene import Hidden, Scene, World, centre_of, focal_of, imaged
from benchmark.studies.boards import Rng, angle_behind_window, unit
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.optics.curve_base import ImageHeight
from fisheye_svp_ros.optics.curves import IMAGE_HEIGHTS, Gennery
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import rotation_from_vector


def viewpoint_shift(scene: Scene, rng: Rng) -> Hidden:
    old = scene.lens.viewpoint_shift or Gennery()
    order = int(rng.integers(1, 4))
    share = rng.normal(size=order) * (1.0, 0.5, 0.3)[:order]
    share /= np.abs(share).max()
    s0, *e = old.coefficients

    def world(world: World, amount: float) -> World:
        more = np.array(e)
        more[:order] += amount * share
        return replace(world, lens=replace(world.lens, viewpoint_shift=Gennery(s0, *more)))

    def truth(amount: float) -> Mapping[str, float]:
        return {'e0': amount * share[0]} if order == 1 else {}

    return Hidden(1e-4, world=world, detail=f'order {order}', truth=truth)


@dataclass(frozen=True)
class _Height(ImageHeight):
    """An image height with a change added to it: for projecting only."""

    base: ImageHeight
    change: Callable[[Array], Array]

    def value_and_slope(self, theta: Array) -> tuple[Array, Array]:
        height, slope = self.base.value_and_slope(theta)
        return height + self.change(theta), slope


def radial_profile(scene: Scene, rng: Rng) -> Hidden:
    own = scene.lens.image_height
    kinds = [
        kind()
        for name, kind in IMAGE_HEIGHTS.items()
        if name != 'kannala_brandt' and kind is not type(own)
    ]
    other = kinds[int(rng.integers(len(kinds)))]
    bend = rng.uniform(1.0, 2.2)
    # Another projection than the one assumed, or a curve with a bend of its own.
    bent = bool(rng.integers(2))

    def change(theta: Array) -> Array:
        if bent:
            return np.asarray(theta * np.sin(bend * theta) ** 2)
        return np.asarray(other.value_and_slope(theta)[0] - own.value_and_slope(theta)[0])

    def world(world: World, amount: float) -> World:
        curve = _Height(world.lens.image_height, lambda theta: amount * change(theta))
        return replace(world, lens=replace(world.lens, image_height=curve))

    what = f'bend {bend:.2f}' if bent else f'part of {type(other).__name__.lower()}'
    return Hidden(1e-4, world=world, detail=what)


def _scaled_lens(world: World, **factors: float) -> World:
    changes = {name: getattr(world.lens, name) * factor for name, factor in factors.items()}
    return replace(world, lens=replace(world.lens, **changes))


def focal_length(scene: Scene, rng: Rng) -> Hidden:
    sign = rng.choice([-1.0, 1.0])
    return Hidden(
        1e-4,
        world=lambda w, a: _scaled_lens(w, fx=1 + sign * a, fy=1 + sign * a),
        truth=lambda a: {'relative': sign * a},
    )


def principal_point(scene: Scene, rng: Rng) -> Hidden:
    way = unit(rng, 2)

    def world(world: World, amount: float) -> World:
        centre = np.array([world.lens.cx, world.lens.cy]) + amount * way
        return replace(world, lens=replace(world.lens, cx=centre[0], cy=centre[1]))

    return Hidden(0.01, world=world, truth=lambda a: {'cx': a * way[0], 'cy': a * way[1]})


def aspect(scene: Scene, rng: Rng) -> Hidden:
    sign = rng.choice([-1.0, 1.0])
    return Hidden(
        1e-4,
        world=lambda w, a: _scaled_lens(w, fx=1 + sign * a / 2, fy=1 - sign * a / 2),
        truth=lambda a: {'relative': sign * a},
    )


def skew(scene: Scene, rng: Rng) -> Hidden:
    sign, lens = rng.choice([-1.0, 1.0]), scene.lens
    slope = sign * lens.fx / lens.fy * np.array([1.0, 0.0])
    return Hidden(
        1e-4,
        world=imaged(lambda uv, a: uv + a * slope * (uv[..., 1:] - lens.cy)),
        truth=lambda a: {'shear': sign * a},
    )


def decentering(scene: Scene, rng: Rng) -> Hidden:
    """An element of cubic power sits off the axis by the amount."""
    way, power = unit(rng, 2), rng.uniform(0.05, 0.2)
    centre, focal = centre_of(scene.lens), focal_of(scene.lens)

    def bent(m: Array) -> Array:
        return np.asarray(m + power * (m * m).sum(axis=-1, keepdims=True) * m)

    def change(uv: Array, amount: float) -> Array:
        m, off = (uv - centre) / focal, amount * way
        return np.asarray(uv + focal * (bent(m - off) + off - bent(m)))

    return Hidden(1e-4, world=imaged(change))


def sensor_tilt(scene: Scene, rng: Rng) -> Hidden:
    """The rays from the exit pupil, a focal length away, meet a tilted plane."""
    angle, lens = rng.uniform(0, 2 * np.pi), scene.lens
    centre, focal = centre_of(lens), focal_of(lens)

    def change(uv: Array, amount: float) -> Array:
        turn = rotation_from_vector(amount * np.array([np.cos(angle), np.sin(angle), 0.0]))
        m = (uv - centre) / focal
        ray = np.concatenate([m, np.ones_like(m[..., :1])], axis=-1)
        # The pupil is at (0, 0, -1), the plane passes through the origin.
        along = turn[2, 2] / (ray @ turn[:, 2])
        met = along[..., None] * ray - np.array([0.0, 0.0, 1.0])
        return np.asarray(centre + focal * (met @ turn[:, :2]))

    return Hidden(
        1e-4,
        world=imaged(change),
        truth=lambda a: {'about_x': a * np.cos(angle), 'about_y': a * np.sin(angle)},
    )


def flat_port(scene: Scene, rng: Rng) -> Hidden:
    """Every ray is traced through the window, Snell's law on both faces."""
    index = float(rng.choice([1.47, 1.49, 1.52]))

    def world(world: World, thickness: float) -> World:
        def optics(lens: Lens, points: Array) -> Array:
            radius, z = np.linalg.norm(points[..., :2], axis=-1), points[..., 2]
            shift = lens.viewpoint_shift
            theta = angle_behind_window(
                radius,
                z,
                thickness,
                index,
                origin=lambda angle: (
                    shift.value_and_slope(angle, np.tan(angle / 2))[0] if shift else 0.0
                ),
            )
            way = points[..., :2] / np.maximum(radius, 1e-12)[..., None]
            height = lens.image_height.value_and_slope(theta)[0]
            uv = centre_of(lens) + focal_of(lens) * height[..., None] * way
            return np.where((z > 0.02)[..., None], uv, np.nan)

        return replace(world, optics=optics)

    return Hidden(1e-4, world=world, detail=f'index {index}')


def focal_drift(scene: Scene, rng: Rng) -> Hidden:
    """The camera warms up: an exponential, about the mean for which the lens is right."""
    duration = np.ptp(scene.times)
    pace = duration * rng.uniform(0.2, 1.5)
    warm = 1 - np.exp(-(scene.times - scene.times[0]) / pace)
    warm = (warm - warm.mean())[scene.frame] * rng.choice([-1.0, 1.0])
    growth, centre = warm[:, None, None], centre_of(scene.lens)
    return Hidden(
        1e-4,
        world=imaged(lambda uv, a: uv + a * growth * (uv - centre)),
        detail=f'pace {pace / duration:.2f}',
    )


def session_step(scene: Scene, rng: Rng) -> Hidden:
    start = int(rng.integers(len(scene.times) // 6, len(scene.times) * 5 // 6))
    after = (scene.frame >= start)[:, None, None]
    way = unit(rng, 3) * (1.0, 300.0, 300.0)
    centre = centre_of(scene.lens)

    return Hidden(
        1e-4,
        world=imaged(lambda uv, a: uv + after * a * (way[0] * (uv - centre) + way[1:])),
        detail=f'from frame {start}',
    )


def detector_bias(scene: Scene, rng: Rng) -> Hidden:
    """Peak locking: towards the middle of the pixels or away from it, not quite a sine."""
    sign, sharpness = rng.choice([-1.0, 1.0]), float(rng.choice([0.0, 0.2, 0.4]))

    def change(uv: Array, amount: float) -> Array:
        phase = 2 * np.pi * uv
        return np.asarray(uv + sign * amount * np.sin(phase) / (1 + sharpness * np.cos(phase)))

    # Beyond the largest one, the order of two points within a pixel would change.
    return Hidden(
        0.01,
        largest=(1 - sharpness) / (2 * np.pi),
        world=imaged(change),
        detail=f'sharpness {sharpness}',
        truth=lambda a: {} if sharpness else {'sine': sign * a},
    )
