"""Products of a design's columns, frame by frame, arranged as blocks to eliminate and the rest."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from scipy import sparse

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

    @property
    def label(self) -> Index:
        """Components (E k + R,) of all coefficients, blocks first."""
        return np.append(self.e_label, self.r_label)


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


def multiplied(design: Design, pose: Array, border: Array) -> Products:
    """Multiply out the columns of a design, of poses and of a border."""
    frames, height, _ = pose.shape
    landmarks, shared, edge = len(design.landmark), design.shared, border.shape[-1]
    own = np.concatenate([pose, design.frame], axis=-1)
    across, flat = np.swapaxes(own, -1, -2), border.reshape(frames * height, edge)
    offsets = design.offsets
    lf = np.zeros((3 * landmarks, frames, own.shape[-1]))
    for f in range(frames):
        lf[:, f] = offsets[f * height : (f + 1) * height].T @ own[f]
    with ThreadPoolExecutor(2) as pool:  # NumPy lets go of the interpreter
        of_axes = pool.map(lambda axis: _shared_products(shared, own, border, axis), (0, 1))
        ss, sf, sx = (u + v for u, v in zip(*of_axes, strict=True))
    place = design.place * (design.slot >= 0)[..., None, None]
    ll = np.zeros((landmarks, 3, 3))
    np.add.at(ll, design.slot, np.swapaxes(place, -1, -2) @ place)
    there = design.landmark_label >= 0
    ll *= there[:, :, None] & there[:, None, :]
    return Products(
        across @ own, ll, lf.reshape(landmarks, 3, frames, -1), ss, sf,
        (offsets.T @ shared).toarray().reshape(landmarks, 3, -1), across @ border,
        (offsets.T @ flat).reshape(landmarks, 3, -1), sx, flat.T @ flat,
    )


def _shared_products(
    shared: sparse.csr_array, own: Array, border: Array, axis: int
) -> tuple[Array, Array, Array]:
    """Return the products of shared columns with themselves, frames' own and the border.

    Over the rows of one axis of the image: a bump moves u or v, and a frame fills a part.
    """
    (frames, height, _), count = own.shape, shared.shape[1]
    ss, sf, sx = (np.zeros((count, *shape)) for shape in (
        (count,), (frames, own.shape[-1]), (border.shape[-1],)))
    for f in range(frames):
        part = shared[f * height + axis : (f + 1) * height : 2]
        seen = np.unique(part.indices)
        dense = part[:, seen].toarray().T
        sf[seen, f] = dense @ own[f, axis::2]
        sx[seen] += dense @ border[f, axis::2]
        ss[np.ix_(seen, seen)] += dense @ dense.T
    return ss, sf, sx


def multiplied_by(design: Design, pose: Array, residual: Array) -> tuple[Array, Array, Array]:
    """Multiply a residual (F, M) by all columns: by frame (F, B), landmark (L, 3), shared (Q,)."""
    own = np.concatenate([pose, design.frame], axis=-1)
    flat = residual.ravel()
    return (np.einsum('fmb,fm->fb', own, residual), (design.offsets.T @ flat).reshape(-1, 3),
            design.shared.T @ flat)


def moves_of(
    design: Design, pose: Array, frame: Array, landmark: Array, shared: Array, landmarks: Index
) -> Array:
    """Return what coefficients do to the rows (F, M, C).

    Those of frames (F, B, C), of some landmarks (m, 3, C) and shared (Q, C); landmarks (m,).
    """
    own = np.concatenate([pose, design.frame], axis=-1)
    offset = np.zeros((len(design.landmark), *landmark.shape[1:]))
    offset[landmarks] = landmark
    flat = design.offsets @ offset.reshape(-1, offset.shape[-1]) + design.shared @ shared
    return np.asarray(flat.reshape(*own.shape[:2], -1) + own @ frame)


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
