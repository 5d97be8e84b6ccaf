"""An independent projection to 30 digits (mpmath), written from the formulas alone."""

from __future__ import annotations

import mpmath
import numpy as np

mpmath.mp.dps = 30

_HEIGHTS = {
    'Orthographic': lambda k, a: mpmath.sin(a),
    'Equidistant': lambda k, a: a,
    'Equisolid': lambda k, a: 2 * mpmath.sin(a / 2),
    'Stereographic': lambda k, a: 2 * mpmath.tan(a / 2),
    'Perspective': lambda k, a: mpmath.tan(a),
    'KannalaBrandt': lambda k, a: (
        a + sum(mpmath.mpf(value) * a ** (2 * i + 3) for i, value in enumerate(k))
    ),
    'BrownConrady': lambda k, a: mpmath.tan(a) * _even(k, a),
    'RationalPolynomial': lambda k, a: mpmath.tan(a) * _even(k[:3], a) / _even(k[3:], a),
}


def _even(k, a):
    return 1 + sum(mpmath.mpf(value) * mpmath.tan(a) ** (2 * i) for i, value in enumerate(k, 1))


def _gennery(m, c, a):
    a = a + 1e-200  # the limit at zero, without a division by it
    growth = a / m.sin(a) - 1
    return c[0] + growth * (c[1] + c[2] * a**2 + c[3] * a**4)


def _flat_port(m, c, a):
    return c[0] * (1 - m.cos(a) / m.sqrt(c[1] ** 2 - m.sin(a) ** 2))


def shift(lens, angle, m=mpmath):
    """Viewpoint shift s(angle), m, in mpmath or (m=numpy) for an array of doubles."""
    if lens.viewpoint_shift is None:
        return 0 * angle
    formula = {'Gennery': _gennery, 'FlatPort': _flat_port}[type(lens.viewpoint_shift).__name__]
    number = mpmath.mpf if m is mpmath else float
    return formula(m, [number(c) for c in lens.viewpoint_shift.coefficients], angle)


def incidence(lens, point):
    """Smallest root of r cos(a) - (Z - s(a)) sin(a) up to max_incidence; None where there is none.

    A grid finds where the sign changes; below the first change every minimum is followed down to
    see that it stays positive, so that no pair of roots is missed between two grid points.
    """
    x, y, z = (mpmath.mpf(float(v)) for v in point)
    r = mpmath.sqrt(x * x + y * y)
    limit = mpmath.mpf(float(lens.max_incidence))
    if r == 0:
        return mpmath.mpf(0) if z > shift(lens, mpmath.mpf(0)) else None

    def equation(a):
        return r * mpmath.cos(a) - (z - shift(lens, a)) * mpmath.sin(a)

    grid, on_grid = _coarse(lens, float(r), float(z))
    crossing = np.flatnonzero((on_grid[:-1] >= 0) & (on_grid[1:] < 0))
    end = int(crossing[0]) + 1 if crossing.size else len(grid) - 1
    for i in (
        np.flatnonzero(
            (on_grid[1:end] < on_grid[: end - 1]) & (on_grid[1:end] < on_grid[2 : end + 1])
        )
        + 1
    ):
        low = _minimum(equation, grid[i - 1], grid[i + 1])
        if equation(low) < 0:
            return _root(equation, grid[i - 1], low)
    if crossing.size:
        return _root(equation, grid[end - 1], min(grid[end], limit))
    # A point on the edge of the field has its root at the last grid point, rounded either way.
    return limit if abs(equation(limit)) < 1e-17 else None


def project(lens, point):
    """Image point (u, v) in mpmath numbers, or None."""
    angle = incidence(lens, point)
    if angle is None:
        return None
    x, y = (mpmath.mpf(float(v)) for v in point[:2])
    r = mpmath.sqrt(x * x + y * y)
    ex, ey = (x / r, y / r) if r else (mpmath.mpf(1), mpmath.mpf(0))
    h = _HEIGHTS[type(lens.image_height).__name__](lens.image_height.coefficients, angle)
    return lens.cx + lens.fx * h * ex, lens.cy + lens.fy * h * ey


def _coarse(lens, r, z):
    grid = np.linspace(0.0, lens.max_incidence, 1201)
    return grid, r * np.cos(grid) - (z - shift(lens, grid, np)) * np.sin(grid)


def _minimum(function, low, high):
    """Golden-section search to 12 digits in the angle, 24 in the value."""
    golden = (mpmath.sqrt(5) - 1) / 2
    low, high = mpmath.mpf(low), mpmath.mpf(high)
    while high - low > 1e-12:
        left, right = high - golden * (high - low), low + golden * (high - low)
        if function(left) < function(right):
            high = right
        else:
            low = left
    return (low + high) / 2


def _root(function, low, high):
    """Bracketed root, function(low) >= 0 > function(high), to 24 digits."""
    return mpmath.findroot(function, (low, high), solver='anderson', tol=1e-25)
