"""Tables for people."""

from __future__ import annotations

import pytest

from fisheye_svp_ros.reporting.tables import print_table


@pytest.mark.parametrize('columns', ['40', '120'])
def test_numbers_are_never_cut(
    columns: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv('COLUMNS', columns)
    monkeypatch.setattr('sys.stdout.isatty', lambda: True, raising=False)
    header = [f'quantity {i}' for i in range(8)]
    print_table('title', header, [[f'-123456.{i:04}' for i in range(8)]])
    printed = capsys.readouterr().out
    for cell in (*header, *(f'-123456.{i:04}' for i in range(8))):
        assert cell in printed
    assert '…' not in printed
