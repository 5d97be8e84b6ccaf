"""transforms.json of nerfstudio and instant-ngp: OPENCV_FISHEYE as it stands, others by a fit.

The image begins at 0, as COLMAP's does, of which most of these files come.
"""

from __future__ import annotations

import json

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.documents import parse_json
from fisheye_svp_ros.io.lens_formats import Foreign, fields, radial
from fisheye_svp_ros.io.lens_formats.distortion import Distortion, brown, nearest_lens
from fisheye_svp_ros.optics.lens import Lens

_CORNER = 0.5  # px, of our first pixel's center from the corner where the image begins
_FISHEYE, _PERSPECTIVE = 'OPENCV_FISHEYE', ('OPENCV', 'PINHOLE', 'SIMPLE_PINHOLE')
_NAMES = ('k1', 'k2', 'k3', 'k4', 'p1', 'p2')


def recognises(text: str) -> bool:
    """Say whether a text is such a file."""
    return text.lstrip().startswith('{') and '"fl_x"' in text


def read(text: str, where: str) -> Foreign:
    """Read the lens, or the first frame's where each has its own; raises LensError."""
    document = parse_json(text, where, LensError)
    frames = document.get('frames')
    first = frames[0] if isinstance(frames, list) and frames else {}
    given = {**(first if isinstance(first, dict) else {}), **document}
    model = given.get('camera_model', _FISHEYE if given.get('is_fisheye') else 'OPENCV')
    if model != _FISHEYE and model not in _PERSPECTIVE:
        raise LensError(f'{where}: camera_model is {model!r}; those that can be read are '
                        f'{", ".join((_FISHEYE, *_PERSPECTIVE))}')
    size = fields.values(given, ('w', 'h'), where)
    fx, cx, cy = fields.values(given, ('fl_x', 'cx', 'cy'), where)
    fy = fields.values(given, ('fl_y',), where)[0] if 'fl_y' in given else fx
    names = tuple(name for name in _NAMES if name in given)
    values = dict(zip(names, fields.values(given, names, where), strict=True))
    if model == _FISHEYE:
        distortion = Distortion(
            radial.EQUIDISTANT, [values.get(name, 0.0) for name in _NAMES[:4]])
    else:
        distortion = brown(radial.PERSPECTIVE, values)
    lens, worst = nearest_lens(
        'camera', size, (fx, fy, cx - _CORNER, cy - _CORNER), distortion, where)
    return Foreign('nerfstudio', {'camera': lens}, (), {'camera': worst})


def write(lens: Lens) -> str:
    """Return the lens in this form, without frames."""
    near = radial.nearest_kannala_brandt(lens)
    return json.dumps({
        'camera_model': _FISHEYE, 'w': near.width, 'h': near.height,
        'fl_x': near.fx, 'fl_y': near.fy, 'cx': near.cx + _CORNER, 'cy': near.cy + _CORNER,
        **dict(zip(_NAMES, radial.coefficients(near), strict=False)), 'frames': [],
    }, indent=4) + '\n'
