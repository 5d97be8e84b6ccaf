"""The formulas of a lens, point by point: what every engine computes, written once.

Each works alike on arrays and on single numbers, so that one engine can run them with NumPy and
another can compile them.  What is changed in place is their own, as what they return is the
caller's: NumPy is faster so.  Angles in rad, lengths in m; `sin` and `cos` are those of theta.
"""

from __future__ import annotations

import numpy as np

from fisheye_svp_ros.arrays import Array

AXIS_EPS = 1e-30  # m; added to X, it gives points on the axis a direction and changes no other


def orthographic(sin: Array, cos: Array) -> tuple[Array, Array]:
    """Return sin(theta) and its derivative."""
    return sin * 1.0, cos * 1.0


def equidistant(theta: Array) -> tuple[Array, Array]:
    """Return theta and its derivative."""
    return theta * 1.0, theta * 0.0 + 1.0


def equisolid(sin: Array, cos: Array) -> tuple[Array, Array]:
    """Return 2 sin(theta / 2) and its derivative."""
    half_sin, half_cos = half_angle(sin, cos)
    return 2.0 * half_sin, half_cos


def stereographic(sin: Array, cos: Array) -> tuple[Array, Array]:
    """Return 2 tan(theta / 2) and its derivative."""
    half_sin, half_cos = half_angle(sin, cos)
    half_tan = half_sin / half_cos
    return 2.0 * half_tan, 1.0 + half_tan * half_tan


def kannala_brandt(
    theta: Array, k1: float, k2: float, k3: float, k4: float
) -> tuple[Array, Array]:
    """Return theta + k1 theta^3 + k2 theta^5 + k3 theta^7 + k4 theta^9 and its derivative."""
    z = theta * theta
    height = k4 * z
    slope = (9.0 * k4) * z
    for k, k_rise in ((k3, 7.0 * k3), (k2, 5.0 * k2), (k1, 3.0 * k1)):
        height += k
        height *= z
        slope += k_rise
        slope *= z
    height += 1.0
    height *= theta
    slope += 1.0
    return height, slope


def gennery(
    theta: Array, sin: Array, cos: Array, s0: float, e0: float, e1: float, e2: float
) -> tuple[Array, Array]:
    """Return s = s0 + (theta / sin - 1) (e0 + e1 theta^2 + e2 theta^4) and sin ds/dtheta."""
    ratio = theta / sin
    growth = ratio - 1.0
    z = theta * theta
    factor = e2 * z
    factor += e1
    factor *= z
    factor += e0
    shift = growth * factor
    shift += s0
    # The rise is (1 - ratio cos) factor + growth sin dfactor/dtheta.
    ratio *= cos
    ratio -= 1.0
    factor *= ratio
    z *= 4.0 * e2
    z += 2.0 * e1
    z *= theta
    z *= sin
    growth *= z
    growth -= factor
    return shift, growth


def flat_port(
    theta: Array, sin: Array, cos: Array, thickness: float, refractive_index: float
) -> tuple[Array, Array]:
    """Return s = d (1 - cos / sqrt(n^2 - sin^2)) and sin ds/dtheta."""
    n2, sin2 = refractive_index * refractive_index, sin * sin
    inverse = 1.0 / np.sqrt(n2 - sin2)
    rise = thickness * (n2 - 1.0) * sin2 * inverse * inverse * inverse
    return thickness * (1.0 - cos * inverse), rise


def half_angle(sin: Array, cos: Array) -> tuple[Array, Array]:
    """Sine and cosine of theta / 2; the larger comes first, as rounding wants it."""
    larger = np.sqrt(0.5 + 0.5 * np.abs(cos))
    smaller = 0.5 * sin / larger
    ahead = 1.0 * (cos >= 0.0)  # a factor: numpy.where makes arrays of single numbers
    behind = 1.0 - ahead
    return ahead * smaller + behind * larger, ahead * larger + behind * smaller


def newton_step(
    r: Array, z: Array, sin: Array, cos: Array, shift: Array, rise: Array
) -> tuple[Array, Array]:
    """Return Newton's step of theta in r cos - (z - s) sin = 0, and the clearance, m.

    The clearance is the equation's derivative, its sign turned; rise: sin ds/dtheta.
    """
    reach = z - shift
    clearance = r * sin
    clearance += reach * cos
    clearance -= rise
    step = r * cos
    reach *= sin
    step -= reach
    step /= clearance
    return step, clearance


def point_derivatives(
    ratio: Array, slope: Array, square: Array, outward: Array, axial: Array
) -> tuple[Array, Array, Array]:
    """Return how the image height h/f changes with a point, and how it bends the image.

    ratio: h / (f r), 1/m; slope: of h/f by theta; square: r^2; outward: dtheta/dr; axial:
    -dtheta/dZ / r.  Rise: dh/dr / f, 1/m; fall: -dh/dZ / (f r), 1/m^2; bend: that of the ratio
    by r, over r, 1/m^3.  The last two that are given are used up.
    """
    outward *= slope
    axial *= slope
    bend = outward - ratio
    bend /= square
    return outward, axial, bend
