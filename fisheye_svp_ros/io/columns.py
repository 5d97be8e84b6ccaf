"""Tables for scripts: pandas frames as CSV, and as Parquet where pyarrow is; whole or in parts.

An empty cell is a missing value.  pandas is imported where a table is made: that takes longer
than most commands need to start.
"""

from __future__ import annotations

import csv
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import cache
from importlib import import_module
from io import BytesIO, TextIOWrapper
from itertools import zip_longest
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from fisheye_svp_ros.errors import OutputError
from fisheye_svp_ros.io.files import open_bytes, read_bytes, replacing

if TYPE_CHECKING:
    from pandas import DataFrame, Series

_ROWS = 1 << 16  # of a row group
_BLOCK_BYTES = 1 << 20  # bytes
_MOST_CELLS = 100_000_000
_NAMES = b'columns'  # in the metadata of Parquet: no checksum holds for the names themselves
_MIN_PYARROW = 15  # of pyarrow: from there on pages have checksums
_KINDS: Mapping[type, Any] = {int: np.int64, float: np.float64, str: object}
_EXACT_BY_DEFAULT = (3, 1)  # pandas, from where on numbers read back to the same bits


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


def make_table(columns: Mapping[str, Sequence[Any]]) -> DataFrame:
    """Return columns of plain values, None where nothing is known, as a table."""
    from pandas import DataFrame

    return DataFrame({name: _series(cells) for name, cells in columns.items()})


def _series(cells: Sequence[Any]) -> Series:
    """Return cells as whole numbers, as numbers, or as what they are."""
    from pandas import Series

    kinds = {type(cell) for cell in cells} - {type(None)}
    if kinds == {int} and all(abs(cell or 0) < 2**63 for cell in cells):
        return Series(cells, dtype='Int64' if None in cells else np.int64)
    return Series(cells, dtype=np.float64 if kinds and kinds <= {int, float} else object)


def plain_columns(table: DataFrame) -> dict[str, list[Any]]:
    """Return the columns of a table as lists of plain values, None where nothing is known."""
    return {
        str(name): [
            None if missing else cell
            for cell, missing in zip(column.tolist(), column.isna(), strict=True)
        ]
        for name, column in table.items()
    }


def write_table(path: Path, table: DataFrame) -> list[Path]:
    """Write a table to `path`.csv and `path`.parquet.

    Numbers in the CSV read back to the same bits; there is no Parquet file where `arrow` says so.
    Returns the files; raises OutputError where one cannot be written.
    """
    with _writing(path) as (text, write_parquet, files):
        _to_csv(table, text)
        write_parquet(table)
    return files


class TableParts:
    """A table that grows part by part in a folder, each written whole; a part has a number.

    types: of the columns.  What a kill leaves behind is whole parts and nothing else.
    """

    def __init__(self, folder: Path, types: Mapping[str, type]) -> None:
        self.folder = folder
        self._types = types

    def numbers(self) -> set[int]:
        """Return which parts are there."""
        return {int(path.stem) for path in self.folder.glob('[0-9]*.csv')}

    def write(self, number: int, table: DataFrame) -> None:
        """Write a part; raise OutputError where that is impossible."""
        with replacing(self._path(number)) as path, path.open('wb') as stream:
            _to_csv(table, stream)

    def join(
        self,
        path: Path,
        is_whole: Callable[[int, DataFrame], bool] = lambda *_: True,
        take: Callable[[DataFrame], None] = lambda _: None,
    ) -> None:
        """Write all parts in order as `write_table` does; no more than one of them is held.

        is_whole: asked of each part, by its number, whether it holds all its rows; take: given
        each part.  Raises OutputError for a bad part.
        """
        with _writing(path) as (text, write_parquet, _):
            for number in sorted(self.numbers()):
                data = read_bytes(self._path(number), OutputError)
                part = self._parse(number, data, is_whole)
                text.write(data[data.index(b'\n') + 1 :] if text.tell() else data)
                write_parquet(part)
                take(part)

    def _parse(
        self, number: int, data: bytes, is_whole: Callable[[int, DataFrame], bool]
    ) -> DataFrame:
        kinds = {name: _KINDS[kind] for name, kind in self._types.items()}
        try:
            part = _read_csv(BytesIO(data), dtype=kinds)
            if [*part] != [*kinds] or not data.endswith(b'\n'):
                raise ValueError('it is cut off, or its columns differ')
            for name, kind in kinds.items():
                if part[name].dtype != kind:  # what pandas 2 makes of a number above 2^63
                    raise ValueError(f'{name} holds a number out of range')
            if not is_whole(number, part):
                raise ValueError('rows are missing')
        except Exception as cause:  # whatever pandas makes of what is damaged
            raise OutputError(
                f'{self._path(number)}: a part of the table is damaged ({_first_line(cause)}); '
                'remove it and compute it again'
            ) from cause
        return part

    def _path(self, number: int) -> Path:
        return self.folder / f'{number:09}.csv'


def read_table(path: Path, wanted: Callable[[str], bool] = lambda _: True) -> DataFrame:
    """Return the wanted columns of a CSV or Parquet table; raise OutputError."""
    pyarrow, problem = arrow()
    if path.suffix != '.csv' and pyarrow is None:
        raise OutputError(f'{path}: {problem}; give the .csv file next to it')
    with open_bytes(path, OutputError) as stream:
        try:
            if path.suffix == '.csv':
                _check_row_lengths(stream)
                return _read_in_pieces(stream, wanted)
            return _read_parquet(pyarrow, stream, wanted)
        except Exception as cause:  # whatever pandas or pyarrow makes of what is damaged
            raise OutputError(f'{path}: not a table ({_first_line(cause)})') from cause


def _read_csv(stream: IO[bytes], **options: Any) -> DataFrame:
    """Read numbers to the same bits; a text is what it says, be it "NA"."""
    import pandas

    if tuple(map(int, pandas.__version__.split('.')[:2])) < _EXACT_BY_DEFAULT:
        options['float_precision'] = 'round_trip'
    return pandas.read_csv(stream, keep_default_na=False, na_values=[''], **options)


def _check_row_lengths(stream: IO[bytes]) -> None:
    """Raise ValueError for what pandas passes over: columns of one name, rows of other lengths."""
    text = TextIOWrapper(stream, encoding='utf-8', newline='')
    header = next(csv.reader(text), [])
    if twice := [name for name in header if header.count(name) > 1]:
        raise ValueError(f'two columns are named {twice[0]!r}; rename one')
    text.seek(0)
    if not _has_even_rows(stream, len(header)):
        text.seek(0)
        reader = csv.reader(text)
        for row in reader:
            if row and len(row) != len(header):
                raise ValueError(
                    f'line {reader.line_num} has {len(row)} cells, the header {len(header)}; '
                    'write it again'
                )
    text.detach().seek(0)


def _has_even_rows(stream: IO[bytes], columns: int) -> bool:
    """Say whether commas and lines are as many as they should be, in a tenth of the time."""
    commas = lines = 0
    while block := stream.read(_BLOCK_BYTES):
        if b'"' in block:
            return False
        commas, lines = commas + block.count(b','), lines + block.count(b'\n')
    return commas == (columns - 1) * lines


def _read_in_pieces(stream: IO[bytes], wanted: Callable[[str], bool]) -> DataFrame:
    """Read a CSV piece by piece; as one, where a column is numbers here and text there."""
    from pandas.errors import DtypeWarning

    with warnings.catch_warnings():
        warnings.simplefilter('error', DtypeWarning)
        try:
            return _read_csv(stream, usecols=wanted)
        except DtypeWarning:
            stream.seek(0)
            return _read_csv(stream, usecols=wanted, low_memory=False)


def _first_line(cause: Exception) -> str:
    return (str(cause) or type(cause).__name__).splitlines()[0]


def _read_parquet(pyarrow: Any, stream: IO[bytes], wanted: Callable[[str], bool]) -> DataFrame:
    file = pyarrow.parquet.ParquetFile(stream, page_checksum_verification=True)
    about, schema = file.metadata, file.schema_arrow
    if about.num_rows * about.num_columns > _MOST_CELLS:
        raise ValueError(f'more than {_MOST_CELLS} cells')
    kinds = pyarrow.types
    for field in schema:
        if any(is_(field.type) for is_ in (kinds.is_nested, kinds.is_binary, kinds.is_duration)):
            raise ValueError(f'a column of {field.type}; numbers and text are read')
    names = ', '.join(schema.names)
    written = (about.metadata or {}).get(_NAMES, names.encode()).decode(errors='replace')
    if names != written:
        name_pairs = zip_longest(schema.names, written.split(', '))
        now, before = next(pair for pair in name_pairs if len({*pair}) > 1)
        raise ValueError(f'column {now!r} was written as {before!r}; write the table again')
    table = file.read([name for name in schema.names if wanted(name)])
    if {table.num_rows, sum(about.row_group(i).num_rows for i in range(about.num_row_groups))} != {
        about.num_rows
    }:
        raise ValueError('its columns differ in length from what was written')
    return table.to_pandas()


def _to_csv(table: DataFrame, stream: IO[bytes]) -> None:
    table.to_csv(stream, index=False, lineterminator='\n')


@contextmanager
def _writing(path: Path) -> Iterator[tuple[IO[bytes], Callable[[DataFrame], None], list[Path]]]:
    """Yield the stream of a CSV, what takes tables for the Parquet file, and both files."""
    files = [path.with_name(f'{path.name}.csv'), path.with_name(f'{path.name}.parquet')]
    pyarrow, _ = arrow()
    with ExitStack() as stack:
        stream = stack.enter_context(stack.enter_context(replacing(files[0])).open('wb'))
        if pyarrow is None:
            yield stream, lambda _: None, files[:1]
        else:
            target = stack.enter_context(replacing(files[1]))
            yield stream, stack.enter_context(_parquet(pyarrow, target)), files


@contextmanager
def _parquet(pyarrow: Any, path: Path) -> Iterator[Callable[[DataFrame], None]]:
    """Write row groups of a fixed size, so that a table does not show how it was made."""
    pending: list[Any] = []
    writer = None

    def add(table: DataFrame) -> None:
        nonlocal pending, writer
        schema = pending[0].schema if pending else None
        pending.append(_arrow_table(pyarrow, table, schema))
        if writer is None:
            writer = pyarrow.parquet.ParquetWriter(
                path, pending[0].schema, write_page_checksum=True
            )
        if sum(map(len, pending)) >= _ROWS:
            joined = pyarrow.concat_tables(pending)
            whole = len(joined) // _ROWS * _ROWS
            writer.write_table(joined.slice(0, whole), row_group_size=_ROWS)
            pending = [joined.slice(whole)]

    yield add
    if writer is not None:
        with writer:
            writer.write_table(pyarrow.concat_tables(pending))


def _arrow_table(pyarrow: Any, table: DataFrame, schema: Any) -> Any:
    """Return a table of numbers and text: text also where no cell of a column has any."""
    if schema is None:
        fields = pyarrow.Schema.from_pandas(table, preserve_index=False)
        kinds = (
            pyarrow.string() if _is_text(pyarrow, field.type) else field.type for field in fields
        )
        schema = pyarrow.schema(zip(fields.names, kinds, strict=True))
    converted = pyarrow.Table.from_pandas(table, schema, preserve_index=False)
    return converted.replace_schema_metadata({_NAMES: ', '.join(schema.names)})


def _is_text(pyarrow: Any, kind: Any) -> bool:
    return bool(pyarrow.types.is_null(kind) or pyarrow.types.is_large_string(kind))
