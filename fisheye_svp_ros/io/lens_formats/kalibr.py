"""Kalibr camchain YAML: pinhole-equidistant as it stands; omni, ds, eucm and pinhole by a fit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.documents import dump_yaml, parse_yaml
from fisheye_svp_ros.io.lens_formats import Foreign, fields, radial
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose

_INTRINSICS = {'pinhole': 4, 'omni': 5, 'ds': 6, 'eucm': 6}


def recognises(text: str) -> bool:
    """Say whether a text is such a file."""
    return 'cam0:' in text and 'camera_model:' in text


def read(text: str, where: str) -> Foreign:
    """Read all cameras and the rigs between them; raises LensError, naming camera and field."""
    document = parse_yaml(text, where, LensError)
    # YAML libraries write cam10 before cam2.
    names = sorted((name for name in map(str, document) if name.startswith('cam')),
                   key=lambda name: (len(name), name))
    lenses, worst = {}, {}
    rigs: list[Pose] = []
    for number, name in enumerate(names):
        camera = fields.section(document, name, where)
        lenses[name], worst[name] = _lens(name, camera, f'{where}: {name}')
        if number and 'T_cn_cnm1' in camera:
            if len(rigs) < number - 1:
                raise LensError(f'{where}: {names[len(rigs) + 1]} has no T_cn_cnm1, and {name} '
                                'after it has one; the chain is broken')
            rigs.append(_rig(camera['T_cn_cnm1'], f'{where}: {name}'))
    return Foreign('kalibr', lenses, tuple(rigs), worst)


def _lens(name: str, camera: Mapping[str, Any], where: str) -> tuple[Lens, float]:
    model, distortion = str(camera.get('camera_model')), camera.get('distortion_model', 'none')
    if model not in _INTRINSICS:
        raise LensError(f'{where}: camera_model is {model!r}; known are {", ".join(_INTRINSICS)}')
    *own, fx, fy, cx, cy = fields.numbers(camera, 'intrinsics', _INTRINSICS[model], where)
    size, pinhole = fields.numbers(camera, 'resolution', 2, where), (fx, fy, cx, cy)
    if model == 'pinhole' and distortion == 'equidistant':
        k = fields.numbers(camera, 'distortion_coeffs', 4, where)
        return radial.kannala_brandt(name, size, pinhole, k, where), 0.0
    k = [] if distortion == 'none' else fields.numbers(camera, 'distortion_coeffs', 4, where)
    if distortion not in ('none', 'radtan') or (k and model in ('ds', 'eucm') and any(k)):
        raise LensError(f'{where}: {model} with {distortion} is not a form that can be read')
    if model == 'ds':
        curve, limit = radial.double_sphere(*own)
    elif model == 'eucm':
        curve, limit = radial.unified(*own)
    else:
        curve, limit = radial.omnidirectional(own[0] if own else 0.0, k[:2])
    lens, worst = radial.fitted(name, size, pinhole, curve, limit, where)
    # Radtan's tangential part is no radial curve: what it moves at the edge is left out.
    edge = float(curve(np.array([lens.max_incidence]))[0])
    return lens, worst + 3 * edge**2 * max(map(abs, k[2:]), default=0.0) * max(fx, fy)


def _rig(rows: Any, where: str) -> Pose:
    try:
        matrix = np.array(rows, dtype=float).reshape(4, 4)
    except (TypeError, ValueError) as cause:
        raise LensError(f'{where}: T_cn_cnm1 must be a matrix of 4 x 4') from cause
    return fields.pose(matrix[:3, 3], matrix[:3, :3], f'{where}: T_cn_cnm1')


def write(lens: Lens) -> str:
    """Return the lens in this form, as the one camera of its chain."""
    near = radial.nearest(lens)
    return dump_yaml({'cam0': {
        'camera_model': 'pinhole',
        'intrinsics': [near.fx, near.fy, near.cx, near.cy],
        'distortion_model': 'equidistant',
        'distortion_coeffs': radial.coefficients(near),
        'resolution': [near.width, near.height],
        'rostopic': f'/{near.name}/image_raw',
    }}, default_flow_style=None)
