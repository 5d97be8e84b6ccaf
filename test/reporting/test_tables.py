"""Tables for people."""

from __future__ import annotations

import pytest

from fisheye_svp_ros.reporting.terminal import interval, print_table, short_number, with_error


@pytest.mark.parametrize('count', [8, 30])
@pytest.mark.parametrize('columns', ['40', '120'])
def test_numbers_are_never_cut(
    columns: str, count: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv('COLUMNS', columns)
    monkeypatch.setattr('sys.stdout.isatty', lambda: True, raising=False)
    header = [f'quantity {i}' for i in range(count)]
    print_table('title', header, [[f'-123456.{i:04}' for i in range(count)]])
    printed = capsys.readouterr().out
    for cell in (*header, *(f'-123456.{i:04}' for i in range(count))):
        assert cell in printed
    assert '…' not in printed


def test_an_interval_has_two_digits_of_its_width() -> None:
    assert interval(355.937, 358.911) == '355.94 … 358.91'
    assert interval(-0.00022, 0.0003) == '-0.000220 … 0.000300'


def test_what_is_rounded_to_zero_has_no_sign() -> None:
    """Intrinsics were told as "-0.0000 ± 0.0024"."""
    assert with_error(-0.00004, 0.0024) == ('0.0000', '0.0024')
    assert with_error(-0.0004, 0.0024) == ('-0.0004', '0.0024')


def test_digits_are_those_that_the_error_leaves() -> None:
    """A table had 367480.6 ± 58114.9."""
    assert with_error(367480.6, 58114.9) == ('367000', '58000')
    assert with_error(367480.6, 81.2) == ('367481', '81')


@pytest.mark.parametrize(
    ('value', 'text'),
    [
        (1.66354e-14, '0'),
        (0.0, '0'),
        (-0.00123456, '-0.001235'),
        (12.34567, '12.35'),
        (4096.0, '4096'),
        (123456.7, '123457'),
        (float('nan'), 'nan'),
        (float('inf'), 'inf'),
    ],
)
def test_numbers_for_people_are_short(value: float, text: str) -> None:
    """The table of a sweep had 1.66354e-14."""
    assert short_number(value) == text
