"""Tables for scripts: columns as CSV and Parquet, whole or part by part."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.errors import OutputError
from fisheye_svp_ros.io.files import replacing

_TYPES = {int: pa.int64(), float: pa.float64(), str: pa.string()}
_ROWS = 1 << 16  # of a row group


def write_columns(path: Path, columns: Mapping[str, Sequence[Any]]) -> list[Path]:
    """Write columns of equal length to `path`.csv and `path`.parquet; None is an empty cell.

    Numbers in the CSV read back to the same bits.  Returns the files; raises OutputError where
    one cannot be written.
    """
    table = pa.table(dict(columns))
    return _write(path, table.schema, [table])


class Parts:
    """A table that grows part by part in a folder, each written whole; a part has a number.

    types: of the columns.  What a kill leaves behind is whole parts and nothing else.
    """

    def __init__(self, folder: Path, types: Mapping[str, type]) -> None:
        self.folder = folder
        self._schema = pa.schema([(name, _TYPES[kind]) for name, kind in types.items()])

    def numbers(self) -> set[int]:
        """Return which parts are there."""
        return {int(path.stem) for path in self.folder.glob('[0-9]*.parquet')}

    def write(self, number: int, columns: Mapping[str, Sequence[Any]]) -> None:
        """Write a part; raise OutputError where that is impossible."""
        table = pa.table(dict(columns), schema=self._schema)
        with replacing(self._path(number)) as temporary:
            parquet.write_table(table, temporary)

    def join(self, path: Path) -> list[Path]:
        """Write all parts, in the order of their numbers, as `write_columns` does."""
        tables = (parquet.read_table(self._path(n), schema=self._schema)
                  for n in sorted(self.numbers()))
        return _write(path, self._schema, tables)

    def _path(self, number: int) -> Path:
        return self.folder / f'{number:09}.parquet'


def read_column(path: Path, name: str) -> Array:
    """Return one column of numbers (N,) of a Parquet table, NaN = empty."""
    column = parquet.read_table(path, columns=[name]).column(0)
    return np.asarray(column.to_numpy(), dtype=float)


def read_columns(path: Path) -> dict[str, list[Any]]:
    """Return the columns of a CSV or Parquet table; an empty cell is None.

    Raises OutputError for a file that is no such table.
    """
    from pyarrow import csv as arrow_csv

    options = arrow_csv.ConvertOptions(strings_can_be_null=False)
    try:
        if path.suffix == '.csv':
            table = arrow_csv.read_csv(path, convert_options=options)
        else:
            table = parquet.read_table(path)
    except (OSError, pa.ArrowException) as cause:
        raise OutputError(f'{path}: not a table ({str(cause).splitlines()[0]})') from cause
    columns: dict[str, list[Any]] = table.to_pydict()
    return columns


def _write(path: Path, schema: pa.Schema, tables: Iterable[pa.Table]) -> list[Path]:
    files = [path.with_name(f'{path.name}.csv'), path.with_name(f'{path.name}.parquet')]
    with (
        replacing(files[0]) as text, replacing(files[1]) as binary,
        text.open('w', encoding='utf-8', newline='') as stream,
        parquet.ParquetWriter(binary, schema) as writer,
    ):
        lines = csv.writer(stream, lineterminator='\n')
        lines.writerow(schema.names)
        pending: list[pa.Table] = []
        for table in tables:
            lines.writerows(zip(*table.to_pydict().values(), strict=True))
            pending.append(table)
            # Row groups of a fixed size, so that a table does not show how it was made.
            if sum(map(len, pending)) >= _ROWS:
                pending = [_grouped(writer, pending)]
        if pending:
            writer.write_table(pa.concat_tables(pending))
    return files


def _grouped(writer: parquet.ParquetWriter, tables: Sequence[pa.Table]) -> pa.Table:
    """Write whole row groups; return the rest."""
    table = pa.concat_tables(tables)
    whole = len(table) // _ROWS * _ROWS
    writer.write_table(table.slice(0, whole), row_group_size=_ROWS)
    return table.slice(whole)
