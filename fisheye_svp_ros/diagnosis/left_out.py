"""Every frame left out in turn, exactly, from the one factorisation of all frames.

With P = V^-1 - V^-1 X (X' V^-1 X)^-1 X' V^-1 of poses X and random parts V, what the other frames
leave of columns c in frame f is inv(P_ff) (P c)_f, and the information that goes with the frame
is (P c)_f' inv(P_ff) (P c)_f.
Source: Cook and Weisberg, Residuals and Influence in Regression (1982), for blocks of rows.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import linalg

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.diagnosis.mixed import Factored, solve_lower
from fisheye_svp_ros.diagnosis.random_effects import Design


class LeftOut(NamedTuple):
    """Each frame seen from all the others.

    information (F, X, X): of the border, that the frame brings, in units of 1 / noise variance;
    rows (F, M, X): what is left of the border once the others have predicted landmarks' offsets
    and image fields, and the frame has fitted its pose.
    """

    information: Array
    rows: Array


def left_out_in_turn(f: Factored, random: Design, pose: Array, border: Array) -> LeftOut:
    """Return what each frame brings beside the others.

    random: the design of the components in the factored equations; pose (F, M, 6) and border
    (F, M, X): the columns that these were made of.
    """
    found = [_left_out(f, random, i, pose[i], border[i]) for i in range(len(pose))]
    return LeftOut(*(np.stack(parts) for parts in zip(*found, strict=True)))


def _left_out(f: Factored, random: Design, frame: int, pose: Array, border: Array) -> LeftOut:
    used = np.flatnonzero(np.abs(pose).sum(axis=1) + np.abs(border).sum(axis=1))
    height, rows = len(pose), np.zeros_like(border)
    own = np.concatenate(
        [pose[used] / f.equations.pose_scale[frame], random.frame[frame][used]], axis=1
    )
    shared = random.shared[frame * height + used].toarray()
    slot = np.repeat(random.slot[frame], 2)[used]
    place = random.place[frame].reshape(height, 3)[used]
    inside, rest, at_border = _eliminated(f, frame, own, shared, slot, place, random)
    half = solve_lower(f.factor, rest)
    # P of this frame's rows, and P border
    p = np.eye(len(used)) - inside - half.T @ half
    left = border[used] - at_border - half.T @ f.border
    basis = _span(pose[used])
    left -= basis @ (basis.T @ left)
    root = linalg.cholesky(p + basis @ basis.T, lower=True, check_finite=False)
    first = solve_lower(root, left)
    rows[used] = solve_lower(root, first, trans=1)
    return LeftOut(first.T @ first, rows)


def _eliminated(
    f: Factored, frame: int, own: Array, shared: Array, slot: Array, place: Array, random: Design
) -> tuple[Array, Array, Array]:
    """Return what the eliminated blocks take from a frame's m rows.

    From their products (m, m), what is left of their columns of the rest (R, m), and from their
    border (m, X).
    """
    eq = f.equations
    order = np.full(len(random.landmark) + 1, -1)
    order[eq.landmarks] = np.arange(len(eq.landmarks))
    at = order[slot]
    place = np.where((random.landmark_label[slot] >= 0) & (at >= 0)[:, None], place, 0.0)
    count = len(eq.landmarks)
    if eq.by_frame:
        first = f.inverse[frame] @ own.T
        landmark = np.zeros((count, 3, len(own)))
        if count:
            landmark[at, :, np.arange(len(own))] = place
        rest = np.concatenate([shared.T, landmark.reshape(3 * count, len(own))])
        return (first.T @ first, rest - f.coupled[frame].T @ first,
                first.T @ f.block_border[frame])
    rest = np.zeros((len(f.factor), len(own)))
    width = own.shape[1]
    rest[frame * width : (frame + 1) * width] = own.T
    rest[len(rest) - shared.shape[1] :] = shared.T
    if not count:
        return np.zeros((len(own), len(own))), rest, np.zeros((len(own), f.border.shape[1]))
    step = (f.inverse[at] @ place[..., None])[..., 0]
    same = at[:, None] == at
    rest -= np.einsum('mi,mir->rm', step, f.coupled[at])
    return np.where(same, step @ step.T, 0.0), rest, np.einsum('mi,mix->mx', step,
                                                              f.block_border[at])


def _span(columns: Array) -> Array:
    """Return an orthonormal basis (m, r) of columns (m, 6)."""
    scale = np.sqrt((columns**2).sum(axis=0))
    u, s, _ = np.linalg.svd(columns / np.maximum(scale, 1e-300), full_matrices=False)
    return u[:, s > 1e-9]
