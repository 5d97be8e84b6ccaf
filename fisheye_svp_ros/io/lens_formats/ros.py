"""ROS camera_info, as YAML of camera_calibration and as message: equidistant, or near to it.

A file may hold either, the message as `ros2 topic echo` prints it (or `rostopic echo`, which has
capitals).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.base import Scene
from fisheye_svp_ros.effects.decentering import DecenteringEffect
from fisheye_svp_ros.effects.forward import project
from fisheye_svp_ros.errors import LensError, ObservationError
from fisheye_svp_ros.io.decoding import read_camera_info
from fisheye_svp_ros.io.documents import dump_yaml, parse_yaml
from fisheye_svp_ros.io.lens_formats import Foreign, fields, radial
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import identity
from fisheye_svp_ros.scene.observations import views_of

# How many coefficients each distortion model of sensor_msgs/distortion_models has
_PERSPECTIVE = {'plumb_bob': (0, 4, 5), 'rational_polynomial': (8,)}
_EQUIDISTANT = ('equidistant', 'fisheye')
_TOLERANCE = 0.2  # px, of a perspective lens as one of ours
_STEPS = 40
_MESSAGE = re.compile('^[kK]:', re.MULTILINE)


def recognises(text: str) -> bool:
    """Say whether a text is such a file."""
    return 'distortion_model:' in text and '%YAML' not in text and (
        'camera_matrix:' in text or bool(_MESSAGE.search(text)))


def read(text: str, where: str) -> Foreign:
    """Read the lens; raises LensError, naming the field."""
    if 'camera_matrix:' not in text:
        return _read_message(text, where)
    document = parse_yaml(text, where, LensError)
    try:
        k = fields.numbers(document['camera_matrix'], 'data', 9, where)
        size = document['image_width'], document['image_height']
        name = str(document.get('camera_name', 'camera'))
        model = str(document['distortion_model'])
        d = document['distortion_coefficients']['data']
        d = fields.numbers({'data': d}, 'data', len(d), where)
    except (KeyError, TypeError, AttributeError) as cause:
        raise LensError(f'{where}: not a whole camera_info ({cause})') from cause
    lens, worst = lens_of(model, size, (k[0], k[4], k[2], k[5]), tuple(d), name, where)
    return Foreign('ros', {name: lens}, (), {name: worst} if worst else {})


def _read_message(text: str, where: str) -> Foreign:
    document = parse_yaml(text.partition('\n---')[0], where, LensError)
    try:
        told = {name.lower(): value for name, value in document.items()}
        fields.numbers(told, 'k', 9, where)
        message = SimpleNamespace(**{**told, 'roi': SimpleNamespace(**told['roi'])})
        model = read_camera_info(message, where)
        name = str(told['header']['frame_id']) or 'camera'
    except ObservationError as cause:
        raise LensError(str(cause)) from cause
    except (LookupError, TypeError, ValueError, AttributeError) as cause:
        raise LensError(f'{where}: not a whole camera_info ({cause})') from cause
    lens, worst = lens_of(*model, name, where)
    return Foreign('ros', {name: lens}, (), {name: worst} if worst else {})


@lru_cache(maxsize=64)
def lens_of(
    model: str, size: tuple[int, int], intrinsics: tuple[float, ...], d: tuple[float, ...],
    name: str, where: str,
) -> tuple[Lens, float]:
    """Return the lens of a distortion model, and how far off it is at worst, px.

    size: width, height; intrinsics: fx, fy, cx, cy; d: as sensor_msgs/CameraInfo has it.
    Raises LensError, naming `where`, for a model that no lens here comes near to.
    """
    try:
        with np.errstate(all='ignore'):
            return _lens_of(model, size, intrinsics, d, name, where)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as cause:
        raise LensError(f'{where}: its numbers make no lens ({cause})') from cause


def _lens_of(
    model: str, size: tuple[int, int], intrinsics: tuple[float, ...], d: tuple[float, ...],
    name: str, where: str,
) -> tuple[Lens, float]:
    if model in _EQUIDISTANT:
        if len(d) != 4:
            raise LensError(f'{where}: {model} has {len(d)} coefficients; k1 to k4 are needed')
        return radial.kannala_brandt(name, size, intrinsics, d, where), 0.0
    if model not in _PERSPECTIVE:
        raise LensError(f'{where}: distortion_model is {model!r}; known are '
                        f'{", ".join((*_EQUIDISTANT, *_PERSPECTIVE))}')
    counts = _PERSPECTIVE[model]
    # rational_polynomial may carry coefficients of a thin prism and a tilt as well.
    if len(d) not in counts and any(d[counts[-1]:] or d):
        raise LensError(f'{where}: {model} has {len(d)} coefficients; {counts[-1]} are needed')
    k1, k2, p1, p2, k3, k4, k5, k6 = (*d, *[0.0] * 8)[:8]
    lens, worst = _perspective(
        name, size, intrinsics, ((k1, k2, k3), (k4, k5, k6)), (p1, p2), where)
    if not worst <= _TOLERANCE:
        raise LensError(f'{where}: no lens here comes nearer than {worst:.2g} px to this {model}; '
                        'calibrate it anew, as equidistant')
    return lens, worst


def _perspective(
    name: str, size: tuple[int, int], intrinsics: Sequence[float],
    ratio: tuple[Sequence[float], Sequence[float]], tangential: tuple[float, float], where: str,
) -> tuple[Lens, float]:
    """Return the lens nearest to Brown and Conrady's, and its worst deviation, px.

    ratio: coefficients of powers of the squared slope above and below the line.
    """
    def polynomial(z: Array, coefficients: Sequence[float]) -> Array:
        return np.asarray(1 + sum(k * z ** (i + 1) for i, k in enumerate(coefficients)))

    def stretch(z: Array) -> Array:
        return polynomial(z, ratio[0]) / polynomial(z, ratio[1])

    def curve(theta: Array) -> Array:
        slope = np.tan(theta)
        return np.asarray(slope * stretch(slope * slope))

    lens, _ = radial.fitted(name, size, intrinsics, curve, np.pi / 2 * (1 - 1e-6), where)
    theta, azimuth = np.meshgrid(np.linspace(0, lens.max_incidence, _STEPS)[1:],
                                 np.linspace(0, 2 * np.pi, _STEPS))
    a, b = np.tan(theta) * np.cos(azimuth), np.tan(theta) * np.sin(azimuth)
    z, (p1, p2) = a * a + b * b, tangential
    x = a * stretch(z) + 2 * p1 * a * b + p2 * (z + 2 * a * a)
    y = b * stretch(z) + p1 * (z + 2 * b * b) + 2 * p2 * a * b
    fx, fy, cx, cy = intrinsics
    uv, points = np.stack([fx * x + cx, fy * y + cy], axis=-1), np.stack([a, b, a**0], axis=-1)
    inside = ((uv >= 0) & (uv < np.array(size))).all(axis=-1)
    if any(tangential):
        found = _decentered(lens, points[inside], uv[inside])
        lens = replace(lens, corrections={
            'decentering': DecenteringEffect().to_dict(found)})
    return lens, float(np.abs(project(lens, points[inside]).uv - uv[inside]).max())


def _decentered(lens: Lens, points: Array, uv: Array) -> Array:
    """Return p1, p2 of the lens that bring image points of points (N, 3) nearest to uv (N, 2)."""
    ideal = project(lens, points).uv
    scene = Scene(views_of(points[None], uv[None]), lens, identity(1), ideal[None])
    columns = DecenteringEffect().columns(scene)
    return np.asarray(np.linalg.lstsq(columns.reshape(-1, 2), (uv - ideal).ravel(), rcond=None)[0])


def write(lens: Lens) -> str:
    """Return the lens in this form."""
    near = radial.nearest(lens)

    def matrix(rows: int, columns: int, data: list[float]) -> dict[str, Any]:
        return {'rows': rows, 'cols': columns, 'data': data}

    k = [near.fx, 0.0, near.cx, 0.0, near.fy, near.cy, 0.0, 0.0, 1.0]
    return dump_yaml({
        'image_width': near.width, 'image_height': near.height, 'camera_name': near.name,
        'camera_matrix': matrix(3, 3, k), 'distortion_model': 'equidistant',
        'distortion_coefficients': matrix(1, 4, radial.coefficients(near)),
        'rectification_matrix': matrix(3, 3, [1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0]),
        'projection_matrix': matrix(3, 4, [*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0]),
    }, default_flow_style=None)
