"""ORB-SLAM3's settings: KannalaBrandt8 as it stands, PinHole by a fit; both cameras of a rig.

Stereo.T_c1_c2 (Tlr in older files) is the second camera in the first one.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.lens_formats import Foreign, fields, models
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose

recognises = re.compile(r'^Camera1?\.fx *:', re.MULTILINE).search
_CAMERAS = {'left': ('Camera1.', 'Camera.'), 'right': ('Camera2.',)}
_STEREO = ('Stereo.T_c1_c2', 'Tlr')


def read(text: str, where: str) -> Foreign:
    """Read one lens or two and the rig; raises LensError, naming the field."""
    document = fields.yaml(text, where)
    prefixes = {
        camera: next((p for p in prefix if f'{p}fx' in document), '')
        for camera, prefix in _CAMERAS.items()
    }
    if not prefixes['right']:
        return Foreign.from_lenses(
            'ORB-SLAM3', {'camera': _orbslam_lens('camera', prefixes['left'], document, where)}
        )
    lenses = {
        camera: _orbslam_lens(camera, prefix, document, f'{where}: {prefix.rstrip(".")}')
        for camera, prefix in prefixes.items()
    }
    rigs = tuple(
        _stereo_pose(document[name], f'{where}: {name}') for name in _STEREO if name in document
    )
    return Foreign.from_lenses('ORB-SLAM3', lenses, rigs[:1])


def _orbslam_lens(
    name: str, prefix: str, document: Mapping[str, Any], where: str
) -> tuple[Lens, float]:
    def values(*names: str) -> list[float]:
        return fields.values(document, [f'{prefix}{name}' for name in names], where)

    kind = str(document.get('Camera.type', 'PinHole'))
    size = fields.values(document, ('Camera.width', 'Camera.height'), where)
    intrinsics = values('fx', 'fy', 'cx', 'cy')
    if models.stated_model(kind) == 'equidistant':
        distortion = models.Distortion(models.EQUIDISTANT, values('k1', 'k2', 'k3', 'k4'))
    elif kind.lower() == 'pinhole':
        names = [name for name in models.OPENCV if f'{prefix}{name}' in document]
        distortion = models.brown(
            models.PERSPECTIVE, dict(zip(names, values(*names), strict=True))
        )
    else:
        raise LensError(
            f'{where}: Camera.type is {kind!r}; KannalaBrandt8 and PinHole can be read'
        )
    return models.nearest_lens(name, size, intrinsics, distortion, where)


def _stereo_pose(matrix: Any, where: str) -> Pose:
    """Return the first camera in the second one."""
    data = matrix.get('data') if isinstance(matrix, dict) else None
    if not isinstance(data, list) or len(data) not in (12, 16):
        raise LensError(f'{where}: a matrix of 4 x 4 or 3 x 4 is needed')
    rows = np.reshape(fields.numbers(matrix, 'data', len(data), where), (-1, 4))
    return fields.pose(rows[:3, 3], rows[:3, :3], where).inverse()
