"""Generic smooth fields over angle, range, place in a pixel and time: probes without a name."""

from __future__ import annotations

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.diagnosis.model import Linearised

_CURVE = 5  # degree of smooth curves over an angle
_WAVES = 12


def mean_fields(linear: Linearised) -> dict[str, Array]:
    """Generic smooth fields (F, M, P) over each variable, at the image stage."""
    scene, views = linear.scene, linear.data.views
    m = scene.normalised()
    scale = max(float(np.nanmax(np.abs(m[views.used]))), 1e-9)
    x, y = np.moveaxis(np.nan_to_num(m / scale), -1, 0)
    theta = np.nan_to_num(scene.theta / scene.theta_max)
    distance = np.linalg.norm(scene.pose.into_body(views.points), axis=-1)
    near = np.where(views.used, 1 / np.maximum(distance, 1e-6), 0.0)
    near = near / max(near.max(), 1e-9)
    radial, tangential = _polar(x, y)
    fields = {
        'theta': _along(radial, _powers(theta)) + _along(tangential, _powers(theta)),
        'range': [
            direction * (near**i * theta**j)[..., None]
            for direction in (radial, tangential) for i in (1, 2) for j in (1, 2, 3)
        ],
        'pixel_phase': _phases(linear.linear.optical),
    }
    t = scene.times
    if np.isfinite(t).all() and np.ptp(t) > 0:
        when = (2 * (t - t.min()) / np.ptp(t) - 1)[:, None] * np.ones_like(x)
        fields['time'] = [
            field * (when**i)[..., None]
            for field in _both_axes([np.ones_like(x), x, y]) for i in (1, 2, 3)
        ]
    return {
        name: linear.whitened(np.stack(columns, axis=-1)) for name, columns in fields.items()
    }


def intrinsic_paths(linear: Linearised) -> tuple[Array, Array]:
    """Smooth paths (F, M, P) of each camera's focal length and centre, in the order of time.

    Cosines over the frames, each half period of three frames at least; and the precision (P,) of
    the coefficient of each beside that of the slowest, as the square of the second derivative.
    """
    data, scene = linear.data, linear.scene
    instant = scene.times if np.isfinite(scene.times).all() else scene.views.frame
    _, place = np.unique(instant, return_inverse=True)
    count = int(place.max()) + 1
    waves = np.arange(1, min(_WAVES, count // 3) + 1)
    path = np.cos(np.pi * waves * (place[:, None] + 0.5) / count)
    mine = data.camera_of[:, None] == np.arange(data.cameras)
    moves = (path[..., None] * mine[:, None]).reshape(len(path), -1)
    growth = np.nan_to_num(scene.normalised())[..., None]
    step = np.concatenate([growth, np.broadcast_to(np.eye(2), (*growth.shape[:-1], 2))], axis=-1)
    columns = step[..., None] * moves[:, None, None, None]
    roughness = np.tile(np.repeat(waves**4.0, data.cameras), step.shape[-1])
    return linear.whitened(columns.reshape(*growth.shape[:-1], -1)), roughness


def _along(direction: Array, scalars: list[Array]) -> list[Array]:
    return [direction * scalar[..., None] for scalar in scalars]


def _powers(theta: Array) -> list[Array]:
    return [theta**i for i in range(1, _CURVE + 1)]


def _polar(x: Array, y: Array) -> tuple[Array, Array]:
    norm = np.maximum(np.hypot(x, y), 1e-9)
    radial = np.stack([x / norm, y / norm], axis=-1)
    return radial, np.stack([-radial[..., 1], radial[..., 0]], axis=-1)


def _phases(uv: Array) -> list[Array]:
    phase = 2 * np.pi * np.nan_to_num(uv)
    columns = []
    for harmonic in (1, 2):
        for wave in (np.sin(harmonic * phase), np.cos(harmonic * phase)):
            for axis in (0, 1):
                column = np.zeros_like(wave)
                column[..., axis] = wave[..., axis]
                columns.append(column)
    return columns


def _both_axes(scalars: list[Array]) -> list[Array]:
    """Return fields (..., 2): each scalar (...) along u, and along v."""
    zero = np.zeros_like(scalars[0])
    pairs = [pair for s in scalars for pair in ((s, zero), (zero, s))]
    return [np.stack(pair, axis=-1) for pair in pairs]
