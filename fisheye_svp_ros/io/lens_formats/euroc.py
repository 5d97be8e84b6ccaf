"""EuRoC's sensor.yaml of a camera, Kimera's too: equidistant as it stands, others by a fit."""

from __future__ import annotations

import re

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.lens_formats import Foreign, fields, models

# Kimera's has camera_id in place of sensor_type.
_OF_CAMERA = re.compile(r'^(sensor_type: *camera|camera_id:)', re.MULTILINE)


def recognises(text: str) -> bool:
    """Say whether a text is such a file."""
    return bool(_OF_CAMERA.search(text)) and 'intrinsics:' in text and 'camera_model:' in text


def read(text: str, where: str) -> Foreign:
    """Read the lens; raises LensError, naming the field."""
    document = fields.yaml(text, where)
    model, kind = document.get('camera_model'), str(document.get('distortion_model', 'none'))
    if str(model).lower() != 'pinhole':
        raise LensError(f'{where}: camera_model is {model!r}; pinhole can be read')
    name, stated = 'distortion_coefficients', models.stated_model(kind)
    if stated == 'equidistant':
        k = fields.coefficient_list(document, name, (4,), where)
        distortion = models.Distortion(models.EQUIDISTANT, k)
    elif stated == 'plumb_bob' or kind.lower() == 'none':
        d = fields.coefficient_list(document, name, (4, 5), where) if stated else ()
        distortion = models.opencv_distortion(d)
    else:
        raise LensError(
            f'{where}: distortion_model is {kind!r}; equidistant and radial-tangential can be read'
        )
    return Foreign.from_lenses(
        'EuRoC',
        {
            'camera': models.nearest_lens(
                'camera',
                fields.numbers(document, 'resolution', 2, where),
                fields.numbers(document, 'intrinsics', 4, where),
                distortion,
                where,
            )
        },
    )
