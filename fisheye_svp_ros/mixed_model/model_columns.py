"""The columns of a mixed model y = X b + Z u + e, and their products, group by group.

Rows are whitened and come in G groups of M rows (padded with zeros); in each group they are N
points of p rows.  Fixed columns X are of two kinds: those that each group has for itself, and
those that all groups share.  Random columns Z are of three: each group's own, offsets of units
that points of all groups belong to (a crossed factor), and shared ones.  A shared column that is a
combination of offsets (a smooth field over the units) is kept as that: its products follow from
those of the units, which are far fewer than rows.
Source: Searle, Casella, McCulloch, Variance Components (1992), chapters 4 and 7.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import sparse

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.mixed_model.threads import run_in_threads


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
    for none; unit_label (U, w); shared: sparse (G M, S); fields: sparse (U w, Q - S), shared
    columns that are combinations of offsets, whether or not these have a label; shared_label (Q,):
    of both, in this order; components: what the labels count.
    """

    group: Array
    group_label: Index
    offset: Array
    unit: Index
    unit_label: Index
    shared: sparse.csr_array
    fields: sparse.csr_array
    shared_label: Index
    components: Components

    @property
    def unit_columns(self) -> sparse.csr_array:
        """Columns (G M, U w) of the offsets of units, with a label or without."""
        rows, width = self.offset.shape[2:]
        present = self.unit >= 0
        unit, values = self.unit[present], self.offset[present]
        column = np.repeat(width * unit[:, None] + np.arange(width), rows, axis=0)
        ends = np.cumsum(np.repeat(width * present, rows))
        return sparse.csr_array(
            (values.ravel(), column.ravel(), np.append(0, ends)),
            (self.unit.size * rows, self.unit_label.size),
        )

    @property
    def shared_columns(self) -> sparse.csr_array:
        """All shared columns (G M, Q), fields last."""
        return sparse.csr_array(
            sparse.hstack([self.shared, self.unit_columns @ self.fields], format='csr')
        )

    def select(self, alive: Mask) -> RandomColumns:
        """Return the columns of some of the components (K,) only."""
        present = np.append(alive, False)
        columns, shared = present[self.group_label], present[self.shared_label]
        count = self.shared.shape[1]
        return self._replace(
            group=self.group[..., columns],
            group_label=self.group_label[columns],
            unit_label=np.where(present[self.unit_label], self.unit_label, -1),
            shared=self.shared[:, shared[:count]],
            fields=self.fields[:, shared[count:]],
            shared_label=self.shared_label[shared],
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
    shared, fields, offsets = random.shared, random.fields.T, random.unit_columns
    own = np.concatenate([group_fixed, random.group], axis=-1)
    across, flat = np.swapaxes(own, -1, -2), border.reshape(groups * height, border.shape[-1])
    uu, count = _square_offsets(random), shared.shape[1]

    def with_groups() -> tuple[Array, Array]:
        """Return the products of offsets, and of fields, with what belongs to groups."""
        ug = _multiply_groups(offsets, own)
        # A field is a combination of units, and so are its products.
        fg = fields @ ug.reshape(len(ug), groups * own.shape[-1])
        return ug, fg.reshape(len(fg), *ug.shape[1:])

    def with_shared() -> tuple[Array, Array]:
        products = (offsets.T @ shared).toarray(), _multiply_units(uu, random)
        us = np.concatenate(products, axis=1)
        return us, fields @ us

    def with_border() -> tuple[Array, Array]:
        ux = offsets.T @ flat
        return ux, fields @ ux

    # The longest first.
    sx, (ug, fg), ss, xx, (us, fs), gx, sg, (ux, fx) = run_in_threads(
        lambda: shared.T @ flat,
        with_groups,
        lambda: (shared.T @ shared).toarray(),
        lambda: flat.T @ flat,
        with_shared,
        lambda: across @ border,
        lambda: _multiply_groups(shared, own),
        with_border,
        products=shared.nnz * flat.shape[1],
    )
    ss = np.block([[ss, fs[:, :count].T], [fs]])
    present = random.unit_label >= 0
    for part in (us, ux, ug):
        part[~present.ravel()] = 0.0
    uu *= present[:, :, None] & present[:, None, :]
    of_units = [part.reshape(*present.shape, *part.shape[1:]) for part in (ug, us, ux)]
    return Products(
        across @ own,
        uu,
        of_units[0],
        ss,
        np.concatenate([sg, fg]),
        of_units[1],
        gx,
        of_units[2],
        np.concatenate([sx, fx]),
        xx,
    )


def _square_offsets(random: RandomColumns) -> Array:
    """Return the products (U, w, w) of the offsets of each unit with each other."""
    units, width = random.unit_label.shape
    offset, unit = random.offset[random.unit >= 0], random.unit[random.unit >= 0]
    squares = np.zeros((units, width, width))
    np.add.at(squares, unit, np.swapaxes(offset, -1, -2) @ offset)
    return squares


def _multiply_units(squares: Array, random: RandomColumns) -> Array:
    """Return the products (U w, P) of the offsets of units with the fields."""
    units, width, _ = squares.shape
    blocks = sparse.bsr_array(
        (squares, np.arange(units), np.arange(units + 1)), shape=(units * width, units * width)
    )
    return np.asarray((blocks @ random.fields).toarray())


def _multiply_groups(shared: sparse.csr_array, own: Array) -> Array:
    """Return the products (S, G, W) of columns of all groups with each one's own (G, M, W)."""
    groups, height, width = own.shape
    count = shared.shape[1]
    group = np.repeat(np.arange(groups * height) // height, np.diff(shared.indptr))
    apart = sparse.csr_array(
        (shared.data, shared.indices + count * group, shared.indptr),
        (groups * height, groups * count),
    )
    products = apart.T @ own.reshape(groups * height, width)
    return np.moveaxis(products.reshape(groups, count, width), 0, 1)


def multiply_rows(
    random: RandomColumns, group_fixed: Array, rows: Array
) -> tuple[Array, Array, Array]:
    """Multiply rows (G, M, C) by columns: by group (G, B, C), unit (U, w, C), shared (Q, C)."""
    own = np.concatenate([group_fixed, random.group], axis=-1)
    flat = rows.reshape(-1, rows.shape[-1])
    unit = random.unit_columns.T @ flat
    shared = np.concatenate([random.shared.T @ flat, random.fields.T @ unit])
    unit = unit.reshape(*random.unit_label.shape, flat.shape[1])
    return np.swapaxes(own, -1, -2) @ rows, _without_absent(random, unit), shared


def predict_rows(
    random: RandomColumns,
    group_fixed: Array,
    group: Array,
    unit: Array,
    shared: Array,
    units: Index,
) -> Array:
    """Return what coefficients add to the rows (G, M, C).

    Those of groups (G, B, C), of some units (m, w, C) and shared (Q, C); units (m,).
    """
    own = np.concatenate([group_fixed, random.group], axis=-1)
    offset = combine_offsets(random, unit, shared, units)
    flat = random.unit_columns @ offset.reshape(-1, offset.shape[-1])
    flat += random.shared @ shared[: random.shared.shape[1]]
    return np.asarray(flat.reshape(*own.shape[:2], -1) + own @ group)


def combine_offsets(random: RandomColumns, unit: Array, shared: Array, units: Index) -> Array:
    """Return the offsets (U, w, C) of all units, fields and all.

    unit (m, w, C), units (m,): of some units alone; shared (Q, C): of shared columns.
    """
    offset = np.zeros((len(random.unit_label), *unit.shape[1:]))
    offset[units] = unit
    offset = _without_absent(random, offset)
    fields = random.fields @ shared[random.shared.shape[1] :]
    return np.asarray(offset + fields.reshape(offset.shape))


def _without_absent(random: RandomColumns, offset: Array) -> Array:
    return np.where((random.unit_label >= 0)[..., None], offset, 0.0)


def group_basis(columns: Array) -> Array:
    """Orthonormal bases (G, M, P) of each group's columns; zero columns where rank is missing."""
    scale = np.sqrt((columns**2).sum(axis=1, keepdims=True))
    u, s, _ = np.linalg.svd(columns / np.maximum(scale, 1e-300), full_matrices=False)
    return np.asarray(u * (s > 1e-9)[:, None, :])


def project_out(columns: Array, group_fixed: Array) -> Array:
    """Return columns (G, M, X) without what those of each group (G, M, P), fitted, take up."""
    basis = group_basis(group_fixed)
    return np.asarray(columns - basis @ (np.swapaxes(basis, -1, -2) @ columns))


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
    (count, width), rest = blocks.shape[:2], len(shared)
    size = count * width
    begin, after = (0, size) if blocks_first else (rest, 0)
    own, others = slice(begin, begin + size), slice(after, after + rest)
    at = begin + np.arange(size).reshape(count, width)
    whole = np.zeros((size + rest, size + rest))
    whole[at[:, :, None], at[:, None]] = blocks
    whole[own, others], whole[others, own], whole[others, others] = crossed.T, crossed, shared
    return whole
