"""Every frame left out in turn, exactly, from the one factorisation of all frames.

With P = V^-1 - V^-1 X (X' V^-1 X)^-1 X' V^-1 of poses X and random parts V, what the other frames
leave of columns c in frame f is inv(P_ff) (P c)_f, and the information that goes with the frame
is (P c)_f' inv(P_ff) (P c)_f.
Source: Cook and Weisberg, Residuals and Influence in Regression (1982), for blocks of rows.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.mixed import Equations, Factored
from fisheye_svp_ros.diagnosis.random_effects import Design
from fisheye_svp_ros.diagnosis.solution import random_roots


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
    eq, (e, r) = f.equations, random_roots(f)
    # Roots of the covariance of the coefficients and, given the border, their predictions.
    e, r = (np.concatenate([root, root @ f.border], axis=1) for root in (e, r))
    split = eq.sorted(e.reshape(*f.coupled.shape[:2], r.shape[1]), r)
    found = LeftOut(np.empty((len(pose), *f.information.shape)), np.zeros_like(border))

    def one(frame: int) -> None:
        rows = found.rows[frame]
        remaining = _left_out(f, split, random, frame, pose[frame], border[frame], rows)
        np.matmul(remaining.T, rows, out=found.information[frame])

    # NumPy's linear algebra, unlike SciPy's, lets go of the interpreter.
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(one, range(len(pose))))
    return found


def _left_out(
    f: Factored, split: tuple[Array, Array, Array], random: Design, frame: int, pose: Array,
    border: Array, rows: Array,
) -> Array:
    """Write what the others leave of a frame's rows (M, X); return it before inv(P_ff), as wide.

    split: roots of the covariance and what the border says, by frame, by landmark, shared.
    """
    used = np.flatnonzero(np.abs(pose).sum(axis=1) + np.abs(border).sum(axis=1))
    height, found = len(pose), np.zeros_like(border)
    own = np.concatenate(
        [pose[used] / f.equations.pose_scale[frame], random.frame[frame][used]], axis=1
    )
    at, place = _places(f.equations, random, frame)
    shared = random.shared[frame * height + used].toarray()
    touched = np.flatnonzero(shared.any(axis=0))
    by_frame, by_landmark, by_all = split
    both = own @ by_frame[frame] + shared[:, touched] @ by_all[touched]
    if len(by_landmark):
        both += (place @ by_landmark[at]).reshape(height, -1)[used]
    root, told = np.split(both, [len(f.factor)], axis=1)
    inside, at_border = _eliminated(f, frame, own, np.repeat(at, 2)[used],
                                    place.reshape(height, 3)[used])
    # P of this frame's rows, and P border
    p = np.eye(len(used)) - inside - root @ root.T
    remaining = border[used] - at_border - told
    basis = _span(pose[used])
    remaining -= basis @ (basis.T @ remaining)
    rows[used], found[used] = np.linalg.solve(p + basis @ basis.T, remaining), remaining
    return found


def _places(eq: Equations, random: Design, frame: int) -> tuple[Index, Array]:
    """Return a frame's landmarks (N,) in the equations and their places (N, 2, 3) or zero."""
    order = np.full(len(random.landmark) + 1, -1)
    order[eq.landmarks] = np.arange(len(eq.landmarks))
    slot = random.slot[frame]
    at = order[slot]
    there = (random.landmark_label[slot] >= 0) & (at >= 0)[:, None]
    return at, np.where(there[:, None], random.place[frame], 0.0)


def _eliminated(
    f: Factored, frame: int, own: Array, at: Index, place: Array
) -> tuple[Array, Array]:
    """Return what the eliminated blocks take from a frame's rows (m, m) and border (m, X)."""
    if f.equations.by_frame:
        first = f.inverse[frame] @ own.T
        return first.T @ first, first.T @ f.block_border[frame]
    if not len(f.equations.landmarks):
        return np.zeros((len(own), len(own))), np.zeros((len(own), f.border.shape[1]))
    step = (f.inverse[at] @ place[..., None])[..., 0]
    same = at[:, None] == at
    return (np.where(same, step @ step.T, 0.0),
            np.einsum('mi,mix->mx', step, f.block_border[at]))


def _span(columns: Array) -> Array:
    """Return an orthonormal basis (m, r) of columns (m, 6)."""
    scale = np.sqrt((columns**2).sum(axis=0))
    u, s, _ = np.linalg.svd(columns / np.maximum(scale, 1e-300), full_matrices=False)
    return u[:, s > 1e-9]
