"""Tables for scripts: columns as CSV, and as Parquet where pyarrow is there; whole or in parts."""

from __future__ import annotations

import csv
import json
import re
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.errors import ObservationError, OutputError
from fisheye_svp_ros.io.csv_files import CsvTable
from fisheye_svp_ros.io.files import read_bytes, read_json, replacing, write_text

_ROWS = 1 << 16  # of a row group
_MOST_CELLS = 100_000_000
_MIN_PYARROW = 15  # of pyarrow: from there on pages have checksums
_MAX_INTEGER = 2**63 - 1  # whole number of a Parquet table
_NAMES = b'fisheye_svp_ros: CRC of the names'  # the foot of a Parquet file has no checksum

_INTEGER = re.compile(r'[+-]?[0-9]{1,18}')
_NUMBER = re.compile(r'[+-]?(([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?|nan|inf)', re.IGNORECASE)

Columns = Mapping[str, Sequence[Any]]


@cache
def arrow() -> tuple[Any, str]:
    """Return pyarrow, or None and in one line why it cannot be had."""
    try:
        pyarrow = import_module('pyarrow')
        import_module('pyarrow.parquet')
        if int(pyarrow.__version__.partition('.')[0]) < _MIN_PYARROW:
            raise ImportError(f'{pyarrow.__version__} is older than {_MIN_PYARROW}')
    except Exception as cause:  # beside an older NumPy it ends in more than one way
        return None, f'only CSV, no Parquet file: pyarrow is not usable ({cause})'
    return pyarrow, ''


def write_columns(path: Path, columns: Columns) -> list[Path]:
    """Write columns of equal length to `path`.csv and `path`.parquet; None is an empty cell.

    Numbers in the CSV read back to the same bits; there is no Parquet file where `arrow` says so.
    Returns the files; raises OutputError where one cannot be written.
    """
    return _write(path, list(columns), None, [columns])


class TableParts:
    """A table that grows part by part in a folder, each written whole; a part has a number.

    types: of the columns.  What a kill leaves behind is whole parts and nothing else.
    """

    def __init__(self, folder: Path, types: Mapping[str, type]) -> None:
        self.folder = folder
        self._types = types

    def numbers(self) -> set[int]:
        """Return which parts are there."""
        return {int(path.stem) for path in self.folder.glob('[0-9]*.json')}

    def write(self, number: int, columns: Columns) -> None:
        """Write a part; raise OutputError where that is impossible."""
        write_text(
            self._path(number),
            json.dumps(
                {name: list(columns[name]) for name in self._types}, default=np.generic.item
            ),
        )

    def join(self, path: Path, numbers: Sequence[str] = ()) -> dict[str, Array]:
        """Write all parts in order as `write_columns` does; return some columns, NaN = empty.

        No more than one part is held, and those columns (N,).  Raises OutputError for a bad part.
        """
        kept: dict[str, list[Array]] = {name: [] for name in numbers}

        def parts() -> Iterator[Columns]:
            for number in sorted(self.numbers()):
                part = self._read(number)
                for name, found in kept.items():
                    found.append(np.array(part[name], dtype=float))
                yield part

        _write(path, list(self._types), self._types, parts())
        return {name: np.concatenate([*found, np.empty(0)]) for name, found in kept.items()}

    def _read(self, number: int) -> Columns:
        path = self._path(number)
        try:
            part: dict[str, list[Any]] = read_json(path, OutputError)
            if {*part} != {*self._types} or len({*map(len, part.values())}) != 1:
                raise ValueError('its columns differ')
            for name, kind in self._types.items():
                if not all(type(cell) in (kind, type(None)) for cell in part[name]):
                    raise ValueError(f'{name} holds other values than {kind.__name__}')
                if kind is int and any(abs(cell or 0) > _MAX_INTEGER for cell in part[name]):
                    raise ValueError(f'{name} holds a number above {_MAX_INTEGER}')
        except (OutputError, ValueError, TypeError) as cause:
            raise OutputError(
                f'{path}: a part of the table is damaged ({cause}); remove it and compute it again'
            ) from cause
        return part

    def _path(self, number: int) -> Path:
        return self.folder / f'{number:09}.json'


def _checksum(names: Sequence[str]) -> bytes:
    return b'%08x' % zlib.crc32('\0'.join(names).encode())


def read_columns(path: Path) -> dict[str, list[Any]]:
    """Return the columns of a CSV or Parquet table, None = empty cell; raise OutputError."""
    if path.suffix == '.csv':
        try:
            return {name: parse_cells(cells) for name, cells in CsvTable(path, ()).items()}
        except ObservationError as cause:
            raise OutputError(str(cause)) from cause
    pyarrow, problem = arrow()
    if pyarrow is None:
        raise OutputError(f'{path}: {problem}; give the .csv file next to it')
    data = read_bytes(path, OutputError)
    try:
        file = pyarrow.parquet.ParquetFile(
            pyarrow.BufferReader(data), page_checksum_verification=True
        )
        about, names = file.metadata, file.schema_arrow.names
        if about.num_rows * about.num_columns > _MOST_CELLS:
            raise ValueError(f'more than {_MOST_CELLS} cells')
        if (about.metadata or {}).get(_NAMES, _checksum(names)) != _checksum(names):
            raise ValueError('the names of its columns are not those that were written')
        columns = {name: _to_python(pyarrow, file.read([name]).column(name)) for name in names}
        rows = sum(about.row_group(i).num_rows for i in range(about.num_row_groups))
        if {about.num_rows, rows, *map(len, columns.values())} != {rows}:
            raise ValueError('its columns differ in length from what was written')
        return columns
    except Exception as cause:  # whatever pyarrow makes of what is damaged
        raise OutputError(f'{path}: not a table ({cause or type(cause).__name__})') from cause


def _to_python(pyarrow: Any, column: Any) -> list[Any]:
    """Return a column of numbers or text; None is an empty cell."""
    kinds = pyarrow.types
    if not any(
        test(column.type)
        for test in (
            kinds.is_integer,
            kinds.is_floating,
            kinds.is_string,
            kinds.is_large_string,
            kinds.is_boolean,
            kinds.is_null,
        )
    ):
        raise ValueError(f'a column of {column.type}; numbers and text are read')
    cells: list[Any] = column.to_pylist()
    return cells


def parse_cells(cells: Sequence[str | None]) -> list[Any]:
    """Return whole numbers or numbers where every cell is one or empty; the text otherwise."""
    for kind, form in ((int, _INTEGER), (float, _NUMBER)):
        if all(not cell or form.fullmatch(cell) for cell in cells):
            return [kind(cell) if cell else None for cell in cells]
    return list(cells)


def _write(
    path: Path, names: Sequence[str], types: Mapping[str, type] | None, parts: Iterable[Columns]
) -> list[Path]:
    files = [path.with_name(f'{path.name}.csv'), path.with_name(f'{path.name}.parquet')]
    pyarrow, _ = arrow()
    with ExitStack() as stack:
        text = stack.enter_context(replacing(files[0]))
        stream = stack.enter_context(text.open('w', encoding='utf-8', newline=''))
        lines = csv.writer(stream, lineterminator='\n')
        lines.writerow(names)
        parts = _to_csv(lines, names, parts)
        if pyarrow is None:
            for _ in parts:
                pass
            return files[:1]
        _to_parquet(pyarrow, stack.enter_context(replacing(files[1])), types, parts)
    return files


def _to_csv(lines: Any, names: Sequence[str], parts: Iterable[Columns]) -> Iterator[Columns]:
    """Write parts as they pass."""
    for part in parts:
        lines.writerows(zip(*(part[name] for name in names), strict=True))
        yield part


def _to_parquet(
    pyarrow: Any, path: Path, types: Mapping[str, type] | None, parts: Iterable[Columns]
) -> None:
    """Write row groups of a fixed size, so that a table does not show how it was made."""
    kinds = {int: pyarrow.int64(), float: pyarrow.float64(), str: pyarrow.string()}
    schema = pyarrow.schema([(n, kinds[t]) for n, t in types.items()]) if types else None
    pending: list[Any] = []
    writer = None
    for part in parts:
        pending.append(pyarrow.table(dict(part), schema=schema))
        if writer is None:
            names = pending[0].schema.names
            schema = pending[0].schema.with_metadata({_NAMES: _checksum(names)})
            writer = pyarrow.parquet.ParquetWriter(path, schema, write_page_checksum=True)
        if sum(map(len, pending)) >= _ROWS:
            table = pyarrow.concat_tables(pending)
            whole = len(table) // _ROWS * _ROWS
            writer.write_table(table.slice(0, whole), row_group_size=_ROWS)
            pending = [table.slice(whole)]
    writer = writer or pyarrow.parquet.ParquetWriter(path, schema)
    with writer:
        if pending:
            writer.write_table(pyarrow.concat_tables(pending))
