"""DepthAI's calibration JSON, as an OAK camera stores it: fisheye as it stands, others by a fit.

Extrinsics bring points of a camera into `toCameraSocket`; translations are in cm.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.files import parse_json
from fisheye_svp_ros.io.lens_formats import Foreign, fields, models
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, identity

recognises = re.compile(r'\s*\{.*"cameraData"', re.DOTALL).match
_PERSPECTIVE, _FISHEYE = 0, 1
_CENTIMETER = 0.01
_SOCKETS = 'ABCDEFGHIJ'


def read(text: str, where: str) -> Foreign:
    """Read all cameras that are calibrated, and the rig; raises LensError, naming the field."""
    document = parse_json(text, where, LensError)
    entries = document.get('cameraData')
    try:
        cameras = {int(socket): dict(camera) for socket, camera in entries}  # type: ignore[union-attr]
    except (TypeError, ValueError) as cause:
        raise LensError(f'{where}: cameraData must be pairs of socket and camera') from cause
    names = {
        socket: f'CAM_{_SOCKETS[socket]}'
        for socket, camera in sorted(cameras.items())
        if 0 <= socket < len(_SOCKETS) and camera.get('width')
    }
    if not names:
        raise LensError(f'{where}: cameraData holds no camera that is calibrated')
    lenses = {
        name: _depthai_lens(name, cameras[socket], f'{where}: {name}')
        for socket, name in names.items()
    }
    poses = [_in_root(socket, cameras, where) for socket in names]
    connected = len({root for root, _ in poses}) == 1
    rigs = [after.inverse().compose(before) for (_, before), (_, after) in pairwise(poses)]
    return Foreign.from_lenses('DepthAI', lenses, rigs if connected else ())


def _depthai_lens(name: str, camera: Mapping[str, Any], where: str) -> tuple[Lens, float]:
    kind = camera.get('cameraType', _PERSPECTIVE)
    if kind not in (_PERSPECTIVE, _FISHEYE):
        raise LensError(
            f'{where}: cameraType is {kind!r}; 0 (perspective) and 1 (fisheye) can be read'
        )
    k = fields.matrix(camera, 'intrinsicMatrix', (3, 3), where)
    d = fields.number_list(camera, 'distortionCoeff', where)
    distortion = (
        models.Distortion(models.EQUIDISTANT, d[:4])
        if kind == _FISHEYE
        else models.opencv_distortion(d)
    )
    size = fields.values(camera, ('width', 'height'), where)
    intrinsics = k[0, 0], k[1, 1], k[0, 2], k[1, 2], k[0, 1]
    return models.nearest_lens(name, size, intrinsics, distortion, where)


def _in_root(
    socket: int, cameras: Mapping[int, Mapping[str, Any]], where: str
) -> tuple[int, Pose]:
    """Return the camera to which a camera's extrinsics lead at last, and its pose in that one."""
    pose = identity()
    for _ in cameras:
        extrinsics = cameras[socket].get('extrinsics') or {}
        target = extrinsics.get('toCameraSocket', -1)
        if target not in cameras:
            break
        place = f'{where}: extrinsics of socket {socket}'
        shift = fields.values(
            fields.section(extrinsics, 'translation', place), tuple('xyz'), place
        )
        turn = fields.matrix(extrinsics, 'rotationMatrix', (3, 3), place)
        pose = fields.pose(_CENTIMETER * np.array(shift), turn, place).compose(pose)
        socket = target
    return socket, pose
