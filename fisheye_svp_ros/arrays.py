"""The array types that the core takes and returns, and named tuples of arrays with equal rows."""

from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]


def scatter(where: Mask, values: Array) -> Array:
    """Return values (M, ...) at the M true places of a mask (...), NaN at the others."""
    whole = np.full((*where.shape, *values.shape[1:]), np.nan)
    whole[where] = values
    return whole


def gather_rows(parts: Sequence[tuple[Index, Array]]) -> Array:
    """Return one array of the rows of all parts, each with the places (M,) that they go to."""
    if len(parts) == 1:
        return parts[0][1]
    first = parts[0][1]
    whole = np.empty((sum(len(rows) for rows, _ in parts), *first.shape[1:]), first.dtype)
    for rows, values in parts:
        whole[rows] = values
    return whole


def symmetric_root(covariance: Array) -> Array:
    """Return the symmetric root (n, n) of a covariance, whose negative eigenvalues count as zero.

    What is drawn by it moves as little as the covariance does.  The signs of eigenvectors, and
    their directions where eigenvalues are alike, are those of the last digits.
    """
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def flat_rows(columns: Array) -> Array:
    """Return columns (..., P) as (rows, P), also where P is 0."""
    return columns.reshape(int(np.prod(columns.shape[:-1])), columns.shape[-1])


class Batch:
    """Methods of a named tuple whose fields, arrays or batches, share their leading axes.

    A field may be None, of all rows alike.
    """

    __slots__ = ()

    def take(self, index: Any) -> Self:
        """Return what stands at `index` of the leading axes."""
        return self._from_fields(
            part if part is None else part.take(index) if isinstance(part, Batch) else part[index]
            for part in self._fields_tuple()
        )

    def put(self, index: Any, other: Self) -> None:
        """Write `other` to the places `index` of the leading axes."""
        for mine, new in zip(self._fields_tuple(), other._fields_tuple(), strict=True):
            if isinstance(mine, Batch):
                mine.put(index, new)
            elif mine is not None:
                mine[index] = new

    @classmethod
    def stack(cls, parts: Sequence[Self]) -> Self:
        """Join batches of one shape along a new first axis."""
        return cls._join_fields(np.stack, parts)

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """Join batches along their first axis."""
        return cls._join_fields(np.concatenate, parts)

    @classmethod
    def _join_fields(cls, join: Any, parts: Sequence[Self]) -> Self:
        return cls._from_fields(
            fields[0]
            if fields[0] is None
            else fields[0]._join_fields(join, fields)
            if isinstance(fields[0], Batch)
            else join(fields)
            for fields in zip(*(part._fields_tuple() for part in parts), strict=True)
        )

    @classmethod
    def _from_fields(cls, parts: Any) -> Self:
        kind: Any = cls
        made: Self = kind._make(parts)
        return made

    def _fields_tuple(self) -> tuple[Any, ...]:
        assert isinstance(self, tuple)
        return self
