"""BoofCV's YAML of its universal omnidirectional model, by a fit."""

from __future__ import annotations

import re

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.files import parse_yaml
from fisheye_svp_ros.io.lens_formats import Foreign, fields, models

recognises = re.compile('omnidirectional_universal').search


def read(text: str, where: str) -> Foreign:
    """Read the lens; raises LensError, naming the field that is missing."""
    document = parse_yaml(text, where, LensError)
    pinhole, distortion = (
        fields.section(document, name, where) for name in ('pinhole', 'radial_tangential')
    )
    size = fields.values(pinhole, ('width', 'height'), f'{where}: pinhole')
    intrinsics = fields.values(
        {'skew': 0.0, **pinhole}, ('fx', 'fy', 'cx', 'cy', 'skew'), f'{where}: pinhole'
    )
    (offset,) = fields.values(document, ('mirror_offset',), where)
    listed, place = distortion.get('radial'), f'{where}: radial_tangential'
    k = fields.numbers(distortion, 'radial', len(listed) if isinstance(listed, list) else 2, place)
    tangential = fields.values({'t1': 0.0, 't2': 0.0, **distortion}, ('t1', 't2'), place)
    bent = models.Distortion(models.omnidirectional(offset), k, (), tangential)
    return Foreign.from_lenses(
        'BoofCV', {'camera': models.nearest_lens('camera', size, intrinsics, bent, where)}
    )
