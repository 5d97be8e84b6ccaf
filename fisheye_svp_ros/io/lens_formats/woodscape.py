"""WoodScape's calibration JSON: a polynomial of the incidence angle in px, by a fit."""

from __future__ import annotations

import re

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.files import parse_json
from fisheye_svp_ros.io.lens_formats import Foreign, fields, models

recognises = re.compile(r'\s*\{.*"radial_poly"', re.DOTALL).match
_POWERS = ('k1', 'k2', 'k3', 'k4')  # of the incidence angle, rad: 1 to 4


def read(text: str, where: str) -> Foreign:
    """Read the lens; raises LensError, naming the field."""
    document = parse_json(text, where, LensError)
    intrinsics, place = fields.section(document, 'intrinsic', where), f'{where}: intrinsic'
    width, height, dx, dy = fields.values(
        intrinsics, ('width', 'height', 'cx_offset', 'cy_offset'), place
    )
    (aspect,) = fields.values({'aspect_ratio': 1.0, **intrinsics}, ('aspect_ratio',), place)
    f, *factors = fields.values(intrinsics, _POWERS, place)
    if not f > 0:
        raise LensError(f'{place}: k1 is {f}; a focal length above 0 px is needed')

    def curve(theta: Array) -> Array:
        return np.asarray(np.polynomial.Polynomial([0.0, 1.0, *(k / f for k in factors)])(theta))

    # Its image begins at 0, half a pixel before the center of the first one.
    center = (width / 2 + dx - 0.5, height / 2 + dy - 0.5)
    name = str(document.get('name', 'camera'))
    lens = models.fit_curve(
        name, (width, height), (f, f * aspect, *center), curve, np.pi * 0.999, where
    )
    return Foreign.from_lenses('WoodScape', {name: lens})
