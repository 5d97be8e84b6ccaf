"""Basalt calibration JSON: kb4 as it stands, ds by a fit."""

from __future__ import annotations

import itertools
import json
from typing import Any

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.documents import parse_json
from fisheye_svp_ros.io.lens_formats import Foreign, fields, radial
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose

_NAMES = ('px', 'py', 'pz', 'qx', 'qy', 'qz', 'qw')


def recognises(text: str) -> bool:
    """Say whether a text is such a file."""
    return text.lstrip().startswith('{') and '"camera_type"' in text


def read(text: str, where: str) -> Foreign:
    """Read all cameras and the rigs between them; raises LensError, naming the field."""
    document = parse_json(text, where, LensError)
    try:
        document = document.get('value0', document)
        cameras, sizes = document['intrinsics'], document['resolution']
        lenses, worst = {}, {}
        for i, (camera, size) in enumerate(zip(cameras, sizes, strict=True)):
            lens, off = _lens(f'cam{i}', camera, size, f'{where}: camera {i}')
            lenses[f'cam{i}'], worst[f'cam{i}'] = lens, off
        rigs = _rigs(document.get('T_imu_cam', []), where)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as cause:
        raise LensError(f'{where}: not a whole Basalt calibration ({cause!r})') from cause
    return Foreign('basalt', lenses, rigs, worst)


def _lens(name: str, camera: dict[str, Any], size: list[float], where: str) -> tuple[Lens, float]:
    values, kind = camera['intrinsics'], camera['camera_type']
    pinhole = [float(values[key]) for key in ('fx', 'fy', 'cx', 'cy')]
    if kind == 'kb4':
        k = [float(values[f'k{i}']) for i in range(1, 5)]
        return radial.kannala_brandt(name, size, pinhole, k, where), 0.0
    if kind == 'ds':
        curve, limit = radial.double_sphere(float(values['xi']), float(values['alpha']))
        return radial.fitted(name, size, pinhole, curve, limit, where)
    raise LensError(f'{where}: camera_type is {kind!r}; kb4 and ds can be read')


def _rigs(entries: list[dict[str, float]], where: str) -> tuple[Pose, ...]:
    table = [[float(entry[name]) for name in _NAMES] for entry in entries]
    places = [fields.pose(row[:3], row[3:], f'{where}: T_imu_cam') for row in table]
    return tuple(later.inverse().compose(earlier)
                 for earlier, later in itertools.pairwise(places))


def write(lens: Lens) -> str:
    """Return the lens in this form, as the one camera of its rig."""
    near = radial.nearest(lens)
    values = {'fx': near.fx, 'fy': near.fy, 'cx': near.cx, 'cy': near.cy}
    values |= {f'k{i}': k for i, k in enumerate(radial.coefficients(near), start=1)}
    return json.dumps({'value0': {
        'T_imu_cam': [dict(zip(_NAMES, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), strict=True))],
        'intrinsics': [{'camera_type': 'kb4', 'intrinsics': values}],
        'resolution': [[near.width, near.height]],
    }}, indent=4) + '\n'
