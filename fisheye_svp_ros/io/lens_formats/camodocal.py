"""CamOdoCal's camera files, as VINS-Fusion has them.

KANNALA_BRANDT as it stands, MEI and PINHOLE by a fit.
"""

from __future__ import annotations

from collections.abc import Sequence

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.lens_formats import Foreign, fields, models

INTRINSICS = {
    'KANNALA_BRANDT': ('mu', 'mv', 'u0', 'v0'),
    'MEI': ('gamma1', 'gamma2', 'u0', 'v0'),
    'PINHOLE': ('fx', 'fy', 'cx', 'cy'),
}


def recognises(text: str) -> bool:
    """Say whether a text is such a file."""
    return 'model_type:' in text and any(
        name in text for name in ('projection_parameters:', 'affine_parameters:')
    )


def read(text: str, where: str) -> Foreign:
    """Read the lens; raises LensError, naming the field."""
    document = fields.yaml(text, where)
    model = str(document.get('model_type')).upper()
    if model not in INTRINSICS:
        raise LensError(
            f'{where}: model_type is {model!r}; those that can be read are {", ".join(INTRINSICS)}'
        )

    def values(section: str, names: Sequence[str]) -> list[float]:
        return fields.values(
            fields.section(document, section, where), names, f'{where}: {section}'
        )

    intrinsics = values('projection_parameters', INTRINSICS[model])
    if model == 'KANNALA_BRANDT':
        distortion = models.Distortion(
            models.EQUIDISTANT, values('projection_parameters', ('k2', 'k3', 'k4', 'k5'))
        )
    else:
        base = models.PERSPECTIVE
        if model == 'MEI':
            base = models.omnidirectional(*values('mirror_parameters', ('xi',)))
        distortion = models.opencv_distortion(
            values('distortion_parameters', ('k1', 'k2', 'p1', 'p2')), base
        )
    size = fields.values(document, ('image_width', 'image_height'), where)
    name = str(document.get('camera_name', 'camera'))
    return Foreign.from_lenses(
        'CamOdoCal', {name: models.nearest_lens(name, size, intrinsics, distortion, where)}
    )
