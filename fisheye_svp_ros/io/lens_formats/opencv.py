"""OpenCV FileStorage (YAML, XML, JSON): a matrix and coefficients, or two cameras.

Those of cv2.fisheye are read as they stand, of cv2.omnidir and cv2.calibrateCamera by a fit.

Of two (K1, D1, K2, D2) R and T bring points of the first camera into the second, as
cv2.fisheye.stereoCalibrate returns them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.files import parse_json
from fisheye_svp_ros.io.lens_formats import Foreign, fields, models
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose

_MATRIX = ('camera_matrix', 'cameraMatrix', 'Camera_Matrix', 'K', 'K1', 'M1', 'cameraMatrix1')
_COEFFICIENTS = (
    'distortion_coefficients',
    'Distortion_Coefficients',
    'distCoeffs',
    'D',
    'D1',
    'distCoeffs1',
)
_RIGHT_KEYS = ('K2', 'M2', 'cameraMatrix2'), ('D2', 'distCoeffs2')
_WIDTH, _HEIGHT = ('image_width', 'width', 'image_Width'), ('image_height', 'height')
_XI, _OF_FISHEYE = 'xi', 4
_IS_FISHEYE = 'fisheye_model'  # 0 or 1, of OpenCV's own calibration program
_COUNTS = [shape for n in (4, 5, 8, 12, 14) for shape in ((1, n), (n, 1))]
_SIZE = ('image_size', 'imageSize', 'size')


def recognises(text: str) -> bool:
    """Say whether a text is such a file."""
    start = text.lstrip()
    return (
        start.startswith('%YAML')
        or '<opencv_storage>' in text
        or (start.startswith('{') and '"opencv-matrix"' in text)
    )


def read(text: str, where: str) -> Foreign:
    """Read the lens; raises LensError, naming what is missing."""
    # A file that is nested deeply ends the process in OpenCV's own parser.
    if text.lstrip().startswith('%YAML'):
        document = fields.yaml(text, where)
    elif text.lstrip().startswith('{'):
        document = parse_json(text, where, LensError)
    else:
        document = _from_xml(text, where)

    def value(names: tuple[str, ...]) -> Any:
        for name in names:
            if name in document:
                return document[name]
        raise LensError(f'{where}: it has none of {", ".join(names)}')

    if any(name in document for name in _SIZE):
        size = fields.numbers({'size': value(_SIZE)}, 'size', 2, where)
    else:
        size = fields.numbers({'size': [value(_WIDTH), value(_HEIGHT)]}, 'size', 2, where)

    def lens(name: str, matrix: tuple[str, ...], named: tuple[str, ...]) -> tuple[Lens, float]:
        k = _matrix(value(matrix), ((3, 3),), where)
        distortion = _distortion(_matrix(value(named), _COUNTS, where), document, where)
        return models.nearest_lens(name, size, (k[0], k[4], k[2], k[5], k[1]), distortion, where)

    pair = {'camera': lens('camera', _MATRIX, _COEFFICIENTS)}
    if any(name in document for name in _RIGHT_KEYS[0]):
        pair = {'left': lens('left', _MATRIX, _COEFFICIENTS), 'right': lens('right', *_RIGHT_KEYS)}
    rigs: tuple[Pose, ...] = ()
    if 'R' in document or 'T' in document:
        turn = np.reshape(_matrix(value(('R',)), ((3, 3),), where), (3, 3))
        place = _matrix(value(('T',)), ((3, 1), (1, 3)), where)
        rigs = (fields.pose(place, turn, f'{where}: R, T'),)
    return Foreign.from_lenses('OpenCV', pair, rigs)


def _distortion(d: Sequence[float], document: Mapping[str, Any], where: str) -> models.Distortion:
    """Four coefficients are those of cv2.fisheye, with xi of cv2.omnidir; more, of a pinhole."""
    if _XI in document:
        given = document[_XI]
        xi = (
            _matrix(given, ((1, 1),), where)[0]
            if isinstance(given, dict)
            else (fields.values(document, (_XI,), where)[0])
        )
        return models.opencv_distortion(d, models.omnidirectional(xi))
    if len(d) == _OF_FISHEYE and document.get(_IS_FISHEYE, 1):
        return models.Distortion(models.EQUIDISTANT, d)
    if any(d[len(models.OPENCV) :]):
        raise LensError(
            f'{where}: {len(d)} coefficients, with a thin prism or a tilt; the four '
            'of cv2.fisheye, or five or eight of cv2.calibrateCamera can be read'
        )
    return models.opencv_distortion(d)


def _matrix(value: Any, shapes: Sequence[tuple[int, int]], where: str) -> list[float]:
    """Return the numbers of a matrix of one of some shapes, row by row."""
    if not isinstance(value, dict) or (value.get('rows'), value.get('cols')) not in shapes:
        raise LensError(
            f'{where}: a matrix of 3 x 3 and the four coefficients of cv2.fisheye are '
            'needed (of a rig R, 3 x 3, and T, 3 x 1)'
        )
    return fields.numbers(value, 'data', value['rows'] * value['cols'], where)


def _from_xml(text: str, where: str) -> dict[str, Any]:
    """Return the numbers, lists and matrices of a FileStorage in XML by name."""
    return {
        one.tag: {part.tag: _parse_numbers(part.text, part.tag == 'data') for part in one}
        if one.get('type_id') == 'opencv-matrix'
        else _parse_numbers(one.text, False)
        for one in fields.xml(text, where, 'OpenCV file')
    }


def _parse_numbers(text: str | None, always_listed: bool) -> Any:
    """Return the numbers in a text: a list, or a number alone; the text if it holds others."""
    try:
        numbers = [float(word) for word in (text or '').split()]
    except ValueError:
        return text
    return numbers if always_listed or len(numbers) != 1 else numbers[0]


def write(lens: Lens) -> str:
    """Return the lens in this form, YAML."""
    import cv2  # takes a while, and other formats do without

    near = models.nearest_kannala_brandt(lens)
    storage = cv2.FileStorage('.yml', cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write('image_width', near.width)
    storage.write('image_height', near.height)
    storage.write('camera_matrix', models.camera_matrix(near))
    storage.write('distortion_coefficients', np.array([models.coefficients(near)]))
    text: str = storage.releaseAndGetString()
    return text
