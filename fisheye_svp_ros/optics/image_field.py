"""Smooth displacements of image points that no curve of a lens holds: a spline over the image.

A tensor product of uniform cubic B-splines, as in mrcal's splined models.  It is twice
continuously differentiable, and zero from two nodes outside the grid on.
Source: de Boor, A Practical Guide to Splines (1978).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.errors import LensError

MIN_NODES, MAX_NODES = 4, 400  # nodes along each axis
_FIELDS = ('low', 'pitch', 'u', 'v', 'stderr')
_MARGIN = 3  # zero coefficients around the grid: what a point outside it is given
_MAX_STEPS = 20
_TOLERANCE = 1e-11  # px


class _Basis(NamedTuple):
    """First node (2, n), with the margin, and weights and their slopes (4, 2, n), by axis."""

    first: Index
    value: Array
    slope: Array


@dataclass(frozen=True, eq=False)
class ImageField:
    """Displacements of image points, px, by their place in the ideal image.

    low, pitch (2,), px: the first node and the distance of neighbors along u and v; values
    (rows, columns, 2), px: coefficients of the B-splines at the nodes; stderr (rows, columns), px:
    standard error of a coordinate at the nodes, None if unknown.
    """

    low: Array
    pitch: Array
    values: Array
    stderr: Array | None = None

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ImageField) and all(
            np.array_equal(getattr(self, name), getattr(other, name))
            for name in ('low', 'pitch', 'values', 'stderr')
        )

    __hash__ = None  # type: ignore[assignment]

    def displacement(self, uv: Array) -> Array:
        """Return displacements (..., 2), px, of ideal image points (..., 2); 0 where NaN."""
        basis = self._basis(uv)
        return self._sum(basis, basis.value[:, 0], basis.value[:, 1]).reshape(uv.shape)

    def slope(self, uv: Array) -> Array:
        """Return derivatives (..., 2, 2) of the displacement: row of u, of v; by u, by v."""
        basis = self._basis(uv)
        slopes = [
            self._sum(basis, basis.slope[:, 0], basis.value[:, 1]),
            self._sum(basis, basis.value[:, 0], basis.slope[:, 1]),
        ]
        return np.stack(slopes, axis=-1).reshape(*uv.shape, 2)

    def apply(self, uv: Array) -> Array:
        """Return image points (..., 2), px, of ideal ones."""
        return np.asarray(uv + self.displacement(uv))

    def invert(self, uv: Array) -> Array:
        """Return the ideal image points (..., 2), px, of image points, by Newton's method."""
        ideal = np.array(uv, dtype=float)
        for _ in range(_MAX_STEPS):
            off = uv - self.apply(ideal)
            if not np.nanmax(np.abs(off), initial=0.0) > _TOLERANCE:
                break
            (a, b), (c, d) = np.moveaxis(self.slope(ideal) + np.eye(2), (-2, -1), (0, 1))
            x, y = np.moveaxis(off, -1, 0)
            ideal += np.stack([d * x - b * y, a * y - c * x], axis=-1) / (a * d - b * c)[..., None]
        return ideal

    def carry(self, uv: Array, columns: Array) -> Array:
        """Return derivatives (..., 2, P) of image points from those of the ideal ones at uv."""
        return np.asarray(columns + self.slope(uv) @ columns)

    def check(self, width: int, height: int) -> str:
        """Say what is wrong with it in an image of so many px; empty if nothing is."""
        sides = zip(
            (width, height),
            np.maximum(self.pitch, max(width, height) / MAX_NODES) / 2,
            strict=True,
        )
        uv = np.stack(np.meshgrid(*(np.arange(0.0, side, step) for side, step in sides)), axis=-1)
        fold = np.linalg.det(self.slope(uv) + np.eye(2))
        if fold.min() <= 0:
            u, v = uv.reshape(-1, 2)[fold.argmin()]
            return (
                f'image_field folds the image at ({u:.0f}, {v:.0f}) px; its values must '
                'change by less than the pitch from node to node'
            )
        return ''

    @classmethod
    def interpolate(
        cls, low: Array, pitch: Array, displacement: Array, stderr: Array | None = None
    ) -> ImageField:
        """Return the field that has displacements (rows, columns, 2), px, at its nodes."""
        by_row, by_column = (_node_weights(count) for count in displacement.shape[:2])
        across = np.linalg.solve(by_row, displacement.reshape(len(by_row), -1))
        along = across.reshape(displacement.shape).swapaxes(0, 1)
        values = np.linalg.solve(by_column, along.reshape(len(by_column), -1))
        return cls(low, pitch, values.reshape(along.shape).swapaxes(0, 1), stderr)

    def weights(self, uv: Array) -> tuple[Array, Index]:
        """Return weights (n, 16) of the coefficients at places (n, 2), px, and their nodes.

        Nodes are numbered row by row; those outside the grid weigh nothing.
        """
        basis, (rows, columns) = self._basis(uv), self.values.shape[:2]
        steps = np.arange(4)
        u = basis.first[0][:, None, None] + steps - _MARGIN
        v = basis.first[1][:, None, None] + steps[:, None] - _MARGIN
        weight = basis.value[:, 1].T[:, :, None] * basis.value[:, 0].T[:, None]
        inside = (u >= 0) & (u < columns) & (v >= 0) & (v < rows)
        node = np.where(inside, v * columns + u, 0)
        return np.where(inside, weight, 0.0).reshape(-1, 16), node.reshape(-1, 16)

    @cached_property
    def nodes(self) -> Array:
        """Places (rows, columns, 2) of the nodes, px."""
        rows, columns = self.values.shape[:2]
        grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1)
        return np.asarray(self.low + self.pitch * grid)

    @property
    def rms(self) -> float:
        """Root mean square of the displacement at the nodes, px."""
        return float(np.sqrt((self.displacement(self.nodes) ** 2).sum(axis=-1).mean()))

    def to_dict(self) -> dict[str, Any]:
        """Return the mapping of a lens file."""
        u, v = np.moveaxis(self.values, -1, 0)
        document = {'low': self.low, 'pitch': self.pitch, 'u': u, 'v': v}
        if self.stderr is not None:
            document['stderr'] = self.stderr
        return {name: np.asarray(value).tolist() for name, value in document.items()}

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any], where: str) -> ImageField:
        """Return the field of a lens file; raise LensError naming `where` and the field."""
        where = f'{where}: corrections.image_field'
        if unknown := sorted(set(map(str, entry)) - set(_FIELDS)):
            raise LensError(
                f'{where}: unknown field {unknown[0]!r}; choose from ' + ', '.join(_FIELDS)
            )
        arrays = {
            name: _number_array(entry, name, where)
            for name in _FIELDS
            if name in entry or name != 'stderr'
        }
        u, v = arrays['u'], arrays['v']
        for name in ('low', 'pitch'):
            if arrays[name].shape != (2,):
                raise LensError(f'{where}.{name} must be two numbers, along u and v')
        if not (arrays['pitch'] > 0).all():
            raise LensError(f'{where}.pitch is {arrays["pitch"].tolist()}; it must be above 0')
        for name in ('u', 'v', 'stderr'):
            values = arrays.get(name, u)
            if values.ndim != 2 or values.shape != u.shape:
                raise LensError(f'{where}.{name} must be rows of numbers, as many as those of u')
        if not all(MIN_NODES <= count <= MAX_NODES for count in u.shape):
            raise LensError(
                f'{where}: {u.shape[0]} rows of {u.shape[1]} nodes; {MIN_NODES} to '
                f'{MAX_NODES} are needed of each'
            )
        if 'stderr' in arrays and (arrays['stderr'] < 0).any():
            raise LensError(f'{where}.stderr has a number below 0')
        return cls(arrays['low'], arrays['pitch'], np.stack([u, v], axis=-1), arrays.get('stderr'))

    @cached_property
    def _padded_values(self) -> Array:
        """Coefficients (rows * columns, 2) with the margin."""
        around = (_MARGIN, _MARGIN)
        return np.pad(self.values, (around, around, (0, 0))).reshape(-1, 2)

    @property
    def _low_with_margin(self) -> Array:
        return np.asarray(self.low - _MARGIN * self.pitch)

    def _basis(self, uv: Array) -> _Basis:
        """Return the B-splines that are not zero at places (..., 2), px."""
        rows, columns = self.values.shape[:2]
        place = (np.reshape(uv, (-1, 2)) - self._low_with_margin) / self.pitch
        last = np.array([columns, rows]) + 2.0 * _MARGIN - 2
        place = np.clip(np.nan_to_num(place, nan=1.0), 1.0, last).T
        first = np.minimum(np.floor(place), last[:, None] - 1).astype(np.int64) - 1
        t = place - first - 1
        left = 1 - t
        value = np.stack([left**3, 3 * t**3 - 6 * t**2 + 4, 3 * left**3 - 6 * left**2 + 4, t**3])
        slope = np.stack([-(left**2), 3 * t**2 - 4 * t, 4 * left - 3 * left**2, t**2])
        return _Basis(first, value / 6, slope / 2 / self.pitch[:, None])

    def _sum(self, basis: _Basis, by_u: Array, by_v: Array) -> Array:
        """Return the sums (n, 2) of coefficients with weights (4, n) along u and along v."""
        width = self.values.shape[1] + 2 * _MARGIN
        start = basis.first[1] * width + basis.first[0]
        total = np.zeros((len(start), 2))
        for j in range(4):
            for i in range(4):
                weight = (by_u[i] * by_v[j])[:, None]
                total += self._padded_values[start + (j * width + i)] * weight
        return total


def _node_weights(count: int) -> Array:
    """Return the weights (count, count) of the coefficients at the nodes of one axis."""
    return (4 * np.eye(count) + np.eye(count, k=1) + np.eye(count, k=-1)) / 6


def _number_array(entry: Mapping[str, Any], name: str, where: str) -> Array:
    """Return a list of numbers, or of rows of them, as an array of finite ones."""
    if name not in entry:
        raise LensError(f'{where}.{name} is missing')
    try:
        array = np.array(entry[name], dtype=float)
    except (TypeError, ValueError, OverflowError) as cause:
        raise LensError(
            f'{where}.{name} must be lists of numbers, as long as each other'
        ) from cause
    if not np.isfinite(array).all():
        raise LensError(f'{where}.{name} holds a number that is not finite')
    return array
