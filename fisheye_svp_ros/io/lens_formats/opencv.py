"""OpenCV FileStorage (YAML, XML, JSON), or its arrays as lists: one camera or two.

Those of cv2.fisheye are read as they stand, of cv2.omnidir and cv2.calibrateCamera by a fit.

Of two (K1, D1, K2, D2) R and T bring points of the first camera into the second, as
cv2.fisheye.stereoCalibrate returns them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.files import parse_json, parse_number
from fisheye_svp_ros.io.lens_formats import Foreign, fields, models
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import STEREO

# Names as programs write them, without case and separators, before what tells two cameras apart
_MATRIX = ('cameramatrix', 'k', 'm', 'intrinsicmatrix', 'intrinsics', 'mtx')
_COEFFICIENTS = (
    'distortioncoefficients',
    'distortioncoeffs',
    'distcoeffs',
    'distcoeff',
    'distortion',
    'dist',
    'd',
)
_SIDES = (('1', '2'), ('0', '1'), ('l', 'r'), ('left', 'right'))
_ROTATION, _TRANSLATION = ('r', 'rotation', 'rotationmatrix'), ('t', 'translation')
_RECTIFIED = ('rectificationmatrix', 'projectionmatrix')  # as a camera_info has them
_WIDTH, _HEIGHT = ('imagewidth', 'imgwidth', 'width'), ('imageheight', 'imgheight', 'height')
_SIZE = ('imagesize', 'imgsize', 'size', 'framesize', 'resolution')
_XI, _OF_FISHEYE = 'xi', 4
_IS_FISHEYE = ('fisheyemodel', 'fisheye')  # 0 or 1; the first of OpenCV's own program
_STATED = ('distortionmodel', 'distortiontype')  # by name: these decide
_KIND = ('cameramodel', 'cameratype', 'modeltype', 'lensmodel')  # of a camera or its distortion
# Entries that tell lists of other programs, as words and as single letters
_LISTS = tuple(
    re.compile(
        rf'(?:^|[{{,])[ \t]*["\']?(?:(?i:{words})|{letter})_?(?:[012lrLR]|left|right)?["\']?'
        r'[ \t]*:',
        re.MULTILINE,
    )
    for words, letter in (
        ('camera_?matrix|intrinsic_?matrix|mtx', 'K'),
        ('dist(?:ortion)?(?:_?coeff(?:icient)?s?)?', 'D'),
    )
)
_COUNTS = [shape for n in (4, 5, 6, 8, 12, 14) for shape in ((1, n), (n, 1))]
_ERRORS = ('avgreprojectionerror', 'reprojectionerror', 'rms', 'rmserror', 'reprojerr')
_MAX_ERROR = 5.0  # px, of a calibration that may be one
_FISHEYE_NOTE = (
    '4 coefficients are read as those of cv2.fisheye; add `fisheye_model: 0` for those of '
    'cv2.calibrateCamera'
)


def recognises(text: str) -> bool:
    """Say whether a text is such a file."""
    start = text.lstrip()
    return (
        start.startswith('%YAML')
        or '<opencv_storage>' in text
        or '!!opencv-' in text
        or (start.startswith('{') and '"opencv-' in text)
        or all(entry.search(text) for entry in _LISTS)
    )


def read(text: str, where: str) -> Foreign:
    """Read the lens; raises LensError, naming what is missing."""
    # A file that is nested deeply ends the process in OpenCV's own parser.
    start = text.lstrip()
    if start.startswith('{'):
        document = parse_json(text, where, LensError)
    elif start.startswith('<'):
        document = _from_xml(text, where)
    else:
        document = fields.yaml(text, where)
    named = {re.sub('[^a-z0-9]', '', str(name).lower()): value for name, value in document.items()}

    def lens(name: str, side: str) -> tuple[Lens, float]:
        k = _read_matrix(
            _named_value(named, _names_of_side(_MATRIX, side), where), ((3, 3),), where
        )
        coefficients = _read_matrix(
            _named_value(named, _names_of_side(_COEFFICIENTS, side), where), _COUNTS, where
        )
        distortion = _distortion(coefficients, named, where)
        return models.nearest_lens(
            name, _image_size(named, where), (k[0], k[4], k[2], k[5], k[1]), distortion, where
        )

    sides = [
        pair
        for pair in _SIDES
        if all(any(name in named for name in _names_of_side(_MATRIX, side)) for side in pair)
    ]
    if sides:
        lenses = dict(zip(STEREO, map(lens, STEREO, sides[0]), strict=True))
    else:
        lenses = {'camera': lens('camera', _only_side(named))}
    rigs: tuple[Pose, ...] = ()
    if any(name in named for name in (*_ROTATION, *_TRANSLATION)):
        turn = np.reshape(
            _read_matrix(_named_value(named, _ROTATION, where), ((3, 3),), where), (3, 3)
        )
        place = _read_matrix(_named_value(named, _TRANSLATION, where), ((3, 1), (1, 3)), where)
        rigs = (fields.pose(place, turn, f'{where}: R, T'),)
    given = Foreign.from_lenses('OpenCV', lenses, rigs)
    assumed = not {_XI, *_IS_FISHEYE} & {*named} and not any(
        models.stated_model(str(named.get(name, ''))) for name in (*_STATED, *_KIND)
    )
    r, p = (_matrix_numbers(named.get(name)) for name in _RECTIFIED)
    return given._replace(
        notes=(*(_FISHEYE_NOTE,) * (assumed and _has_four(named)), *_failures(named, lenses)),
        rectified=fields.rectified(r, p, where),
    )


def _failures(named: Mapping[str, Any], lenses: Mapping[str, tuple[Lens, float]]) -> Iterator[str]:
    """Yield why the calibration that a file is of has failed, by its own figures."""
    stated = next((named[name] for name in _ERRORS if name in named), None)
    poor = [f'the file states {stated:.3g} px'] if _is_poor(stated) else []
    for camera, (lens, _) in lenses.items():
        begun = abs(lens.fx - lens.width / np.pi) < 1e-6 * lens.width and lens.fx == lens.fy
        begun = begun and not any(lens.image_height.coefficients)
        if begun or poor:
            start = ["f = width / pi without distortion is OpenCV's start value"] * begun
            yield f'{camera}: {", ".join(poor + start)}: this fit failed; calibrate again'


def _is_poor(stated: Any) -> bool:
    return isinstance(stated, int | float) and stated > _MAX_ERROR


def _names_of_side(names: Sequence[str], side: str) -> list[str]:
    """Return the names of one camera's entry: `side` stands after or, as a word, before them."""
    before = [side + name for name in names] if side.isalpha() else []
    return [name + side for name in names] + before


def _only_side(named: Mapping[str, Any]) -> str:
    """Return what stands after the names of the only camera of a file: mostly nothing."""
    sides = ('', *(side for pair in _SIDES for side in pair))
    return next(
        (side for side in sides if any(name in named for name in _names_of_side(_MATRIX, side))),
        '',
    )


def _has_four(named: Mapping[str, Any]) -> bool:
    """Say whether the coefficients of any camera are four."""
    sides = ('', *(side for pair in _SIDES for side in pair))
    given = (named.get(name) for side in sides for name in _names_of_side(_COEFFICIENTS, side))
    lists = (value.get('data') if isinstance(value, dict) else value for value in given)
    return any(np.size(value) == _OF_FISHEYE for value in lists if isinstance(value, list))


def _named_value(named: Mapping[str, Any], names: Sequence[str], where: str) -> Any:
    """Return the value under the first of some names; raise LensError for none."""
    for name in names:
        if name in named:
            return named[name]
    raise LensError(f'{where}: it has none of {", ".join(names)}')


def _image_size(named: Mapping[str, Any], where: str) -> list[float]:
    """Return width and height, px; raise LensError where they are not told."""
    for name in _SIZE:
        if name in named:
            return fields.numbers({'size': _matrix_numbers(named[name])}, 'size', 2, where)
    pair = [
        next((named[name] for name in names if name in named), None) for names in (_WIDTH, _HEIGHT)
    ]
    if None in pair:
        raise LensError(
            f'{where}: the image size is missing; add image_width and image_height, px'
        )
    return fields.numbers({'size': pair}, 'size', 2, where)


def _distortion(d: Sequence[float], named: Mapping[str, Any], where: str) -> models.Distortion:
    """Return what the file states; four coefficients alone are those of cv2.fisheye.

    With xi they are those of cv2.omnidir; more than four are of a pinhole.
    """
    stated = {name: str(named[name]) for name in (*_STATED, *_KIND) if name in named}
    if model := next(filter(None, map(models.stated_model, stated.values())), None):
        return models.stated_distortion(model, d, where)
    if _XI not in named and (unknown := next((stated[n] for n in _STATED if n in stated), '')):
        raise LensError(
            f'{where}: the distortion model is {unknown!r}; choose from '
            f'{", ".join(models.STATED_MODELS)} and fisheye'
        )
    if _XI in named:
        given = named[_XI]
        xi = (
            _read_matrix(given, ((1, 1),), where)[0]
            if isinstance(given, dict)
            else (fields.values(named, (_XI,), where)[0])
        )
        return models.opencv_distortion(d, models.omnidirectional(xi))
    if len(d) == _OF_FISHEYE and all(named.get(name, 1) for name in _IS_FISHEYE):
        return models.Distortion(models.EQUIDISTANT, d)
    return models.opencv_distortion(d)


def _read_matrix(value: Any, shapes: Sequence[tuple[int, int]], where: str) -> list[float]:
    """Return the numbers of a matrix of one of some shapes, row by row.

    OpenCV 5 writes arrays of one dimension by their `sizes`; lists are those of other programs.
    """
    data = _matrix_numbers(value)
    shape: tuple[Any, ...] | None = None
    if isinstance(value, dict):
        shape = value.get('rows'), value.get('cols')
        if isinstance(sizes := value.get('sizes'), list):
            shape = tuple(map(int, [*sizes, 1][:2])) if 0 < len(sizes) < 3 else None
    elif isinstance(data, list):
        shape = next(
            (candidate for candidate in shapes if candidate[0] * candidate[1] == len(data)), None
        )
    if shape is None or shape not in shapes:
        raise LensError(
            f'{where}: a 3 x 3 matrix and four coefficients of cv2.fisheye are needed; for a '
            'rig, R (3 x 3) and T (3 x 1)'
        )
    return fields.numbers({'data': data}, 'data', int(shape[0] * shape[1]), where)


def _matrix_numbers(value: Any) -> Any:
    """Return the numbers of a list of lists, or of a matrix, in one list."""
    if isinstance(value, dict):
        value = value.get('data')
    if isinstance(value, list) and all(isinstance(row, list) for row in value):
        return [number for row in value for number in row]
    return value


def _from_xml(text: str, where: str) -> dict[str, Any]:
    """Return the numbers, lists and matrices of a FileStorage in XML by name."""
    return {
        element.tag: {
            part.tag: _parse_numbers(part.text, part.tag in ('data', 'sizes')) for part in element
        }
        if str(element.get('type_id')).startswith('opencv-')
        else _parse_numbers(element.text, False)
        for element in fields.xml(text, where, 'OpenCV file')
    }


def _parse_numbers(text: str | None, always_listed: bool) -> Any:
    """Return the numbers in a text: a list, or a number alone; the text if it holds others."""
    try:
        numbers = [parse_number(word) for word in (text or '').split()]
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
    storage.write('fisheye_model', 1)
    storage.write('distortion_coefficients', np.array([models.coefficients(near)]))
    text: str = storage.releaseAndGetString()
    return text
