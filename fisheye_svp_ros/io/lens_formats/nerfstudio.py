"""transforms.json of nerfstudio and instant-ngp: OPENCV_FISHEYE as it stands, others by a fit.

The image begins at 0, as COLMAP's does, of which most of these files come.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.files import parse_json
from fisheye_svp_ros.io.lens_formats import Foreign, fields, models
from fisheye_svp_ros.optics.lens import Lens

recognises = re.compile(r'\s*\{.*"fl_x"', re.DOTALL).match
_CORNER = 0.5  # px, of our first pixel's center from the corner where the image begins
_FISHEYE, _PERSPECTIVE = 'OPENCV_FISHEYE', ('OPENCV', 'PINHOLE', 'SIMPLE_PINHOLE')
_NAMES = ('k1', 'k2', 'k3', 'k4', 'p1', 'p2')
_KEYS = ('camera_model', 'is_fisheye', 'w', 'h', 'fl_x', 'fl_y', 'cx', 'cy', *_NAMES)


def read(text: str, where: str) -> Foreign:
    """Read the lens, or the different ones of the frames; raises LensError."""
    document = parse_json(text, where, LensError)
    shared = {key: document[key] for key in _KEYS if key in document}
    frames = document.get('frames')
    cameras = [
        {key: frame[key] for key in _KEYS if key in frame} | shared
        for frame in (frames if isinstance(frames, list) else [])
        if isinstance(frame, dict)
    ]
    different = list({json.dumps(camera): camera for camera in cameras}.values()) or [shared]
    if len(different) == 1:
        lenses = {'camera': _nerfstudio_lens('camera', different[0], where)}
    else:
        lenses = {
            f'camera{i}': _nerfstudio_lens(f'camera{i}', camera, f'{where}: camera{i}')
            for i, camera in enumerate(different, start=1)
        }
    return Foreign.from_lenses('nerfstudio', lenses)


def _nerfstudio_lens(name: str, given: Mapping[str, Any], where: str) -> tuple[Lens, float]:
    model = str(given.get('camera_model', _FISHEYE if given.get('is_fisheye') else 'OPENCV'))
    model = model.upper()
    if model != _FISHEYE and model not in _PERSPECTIVE:
        raise LensError(
            f'{where}: camera_model is {model!r}; those that can be read are '
            f'{", ".join((_FISHEYE, *_PERSPECTIVE))}'
        )
    size = fields.values(given, ('w', 'h'), where)
    fx, cx, cy = fields.values(given, ('fl_x', 'cx', 'cy'), where)
    fy = fields.values(given, ('fl_y',), where)[0] if 'fl_y' in given else fx
    names = tuple(key for key in _NAMES if key in given)
    values = dict(zip(names, fields.values(given, names, where), strict=True))
    if model == _FISHEYE:
        distortion = models.Distortion(
            models.EQUIDISTANT, [values.get(key, 0.0) for key in _NAMES[:4]]
        )
    else:
        distortion = models.brown(models.PERSPECTIVE, values)
    return models.nearest_lens(name, size, (fx, fy, cx - _CORNER, cy - _CORNER), distortion, where)


def write(lens: Lens) -> str:
    """Return the lens in this form, without frames."""
    near = models.nearest_kannala_brandt(lens)
    return (
        json.dumps(
            {
                'camera_model': _FISHEYE,
                'w': near.width,
                'h': near.height,
                'fl_x': near.fx,
                'fl_y': near.fy,
                'cx': near.cx + _CORNER,
                'cy': near.cy + _CORNER,
                **dict(zip(_NAMES, models.coefficients(near), strict=False)),
                'frames': [],
            },
            indent=4,
        )
        + '\n'
    )
