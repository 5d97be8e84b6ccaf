"""The formulas compiled by Numba, in loops over flat scratch memory that vectorize.

A block of points is a set of rows of `B` numbers in one flat array: separate arrays would make the
compiler check them for overlap, and calls of libm would end vectorization.  So would an index that
might be negative: what starts at a variable place is a slice first.  A lens is one array, see
`numba_engine.pack_lens`.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numba.core.cpu import CPUTargetOptions
from numba.extending import register_jitable

from fisheye_svp_ros.optics import formulas
from fisheye_svp_ros.optics.formulas import AXIS_EPS
from fisheye_svp_ros.optics.rays import (
    BACKWARD_ANGLE,
    MORE_STEPS,
    NEWTON_STEPS,
    STEP_TOLERANCE,
    ZERO_CLEARANCE,
)

# Division must not raise for a loop to vectorize; sums may be reordered, NaN keep their meaning.
OPTIONS = {'error_model': 'numpy', 'fastmath': {'reassoc', 'contract', 'arcp'}}
# What allocates nothing need not count who holds an array either, which would take a third of its
# time.  Numba has its own runtime's switch under a private name.
BARE = OPTIONS | ({'_nrt': False} if hasattr(CPUTargetOptions, '_nrt') else {})
HEIGHTS = (
    formulas.orthographic,
    formulas.equidistant,
    formulas.equisolid,
    formulas.stereographic,
    formulas.kannala_brandt,
)
SHIFTS = (formulas.gennery, formulas.flat_port)
for formula in (
    *HEIGHTS,
    *SHIFTS,
    formulas.half_angle,
    formulas.newton_step,
    formulas.point_derivatives,
):
    register_jitable(**OPTIONS)(formula)

B = 248  # points in a block; rows a power of two apart would share the same lines of the cache
(
    X,
    Y,
    Z,
    R,
    THETA0,
    SIN0,
    COS0,
    THETA,
    SIN,
    COS,
    TURN,
    CLEARANCE,
    STATE,
    RATIO,
    SLOPE,
    U,
    V,
    ROW,
) = (B * i for i in range(18))
ROWS = 7 * B  # from ROW on, for u and for v: by place (3), by turn (3), residual
GRAM = ROW + 2 * ROWS  # the upper triangle of 7 x 7, row by row, then room for `view_equations`
SCRATCH = GRAM + 28 + 49 + 42
VALID, INVALID, UNSETTLED = 1.0, 0.0, -1.0
SINGULAR = 1e-15  # pivot beside the diagonal
DOF = 6  # unknowns of a pose or a rig; a size that the compiler knows is faster

FX, FY, CX, CY, NEAR, HEIGHT_KIND, SHIFT_KIND, HEIGHT_K, SHIFT_K = 0, 1, 2, 3, 4, 5, 6, 7, 11
LENS = 15


@njit(inline='always', **BARE)
def _half_angle(r, m):
    """Return arctan(r / m) for 0 <= r <= m, to 1e-16."""
    large = r > 0.4142135623730951 * m
    num, den = (r - m, r + m) if large else (r, m)
    x = num / den
    w = x * x
    p = -0.017803896394812564
    p = p * w + 0.03796390316111083
    p = p * w - 0.05035049795312439
    p = p * w + 0.05846866752275139
    p = p * w - 0.06662950246036792
    p = p * w + 0.07692045194561481
    p = p * w - 0.09090896801472813
    p = p * w + 0.11111110744657099
    p = p * w - 0.14285714279244968
    p = p * w + 0.19999999999940837
    p = p * w - 0.3333333333333312
    p = p * w + 1.0
    return (0.7853981633974483 if large else 0.0) + x * p


@njit(inline='always', **BARE)
def _rotate_sin_cos(sin, cos, turn):
    """Return sine and cosine of an angle turned on by up to 0.3 rad."""
    w = turn * turn
    s = turn * (
        1 + w * (-1 / 6 + w * (1 / 120 + w * (-1 / 5040 + w * (1 / 362880 - w / 39916800))))
    )
    c = 1 + w * (
        -1 / 2
        + w * (1 / 24 + w * (-1 / 720 + w * (1 / 40320 + w * (-1 / 3628800 + w / 479001600))))
    )
    return sin * c + cos * s, cos * c - sin * s


@njit(**BARE)
def solve_rays(w, n, lens, edge):
    """Solve the ray equation of n points in the rows X, Y, Z; STATE says how it went."""
    for i in range(n):
        x, y, z = w[X + i] + AXIS_EPS, w[Y + i], w[Z + i]
        r2 = x * x + y * y
        r, d = np.sqrt(r2), np.sqrt(r2 + z * z)
        half = 2.0 * _half_angle(r, d + abs(z))
        w[THETA0 + i] = w[THETA + i] = half if z >= 0.0 else np.pi - half
        inverse = 1.0 / d
        w[SIN0 + i] = w[SIN + i] = r * inverse
        w[COS0 + i] = w[COS + i] = z * inverse
        w[R + i], w[CLEARANCE + i] = r, d
    if lens[SHIFT_KIND] >= 0:
        _shift_rays(w, n, lens)
    for i in range(n):
        seen = (w[CLEARANCE + i] > ZERO_CLEARANCE) & (w[THETA + i] <= edge)
        w[STATE + i] = VALID if seen else INVALID
    if lens[SHIFT_KIND] >= 0:
        for i in range(n):
            far = w[R + i] * w[R + i] + w[Z + i] * w[Z + i] >= lens[NEAR] * lens[NEAR]
            settled = (w[TURN + i] <= 0.3) & (w[TURN + i] >= -0.3) & (w[THETA + i] > 0.0)
            w[STATE + i] = w[STATE + i] if far & settled else UNSETTLED


@njit(**BARE)
def _shift_rays(w, n, lens):
    for i in range(n):
        w[TURN + i] = 0.0
    late = 0
    for _ in range(NEWTON_STEPS):
        late = _newton_steps(w, 0, n, lens)
    if late:
        for i in range(n):
            for _ in range(MORE_STEPS):
                if not w[STATE + i] < STEP_TOLERANCE:
                    _newton_steps(w, i, i + 1, lens)
            if not w[STATE + i] < STEP_TOLERANCE:
                w[TURN + i] = np.nan


@njit(**BARE)
def _newton_steps(w, first, last, lens):
    """Take one Newton step with some points; return how many have not settled."""
    k = lens[SHIFT_K:]
    if lens[SHIFT_KIND] == 0:
        for i in range(first, last):
            w[U + i], w[V + i] = formulas.gennery(
                w[THETA + i], w[SIN + i], w[COS + i], k[0], k[1], k[2], k[3]
            )
    elif lens[SHIFT_KIND] == 1:
        for i in range(first, last):
            w[U + i], w[V + i] = formulas.flat_port(
                w[THETA + i], w[SIN + i], w[COS + i], k[0], k[1]
            )
    else:
        for i in range(first, last):
            w[U + i] = w[V + i] = np.nan
    late = 0
    for i in range(first, last):
        step, clearance = formulas.newton_step(
            w[R + i], w[Z + i], w[SIN + i], w[COS + i], w[U + i], w[V + i]
        )
        turn = w[TURN + i] + step
        w[TURN + i], w[CLEARANCE + i] = turn, clearance
        w[THETA + i] = w[THETA0 + i] + turn
        w[SIN + i], w[COS + i] = _rotate_sin_cos(w[SIN0 + i], w[COS0 + i], turn)
        w[STATE + i] = abs(step)
        late += not w[STATE + i] < STEP_TOLERANCE
    return late


@njit(**BARE)
def image(w, n, lens):
    """Write image heights over the radius, slopes of the heights, and image points."""
    k, kind = lens[HEIGHT_K:], lens[HEIGHT_KIND]
    if kind == 0:
        for i in range(n):
            w[RATIO + i], w[SLOPE + i] = formulas.orthographic(w[SIN + i], w[COS + i])
    elif kind == 1:
        for i in range(n):
            w[RATIO + i], w[SLOPE + i] = formulas.equidistant(w[THETA + i])
    elif kind == 2:
        for i in range(n):
            w[RATIO + i], w[SLOPE + i] = formulas.equisolid(w[SIN + i], w[COS + i])
    elif kind == 3:
        for i in range(n):
            w[RATIO + i], w[SLOPE + i] = formulas.stereographic(w[SIN + i], w[COS + i])
    elif kind == 4:
        for i in range(n):
            w[RATIO + i], w[SLOPE + i] = formulas.kannala_brandt(
                w[THETA + i], k[0], k[1], k[2], k[3]
            )
    else:  # a formula that has no lines here: nothing rather than another one
        for i in range(n):
            w[RATIO + i] = w[SLOPE + i] = np.nan
    fx, fy, cx, cy = lens[FX], lens[FY], lens[CX], lens[CY]
    for i in range(n):
        w[RATIO + i] /= w[R + i]
        w[U + i] = cx + fx * w[RATIO + i] * w[X + i]
        w[V + i] = cy + fy * w[RATIO + i] * w[Y + i]


@njit(**BARE)
def derivatives(w, n, lens):
    """Write derivatives by place and by turn in the camera frame, as `numpy_engine` does."""
    fx, fy = lens[FX], lens[FY]
    for i in range(n):
        x, y, z, r, ratio = w[X + i], w[Y + i], w[Z + i], w[R + i], w[RATIO + i]
        inverse = 1.0 / (w[CLEARANCE + i] * r)
        rise, fall, bend = formulas.point_derivatives(
            ratio, w[SLOPE + i], r * r, w[COS + i] * r * inverse, w[SIN + i] * inverse
        )
        turn, level = bend * z + fall, ratio * z
        x2, y2, mixed = x * x, y * y, x * y
        w[ROW + i] = fx * (ratio + x2 * bend)
        w[ROW + B + i] = fx * mixed * bend
        w[ROW + 2 * B + i] = -fx * x * fall
        w[ROW + 3 * B + i] = fx * mixed * turn
        w[ROW + 4 * B + i] = -fx * (level + x2 * turn)
        w[ROW + 5 * B + i] = fx * y * ratio
        w[ROW + 7 * B + i] = fy * mixed * bend
        w[ROW + 8 * B + i] = fy * (rise - x2 * bend)
        w[ROW + 9 * B + i] = -fy * y * fall
        w[ROW + 10 * B + i] = fy * (level + y2 * turn)
        w[ROW + 11 * B + i] = -fy * mixed * turn
        w[ROW + 12 * B + i] = -fy * x * ratio


@njit(**BARE)
def load(w, n, points, rotation, position):
    """Bring the first n points from the world into the camera frame."""
    r, p = rotation, position
    for i in range(n):
        x, y, z = points[i, 0] - p[0], points[i, 1] - p[1], points[i, 2] - p[2]
        w[X + i] = r[0, 0] * x + r[1, 0] * y + r[2, 0] * z
        w[Y + i] = r[0, 1] * x + r[1, 1] * y + r[2, 1] * z
        w[Z + i] = r[0, 2] * x + r[1, 2] * y + r[2, 2] * z


@njit(**BARE)
def add_view(w, points, uv, weight, lens, rotation, position, gram):
    """Add the products of a view's rows to gram (28), camera frame; return how it went."""
    for start in range(0, len(points), B):
        n, weights, measured = min(B, len(points) - start), weight[start:], uv[start:]
        load(w, n, points[start:], rotation, position)
        for i in range(n):
            unused = weights[i] == 0.0
            w[X + i] = 0.0 if unused else w[X + i]
            w[Y + i] = 0.0 if unused else w[Y + i]
            w[Z + i] = 1.0 if unused else w[Z + i]
        solve_rays(w, n, lens, BACKWARD_ANGLE)
        image(w, n, lens)
        derivatives(w, n, lens)
        failed = 0
        for i in range(n):
            failed += (w[STATE + i] != VALID) & (weights[i] != 0.0)
        if failed:
            return _worst_state(w, n, weights)
        for i in range(n):
            w[ROW + 6 * B + i] = w[U + i] - measured[i, 0]
            w[ROW + 13 * B + i] = w[V + i] - measured[i, 1]
            w[STATE + i] = weights[i] * weights[i]
        _add_products(w, n, gram)
    return VALID


@njit(**BARE)
def _worst_state(w, n, weight):
    worst = VALID
    for i in range(n):
        if weight[i] != 0.0:
            worst = min(worst, w[STATE + i])
    return worst


@njit(inline='always', **BARE)
def _row_product(w, i, row, u, v):
    """Return the product of one row of a point with another."""
    at = ROW + row * B + i
    return u * w[at] + v * w[at + ROWS]


@njit(**BARE)
def _add_products(w, n, gram):
    """Add the products of all rows with each other, weighted by STATE."""
    a0 = a1 = a2 = a3 = a4 = a5 = a6 = b1 = b2 = b3 = b4 = b5 = b6 = 0.0
    c2 = c3 = c4 = c5 = c6 = d3 = d4 = d5 = d6 = e4 = e5 = e6 = f5 = f6 = g6 = 0.0
    for i in range(n):  # as many sums at once as there are registers for them
        s = w[STATE + i]
        u, v = s * w[ROW + i], s * w[ROW + ROWS + i]
        a0 += _row_product(w, i, 0, u, v)
        a1 += _row_product(w, i, 1, u, v)
        a2 += _row_product(w, i, 2, u, v)
        a3 += _row_product(w, i, 3, u, v)
        a4 += _row_product(w, i, 4, u, v)
        a5 += _row_product(w, i, 5, u, v)
        a6 += _row_product(w, i, 6, u, v)
        u, v = s * w[ROW + B + i], s * w[ROW + ROWS + B + i]
        b1 += _row_product(w, i, 1, u, v)
        b2 += _row_product(w, i, 2, u, v)
        b3 += _row_product(w, i, 3, u, v)
        b4 += _row_product(w, i, 4, u, v)
        b5 += _row_product(w, i, 5, u, v)
        b6 += _row_product(w, i, 6, u, v)
        u, v = s * w[ROW + 2 * B + i], s * w[ROW + ROWS + 2 * B + i]
        c2 += _row_product(w, i, 2, u, v)
        c3 += _row_product(w, i, 3, u, v)
        c4 += _row_product(w, i, 4, u, v)
        c5 += _row_product(w, i, 5, u, v)
        c6 += _row_product(w, i, 6, u, v)
    for i in range(n):
        s = w[STATE + i]
        u, v = s * w[ROW + 3 * B + i], s * w[ROW + ROWS + 3 * B + i]
        d3 += _row_product(w, i, 3, u, v)
        d4 += _row_product(w, i, 4, u, v)
        d5 += _row_product(w, i, 5, u, v)
        d6 += _row_product(w, i, 6, u, v)
        u, v = s * w[ROW + 4 * B + i], s * w[ROW + ROWS + 4 * B + i]
        e4 += _row_product(w, i, 4, u, v)
        e5 += _row_product(w, i, 5, u, v)
        e6 += _row_product(w, i, 6, u, v)
        u, v = s * w[ROW + 5 * B + i], s * w[ROW + ROWS + 5 * B + i]
        f5 += _row_product(w, i, 5, u, v)
        f6 += _row_product(w, i, 6, u, v)
        u, v = s * w[ROW + 6 * B + i], s * w[ROW + ROWS + 6 * B + i]
        g6 += _row_product(w, i, 6, u, v)
    sums = (
        a0,
        a1,
        a2,
        a3,
        a4,
        a5,
        a6,
        b1,
        b2,
        b3,
        b4,
        b5,
        b6,
        c2,
        c3,
        c4,
        c5,
        c6,
        d3,
        d4,
        d5,
        d6,
        e4,
        e5,
        e6,
        f5,
        f6,
        g6,
    )
    for k in range(28):
        gram[k] += sums[k]


@njit(**BARE)
def view_equations(w, points, uv, weight, lens, rotation, position, hessian, gradient):
    """Write H (6, 6) and g (6) of one pose; return its cost, inf outside, nan if left."""
    sums, gram, half = w[GRAM : GRAM + 28], w[GRAM + 28 : GRAM + 77], w[GRAM + 77 : SCRATCH]
    sums[:] = 0.0
    state = add_view(w, points, uv, weight, lens, rotation, position, sums)
    if state < VALID:
        return np.nan if state == UNSETTLED else np.inf
    k = 0
    for a in range(7):
        for b in range(a, 7):
            gram[7 * a + b] = gram[7 * b + a] = sums[k]
            k += 1
    for part in range(2):
        for a in range(3):
            for b in range(7):
                total = 0.0
                for k in range(3):
                    total += rotation[a, k] * gram[7 * (3 * part + k) + b]
                # By place, the camera moves, not the point.
                half[7 * (3 * part + a) + b] = total if part else -total
    for a in range(6):
        gradient[a] = half[7 * a + 6]
        for b in range(3):
            place, turn = 0.0, 0.0
            for k in range(3):
                place -= half[7 * a + k] * rotation[b, k]
                turn += half[7 * a + 3 + k] * rotation[b, k]
            hessian[a, b], hessian[a, 3 + b] = place, turn
    return gram[48]


@njit(**BARE)
def factor(hessian, damping, lower):
    """Factor H + damping diag H; return whether that can be done.

    lower: Cholesky's factor, with the reciprocals of its diagonal.
    """
    for j in range(DOF):
        for i in range(j, DOF):
            total = hessian[i, j] * (1.0 + damping if i == j else 1.0)
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            if i > j:
                lower[i, j] = total * lower[j, j]
            elif total > SINGULAR * hessian[j, j]:
                lower[j, j] = 1.0 / np.sqrt(total)
            else:
                return False
    return True


@njit(**BARE)
def substitute(lower, x):
    """Solve for the matrix that was factored, x in place."""
    for i in range(DOF):
        for k in range(i):
            x[i] -= lower[i, k] * x[k]
        x[i] *= lower[i, i]
    for i in range(DOF - 1, -1, -1):
        for k in range(i + 1, DOF):
            x[i] -= lower[k, i] * x[k]
        x[i] *= lower[i, i]


@njit(**BARE)
def retract(rotation, position, change, new_rotation, new_position):
    """Apply a small change (6): `pose.Pose.retract`."""
    x, y, z = change[3], change[4], change[5]
    angle2 = x * x + y * y + z * z
    a, b = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
    if angle2 >= 1e-12:
        angle = np.sqrt(angle2)
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2
    t00, t01, t02 = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    t10, t11, t12 = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
    t20, t21, t22 = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)
    for i in range(3):
        new_position[i] = position[i] + change[i]
        r0, r1, r2 = rotation[0, i], rotation[1, i], rotation[2, i]
        new_rotation[0, i] = t00 * r0 + t01 * r1 + t02 * r2
        new_rotation[1, i] = t10 * r0 + t11 * r1 + t12 * r2
        new_rotation[2, i] = t20 * r0 + t21 * r1 + t22 * r2
