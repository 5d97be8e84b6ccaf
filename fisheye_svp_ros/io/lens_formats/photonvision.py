"""PhotonVision's calibration JSON: OpenCV's camera matrix and coefficients, by a fit."""

from __future__ import annotations

import re

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.files import parse_json
from fisheye_svp_ros.io.lens_formats import Foreign, fields, models

recognises = re.compile(r'\s*\{.*"cameraIntrinsics"', re.DOTALL).match
_MODEL = 'LENSMODEL_OPENCV'  # with 4, 5 or 8 behind it, or nothing


def read(text: str, where: str) -> Foreign:
    """Read the lens; raises LensError, naming the field."""
    document = parse_json(text, where, LensError)
    model = str(document.get('lensmodel', _MODEL))
    if not model.upper().startswith(_MODEL):
        raise LensError(
            f'{where}: lensmodel is {model!r}; of PhotonVision {_MODEL} can be read, and of '
            'mrcal its .cameramodel'
        )
    size = fields.values(fields.section(document, 'resolution', where), ('width', 'height'), where)
    place = f'{where}: cameraIntrinsics'
    k = fields.numbers(fields.section(document, 'cameraIntrinsics', where), 'data', 9, place)
    d = fields.number_list(
        fields.section(document, 'distCoeffs', where), 'data', f'{where}: distCoeffs'
    )
    return Foreign.from_lenses(
        'PhotonVision',
        {
            'camera': models.nearest_lens(
                'camera',
                size,
                (k[0], k[4], k[2], k[5], k[1]),
                models.opencv_distortion(d),
                where,
            )
        },
    )
