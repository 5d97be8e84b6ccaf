"""Results of the library as files, and their rows as columns."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, Self, get_args, get_origin, get_type_hints

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.io.documents import read_json
from fisheye_svp_ros.io.files import write_json
from fisheye_svp_ros.io.lens_files import lens_from_dict, lens_to_dict
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose

_BRIEF = 60  # characters of a value in a repr
_KIND_KEY = 'result'


class Columns(dict[str, list[Any]]):
    """Rows by column, of plain Python values; pandas.DataFrame and pyarrow.table take it."""

    def __init__(self, columns: Mapping[str, Any]) -> None:
        super().__init__({name: np.asarray(values).tolist() if isinstance(values, np.ndarray)
                          else list(values) for name, values in columns.items()})

    def rows(self) -> Iterator[tuple[Any, ...]]:
        """Yield the rows."""
        return zip(*self.values(), strict=True)

    def save(self, path: str | Path) -> list[Path]:
        """Write PATH.csv and PATH.parquet; return both."""
        from fisheye_svp_ros.io.columns import write_columns

        return write_columns(Path(path), self)

    def __str__(self) -> str:
        cells = [list(self), *([f'{cell:.6g}' if isinstance(cell, float) else str(cell)
                                for cell in row] for row in self.rows())]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        return '\n'.join(
            '  '.join(cell.rjust(width) for cell, width in zip(row, widths, strict=True))
            for row in cells
        )


def _brief(value: Any) -> str:
    """Return an array's shape, a mapping's or list's length, a lens's name, a number as it is."""
    shape = getattr(value, 'shape', None)
    if shape:
        return f'array{shape}'
    if isinstance(value, Mapping | list | tuple) and not hasattr(value, '_fields'):
        return f'{type(value).__name__} of {len(value)}'
    name = getattr(value, 'name', None)
    text = f'{type(value).__name__} {name!r}' if name else repr(value)
    return text if len(text) <= _BRIEF else f'{text[:_BRIEF].splitlines()[0]} ...'


class Result(ABC):
    """A dataclass of arrays, poses, lenses, tables and plain values that is kept as JSON."""

    def __init_subclass__(cls) -> None:
        # Before the dataclass has its own, which prints whole arrays.
        cls.__repr__ = Result.__repr__  # type: ignore[method-assign]

    def __repr__(self) -> str:
        parts = (f'{name}={_brief(value)}' for name, value in vars(self).items())
        return f'{type(self).__name__}({", ".join(parts)})'

    @abstractmethod
    def table(self) -> Columns:
        """Return the rows that a person would look at."""

    def save(self, path: str | Path) -> None:
        """Write a JSON file that `load` reads back; raise OutputError where it cannot."""
        write_json(path, {_KIND_KEY: type(self).__name__, **_to_json(self)})

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read what `save` wrote; raise ObservationError, naming the file, for anything else."""
        document = read_json(path, ObservationError)
        try:
            if document.pop(_KIND_KEY) != cls.__name__:
                raise ValueError(f'it holds another result than {cls.__name__}')
            found: Self = _from_json(document, cls)
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as cause:
            raise ObservationError(f'{path}: not a saved {cls.__name__} ({cause})') from cause
        return found


def _to_json(value: Any) -> Any:
    if isinstance(value, Lens):
        return lens_to_dict(value)
    if isinstance(value, Pose):
        return {name: _to_json(part) for name, part in value._asdict().items()}
    if is_dataclass(value):
        return {field.name: _to_json(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {key: _to_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_to_json(item) for item in value]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def _from_json(value: Any, hint: Any) -> Any:
    """Return what `_plain` made plain, as the annotation of its field has it."""
    kinds = [kind for kind in get_args(hint) if kind is not type(None)]
    if hint in (Array, Index):
        return np.array(value, dtype=float if hint == Array else np.int64)
    if value is None or hint is Any:
        return value
    if hint is Lens:
        return lens_from_dict(value)
    if hint is Pose:
        return Pose(*(np.array(value[name], dtype=float) for name in Pose._fields))
    if isinstance(hint, type) and is_dataclass(hint):
        hints = get_type_hints(hint)
        return hint(**{field.name: _from_json(value[field.name], hints[field.name])
                       for field in fields(hint)})
    if get_origin(hint) is dict:
        return {key: _from_json(item, kinds[1]) for key, item in value.items()}
    if get_origin(hint) is tuple:
        return tuple(value)
    if len(kinds) == 1 and get_origin(hint) is not list:
        return _from_json(value, kinds[0])
    return value
