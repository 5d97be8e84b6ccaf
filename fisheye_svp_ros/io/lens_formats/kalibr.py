"""Kalibr camchain YAML, OpenVINS's too: pinhole-equidistant as it stands, others by a fit.

A camera stands in the one before (T_cn_cnm1) or, as both do, in the IMU (T_cam_imu brings points
of the IMU into the camera, T_imu_cam the other way).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.files import dump_yaml
from fisheye_svp_ros.io.lens_formats import Foreign, fields, models
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose

_INTRINSICS = {'pinhole': 4, 'omni': 5, 'ds': 6, 'eucm': 6}
_COEFFICIENTS = {'equidistant': 4, 'radtan': 4, 'fov': 1, 'none': 0}


def recognises(text: str) -> bool:
    """Say whether a text is such a file."""
    return 'cam0:' in text and 'camera_model:' in text


def read(text: str, where: str) -> Foreign:
    """Read all cameras and the rigs between them; raises LensError, naming camera and field."""
    document = fields.yaml(text, where)
    # YAML libraries write cam10 before cam2.
    names = sorted(
        (name for name in map(str, document) if name.startswith('cam')),
        key=lambda name: (len(name), name),
    )
    cameras = {name: fields.section(document, name, where) for name in names}
    lenses = {
        name: _kalibr_lens(name, camera, f'{where}: {name}') for name, camera in cameras.items()
    }
    rigs: list[Pose] = []
    for number, (before, name) in enumerate(pairwise(names)):
        step = _neighbor_pose(cameras, before, name, where)
        if step is None:
            continue
        if len(rigs) < number:
            raise LensError(
                f'{where}: {names[len(rigs) + 1]} has no T_cn_cnm1, and {name} '
                'after it has one; the chain is broken'
            )
        rigs.append(step)
    return Foreign.from_lenses('Kalibr', lenses, rigs)


def _kalibr_lens(name: str, camera: Mapping[str, Any], where: str) -> tuple[Lens, float]:
    model = str(camera.get('camera_model')).lower()
    if model not in _INTRINSICS:
        raise LensError(
            f'{where}: camera_model is {model!r}; choose from {", ".join(_INTRINSICS)}'
        )
    *model_numbers, fx, fy, cx, cy = fields.numbers(
        camera, 'intrinsics', _INTRINSICS[model], where
    )
    size = fields.numbers(camera, 'resolution', 2, where)
    distortion = _kalibr_distortion(camera, model, model_numbers, where)
    return models.nearest_lens(name, size, (fx, fy, cx, cy), distortion, where)


def _kalibr_distortion(
    camera: Mapping[str, Any], model: str, own: Sequence[float], where: str
) -> models.Distortion:
    """Return what the image is distorted by; own: numbers of the model beside the intrinsics."""
    kind = str(camera.get('distortion_model', 'none')).lower()
    d = (
        fields.coefficient_list(camera, 'distortion_coeffs', (_COEFFICIENTS[kind],), where)
        if (_COEFFICIENTS.get(kind))
        else []
    )
    match model, kind:
        case 'pinhole', 'equidistant':
            return models.Distortion(models.EQUIDISTANT, d)
        case 'pinhole', 'fov':
            return models.Distortion(models.field_of_view_model(*d))
        case 'pinhole' | 'omni', 'radtan' | 'none':
            return models.opencv_distortion(
                d, models.omnidirectional(*own) if own else models.PERSPECTIVE
            )
        case 'ds' | 'eucm', 'radtan' | 'none' if not any(d):
            heights = models.double_sphere if model == 'ds' else models.unified_heights
            return models.Distortion(heights(*own))
    raise LensError(
        f'{where}: {model} with {kind} cannot be read. Readable are pinhole with equidistant, '
        'fov, radtan, or none, omni with radtan or none, ds, and eucm'
    )


def _neighbor_pose(
    cameras: Mapping[str, Mapping[str, Any]], before: str, name: str, where: str
) -> Pose | None:
    """Return a camera's neighbor in it: as stated, or through the IMU of both; None: not known."""
    if 'T_cn_cnm1' in cameras[name]:
        return _transform(cameras[name], 'T_cn_cnm1', f'{where}: {name}')
    poses = [_imu_in_camera(cameras[camera], f'{where}: {camera}') for camera in (before, name)]
    if poses[0] is None or poses[1] is None:
        return None
    return poses[1].compose(poses[0].inverse())


def _imu_in_camera(camera: Mapping[str, Any], where: str) -> Pose | None:
    if 'T_cam_imu' in camera:
        return _transform(camera, 'T_cam_imu', where)
    return _transform(camera, 'T_imu_cam', where).inverse() if 'T_imu_cam' in camera else None


def _transform(camera: Mapping[str, Any], name: str, where: str) -> Pose:
    try:
        matrix = np.array(camera[name], dtype=float).reshape(4, 4)
    except (TypeError, ValueError) as cause:
        raise LensError(f'{where}: {name} must be a matrix of 4 x 4') from cause
    return fields.pose(matrix[:3, 3], matrix[:3, :3], f'{where}: {name}')


def write(lens: Lens) -> str:
    """Return the lens in this form, as the one camera of its chain."""
    return write_chain([lens], ())


def write_chain(lenses: Sequence[Lens], rigs: Sequence[Pose]) -> str:
    """Return lenses and each camera in the next one in this form; viewpoint shifts stay behind."""
    document: dict[str, Any] = {}
    for number, near in enumerate(map(models.nearest_kannala_brandt, lenses)):
        document[f'cam{number}'] = {
            'camera_model': 'pinhole',
            'intrinsics': [near.fx, near.fy, near.cx, near.cy],
            'distortion_model': 'equidistant',
            'distortion_coeffs': models.coefficients(near),
            'resolution': [near.width, near.height],
            'rostopic': f'/{near.name}/image_raw',
        }
        if number:
            rig = rigs[number - 1]
            rows = np.column_stack([rig.rotation, rig.position]).tolist()
            document[f'cam{number}']['T_cn_cnm1'] = [*rows, [0.0, 0.0, 0.0, 1.0]]
    return dump_yaml(document, default_flow_style=None)
