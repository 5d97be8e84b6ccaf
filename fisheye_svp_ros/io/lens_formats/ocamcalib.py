"""OCamCalib's calib_results.txt (Scaramuzza), by a fit of its direct polynomial.

Its x goes down the rows and y along the columns from 0, and it looks along -z.  Rows are
c x + d y + x0, columns e x + y + y0: where columns have no part in rows (d = 0) this is a
skew; otherwise the camera is taken to be turned about its axis by so much.
"""

from __future__ import annotations

import re

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.files import parse_number
from fisheye_svp_ros.io.lens_formats import Foreign, models
from fisheye_svp_ros.io.lens_formats.fields import MAX_NUMBER

_LINES = ('direct polynomial', 'inverse polynomial', 'center', 'affine c, d, e', 'image size')
_MARK = re.compile(r'affine.*"?c"?, *"?d"?, *"?e"?', re.IGNORECASE)
_SAMPLES = 4001


def recognises(text: str) -> bool:
    """Say whether a text is such a file."""
    return text.lstrip().startswith('#') and _MARK.search(text) is not None


def read(text: str, where: str) -> Foreign:
    """Read the lens; raises LensError, naming the line that is missing."""
    lines = [line for line in text.splitlines() if line.strip() and line.strip()[0] != '#']
    if len(lines) < len(_LINES):
        raise LensError(
            f'{where}: {_LINES[len(lines)]} is missing; calib_results.txt of '
            'OCamCalib has five lines of numbers'
        )
    try:
        rows = [np.array([parse_number(word) for word in line.split()]) for line in lines]
        direct, (row, column) = rows[0], rows[2]
        (c, d, e), (height, width) = rows[3], rows[4]
    except ValueError as cause:
        raise LensError(f'{where}: not a whole calib_results.txt ({cause})') from cause
    if (
        len(direct) < 2
        or len(direct) != 1 + direct[0]
        or not (np.abs(np.concatenate(rows)) < MAX_NUMBER).all()
        or not direct[1] < 0
    ):
        raise LensError(
            f'{where}: the direct polynomial must have as many coefficients as its '
            'first number says, and begin below 0'
        )
    # What remains when a turn about the axis is taken out of the affine part
    cos, sin = np.array([c, d]) / np.hypot(c, d)
    fx, fy, skew = cos - sin * e, np.hypot(c, d), sin + cos * e
    focal = float(-direct[1])
    farthest = 2 * float(np.hypot(max(row, height - row), max(column, width - column)))
    base = _heights(direct[1:], farthest)
    return Foreign.from_lenses(
        'OCamCalib',
        {
            'camera': models.nearest_lens(
                'camera',
                (width, height),
                (focal * fx, focal * fy, column, row, focal * skew),
                models.Distortion(base),
                where,
            )
        },
    )


def _heights(direct: Array, farthest: float) -> models.Base:
    """Return image heights, in units of the focal length, up to `farthest`, px."""
    rho = np.linspace(0.0, farthest, _SAMPLES)
    theta = np.arctan2(rho, -np.polynomial.polynomial.polyval(rho, direct))
    falls = np.diff(theta) <= 0
    last = int(np.argmax(falls)) if falls.any() else _SAMPLES - 1
    rho, theta = rho[: last + 1], theta[: last + 1]

    def height(angle: Array) -> Array:
        radius = np.interp(angle, theta, rho)
        for _ in range(4):  # Newton's method: rho cos(angle) + f(rho) sin(angle) = 0
            value, slope = (
                np.polynomial.polynomial.polyval(radius, p)
                for p in (direct, np.polynomial.polynomial.polyder(direct))
            )
            sin, cos = np.sin(angle), np.cos(angle)
            radius = radius - (radius * cos + value * sin) / (cos + slope * sin)
        return np.asarray(radius / -direct[0])

    return models.Base(height, float(theta[-1]))
