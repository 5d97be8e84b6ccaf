"""The node graph through a sweep file, recorded and tabulated: the rows of the offline sweep."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from helpers import graph  # noqa: F401 - skips where there is no rclpy
from helpers.nodes import ROOT

from fisheye_svp_ros.cli import main
from fisheye_svp_ros.commands import record
from fisheye_svp_ros.io.bags import Bag
from fisheye_svp_ros.io.columns import plain_columns, read_table
from fisheye_svp_ros.io.recording import NAMESPACE, STAMP, is_tabulated, tabulate

MONO = """
/**:
  ros__parameters:
    sweep.environment: [whole, FEW, inner]
    sweep.radius: [2.0, 0.2]
    sweep.shift_scale: [0.5, 1.0]
    noise_px: 0.4
localizer: {ros__parameters: {sigma_px: 0.4}}
"""
RIG = """
synthetic_camera:
  ros__parameters:
    sweep.style: [parallel, vergent]
    sweep.baseline: [0.1, 0.3]
    radius: 0.5
    noise_px: 0.1
    poses: [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.05, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
stereo_depth: {ros__parameters: {optimal: true}}
"""
# Tilted cameras, near: the error of the SVP model is far above the noise, and no outlier.
SVP = """
synthetic_camera: {ros__parameters: {
  lens: fish214, noise_px: 0.2, radius: 0.5, poses_file: calibration, sweep.seed: [0]}}
localizer: {ros__parameters: {svp: true}}
"""
FEW = 'landmark,x,y,z\n1,0,0,-1\n2,1,0,-1\n3,0,1,-1\n'


@pytest.mark.parametrize(
    ('text', 'scenarios', 'sets'),
    [(MONO, 12, 1), (RIG, 4, 2), (SVP, 1, 10)],
    ids=['camera', 'rig', 'svp'],
)
def test_every_scenario_once_and_with_the_offline_numbers(
    ros_domain: int,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    text: str,
    scenarios: int,
    sets: int,
) -> None:
    monkeypatch.setenv('PYTHONPATH', str(ROOT), prepend=':')
    few = tmp_path / 'few.csv'
    few.write_text(FEW)
    path = tmp_path / 'file.yaml'
    path.write_text(text.replace('FEW', str(few)))
    bars: list[int] = []

    @contextmanager
    def progress(_: str, total: int) -> Iterator[Callable[[int], None]]:
        assert total == scenarios
        yield bars.append

    with monkeypatch.context() as patched:
        patched.setattr('fisheye_svp_ros.reporting.terminal.progress', progress)
        assert main(['record', '--sweep', str(path), '-o', str(tmp_path / 'bag')]) == 0
    assert bars and min(bars) > 0 and sum(bars) <= scenarios
    assert main(['sweep', str(path), '-o', str(tmp_path / 'out')]) == 0
    recorded = plain_columns(tabulate(Bag(tmp_path / 'bag').records(is_tabulated)))
    offline = plain_columns(read_table(tmp_path / 'out' / 'sweep.csv'))
    places = list(zip(recorded['scenario'], recorded['set'], strict=True))
    assert places == [(n, s) for n in range(scenarios) for s in range(sets)]
    notes = {name for name in offline if name.endswith('.note')}
    warnings = {name for name in recorded if '.warning' in name}
    assert set(offline) - notes == set(recorded) - notes - warnings - {NAMESPACE, STAMP}
    for name in set(offline) - notes:
        if isinstance(offline[name][0], float):
            for mine, theirs in zip(offline[name], recorded[name], strict=True):
                assert (mine is None) == (theirs is None)
                assert mine is None or mine == pytest.approx(theirs, abs=1e-9, nan_ok=True)
        else:
            assert offline[name] == recorded[name]
    for name in notes:
        told = recorded.get(name, [None] * len(places))
        assert told == [note or None for note in offline[name]]  # CSV has no None


def test_a_bad_sweep_starts_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / 'file.yaml'
    path.write_text('synthetic_camera: {ros__parameters: {sweep.radios: [1.0]}}')
    assert main(['record', '--sweep', str(path), '-o', str(tmp_path / 'bag')]) == 2
    assert 'no such parameter to sweep' in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ['file.yaml']


def test_a_recorder_takes_ros_arguments() -> None:
    parser = argparse.ArgumentParser()
    record.add_arguments(parser)
    assert parser.parse_args(['-o', 'bag', '--ros-args', '-r', 'a:=b']).ros_args == ['-r', 'a:=b']
    assert parser.parse_args(['-o', 'bag']).ros_args == []
