"""ROS camera_info YAML, as camera_calibration writes it, of fisheye lenses (equidistant)."""

from __future__ import annotations

from typing import Any

import yaml

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.lens_formats import Foreign, radial
from fisheye_svp_ros.optics.lens import Lens

_MODELS = ('equidistant', 'fisheye')


def recognises(text: str) -> bool:
    """Say whether a text is such a file."""
    return 'distortion_model:' in text and 'camera_matrix:' in text and '%YAML' not in text


def read(text: str, where: str) -> Foreign:
    """Read the lens; raises LensError, naming the field."""
    try:
        document = yaml.safe_load(text)
        model = document['distortion_model']
        k = radial.numbers(document['camera_matrix'], 'data', 9, where)
        size = document['image_width'], document['image_height']
        name = str(document.get('camera_name', 'camera'))
        if model not in _MODELS:
            raise LensError(f'{where}: distortion_model is {model!r}; fisheye lenses are '
                            'equidistant')
        d = radial.numbers(document['distortion_coefficients'], 'data', 4, where)
    except (KeyError, TypeError, yaml.YAMLError) as cause:
        raise LensError(f'{where}: not a whole camera_info ({cause})') from cause
    lens = radial.kannala_brandt(name, size, (k[0], k[4], k[2], k[5]), d, where)
    return Foreign('ros', {name: lens}, (), {})


def write(lens: Lens) -> str:
    """Return the lens in this form."""
    near = radial.nearest(lens)

    def matrix(rows: int, columns: int, data: list[float]) -> dict[str, Any]:
        return {'rows': rows, 'cols': columns, 'data': data}

    k = [near.fx, 0.0, near.cx, 0.0, near.fy, near.cy, 0.0, 0.0, 1.0]
    return yaml.safe_dump({
        'image_width': near.width, 'image_height': near.height, 'camera_name': near.name,
        'camera_matrix': matrix(3, 3, k), 'distortion_model': 'equidistant',
        'distortion_coefficients': matrix(1, 4, radial.coefficients(near)),
        'rectification_matrix': matrix(3, 3, [1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0]),
        'projection_matrix': matrix(3, 4, [*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0]),
    }, sort_keys=False, default_flow_style=None)
