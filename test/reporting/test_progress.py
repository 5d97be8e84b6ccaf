"""Progress where standard error is no terminal."""

from __future__ import annotations

import pytest

from fisheye_svp_ros.reporting import terminal


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch, no_progress: None) -> list[float]:
    """Return the time that the progress sees, as its only element; have it print lines."""
    now = [0.0]
    monkeypatch.setattr(terminal, '_INTERVAL', 5.0)
    monkeypatch.setattr(terminal.time, 'monotonic', lambda: now[0])
    return now


def test_long_work_prints_a_line_every_few_seconds(
    clock: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    with terminal.stages('diagnosis') as update:
        for second in range(13):
            clock[0] = float(second)
            update(f'stage {second // 6}', second / 20)
    assert capsys.readouterr().err == 'diagnosis: stage 0 (25%)\ndiagnosis: stage 1 (50%)\n'


def test_short_work_prints_nothing(clock: list[float], capsys: pytest.CaptureFixture[str]) -> None:
    with terminal.progress('sweep', 10) as advance:
        for second in range(5):
            clock[0] = float(second)
            advance()
    assert capsys.readouterr().err == ''


def test_steps_are_counted_without_a_total_too(
    clock: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    with terminal.progress('calibrating') as advance:
        clock[0] = 6.0
        advance(3)
    with terminal.progress('sweep', 10) as advance:
        advance(4)
        clock[0] = 12.0
        advance()
    assert capsys.readouterr().err == 'calibrating\nsweep (50%)\n'
