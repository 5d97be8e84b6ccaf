"""OpenCV FileStorage (YAML or XML) of cv2.fisheye: a matrix and four coefficients."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any
from xml.etree import ElementTree

import numpy as np

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.documents import LARGEST_YAML, parse_yaml
from fisheye_svp_ros.io.lens_formats import Foreign, radial
from fisheye_svp_ros.optics.lens import Lens

_MATRIX = ('camera_matrix', 'cameraMatrix', 'Camera_Matrix', 'K', 'K1', 'M1')
_COEFFICIENTS = ('distortion_coefficients', 'Distortion_Coefficients', 'distCoeffs', 'D', 'D1')
_WIDTH, _HEIGHT = ('image_width', 'width', 'image_Width'), ('image_height', 'height')
_SIZE = ('image_size', 'imageSize', 'size')


def recognises(text: str) -> bool:
    """Say whether a text is such a file."""
    return text.lstrip().startswith('%YAML') or '<opencv_storage>' in text


def read(text: str, where: str) -> Foreign:
    """Read the lens; raises LensError, naming what is missing."""
    # A file that is nested deeply ends the process in OpenCV's own parser.
    if text.lstrip().startswith('%YAML'):
        document = parse_yaml(text.lstrip().partition('\n')[2], where, LensError)
    else:
        document = _from_xml(text, where)

    def value(names: tuple[str, ...]) -> Any:
        for name in names:
            if name in document:
                return document[name]
        raise LensError(f'{where}: it has none of {", ".join(names)}')

    if any(name in document for name in _SIZE):
        size = radial.numbers({'size': value(_SIZE)}, 'size', 2, where)
    else:
        size = radial.numbers({'size': [value(_WIDTH), value(_HEIGHT)]}, 'size', 2, where)
    k = _matrix(value(_MATRIX), ((3, 3),), where)
    d = _matrix(value(_COEFFICIENTS), ((1, 4), (4, 1)), where)
    lens = radial.kannala_brandt('camera', size, (k[0], k[4], k[2], k[5]), d, where)
    return Foreign('opencv', {'camera': lens}, (), {})


def _matrix(value: Any, shapes: Sequence[tuple[int, int]], where: str) -> list[float]:
    """Return the numbers of a matrix of one of some shapes, row by row."""
    if not isinstance(value, dict) or (value.get('rows'), value.get('cols')) not in shapes:
        raise LensError(f'{where}: a matrix of 3 x 3 and the four coefficients of cv2.fisheye are '
                        'needed')
    return radial.numbers(value, 'data', int(np.prod(shapes[0])), where)


def _from_xml(text: str, where: str) -> dict[str, Any]:
    """Return the numbers, lists and matrices of a FileStorage in XML by name."""
    if '<!' in text.replace('<!--', '') or len(text) > LARGEST_YAML:
        raise LensError(f'{where}: not a whole OpenCV file (document types are not read, nor more '
                        f'than {LARGEST_YAML >> 20} MB)')
    try:
        root = ElementTree.fromstring(text.lstrip().encode())
        return {
            one.tag: {part.tag: _from_words(part.text, part.tag == 'data') for part in one}
            if one.get('type_id') == 'opencv-matrix' else _from_words(one.text, False)
            for one in root
        }
    except (ElementTree.ParseError, ValueError, LookupError) as cause:
        raise LensError(f'{where}: not a whole OpenCV file ({cause})') from cause


def _from_words(text: str | None, always_listed: bool) -> Any:
    """Return the numbers in a text: a list, or a number alone; the text if it holds others."""
    try:
        numbers = [float(word) for word in (text or '').split()]
    except ValueError:
        return text
    return numbers if always_listed or len(numbers) != 1 else numbers[0]


def write(lens: Lens) -> str:
    """Return the lens in this form, YAML."""
    import cv2  # takes a while, and other formats do without

    near = radial.nearest(lens)
    storage = cv2.FileStorage('.yml', cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write('image_width', near.width)
    storage.write('image_height', near.height)
    storage.write('camera_matrix', np.array(
        [[near.fx, 0, near.cx], [0, near.fy, near.cy], [0, 0, 1]]))
    storage.write('distortion_coefficients', np.array([radial.coefficients(near)]))
    text: str = storage.releaseAndGetString()
    return text
