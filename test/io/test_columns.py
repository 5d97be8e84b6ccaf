"""Tables for scripts, whole and damaged."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from fisheye_svp_ros.errors import OutputError
from fisheye_svp_ros.io.columns import arrow, make_table, plain_columns, read_table, write_table
from fisheye_svp_ros.io.recording import parse_cells

COLUMNS = {'n': list(range(50)), 'x': [0.1 * i for i in range(50)], 'name': ['a', None] * 25}


def test_a_flipped_bit_of_a_parquet_table_never_changes_a_cell(tmp_path: Path) -> None:
    if arrow()[0] is None:
        pytest.skip('pyarrow is not usable')
    *_, path = write_table(tmp_path / 'table', make_table(COLUMNS))
    good, rng = path.read_bytes(), np.random.default_rng(3)
    assert plain_columns(read_table(path)) == COLUMNS
    refused = 0
    for place in rng.choice(8 * len(good), 300, replace=False).tolist():
        bad = bytearray(good)
        bad[place // 8] ^= 1 << place % 8
        path.write_bytes(bad)
        try:
            found = plain_columns(read_table(path))
        except OutputError as error:
            refused += 1
            assert str(error).startswith(f'{path}: not a table (')
        else:
            assert found == COLUMNS, place
    assert refused > 30


def test_a_changed_name_of_a_parquet_column_is_refused(tmp_path: Path) -> None:
    if arrow()[0] is None:
        pytest.skip('pyarrow is not usable')
    *_, path = write_table(tmp_path / 'table', make_table({'localizer.rms_px': [0.1, 0.2]}))
    good, refused = path.read_bytes(), 0
    for copy in re.finditer(
        b'localizer.rms_px', good
    ):  # which of them is read, versions differ in
        path.write_bytes(good[: copy.start()] + b'X' + good[copy.start() + 1 :])
        try:
            assert [*read_table(path).columns] == ['localizer.rms_px']
        except OutputError as why:
            assert re.search(r"not a table \(column '.*_px' was written as '", str(why))
            refused += 1
    assert refused >= 2  # the name, and what it is held against


def test_other_columns_than_numbers_and_text_are_refused(tmp_path: Path) -> None:
    pyarrow = arrow()[0]
    if pyarrow is None:
        pytest.skip('pyarrow is not usable')
    for cells, kind in (
        (pyarrow.array([[1, 2]]), 'list'),
        (pyarrow.array([1], pyarrow.duration('s')), 'duration'),  # a flipped bit makes it of 1
    ):
        pyarrow.parquet.write_table(pyarrow.table({'a': cells}), tmp_path / 'a.parquet')
        with pytest.raises(OutputError, match=f'a column of {kind}'):
            read_table(tmp_path / 'a.parquet')


def test_cells_are_numbers_where_all_are() -> None:
    assert parse_cells(['1', '', None, '-3']) == [1, None, None, -3]
    assert parse_cells(['1', '2.5', 'nan'])[:2] == [1.0, 2.5]
    long = '9' * 5000
    assert parse_cells(['1', long]) == [1.0, float('inf')]
    assert parse_cells(['1_000', '2']) == ['1_000', '2']


def test_an_empty_table_is_said_to_be_one(tmp_path: Path) -> None:
    (tmp_path / 'a.csv').touch()
    with pytest.raises(OutputError, match='not a table'):
        read_table(tmp_path / 'a.csv')


@pytest.mark.parametrize(
    ('text', 'reason'),
    [
        ('a,b,a\n1,2,3\n', "two columns are named 'a'; rename one"),
        ('a,b\n1,2\n3\n', 'line 3 has 1 cells, the header 2; write it again'),
        ('a,b\n1,2,3\n', 'line 2 has 3 cells, the header 2; write it again'),
    ],
)
def test_columns_of_one_name_and_rows_of_another_length_are_refused(
    text: str, reason: str, tmp_path: Path
) -> None:
    (tmp_path / 'a.csv').write_text(text)
    with pytest.raises(OutputError) as told:
        read_table(tmp_path / 'a.csv')
    assert str(told.value) == f'{tmp_path}/a.csv: not a table ({reason})'


def test_a_table_reads_back_as_it_was(tmp_path: Path) -> None:
    table = make_table(
        {
            'whole': [1, None, 2**53 + 1],
            'number': [0.1 + 0.2, None, 1e-300],
            'text': ['NA', None, 'a,"b"'],
            'empty': [None] * 3,
        }
    )
    for path in write_table(tmp_path / 'table', table):
        found = plain_columns(read_table(path))
        assert found['number'] == [0.1 + 0.2, None, 1e-300]
        assert found['text'] == ['NA', None, 'a,"b"'] and found['empty'] == [None] * 3
    assert (tmp_path / 'table.csv').read_text().splitlines()[1] == '1,0.30000000000000004,NA,'
    assert list(read_table(tmp_path / 'table.csv', lambda name: name == 'text')) == ['text']


def test_a_column_is_text_as_a_whole_or_not_at_all(tmp_path: Path) -> None:
    rows = 200_000
    (tmp_path / 'a.csv').write_text('a,b\n' + '1,2\n' * rows + 'x,2\n')
    table = read_table(tmp_path / 'a.csv')
    assert set(table['a']) == {'1', 'x'} and table['b'].sum() == 2 * (rows + 1)
