"""Products of a design's columns, frame by frame, arranged as blocks to eliminate and the rest."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.random_effects import Design


class Blocks(NamedTuple):
    """Products of columns: e, the E blocks of k eliminated coefficients; r, the rest; x, border.

    ee (E, k, k), er (E, k, R), rr (R, R), ex (E, k, X), rx (R, X), xx (X, X); e_label (E, k),
    r_label (R,): components.  The border is fixed columns and, last, the residual itself.
    """

    ee: Array
    er: Array
    rr: Array
    ex: Array
    rx: Array
    xx: Array
    e_label: Index
    r_label: Index


class Products(NamedTuple):
    """Products of columns by frame (f), landmark (l), shared (s) and border (x)."""

    ff: Array
    ll: Array
    lf: Array
    ss: Array
    sf: Array
    ls: Array
    fx: Array
    lx: Array
    sx: Array
    xx: Array


def multiplied(design: Design, pose: Array, border: Array, frames: Index) -> Products:
    """Multiply out some frames; the other frames' blocks are zero."""
    count, height, _ = pose.shape
    labels = design.landmark_label
    landmarks, shared, edge = len(labels), design.shared.shape[1], border.shape[-1]
    width = 6 + design.frame.shape[-1]
    p = Products(
        np.zeros((count, width, width)), np.zeros((landmarks, 3, 3)),
        np.zeros((landmarks, 3, count, width)), np.zeros((shared, shared)),
        np.zeros((shared, count, width)), np.zeros((landmarks, 3, shared)),
        np.zeros((count, width, edge)), np.zeros((landmarks, 3, edge)), np.zeros((shared, edge)),
        np.zeros((edge, edge)),
    )
    offsets = bool((labels >= 0).any())
    for f in frames:
        own = np.concatenate([pose[f], design.frame[f]], axis=-1)
        s = design.shared[f * height : (f + 1) * height].toarray()
        p.ff[f], p.fx[f] = own.T @ own, own.T @ border[f]
        p.ss[:] += s.T @ s
        p.sf[:, f], p.sx[:] = s.T @ own, p.sx + s.T @ border[f]
        p.xx[:] += border[f].T @ border[f]
        n = np.flatnonzero(design.slot[f] >= 0)
        if not offsets or not len(n):
            continue
        slot = design.slot[f, n]
        place = np.where(labels[slot][:, None] >= 0, design.place[f, n], 0.0)
        across = np.swapaxes(place, -1, -2)
        pairs = (2 * n[:, None] + np.arange(2)).ravel()
        all_rows = np.concatenate([own, border[f], s], axis=-1)
        crossed = across @ all_rows[pairs].reshape(len(n), 2, -1)
        for first in _once(slot):  # two cameras see a landmark twice
            at, part = slot[first], crossed[first]
            p.ll[at] += (across @ place)[first]
            p.lf[at, :, f] += part[..., :width]
            p.lx[at] += part[..., width : width + edge]
            p.ls[at] += part[..., width + edge :]
    return p


def _once(slot: Index) -> list[Index]:
    """Return groups of places in `slot` in each of which every value stands once."""
    groups, left = [], np.arange(len(slot))
    while len(left):
        first = np.unique(slot[left], return_index=True)[1]
        groups.append(left[first])
        left = np.delete(left, first)
    return groups


def arranged(
    p: Products, f_label: Index, l_label: Index, s_label: Index, by_frame: bool
) -> Blocks:
    """Put the products in their places as blocks and rest."""
    count, width, edge = p.fx.shape
    landmarks = len(p.ll)
    if by_frame:
        by_landmark = np.moveaxis(p.lf, (2, 3), (0, 1)).reshape(count, width, 3 * landmarks)
        er = np.concatenate([np.moveaxis(p.sf, 0, -1), by_landmark], axis=-1)
        rr = _assembled(p.ss, p.ls.reshape(3 * landmarks, -1).T, p.ll, False)
        rx = np.concatenate([p.sx, p.lx.reshape(3 * landmarks, edge)])
        label = np.concatenate([s_label, l_label.ravel()])
        return Blocks(p.ff, er, rr, p.fx, rx, p.xx, f_label, label)
    by_frames = p.lf.reshape(landmarks, 3, count * width)
    er = np.concatenate([by_frames, p.ls], axis=-1)
    rr = _assembled(p.ss, p.sf.reshape(len(p.ss), count * width), p.ff, True)
    rx = np.concatenate([p.fx.reshape(count * width, edge), p.sx])
    label = np.concatenate([f_label.ravel(), s_label])
    return Blocks(p.ll, er, rr, p.lx, rx, p.xx, l_label, label)


def _assembled(shared: Array, crossed: Array, blocks: Array, blocks_first: bool) -> Array:
    """Return one matrix of shared products (Q, Q), crossed (Q, E k) and diagonal blocks."""
    count, width = blocks.shape[:2]
    diagonal = np.zeros((count, width, count, width))
    diagonal[np.arange(count), :, np.arange(count)] = blocks
    flat = diagonal.reshape(count * width, count * width)
    parts = [[flat, crossed.T], [crossed, shared]]
    if not blocks_first:
        parts = [row[::-1] for row in parts[::-1]]
    return np.block(parts)
