"""Tables for scripts: columns as CSV and Parquet."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
from pyarrow import parquet

from fisheye_svp_ros.files import replacing, write_text


def write_columns(path: Path, columns: Mapping[str, Sequence[Any]]) -> list[Path]:
    """Write columns of equal length to `path`.csv and `path`.parquet; None is an empty cell.

    Numbers in the CSV read back to the same bits.  Returns the files; raises OutputError where
    one cannot be written.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator='\n')
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    files = [path.with_name(f'{path.name}.csv'), path.with_name(f'{path.name}.parquet')]
    write_text(files[0], text.getvalue())
    with replacing(files[1]) as temporary:
        parquet.write_table(pa.table(dict(columns)), temporary)
    return files
