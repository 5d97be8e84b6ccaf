"""OpenImuCameraCalibrator's JSON, with the cameras of Theia: FISHEYE as it stands, others fitted.

fy is aspect_ratio times focal_length.  DIVISION_UNDISTORTION divides pixels by 1 + k r^2, r in px
about the principal point, after the focal length.
"""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.files import parse_json
from fisheye_svp_ros.io.lens_formats import Foreign, fields, models

recognises = re.compile(r'\s*\{.*"intrinsic_type"', re.DOTALL).match
_RADIAL = [f'radial_distortion_{i}' for i in range(1, 5)]
_DIVISION, _ANGLES = 'DIVISION_UNDISTORTION', 200
# Names of the parameters of each camera, and what it is distorted by; f in px
_MODELS: dict[str, tuple[tuple[str, ...], Callable[..., models.Distortion]]] = {
    'FISHEYE': (tuple(_RADIAL), lambda f, *k: models.Distortion(models.EQUIDISTANT, k)),
    _DIVISION: (
        ('div_undist_distortion',),
        lambda f, k: models.Distortion(models.division(k * f * f)),
    ),
    'DOUBLE_SPHERE': (
        ('xi', 'alpha'),
        lambda f, *of: models.Distortion(models.double_sphere(*of)),
    ),
    'EXTENDED_UNIFIED': (
        ('alpha', 'beta'),
        lambda f, *of: models.Distortion(models.unified_heights(*of)),
    ),
    'PINHOLE': ((), lambda f: models.Distortion(models.PERSPECTIVE)),
    'PINHOLE_RADIAL_TANGENTIAL': (
        (*_RADIAL[:3], 'tangential_distortion_1', 'tangential_distortion_2'),
        lambda f, k1, k2, k3, p1, p2: models.opencv_distortion((k1, k2, p1, p2, k3)),
    ),
}


def read(text: str, where: str) -> Foreign:
    """Read the lens; raises LensError, naming the field."""
    document = parse_json(text, where, LensError)
    kind = str(document.get('intrinsic_type')).upper()
    if kind not in _MODELS:
        raise LensError(
            f'{where}: intrinsic_type is {kind!r}; those that can be read are {", ".join(_MODELS)}'
        )
    names, distortion = _MODELS[kind]
    size = fields.values(document, ('image_width', 'image_height'), where)
    intrinsics, place = fields.section(document, 'intrinsics', where), f'{where}: intrinsics'
    f, cx, cy = fields.values(
        intrinsics, ('focal_length', 'principal_pt_x', 'principal_pt_y'), place
    )
    aspect, skew = fields.values(
        {'aspect_ratio': 1.0, 'skew': 0.0, **intrinsics}, ('aspect_ratio', 'skew'), place
    )
    bent = distortion(f, *fields.values(intrinsics, names, place))
    lens, worst = models.nearest_lens('camera', size, (f, f * aspect, cx, cy, skew), bent, where)
    if kind == _DIVISION:
        # It sees pixels: along v, where these are of another size, its curve is another one.
        theta = np.linspace(0.0, lens.max_incidence, _ANGLES)
        along_v = lens.fy * lens.image_height.value_and_slope(theta)[0]
        right = distortion(f * aspect, *fields.values(intrinsics, names, place)).height(theta)
        worst = max(worst, float(np.abs(along_v - f * aspect * right).max()))
    return Foreign.from_lenses('OpenImuCameraCalibrator', {'camera': (lens, worst)})
