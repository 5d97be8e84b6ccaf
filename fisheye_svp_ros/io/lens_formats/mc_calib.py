"""MC-Calib's YAML of a rig: the lenses alone, since its poses have the unit of its board."""

from __future__ import annotations

import re

import numpy as np

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.lens_formats import Foreign, fields, models

_KINDS = {0: 'plumb_bob', 1: 'equidistant'}
_CAMERA = re.compile(r'camera_\d+')
_NOTE = 'the poses between its cameras have the unit of the board and are not read; use --rig FILE'


def recognises(text: str) -> bool:
    """Say whether a text is such a file."""
    return 'nb_camera:' in text and 'distortion_vector:' in text


def read(text: str, where: str) -> Foreign:
    """Read all cameras; raises LensError, naming camera and field."""
    document = fields.yaml(text, where)
    lenses = {}
    for name in filter(_CAMERA.fullmatch, map(str, document)):
        camera, place = fields.section(document, name, where), f'{where}: {name}'
        kind = camera.get('distortion_type')
        if kind not in _KINDS:
            raise LensError(f'{place}: distortion_type is {kind!r}; 0 and 1 (fisheye) can be read')
        data = fields.section(camera, 'camera_matrix', place)
        k = np.reshape(fields.numbers(data, 'data', 9, f'{place}: camera_matrix'), (3, 3))
        d = fields.number_list(fields.section(camera, 'distortion_vector', place), 'data', place)
        size = fields.values(camera, ('img_width', 'img_height'), place)
        intrinsics = k[0, 0], k[1, 1], k[0, 2], k[1, 2], k[0, 1]
        distortion = models.stated_distortion(_KINDS[kind], d, place)
        lenses[name] = models.nearest_lens(name, size, intrinsics, distortion, place)
    if not lenses:
        raise LensError(f'{where}: it holds no camera_0')
    return Foreign.from_lenses('MC-Calib', lenses)._replace(
        notes=(_NOTE,) if len(lenses) > 1 else ()
    )
