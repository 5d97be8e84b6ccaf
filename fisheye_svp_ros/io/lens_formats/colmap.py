"""COLMAP's cameras.txt: fisheye and pinhole models as they stand, others by a fit.

Its image begins at 0, so that the center of the first pixel is at 0.5.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.files import parse_number
from fisheye_svp_ros.io.lens_formats import Foreign, models
from fisheye_svp_ros.optics.lens import Lens

Values = dict[str, float]

_CORNER = 0.5  # px, of our first pixel's center from the corner where COLMAP's image begins
_ROW = re.compile(r'(\d+)[ ,\t]+([A-Z][A-Z\d_]+)[ ,\t]+(.+)')


def _fisheye(values: Values) -> models.Distortion:
    k = [values.get(f'k{i}', 0.0) for i in range(1, 5)]
    p1, p2, sx1, sy1 = (values.get(name, 0.0) for name in ('p1', 'p2', 'sx1', 'sy1'))
    return models.Distortion(models.EQUIDISTANT, k, (), (p1, p2), prism=((sx1,), (sy1,)))


def fisheye624(values: Values) -> models.Distortion:
    """Return the distortion of six radial, two tangential and four thin prism coefficients."""
    k, s = ([values[f'{name}{i}'] for i in range(count)] for name, count in (('k', 6), ('s', 4)))
    # Its p0 belongs to u, as OpenCV's p2 does.
    return models.Distortion(
        models.EQUIDISTANT, k, (), (values['p1'], values['p0']), prism=(s[:2], s[2:]), late=True
    )


def _brown(values: Values) -> models.Distortion:
    return models.brown(models.PERSPECTIVE, values)


# Parameters in their order, and what they distort
_MODELS: dict[str, tuple[str, Callable[[Values], models.Distortion]]] = {
    'OPENCV_FISHEYE': ('fx fy cx cy k1 k2 k3 k4', _fisheye),
    'SIMPLE_RADIAL_FISHEYE': ('f cx cy k1', _fisheye),
    'RADIAL_FISHEYE': ('f cx cy k1 k2', _fisheye),
    'SIMPLE_FISHEYE': ('f cx cy', _fisheye),
    'FISHEYE': ('fx fy cx cy', _fisheye),
    'THIN_PRISM_FISHEYE': ('fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1', _fisheye),
    'RAD_TAN_THIN_PRISM_FISHEYE': ('fx fy cx cy k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3', fisheye624),
    'FOV': (
        'fx fy cx cy omega',
        lambda v: models.Distortion(models.field_of_view_model(v['omega'])),
    ),
    'EUCM': (
        'fx fy cx cy alpha beta',
        lambda v: models.Distortion(models.unified_heights(v['alpha'], v['beta'])),
    ),
    'SIMPLE_PINHOLE': ('f cx cy', _brown),
    'PINHOLE': ('fx fy cx cy', _brown),
    'SIMPLE_RADIAL': ('f cx cy k1', _brown),
    'RADIAL': ('f cx cy k1 k2', _brown),
    'OPENCV': ('fx fy cx cy k1 k2 p1 p2', _brown),
    'FULL_OPENCV': ('fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6', _brown),
    'SIMPLE_DIVISION': ('f cx cy k', lambda v: models.Distortion(models.division(v['k']))),
    'DIVISION': ('fx fy cx cy k', lambda v: models.Distortion(models.division(v['k']))),
}


def recognises(text: str) -> bool:
    """Say whether a text is such a file."""
    lines = _uncommented_lines(text)
    return bool(lines) and all(map(_ROW.fullmatch, lines))


def _uncommented_lines(text: str) -> list[str]:
    """Return the lines without comments."""
    lines = (line.partition('#')[0].strip() for line in text.splitlines())
    return [line for line in lines if line]


def read(text: str, where: str) -> Foreign:
    """Read all cameras, by their ids; raises LensError, naming camera and model."""
    lenses = {}
    for row in filter(None, map(_ROW.fullmatch, _uncommented_lines(text))):
        camera, model, numbers = row.groups()
        place = f'{where}: camera {camera}'
        try:
            width, height, *values = (
                parse_number(word) for word in numbers.replace(',', ' ').split()
            )
        except ValueError as cause:
            raise LensError(
                f'{place}: width, height and the parameters of {model} must be numbers ({cause})'
            ) from cause
        lenses[camera] = _colmap_lens(f'camera{camera}', model, (width, height), values, place)
    return Foreign.from_lenses('COLMAP', lenses)


def _colmap_lens(
    name: str, model: str, size: Sequence[float], given: Sequence[float], where: str
) -> tuple[Lens, float]:
    if model not in _MODELS:
        raise LensError(
            f'{where}: model is {model}; those that can be read are {", ".join(_MODELS)}'
        )
    names, distortion = _MODELS[model][0].split(), _MODELS[model][1]
    if len(given) != len(names):
        raise LensError(
            f'{where}: {model} has {len(given)} parameters; needed are {", ".join(names)}'
        )
    values = dict(zip(names, given, strict=True))
    focal = values.get('fx', values.get('f', 0.0)), values.get('fy', values.get('f', 0.0))
    middle = values['cx'] - _CORNER, values['cy'] - _CORNER
    return models.nearest_lens(name, size, (*focal, *middle), distortion(values), where)


def write(lens: Lens) -> str:
    """Return the lens in this form, as its first camera."""
    near = models.nearest_kannala_brandt(lens)
    values = (near.fx, near.fy, near.cx + _CORNER, near.cy + _CORNER, *models.coefficients(near))
    return (
        '# Camera list with one line of data per camera:\n'
        '#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n'
        f'1 OPENCV_FISHEYE {near.width} {near.height} {" ".join(map(repr, values))}\n'
    )
