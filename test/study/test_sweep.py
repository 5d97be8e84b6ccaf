"""Offline sweeps: the same numbers as one by one, whoever works on them and whatever happens."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path
from threading import Timer
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pandas as pd
import pytest
from helpers.commands import refused
from helpers.nodes import ROOT, until

from fisheye_svp_ros.cli import main
from fisheye_svp_ros.commands.executors import completed_tasks, dask
from fisheye_svp_ros.commands.node_sweeps import read_sweep
from fisheye_svp_ros.commands.sweep import _sole_writer
from fisheye_svp_ros.errors import OutputError, ParameterError, SweepError
from fisheye_svp_ros.io import columns as tables
from fisheye_svp_ros.io.columns import plain_columns, read_table
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.io.parameters import with_values
from fisheye_svp_ros.optics import engines
from fisheye_svp_ros.scene.observations import views_of
from fisheye_svp_ros.simulate.scenario import Scenario, model_of, simulate_scenario
from fisheye_svp_ros.solve.poses import solve_poses
from fisheye_svp_ros.study.solutions import localization_metrics
from fisheye_svp_ros.study.sweep import (
    column_types,
    fingerprint,
    part_check,
    plan_sweep,
    sweep_rows,
    tasks,
    write_rows,
)

# What a sweep leaves behind for scripts.
FILES = ['sweep.csv', *(['sweep.parquet'] if tables.arrow()[0] else [])]
SMALL = """
/**:
  ros__parameters:
    sweep.environment: [whole, inner]
    sweep.radius: [2.0, 0.3]
    sweep.shift_scale: [0.0, 1.0]
    noise_px: 0.3
    seed: 5
localizer: {ros__parameters: {svp: true}}
"""
# Seconds of work, in many tasks.
LONG = f"""
synthetic_camera:
  ros__parameters:
    noise_px: 0.5
    environment: inner
    sweep.radius: [2.0, 0.5, 0.3]
    sweep.seed: {list(range(850))}
"""
TASKS = 5


@pytest.fixture(autouse=True)
def reference_engine(same_engine: None) -> None:
    """Solve by the reference: which engine `auto` takes depends on what was compiled before."""
    engines.use('numpy')


@pytest.fixture(scope='module')
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the finished sweep LONG."""
    folder = tmp_path_factory.mktemp('undisturbed')
    (folder / 'file.yaml').write_text(LONG)
    finish(folder / 'file.yaml', '-o', folder / 'out')
    return folder / 'out'


@pytest.fixture
def write(tmp_path: Path) -> Callable[[str], Path]:
    """Return a function that writes a sweep file."""

    def file(text: str) -> Path:
        path = tmp_path / 'file.yaml'
        path.write_text(text)
        return path

    return file


def sweep(*arguments: Any) -> None:
    assert main(['sweep', *map(str, arguments)]) == 0


def start(*arguments: Any) -> subprocess.Popen[str]:
    """Start a sweep in a process of its own."""
    env = os.environ | {'PYTHONPATH': str(ROOT), engines.VARIABLE: 'numpy'}
    command = [sys.executable, '-m', 'fisheye_svp_ros.cli', 'sweep', *map(str, arguments)]
    return subprocess.Popen(
        command, env=env, text=True, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL
    )


def finish(*arguments: Any) -> None:
    """Run a sweep in a process of its own: BLAS gets its threads from there."""
    process = start(*arguments)
    _, err = process.communicate()
    assert process.returncode == 0, err


def files_of(folder: Path) -> list[bytes]:
    """Return the tables of a finished sweep, byte by byte."""
    assert sorted(p.name for p in folder.iterdir()) == sorted([*FILES, 'sweep.json'])
    return [(folder / name).read_bytes() for name in FILES]


def workers_of(process: subprocess.Popen[str]) -> list[Any]:
    """Return the processes that work on a sweep."""
    psutil = pytest.importorskip('psutil', reason='psutil finds the workers')
    return [
        child
        for child in psutil.Process(process.pid).children()
        if 'spawn_main' in ' '.join(child.cmdline())
    ]


def at_rest(process: Any) -> bool:
    """Say whether a process waits for something, as often as one looks."""

    def waits() -> bool:
        time.sleep(0.05)
        return bool(process.status() == 'sleeping')

    return all(waits() for _ in range(20))


def parts_in(folder: Path) -> int:
    return len(list((folder / 'parts').glob('0*.csv')))


def test_rows_are_those_of_scenarios_one_by_one(
    write: Callable[[str], Path], tmp_path: Path
) -> None:
    sweep(write(SMALL), '-o', tmp_path / 'out')
    columns = plain_columns(read_table(tmp_path / 'out' / FILES[-1]))
    assert plain_columns(read_table(tmp_path / 'out' / 'sweep.csv')) == columns
    assert columns['scenario'] == list(range(8))
    assert columns['environment'] == ['whole'] * 4 + ['inner'] * 4
    assert columns['radius'] == [2.0, 2.0, 0.3, 0.3] * 2
    assert columns['shift_scale'] == [0.0, 1.0] * 4
    for number in range(8):
        point = {name: columns[name][number] for name in ('environment', 'radius', 'shift_scale')}
        scenario = with_values(Scenario(noise_px=0.3, seed=5), point)
        simulation = simulate_scenario(scenario, number)
        seen, model = simulation.observations, model_of('fish214', point['shift_scale'], svp=True)
        solved = solve_poses(model, views_of(seen.xyz, seen.uv[None]), examined=False)
        metrics = localization_metrics(solved, simulation.poses[0])
        for name, value in metrics.items():
            assert columns[f'localizer.{name}'][number] == pytest.approx(float(value[0]), abs=1e-9)


def test_each_scenario_has_noise_of_its_own_and_always_the_same() -> None:
    plan = plan_sweep({'synthetic_camera': {'noise_px': 0.5, 'sweep.seed': [1, 1, 2]}})
    rms = sweep_rows(plan, range(3))['localizer.rms_px'].tolist()
    assert len(set(rms)) == 3
    alone = sweep_rows(plan, range(1, 3))['localizer.rms_px'].tolist()
    assert alone == pytest.approx(rms[1:], rel=1e-12)  # products of other shapes round otherwise


def test_every_set_of_a_rig_is_a_row() -> None:
    plan = plan_sweep(
        {
            'synthetic_camera': {
                'sweep.style': ['parallel', 'divergent'],
                'sweep.radius': [0.5, 2.0],
                'poses_file': 'calibration',
            },
            'stereo_calibrator': {'svp': False, 'views': 4},
            'stereo_depth': {'svp': False},
        }
    )
    (numbers,) = tasks(plan)
    columns = plain_columns(sweep_rows(plan, numbers))
    assert numbers == range(4)
    assert columns['scenario'] == [n for n in range(4) for _ in range(10)]
    assert columns['set'] == list(range(10)) * 4
    assert columns['stereo_calibrator.views'] == [1, 2, 3, 4, 4, 4, 4, 4, 4, 4] * 4
    assert max(columns['stereo_calibrator.position_error_m']) < 1e-9
    assert max(columns['stereo_depth.error3_m']) < 1e-8
    assert set(columns['stereo_depth.note']) == {None}


@pytest.mark.parametrize(
    ('node', 'camera', 'said'),
    [
        (
            'stereo_calibrator',
            'style: mono, sweep.radius: [0.5]',
            'stereo_calibrator solves nothing in this sweep: it needs style parallel, '
            'vergent or diver',
        ),
        ('localizer', 'sweep.style: [parallel, vergent]', 'it needs style mono'),
        ('/**', 'sweep.radius: [0.5]', ''),  # the nodes that there are
    ],
)
def test_a_section_of_a_solver_that_no_style_uses_is_told(
    write: Callable[[str], Path],
    capsys: pytest.CaptureFixture[str],
    node: str,
    camera: str,
    said: str,
) -> None:
    """A parameter file of ROS may hold more nodes than there are: it is no error."""
    plan = read_sweep(
        write(
            f'{node}: {{ros__parameters: {{svp: true}}}}\n'
            f'synthetic_camera: {{ros__parameters: {{{camera}}}}}'
        )
    )
    assert node not in plan.solvers
    told = capsys.readouterr().err
    assert said in told and bool(told) == bool(said)


def test_a_set_that_cannot_be_solved_is_a_row_that_says_why(tmp_path: Path) -> None:
    few = tmp_path / 'few.csv'
    few.write_text('landmark,x,y,z\n1,0,0,-1\n2,1,0,-1\n3,0,1,-1\n')
    line = tmp_path / 'line.csv'
    line.write_text('landmark,x,y,z\n' + ''.join(f'{i},0,0,{-1 - i}\n' for i in range(6)))
    plan = plan_sweep(
        {
            'synthetic_camera': {
                'sweep.environment': ['whole', str(few), 'inner', str(line)],
                'sweep.radius': [1.0, 2.0],
            }
        }
    )
    columns = plain_columns(sweep_rows(plan, range(8)))
    assert [error is not None for error in columns['localizer.rms_px']] == [
        True,
        True,
        False,
        False,
        True,
        True,
        False,
        False,
    ]
    assert 'has 3 usable points' in columns['localizer.note'][2]
    assert 'do not determine a pose' in columns['localizer.note'][6]
    assert columns['localizer.note'][0] is None


BAD = {
    'sweep.radios: [1.0]': 'sweep.radios: no such parameter to sweep',
    'sweep.rig_file: [rig.yaml]': 'sweep.rig_file: no such parameter to sweep; choose from lens, '
    'shift_scale, environment, radius, style, baseline, vergence, poses_file, '
    'trajectory_steps, noise_px, seed\n',
    'sweep.radius: []': 'sweep.radius is []; a list of at least one value',
    'sweep.radius: 2.0': 'sweep.radius is 2.0; a list of at least one value',
    'sweep.radius: [near, far]': "radius is 'near'; a number is needed",
    'sweep.radius: [1.0, near]': 'sweep.radius: the values in line 1 differ in type\n',
    'sweep.radius: [2.0, -1]': 'line 1 differ in type; write -1 as -1.0',
    'sweep.radius: [-1.0]': 'radius is -1.0; allowed is',
    'sweep.style: [mono, parallel]': 'make two sweeps of it',
    'sweep.lens: [fish214, nonsense]': "'nonsense' is neither a file",
    'sweep.environment: [nowhere]': "environment 'nowhere' is unknown",
    'radius: 2.0': 'no parameter is swept',
    'sweep.seed: [1], radios: 3': 'radios is not a parameter of synthetic_camera',
    'sweep.seed: [1], rate: -3': 'rate is -3.0; allowed is',
    'sweep.seed: [1], poses: [1.0, 2.0]': 'seven a pose are needed',
    'sweep.seed: [1], poses: 3.0': 'poses is 3.0; a list is needed',
    'sweep.seed: [1], noise_px: much': "noise_px is 'much'; a number is needed",
    f'sweep.seed: {list(range(1001))}, sweep.radius: {[0.1 * n for n in range(1, 1001)]}': (
        '1001000 scenarios (1001 seed x 1000 radius); add --large to run them all'
    ),
}


@pytest.mark.parametrize('parameters', BAD)
def test_a_bad_sweep_is_refused_before_anything_runs(
    write: Callable[[str], Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    parameters: str,
) -> None:
    path = write(f'synthetic_camera: {{ros__parameters: {{{parameters}}}}}')
    assert main(['sweep', str(path), '-o', str(tmp_path / 'out')]) == 2
    err = capsys.readouterr().err
    assert BAD[parameters] in err and str(path) in err and err.count('\n') == 1
    assert not (tmp_path / 'out').exists()


def test_one_scenario_is_told_in_the_singular(
    write: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = write('/**: {ros__parameters: {sweep.radius: [2.0]}}')
    sweep(file, '-o', tmp_path / 'out')
    assert f'{file}: 1 scenario\n' in capsys.readouterr().out


@pytest.mark.parametrize(
    ('text', 'reason'),
    [
        ('localiser: {ros__parameters: {svp: true}}', 'is not a node of a sweep'),
        (
            'localizer: {ros__parameters: {sweep.svp: [true]}}',
            'sweep.svp: only parameters of '
            'synthetic_camera can be swept, below its name; localizer takes one value of each',
        ),
        ('', 'should hold node names'),
        ('a: [', 'broken YAML at line 2'),
        (
            'stereo_depth: {ros__parameters: {rig: topic}}\nsynthetic_camera: {ros__parameters: '
            '{sweep.style: [parallel]}}',
            "rig is 'topic'",
        ),
        (
            'localizer: {ros__parameters: {lens: nonsense}}\nsynthetic_camera: {ros__parameters: '
            '{sweep.seed: [1]}}',
            "'nonsense' is neither a file",
        ),
    ],
)
def test_a_file_that_is_no_sweep_is_refused(
    write: Callable[[str], Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    text: str,
    reason: str,
) -> None:
    assert main(['sweep', str(write(text)), '-o', str(tmp_path / 'out')]) == 2
    err = capsys.readouterr().err
    assert reason in err and err.count('\n') == 1


@pytest.mark.slow
def test_the_result_does_not_depend_on_who_works(
    write: Callable[[str], Path], tmp_path: Path, undisturbed: Path
) -> None:
    sweep(write(LONG), '-o', tmp_path / 'two', '--workers', 2)
    assert files_of(tmp_path / 'two') == files_of(undisturbed)
    summary = json.loads((undisturbed / 'sweep.json').read_text())
    assert summary['scenarios'] == summary['metrics']['localizer.rms_px']['solved'] == 2550


@pytest.mark.slow
def test_killed_twice_and_resumed_it_is_the_same_file(
    write: Callable[[str], Path], tmp_path: Path, undisturbed: Path
) -> None:
    path, out = write(LONG), tmp_path / 'out'
    before = 0
    for resume in ([], ['--resume']):
        process = start(path, '-o', out, *resume)
        until(lambda: parts_in(out) > before)  # noqa: B023
        process.send_signal(signal.SIGKILL)
        process.communicate()
        before = parts_in(out)
    assert before < TASKS
    sweep(path, '-o', out, '--workers', 2, '--resume')
    assert files_of(out) == files_of(undisturbed)


def test_parts_are_neither_repeated_nor_mixed_nor_lost(
    write: Callable[[str], Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path, out = write(LONG), tmp_path / 'out'
    process = start(path, '-o', out)
    until(lambda: parts_in(out) >= 2)
    process.kill()
    process.communicate()
    done = {p.name: p.stat().st_mtime_ns for p in (out / 'parts').glob('0*.csv')}
    assert main(['sweep', str(path), '-o', str(out)]) == 2
    assert 'continue with --resume' in capsys.readouterr().err
    other = tmp_path / 'other.yaml'
    other.write_text(LONG.replace('0.5\n', '0.6\n'))
    assert main(['sweep', str(other), '-o', str(out), '--resume']) == 2
    assert 'it holds another, interrupted sweep' in capsys.readouterr().err
    # What is done stays as it is until it is joined.
    kept: dict[str, int] = {}
    monkeypatch.setattr(
        'shutil.rmtree',
        lambda folder, **_: kept.update(
            {p.name: p.stat().st_mtime_ns for p in Path(folder).glob('0*.csv')}
        ),
    )
    sweep(path, '-o', out, '--resume')
    assert 'scenarios are already done' in capsys.readouterr().err
    assert len(kept) == TASKS and {name: kept[name] for name in done} == done
    monkeypatch.undo()
    sweep(path, '-o', out, '--resume')
    assert 'already holds this sweep' in capsys.readouterr().err


def test_a_folder_is_one_sweep_s_at_a_time(
    write: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = [tmp_path / f'{seed}.yaml' for seed in (1, 2)]
    for seed, path in enumerate(paths):
        path.write_text(f'synthetic_camera: {{ros__parameters: {{sweep.seed: [{seed}]}}}}')
    out = tmp_path / 'out'
    with _sole_writer(out / 'parts'):
        assert 'another sweep is writing there' in refused(capsys, 'sweep', paths[0], '-o', out)
    sweep(paths[0], '-o', out)
    before = (out / 'sweep.csv').read_bytes()
    said = refused(capsys, 'sweep', paths[1], '-o', out, '--resume')
    assert 'it holds another, finished sweep' in said
    assert (out / 'sweep.csv').read_bytes() == before and not (out / 'parts').exists()
    sweep(paths[1], '-o', out)  # replaces it, as every command does
    assert (out / 'sweep.csv').read_bytes() != before


@pytest.mark.slow
@pytest.mark.xdist_group('engines')
def test_it_goes_on_with_the_engine_that_it_was_begun_with(
    write: Callable[[str], Path], tmp_path: Path, undisturbed: Path
) -> None:
    pytest.importorskip('numba')
    path, out = write(LONG), tmp_path / 'out'
    process = start(path, '-o', out, '--engine', 'numpy')
    until(lambda: parts_in(out) >= 1)
    process.kill()
    process.communicate()
    finish(path, '-o', out, '--resume', '--engine', 'numba')
    assert files_of(out) == files_of(undisturbed)


def test_a_worker_that_dies_is_named(write: Callable[[str], Path], tmp_path: Path) -> None:
    out = tmp_path / 'out'
    process = start(write(LONG), '-o', out, '--workers', 2)
    until(lambda: parts_in(out) >= 1)
    workers_of(process)[0].kill()
    _, err = process.communicate(timeout=60)
    assert process.returncode == 2 and 'a worker process died' in err
    assert parts_in(out) >= 1


@pytest.mark.slow
def test_workers_that_die_while_they_send_results_are_named(
    write: Callable[[str], Path], tmp_path: Path
) -> None:
    out = tmp_path / 'out'
    process = start(write(LONG), '-o', out, '--workers', 2)
    until(lambda: parts_in(out) >= 1)
    workers = workers_of(process)
    process.send_signal(signal.SIGSTOP)  # nobody takes their results
    try:
        until(lambda: all(at_rest(worker) for worker in workers))
        for worker in workers:
            worker.kill()
    finally:
        process.send_signal(signal.SIGCONT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 2 and 'a worker process died' in err


def test_workers_end_with_a_sweep_that_is_killed(
    write: Callable[[str], Path], tmp_path: Path
) -> None:
    psutil = pytest.importorskip('psutil', reason='psutil finds the workers')
    out = tmp_path / 'out'
    process = start(write(LONG), '-o', out, '--workers', 2)
    until(lambda: parts_in(out) >= 1)
    children = psutil.Process(process.pid).children()
    assert len(children) >= 2
    process.kill()
    process.communicate()
    gone, alive = psutil.wait_procs(children, timeout=30)
    assert not alive and len(gone) == len(children)


def read_address(place: Path) -> str:
    """Return the address in a file of a Dask scheduler."""
    return str(json.loads(place.read_text())['address'])


@contextmanager
def scheduler_and_worker(
    folder: Path,
) -> Iterator[tuple[str, subprocess.Popen[bytes], subprocess.Popen[bytes]]]:
    """Yield the address of a Dask scheduler, and the processes of it and of its one worker."""
    pytest.importorskip('distributed', reason='needs the extra `dask`')
    place = folder / 'scheduler.json'
    begun: list[subprocess.Popen[bytes]] = []
    try:
        for name, more in (
            ('scheduler', ['--port', '0']),
            ('worker', ['--nthreads', '1', '--no-nanny']),
        ):
            command = [sys.executable, '-m', f'distributed.cli.dask_{name}', '--no-dashboard']
            begun.append(
                subprocess.Popen(
                    [*command, *more, '--scheduler-file', str(place)],
                    env={**os.environ, 'PYTHONPATH': str(ROOT)},
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                )
            )
        until(lambda: place.exists() and place.read_text().strip().endswith('}'))
        yield read_address(place), begun[0], begun[1]
    finally:
        for one in reversed(begun):
            one.terminate()
            one.wait(60)


class TestDask:
    @pytest.fixture
    def cluster(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
        """Return a cluster of two worker processes on loopback."""
        distributed = pytest.importorskip(
            'distributed', reason='dask.distributed is not installed (extra `dask`)'
        )
        monkeypatch.setenv('PYTHONPATH', str(ROOT))
        with distributed.LocalCluster(
            n_workers=2,
            threads_per_worker=1,
            host='127.0.0.1',
            dashboard_address=None,
            local_directory=str(tmp_path / 'dask'),
        ) as cluster:
            yield cluster

    @pytest.mark.slow
    def test_the_same_rows_though_a_worker_is_killed(
        self, cluster: Any, write: Callable[[str], Path], tmp_path: Path, undisturbed: Path
    ) -> None:
        path, out = write(LONG), tmp_path / 'out'
        process = start(path, '-o', out, '--dask', cluster.scheduler_address)
        until(lambda: parts_in(out) >= 1)
        pids = [nanny.pid for nanny in cluster.workers.values()]
        os.kill(pids[0], signal.SIGKILL)
        _, err = process.communicate(timeout=60)
        assert process.returncode == 0, err
        assert files_of(out) == files_of(undisturbed)

    @pytest.mark.slow
    @pytest.mark.parametrize('number', [signal.SIGKILL, signal.SIGTERM])
    def test_a_scheduler_that_dies_is_one_line(
        self, number: signal.Signals, write: Callable[[str], Path], tmp_path: Path
    ) -> None:
        out = tmp_path / 'out'
        with scheduler_and_worker(tmp_path) as (address, scheduler, _):
            process = start(write(LONG), '-o', out, '--dask', address)
            until(lambda: parts_in(out) >= 1)
            scheduler.send_signal(number)
            _, err = process.communicate(timeout=60)
        lines = [line for line in err.splitlines() if not line.endswith('%)')]
        assert process.returncode == 2 and len(lines) == 1
        assert 'continue with --resume' in lines[0] and parts_in(out) >= 1

    @pytest.mark.slow
    def test_a_last_worker_that_dies_is_one_line(
        self, write: Callable[[str], Path], tmp_path: Path
    ) -> None:
        """The tasks of a worker go to the others; without others they waited without end."""
        code = (
            'import sys; from fisheye_svp_ros.commands import executors as e; '
            'from fisheye_svp_ros.cli import main; '
            'e._CHECK_INTERVAL, e._WORKER_PATIENCE = 0.5, 1; sys.exit(main(sys.argv[1:]))'
        )
        out = tmp_path / 'out'
        with scheduler_and_worker(tmp_path) as (address, _, worker):
            process = subprocess.Popen(
                [sys.executable, '-c', code, 'sweep', write(LONG), '-o', out, '--dask', address],
                env={**os.environ, 'PYTHONPATH': str(ROOT)},
                stderr=subprocess.PIPE,
                text=True,
            )
            until(lambda: parts_in(out) >= 1)
            worker.kill()
            _, err = process.communicate(timeout=60)
        assert process.returncode == 2 and parts_in(out) >= 1
        assert 'no worker came' in err and 'continue with --resume' in err

    def test_tasks_that_nobody_works_on_any_longer_end_a_sweep(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """They waited without end, as the next test shows with processes."""
        distributed = pytest.importorskip('distributed', reason='needs the extra `dask`')
        monkeypatch.setattr('fisheye_svp_ros.commands.executors._CHECK_INTERVAL', 0.01)
        client = MagicMock()
        client.nthreads.side_effect = [{'worker': 1}, {'worker': 1}, {}]
        client.wait_for_workers.side_effect = OSError
        never: Future[str] = Future()
        client.get_executor().submit = lambda *_: never
        monkeypatch.setattr(distributed, 'Client', lambda *_, **__: client)
        hang = Timer(5.0, never.set_result, [''])  # or a fault would wait without end, too
        hang.start()
        with (
            pytest.raises(SweepError, match=r'no worker came .* continue with --resume'),
            dask('tcp://here') as workers,
        ):
            list(completed_tasks(str, ['1'], workers))
        hang.cancel()

    def test_a_worker_is_awaited_with_a_word_and_up_to_a_limit(
        self,
        write: Callable[[str], Path],
        tmp_path: Path,
        capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        distributed = pytest.importorskip('distributed', reason='needs the extra `dask`')
        monkeypatch.setattr('fisheye_svp_ros.commands.executors._WORKER_PATIENCE', 0.5)
        arguments = ['sweep', str(write(SMALL)), '-o', str(tmp_path / 'out')]
        with distributed.LocalCluster(
            n_workers=0,
            host='127.0.0.1',
            dashboard_address=None,
            local_directory=str(tmp_path / 'dask'),
        ) as cluster:
            assert main([*arguments, '--dask', cluster.scheduler_address]) == 2
        note, refusal = capsys.readouterr().err.splitlines()
        assert 'has no worker; waiting up to 0.5 s' in note
        assert 'no worker came to the Dask cluster in 0.5 s' in refusal
        assert main(arguments) == 0  # nothing was solved that would have to be resumed

    def test_no_scheduler_is_one_line(
        self,
        write: Callable[[str], Path],
        tmp_path: Path,
        capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        pytest.importorskip(
            'distributed', reason='dask.distributed is not installed (extra `dask`)'
        )
        monkeypatch.setattr('fisheye_svp_ros.commands.executors._PATIENCE', 0.2)
        arguments = ['sweep', str(write(SMALL)), '-o', str(tmp_path / 'out'), '--dask']
        assert main([*arguments, 'tcp://127.0.0.1:9']) == 2
        assert 'no Dask scheduler answers there' in capsys.readouterr().err


def test_points_of_a_sweep_are_counted_like_an_odometer() -> None:
    plan = plan_sweep({'synthetic_camera': {'sweep.radius': [2.0, 1.0], 'sweep.seed': [7, 8, 9]}})
    assert list(plan.sweep) == [{'radius': r, 'seed': s} for r in (2.0, 1.0) for s in (7, 8, 9)]
    with pytest.raises(ParameterError):
        plan_sweep({})


def test_the_order_of_work_does_not_matter() -> None:
    plan = plan_sweep({'synthetic_camera': {'noise_px': 1.0, 'sweep.seed': list(range(40))}})
    whole = sweep_rows(plan, range(40))
    rows = np.array(whole['localizer.position_error_m'])
    for numbers in (range(30, 40), range(30)):
        again = sweep_rows(plan, numbers)['localizer.position_error_m'].to_numpy()
        assert again == pytest.approx(rows[numbers.start : numbers.stop], abs=1e-12)


def test_without_pyarrow_there_is_csv_and_one_line_that_says_so(
    write: Callable[[str], Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert main(['sweep', str(write(SMALL)), '-o', str(tmp_path / 'with')]) == 0
    capsys.readouterr()
    tables.arrow.cache_clear()
    monkeypatch.setitem(sys.modules, 'pyarrow', None)
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path / 'cache'))
    assert main(['sweep', str(write(SMALL)), '-o', str(tmp_path / 'out')]) == 0
    err = capsys.readouterr().err
    tables.arrow.cache_clear()
    assert 'only CSV, no Parquet file: pyarrow' in err and err.count('\n') == 1
    assert not (tmp_path / 'out' / 'sweep.parquet').exists()
    assert (tmp_path / 'out' / 'sweep.csv').read_text() == (
        tmp_path / 'with' / 'sweep.csv'
    ).read_text()


def solve_all_but_join(path: Path, out: Path) -> None:
    """Leave all parts of a sweep of one set a scenario behind, the rows of its first, repeated."""
    plan = read_sweep(path)
    parts = tables.TableParts(out / 'parts', column_types(plan))
    rows = sweep_rows(plan, tasks(plan)[0])
    for numbers in tasks(plan):
        parts.write(numbers.start, rows.assign(scenario=rows['scenario'] + numbers.start))
    write_text(parts.folder / 'sweep.txt', f'{fingerprint(plan)} numpy')


@pytest.mark.parametrize('parquet', [True, False])
def test_memory_grows_with_the_metrics_of_a_sweep_alone(
    parquet: bool,
    write: Callable[[str], Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if parquet and tables.arrow()[0] is None:
        pytest.skip('pyarrow is not here')
    if not parquet:
        monkeypatch.setattr(tables, 'arrow', lambda: (None, ''))
    monkeypatch.setattr(tables, '_ROWS', 1024)  # of a row group, which is held, too
    peaks: list[int] = []
    for seeds in (3, 3, 13):  # the first one loads what all need
        lists = f'{{sweep.radius: {[0.5] * 512}, sweep.seed: {list(range(seeds))}}}'
        path, out = write(f'/**: {{ros__parameters: {lists}}}'), tmp_path / f'{len(peaks)}'
        solve_all_but_join(path, out)
        tracemalloc.start()
        sweep(path, '-o', out, '--resume')
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        written = json.loads((out / 'sweep.json').read_text())['metrics']
        assert written['localizer.rms_px']['solved'] == 512 * seeds
    # Of the rows of 5120 more scenarios their 11 metrics, 8 bytes each, and half as much again
    # with older versions of NumPy and pandas
    assert peaks[2] - peaks[1] < 18 * 8 * 5120


def test_a_damaged_part_is_named(tmp_path: Path) -> None:
    parts = tables.TableParts(tmp_path / 'parts', {'n': int, 'x': float, 'note': str})
    for number in range(3):
        parts.write(number, pd.DataFrame({'n': [number], 'x': [np.nan], 'note': ['']}))
    parts.join(tmp_path / 'whole')
    assert (tmp_path / 'whole.csv').read_text() == 'n,x,note\n0,,\n1,,\n2,,\n'
    for damaged in (
        '',
        'n,x\n1,\n',
        'n,x,note\n1,0.5',
        'n,x,note\n1,,,\n',
        'n,x,note\n,,\n',
        'n,x,note\n9223372036854775808,1.0,\n',
    ):
        (tmp_path / 'parts' / '000000001.csv').write_text(damaged)
        with pytest.raises(OutputError, match=r'000000001.csv: a part of the table is damaged'):
            parts.join(tmp_path / 'whole')


def test_a_part_that_ends_with_a_line_before_its_last_one_is_named(
    write: Callable[[str], Path], tmp_path: Path
) -> None:
    text = '{sweep.radius: [1.0, 0.5], poses_file: calibration}'
    plan = read_sweep(write(f'/**: {{ros__parameters: {text}}}'))
    parts = tables.TableParts(tmp_path / 'parts', column_types(plan))
    write_rows(parts, 'numpy', plan, range(2))
    parts.join(tmp_path / 'whole', part_check(plan))
    (file,) = parts.folder.iterdir()
    lines = file.read_text().splitlines(keepends=True)
    assert len(lines) == 1 + 2 * 10
    for kept in (lines[:-1], lines[:11]):
        file.write_text(''.join(kept))
        with pytest.raises(
            OutputError, match=r'000000000.csv: .* \(rows are missing\); remove it'
        ):
            parts.join(tmp_path / 'whole', part_check(plan))


def test_nodes_of_one_namespace_are_those_of_the_sweep(tmp_path: Path) -> None:
    path = tmp_path / 'robot.yaml'
    text = (
        '/robot/synthetic_camera: {ros__parameters: {sweep.radius: [1.0, 2.0], noise_px: 0.2}}\n'
        '/robot/localizer: {ros__parameters: {sigma_px: 0.2}}\n'
        '/**: {ros__parameters: {baseline: 0.3}}\n'
    )
    path.write_text(text)
    plan = read_sweep(path)
    assert plan.base.noise_px == plan.solvers['localizer'].sigma_px == 0.2
    assert plan.base.baseline == 0.3 and len(plan.sweep) == 2
    path.write_text(text.replace('/robot/localizer', '/other/localizer'))
    with pytest.raises(ParameterError, match='nodes of the namespaces /other, /robot'):
        read_sweep(path)
