"""The columns of a mixed model y = X b + Z u + e, and their products, group by group.

Rows are whitened and come in G groups of M rows (padded with zeros); in each group they are N
points of p rows.  Fixed columns X are of two kinds: those that each group has for itself, and
those that all groups share.  Random columns Z are of three: each group's own, offsets of units
that points of all groups belong to (a crossed factor), and shared ones.
Source: Searle, Casella, McCulloch, Variance Components (1992), chapters 4 and 7.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import reduce
from typing import NamedTuple

import numpy as np
from scipy import sparse

from fisheye_svp_ros.arrays import Array, Index, Mask

_DENSE_SIZE = 4_000_000  # numbers of shared columns that are made dense at a time


@dataclass(frozen=True)
class Components:
    """The K variance components of a model.

    of_units (K,): those of offsets of units, which follow a t distribution; numerous (K,): those
    of many coefficients that are seldom called for: they are tested last.
    """

    of_units: Mask
    numerous: Mask

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self.of_units)


class RandomColumns(NamedTuple):
    """The random columns Z and the component of each, -1 for what is absent.

    group (G, M, B): of coefficients that each group has for itself, group_label (B,);
    offset (G, N, p, w): of offsets of units, by point; unit (G, N): the unit of each point, -1
    for none; unit_label (U, w); shared: sparse (G M, Q), shared_label (Q,); components: what the
    labels count.
    """

    group: Array
    group_label: Index
    offset: Array
    unit: Index
    unit_label: Index
    shared: sparse.csr_array
    shared_label: Index
    components: Components

    @property
    def point_label(self) -> Index:
        """Components (G, N, w) of the offsets of each point's unit, -1 for none."""
        none = np.full((1, self.unit_label.shape[1]), -1)
        return np.asarray(np.concatenate([self.unit_label, none])[self.unit])

    @property
    def unit_columns(self) -> sparse.csr_array:
        """Columns (G M, U w) of the offsets of units, sparse; zero for what is absent."""
        rows, width = self.offset.shape[2:]
        group, point, axis = np.nonzero(self.point_label >= 0)
        values = self.offset[group, point, :, axis]
        row = rows * (self.unit.shape[1] * group + point)[:, None] + np.arange(rows)
        column = np.repeat(width * self.unit[group, point] + axis, rows)
        return sparse.csr_array(
            (values.ravel(), (row.ravel(), column)), (self.unit.size * rows, self.unit_label.size)
        )

    def select(self, alive: Mask) -> RandomColumns:
        """Return the columns of some of the components (K,) only."""
        present = np.append(alive, False)
        columns, shared = present[self.group_label], present[self.shared_label]
        return self._replace(
            group=self.group[..., columns], group_label=self.group_label[columns],
            unit_label=np.where(present[self.unit_label], self.unit_label, -1),
            shared=self.shared[:, shared], shared_label=self.shared_label[shared],
        )


class Blocks(NamedTuple):
    """Products of columns: e, the E blocks of k eliminated coefficients; r, the rest; x, border.

    ee (E, k, k), er (E, k, R), rr (R, R), ex (E, k, X), rx (R, X), xx (X, X); e_label (E, k),
    r_label (R,): components.  The border is the shared fixed columns and, last, y itself.
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
    """Products of columns by group (g), unit (u), shared (s) and border (x)."""

    gg: Array
    uu: Array
    ug: Array
    ss: Array
    sg: Array
    us: Array
    gx: Array
    ux: Array
    sx: Array
    xx: Array


def multiply_columns(random: RandomColumns, group_fixed: Array, border: Array) -> Products:
    """Multiply out random columns, those that are fixed in each group and a border."""
    groups, height, _ = group_fixed.shape
    (units, width), shared, edge = random.unit_label.shape, random.shared, border.shape[-1]
    own = np.concatenate([group_fixed, random.group], axis=-1)
    across, flat = np.swapaxes(own, -1, -2), border.reshape(groups * height, edge)
    offsets = random.unit_columns
    ug = np.zeros((width * units, groups, own.shape[-1]))
    for g in range(groups):
        ug[:, g] = offsets[g * height : (g + 1) * height].T @ own[g]
    rows = random.offset.shape[2]
    with ThreadPoolExecutor(2) as pool:  # NumPy lets go of the interpreter
        of_rows = pool.map(
            lambda row: _multiply_shared(shared, own, border, row, rows), range(rows))
        ss, sg, sx = (reduce(np.add, parts) for parts in zip(*of_rows, strict=True))
    offset, of_unit = random.offset[random.unit >= 0], random.unit[random.unit >= 0]
    uu = np.zeros((units, width, width))
    np.add.at(uu, of_unit, np.swapaxes(offset, -1, -2) @ offset)
    present = random.unit_label >= 0
    uu *= present[:, :, None] & present[:, None, :]
    return Products(
        across @ own, uu, ug.reshape(units, width, groups, own.shape[-1]),
        ss, sg,
        (offsets.T @ shared).toarray().reshape(units, width, shared.shape[1]), across @ border,
        (offsets.T @ flat).reshape(units, width, edge), sx, flat.T @ flat,
    )


def _multiply_shared(
    shared: sparse.csr_array, own: Array, border: Array, row: int, step: int
) -> tuple[Array, Array, Array]:
    """Return the products of shared columns with themselves, groups' own and the border.

    Over one of the `step` rows of every point: a shared column fills one of them, a group a part.
    Several groups at a time are made dense, as many as `_DENSE_SIZE` has room for.
    """
    (groups, height, _), count = own.shape, shared.shape[1]
    ss, sg, sx = (np.zeros((count, *shape)) for shape in (
        (count,), (groups, own.shape[-1]), (border.shape[-1],)))
    rows, points = shared[row::step], height // step
    parts = 1 + groups * points * count // _DENSE_SIZE
    for some in np.array_split(np.arange(groups), min(parts, groups)):
        part = rows[some[0] * points : (some[-1] + 1) * points]
        touched = np.flatnonzero(np.bincount(part.indices, minlength=count))
        dense = part[:, touched].toarray()
        by_group = dense.reshape(len(some), points, len(touched))
        products = np.swapaxes(by_group, -1, -2) @ own[some, row::step]
        sg[np.ix_(touched, some)] = np.moveaxis(products, 0, 1)
        sx[touched] += dense.T @ border[some, row::step].reshape(len(dense), -1)
        ss[np.ix_(touched, touched)] += dense.T @ dense
    return ss, sg, sx


def multiply_rows(
    random: RandomColumns, group_fixed: Array, rows: Array
) -> tuple[Array, Array, Array]:
    """Multiply rows (G, M, C) by columns: by group (G, B, C), unit (U, w, C), shared (Q, C)."""
    own = np.concatenate([group_fixed, random.group], axis=-1)
    count = rows.shape[-1]
    flat = rows.reshape(-1, count)
    unit = (random.unit_columns.T @ flat).reshape(*random.unit_label.shape, count)
    return np.swapaxes(own, -1, -2) @ rows, unit, random.shared.T @ flat


def predict_rows(
    random: RandomColumns, group_fixed: Array, group: Array, unit: Array, shared: Array,
    units: Index,
) -> Array:
    """Return what coefficients add to the rows (G, M, C).

    Those of groups (G, B, C), of some units (m, w, C) and shared (Q, C); units (m,).
    """
    own = np.concatenate([group_fixed, random.group], axis=-1)
    offset = np.zeros((len(random.unit_label), *unit.shape[1:]))
    offset[units] = unit
    flat = random.unit_columns @ offset.reshape(-1, offset.shape[-1]) + random.shared @ shared
    return np.asarray(flat.reshape(*own.shape[:2], -1) + own @ group)


def arrange_blocks(
    p: Products, g_label: Index, u_label: Index, s_label: Index, by_group: bool
) -> Blocks:
    """Put the products in their places as eliminated blocks and rest."""
    count, width, edge = p.gx.shape
    units, size = p.ux.shape[:2]
    if by_group:
        by_unit = np.moveaxis(p.ug, (2, 3), (0, 1)).reshape(count, width, size * units)
        er = np.concatenate([np.moveaxis(p.sg, 0, -1), by_unit], axis=-1)
        rr = _assemble(p.ss, p.us.reshape(size * units, len(p.ss)).T, p.uu, False)
        rx = np.concatenate([p.sx, p.ux.reshape(size * units, edge)])
        label = np.concatenate([s_label, u_label.ravel()])
        return Blocks(p.gg, er, rr, p.gx, rx, p.xx, g_label, label)
    by_groups = p.ug.reshape(units, size, count * width)
    er = np.concatenate([by_groups, p.us], axis=-1)
    rr = _assemble(p.ss, p.sg.reshape(len(p.ss), count * width), p.gg, True)
    rx = np.concatenate([p.gx.reshape(count * width, edge), p.sx])
    label = np.concatenate([g_label.ravel(), s_label])
    return Blocks(p.uu, er, rr, p.ux, rx, p.xx, u_label, label)


def _assemble(shared: Array, crossed: Array, blocks: Array, blocks_first: bool) -> Array:
    """Return one matrix of shared products (Q, Q), crossed (Q, E k) and diagonal blocks."""
    count, width = blocks.shape[:2]
    diagonal = np.zeros((count, width, count, width))
    diagonal[np.arange(count), :, np.arange(count)] = blocks
    flat = diagonal.reshape(count * width, count * width)
    parts = [[flat, crossed.T], [crossed, shared]]
    if not blocks_first:
        parts = [row[::-1] for row in parts[::-1]]
    return np.block(parts)
