"""Basalt calibration JSON: kb4 as it stands, others by a fit."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.files import parse_json
from fisheye_svp_ros.io.lens_formats import Foreign, fields, models
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, identity, quaternion_from_rotation

recognises = re.compile(r'\s*\{.*"camera_type"', re.DOTALL).match
# Coefficients of each model, and what they make
_MODELS: dict[str, tuple[tuple[str, ...], Callable[..., models.Distortion]]] = {
    'kb4': (('k1', 'k2', 'k3', 'k4'), lambda *k: models.Distortion(models.EQUIDISTANT, k)),
    'ds': (('xi', 'alpha'), lambda *of: models.Distortion(models.double_sphere(*of))),
    'eucm': (('alpha', 'beta'), lambda *of: models.Distortion(models.unified_heights(*of))),
    'ucm': (('alpha',), lambda alpha: models.Distortion(models.unified_heights(alpha, 1.0))),
    'fov': (('w',), lambda omega: models.Distortion(models.field_of_view_model(omega))),
    'pinhole': ((), lambda: models.Distortion(models.PERSPECTIVE)),
    'pinhole-radtan8': (models.OPENCV[:8], lambda *d: models.opencv_distortion(d)),
}
_NAMES = ('px', 'py', 'pz', 'qx', 'qy', 'qz', 'qw')


def read(text: str, where: str) -> Foreign:
    """Read all cameras and the rigs between them; raises LensError, naming the field."""
    document: Mapping[str, Any] = parse_json(text, where, LensError)
    if 'value0' in document:
        document = fields.section(document, 'value0', where)
    cameras = fields.sections(document, 'intrinsics', where)
    sizes = document.get('resolution')
    if not isinstance(sizes, list) or len(sizes) != len(cameras):
        raise LensError(
            f'{where}: resolution is {sizes!r}; a list of width and height of each of '
            f'the {len(cameras)} cameras of intrinsics is needed'
        )
    lenses = {
        f'cam{i}': _basalt_lens(f'cam{i}', camera, size, f'{where}: camera {i}')
        for i, (camera, size) in enumerate(zip(cameras, sizes, strict=True))
    }
    rigs = _rigs(fields.sections({'T_imu_cam': [], **document}, 'T_imu_cam', where), where)
    return Foreign.from_lenses('Basalt', lenses, rigs)


def _basalt_lens(
    name: str, camera: Mapping[str, Any], size: Any, where: str
) -> tuple[Lens, float]:
    kind = str(camera.get('camera_type')).lower()
    if kind not in _MODELS:
        raise LensError(
            f'{where}: camera_type is {kind!r}; those that can be read are {", ".join(_MODELS)}'
        )
    names, distortion = _MODELS[kind]
    intrinsics = fields.section(camera, 'intrinsics', where)
    pinhole = fields.values(intrinsics, ('fx', 'fy', 'cx', 'cy'), where)
    size = fields.numbers({'resolution': size}, 'resolution', 2, where)
    return models.nearest_lens(
        name, size, pinhole, distortion(*fields.values(intrinsics, names, where)), where
    )


def _rigs(entries: Sequence[Mapping[str, Any]], where: str) -> tuple[Pose, ...]:
    table = [
        fields.values(entry, _NAMES, f'{where}: T_imu_cam {i}') for i, entry in enumerate(entries)
    ]
    places = [fields.pose(row[:3], row[3:], f'{where}: T_imu_cam') for row in table]
    return tuple(later.inverse().compose(earlier) for earlier, later in itertools.pairwise(places))


def write(lens: Lens) -> str:
    """Return the lens in this form, as the one camera of its rig."""
    return write_chain([lens], ())


def write_chain(lenses: Sequence[Lens], rigs: Sequence[Pose]) -> str:
    """Return lenses and each camera in the next one in this form, the first as the IMU.

    Viewpoint shifts stay behind.
    """
    near = [models.nearest_kannala_brandt(lens) for lens in lenses]
    places = [identity()]
    for rig in rigs:
        places.append(places[-1].compose(rig.inverse()))
    document = {
        'T_imu_cam': [
            dict(
                zip(
                    _NAMES,
                    [*place.position.tolist(), *quaternion_from_rotation(place.rotation).tolist()],
                    strict=True,
                )
            )
            for place in places
        ],
        'intrinsics': [{'camera_type': 'kb4', 'intrinsics': _intrinsics(lens)} for lens in near],
        'resolution': [[lens.width, lens.height] for lens in near],
    }
    return json.dumps({'value0': document}, indent=4) + '\n'


def _intrinsics(lens: Lens) -> dict[str, float]:
    values = {'fx': lens.fx, 'fy': lens.fy, 'cx': lens.cx, 'cy': lens.cy}
    return values | {f'k{i}': k for i, k in enumerate(models.coefficients(lens), start=1)}
