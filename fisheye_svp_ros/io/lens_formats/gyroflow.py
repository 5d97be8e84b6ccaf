"""Gyroflow's lens profile: cv2.fisheye as it stands, cv2.calibrateCamera's by a fit."""

from __future__ import annotations

import re

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.files import parse_json
from fisheye_svp_ros.io.lens_formats import Foreign, fields, models

recognises = re.compile(r'\s*\{.*"fisheye_params"', re.DOTALL).match
_STRETCHES = ('input_horizontal_stretch', 'input_vertical_stretch')


def read(text: str, where: str) -> Foreign:
    """Read the lens at the size it was calibrated for; raises LensError, naming the field."""
    document = parse_json(text, where, LensError)
    stated = str(document.get('distortion_model') or 'opencv_fisheye')
    model = models.stated_model(stated)
    if model is None:
        raise LensError(
            f'{where}: distortion_model is {stated!r}; of Gyroflow opencv_fisheye and '
            'opencv_standard can be read'
        )
    # Gyroflow takes 0 for 1.
    changed = [name for name in _STRETCHES if (document.get(name) or 1) != 1]
    if changed or document.get('digital_lens'):
        name = (*changed, 'digital_lens')[0]
        raise LensError(
            f'{where}: {name} is {document[name]!r}; the image of such a lens is changed '
            'before it is calibrated, which cannot be read'
        )
    size = fields.values(
        fields.section(document, 'calib_dimension', where), ('w', 'h'), f'{where}: calib_dimension'
    )
    parameters = fields.section(document, 'fisheye_params', where)
    place = f'{where}: fisheye_params'
    k = fields.matrix(parameters, 'camera_matrix', (3, 3), place)
    d = fields.number_list(parameters, 'distortion_coeffs', place)
    lens = models.nearest_lens(
        'camera',
        size,
        (k[0, 0], k[1, 1], k[0, 2], k[1, 2], k[0, 1]),
        models.stated_distortion(model, d, place),
        where,
    )
    return Foreign.from_lenses('Gyroflow', {'camera': lens})
