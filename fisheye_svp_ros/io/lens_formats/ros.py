"""ROS camera_info, as YAML of camera_calibration and as message.

A file may hold either, the message as `ros2 topic echo` prints it (or `rostopic echo`, which has
capitals).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.errors import LensError, ObservationError
from fisheye_svp_ros.io.decoding import read_camera_info
from fisheye_svp_ros.io.files import dump_yaml, parse_yaml
from fisheye_svp_ros.io.lens_formats import Foreign, fields, models
from fisheye_svp_ros.optics.lens import Lens

_MESSAGE = re.compile('^[kK]:', re.MULTILINE)


def recognises(text: str) -> bool:
    """Say whether a text is such a file."""
    if '%YAML' in text:
        return False
    if 'distortion_model:' in text:
        return 'camera_matrix:' in text or bool(_MESSAGE.search(text))
    return 'camera_matrix:' in text and 'distortion_coefficients:' in text


def read(text: str, where: str) -> Foreign:
    """Read the lens; raises LensError, naming the field."""
    if 'camera_matrix:' not in text:
        return _read_message(text, where)
    document = parse_yaml(text, where, LensError)
    try:
        k = fields.numbers(document['camera_matrix'], 'data', 9, where)
        size = document['image_width'], document['image_height']
        name = str(document.get('camera_name', 'camera'))
        if 'distortion_model' not in document:
            tool = document.get('camera_model')
            instead = f' in place of camera_model: {tool}' if tool else ''
            raise LensError(
                f'{where}: distortion_model is missing; a fisheye camera_info has '
                f'distortion_model: equidistant{instead}'
            )
        model = str(document['distortion_model'])
        d = document['distortion_coefficients']['data']
        d = fields.numbers({'data': d}, 'data', len(d), where)
    except KeyError as cause:
        raise LensError(f'{where}: not a whole camera_info; {cause.args[0]} is missing') from cause
    except (TypeError, AttributeError) as cause:
        raise LensError(f'{where}: not a whole camera_info ({cause})') from cause
    foreign = Foreign.from_lenses(
        'ROS',
        {
            name: (
                distortion_lens(
                    model, size, (k[0], k[4], k[2], k[5], k[1]), tuple(d), name, where
                ),
                0.0,
            )
        },
    )
    r, p = (
        fields.section({key: {}, **document}, key, where).get('data')
        for key in ('rectification_matrix', 'projection_matrix')
    )
    return foreign._replace(rectified=fields.rectified(r, p, where))


def _read_message(text: str, where: str) -> Foreign:
    document = parse_yaml(text.partition('\n---')[0], where, LensError)
    try:
        told = {name.lower(): value for name, value in document.items()}
        fields.numbers(told, 'k', 9, where)
        message = SimpleNamespace(**{**told, 'roi': SimpleNamespace(**told['roi'])})
        model = read_camera_info(message, where)
        name = str(told['header']['frame_id']) or 'camera'
    except ObservationError as cause:
        raise LensError(str(cause)) from cause
    except (LookupError, TypeError, ValueError, AttributeError) as cause:
        raise LensError(f'{where}: not a whole camera_info ({cause})') from cause
    foreign = Foreign.from_lenses('ROS', {name: (distortion_lens(*model, name, where), 0.0)})
    return foreign._replace(rectified=fields.rectified(told.get('r'), told.get('p'), where))


@lru_cache(maxsize=64)
def distortion_lens(
    model: str,
    size: tuple[int, int],
    intrinsics: tuple[float, ...],
    d: tuple[float, ...],
    name: str,
    where: str,
) -> Lens:
    """Return the lens of a distortion model, exactly.

    size: width, height; intrinsics: fx, fy, cx, cy and skew, which may be left out; d: as
    sensor_msgs/CameraInfo has it.
    Raises LensError, naming `where`, for a model or numbers of no lens.
    """
    # A camera without distortion need not name a model of it.
    stated = models.stated_model(model) if model or d else 'plumb_bob'
    if stated is None:
        raise LensError(
            f'{where}: distortion_model is {model!r}; choose from '
            f'{", ".join(models.STATED_MODELS)} and fisheye'
        )
    distortion = models.stated_distortion(stated, d, where)
    try:
        with np.errstate(all='ignore'):
            return models.nearest_lens(name, size, intrinsics, distortion, where)[0]
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as cause:
        raise LensError(f'{where}: its numbers are no valid lens ({cause})') from cause


def write(lens: Lens) -> str:
    """Return the lens in this form."""
    near = models.nearest_kannala_brandt(lens)
    k = models.camera_matrix(near)
    return camera_info_text(
        near.name,
        (near.width, near.height),
        k,
        'equidistant',
        models.coefficients(near),
        np.column_stack([k, np.zeros(3)]),
    )


def camera_info_text(
    name: str, size: tuple[int, int], k: Array, model: str, d: Sequence[float], p: Array
) -> str:
    """Return a camera_info as camera_calibration writes it: k (3, 3), p (3, 4), px and px m."""

    def matrix(values: Array) -> dict[str, Any]:
        rows, columns = values.shape
        return {'rows': rows, 'cols': columns, 'data': values.ravel().tolist()}

    return dump_yaml(
        {
            'image_width': size[0],
            'image_height': size[1],
            'camera_name': name,
            'camera_matrix': matrix(k),
            'distortion_model': model,
            'distortion_coefficients': matrix(np.array([d], dtype=float)),
            'rectification_matrix': matrix(np.eye(3)),
            'projection_matrix': matrix(p),
        },
        default_flow_style=None,
    )
