"""The demo, a small one: one lens, one radius, all three tasks."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import matplotlib
import numpy as np
import pandas as pd
import pytest
from helpers.nodes import ROOT, need_ros

from fisheye_svp_ros.cli import main
from fisheye_svp_ros.commands.processes import Processes
from fisheye_svp_ros.errors import BagError, GraphError, ObservationError
from fisheye_svp_ros.io.bags import Bag
from fisheye_svp_ros.io.columns import plain_columns, read_table
from fisheye_svp_ros.io.decoding import RESIDUALS
from fisheye_svp_ros.io.readers import read_observations
from fisheye_svp_ros.io.recording import has_residuals, is_tabulated, tabulate
from fisheye_svp_ros.paper.demonstration import TASKS, compute_demo, demo_rows, residual_fields

pytestmark = pytest.mark.xdist_group('demo')  # run once


@pytest.fixture(scope='module')
def demo(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Run the demo once; return its folder and what it printed."""
    need_ros()
    folder = tmp_path_factory.mktemp('demo')
    env = {name: value for name, value in os.environ.items() if name != 'ROS_DOMAIN_ID'}
    env['PYTHONPATH'] = os.pathsep.join([str(ROOT), env.get('PYTHONPATH', '')])
    # Nothing is compiled yet, as after an installation; fonts are found.
    env |= {'XDG_CACHE_HOME': str(folder / 'cache'), 'MPLCONFIGDIR': matplotlib.get_cachedir()}
    done = subprocess.run(
        [
            sys.executable,
            '-m',
            'fisheye_svp_ros.cli',
            'demo',
            '-o',
            str(folder),
            '--lenses',
            'fish180',
            '--radii',
            '0.5',
        ],
        env=env,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return folder, done.stdout


def test_every_scenario_is_there_once_beside_the_published_numbers(demo: Any) -> None:
    folder, _ = demo
    rows = json.loads((folder / 'demo.json').read_text())['rows']
    assert [(row['task'], row['where']) for row in rows] == [
        (task, where)
        for task, names in (
            ('localization', ('whole', 'inner', 'outer')),
            ('calibration', ('parallel', 'vergent', 'divergent')),
            ('depth', ('parallel', 'vergent', 'divergent')),
        )
        for where in names
    ]
    whole, inner, outer = rows[:3]
    # Kita, table 1: -0.16, 0.24 and -1.67 mm.
    assert whole['published_error'] == pytest.approx([-0.1614e-3] * 2)
    for row in (whole, inner, outer):
        assert row['error'] == pytest.approx(row['published_error'][0], rel=0.2)
        assert row['pixels'] == pytest.approx(row['published_pixels'][0], rel=0.1)
    for row in rows[3:6]:  # the paper does not print the poses of its rig
        assert row['error'] == pytest.approx(row['published_error'][0], rel=0.5)
        assert row['pixels'] == pytest.approx(row['published_pixels'][0], rel=0.25)
    for row in rows[6:]:
        for name in ('error', 'pixels'):
            low, high = row[f'published_{name}']
            assert low / 2 < row[name] < 2 * high


def test_nothing_is_compiled_for_some_scenarios(demo: Any) -> None:
    assert not (demo[0] / 'cache').exists()


def test_a_rectified_pair_is_shown(demo: Any) -> None:
    folder, out = demo
    assert 'A pair of fish180, rectified at 0.5 m: row difference between left' in out
    assert out.startswith(f'{folder / "errors.png"}: the errors of this package')
    rows = json.loads((folder / 'demo.json').read_text())['rectified']
    worst = dict(zip(rows['ranges_m'], rows['worst_px'], strict=True))
    assert worst[0.5] < 1e-6 < 0.05 < worst[0.3]
    picture = cv2.imread(str(folder / 'rectified.png'))
    assert picture.shape == (480, 1280, 3)


def test_everything_is_recorded(demo: Any) -> None:
    folder, _ = demo
    columns = plain_columns(tabulate(Bag(folder / 'recording').records(is_tabulated)))
    counts = {name: columns['namespace'].count(name) for name in set(columns['namespace'])}
    assert counts == {'/localization': 3, '/calibration': 3 * 10, '/depth': 3 * 2}
    assert len(set(zip(columns['namespace'], columns['stamp_ns'], strict=True))) == 39
    everything = Bag(folder / 'recording').records(lambda topic, typename: True)
    types = {record.topic: record.typename for record in everything}
    pose = types['/localization/localizer/pose']
    assert pose == 'geometry_msgs/msg/PoseWithCovarianceStamped'
    assert types['/depth/stereo_depth/metrics/error3_m'] == 'std_msgs/msg/Float64'


def test_every_topic_of_a_layout_is_recorded(demo: Any) -> None:
    everything = Bag(demo[0] / 'recording').records(lambda topic, typename: True)
    recorded = {record.topic for record in everything}
    layouts = [path.read_text() for path in (ROOT / 'config' / 'layouts').iterdir()]
    shown = {
        topic
        for text in layouts
        for topic in re.findall(r'["\s](/(?:localization|depth)/[\w/]+?)(?://|["\s.])', text)
    }
    assert len(shown) == 6 and shown <= recorded


def test_as_observations_it_says_how_to_record_one_of_its_namespaces(demo: Any) -> None:
    with pytest.raises(ObservationError, match=r"calibration, /depth, .*--topics '/localization/"):
        read_observations(demo[0] / 'recording')


def test_the_table_and_the_pictures_are_there(demo: Any) -> None:
    folder, printed = demo
    assert printed.count(' with the SVP model: ') == 3
    lines = printed.splitlines()
    assert sum(line.startswith('  fish180 ') for line in lines) == 9 and '-0.1614' in printed
    assert 'Error2' in printed and 'Error3' in printed
    for name in ('errors.png', 'residuals.png', 'rectified.png'):
        assert (folder / name).read_bytes().startswith(b'\x89PNG')
    assert (folder / 'table.csv').exists()


def test_the_nodes_have_nothing_to_complain_of(demo: Any) -> None:
    """But of one another's slow start, of a camera that ended first, and of a busy machine."""
    folder, _ = demo
    names = ['recorder', *(name for task in TASKS for name in (f'camera_{task.name}', task.node))]
    logs = [folder / 'logs' / f'{name}.log' for name in names]
    assert set(logs) <= set((folder / 'logs').glob('*.log'))
    for log in logs:
        text = '\n'.join(
            line
            for line in log.read_text().splitlines()
            if not re.search('no message on|nothing is published yet| s late: ', line)
        )
        assert 'Traceback' not in text and 'WARN' not in text and 'dropped' not in text, log


def test_a_missing_scenario_is_named(demo: Any) -> None:
    folder, _ = demo
    table = tabulate(Bag(folder / 'recording').records(is_tabulated))
    with pytest.raises(BagError, match=r'no result of localizer for fish180, whole, 2\.0 m'):
        demo_rows(table, ['fish180'], [2.0])
    with pytest.raises(BagError, match='was recorded twice'):
        demo_rows(pd.concat([table, table]), ['fish180'], [0.5])


@pytest.fixture
def computed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Any:
    """Run the demo where there is no rclpy; return its folder and what it printed."""
    monkeypatch.setitem(sys.modules, 'rclpy', None)
    assert (
        main(
            [
                'demo',
                '-o',
                str(tmp_path),
                '--lenses',
                'fish180',
                'fish180',
                '--radii',
                '0.5',
                '0.5',
            ]
        )
        == 0
    )
    return tmp_path, capsys.readouterr().out


def test_without_ros_the_same_scenarios_are_computed(computed: Any) -> None:
    folder, printed = computed
    first, *others = printed.splitlines()
    assert first.startswith('  ROS 2 is missing (') and 'in one process, without nodes' in first
    assert sum(line.startswith('  fish180 ') for line in others) == 9
    assert sorted(path.name for path in folder.iterdir() if path.suffix != '.parquet') == [
        'demo.json',
        'errors.png',
        'rectified.png',
        'residuals.png',
        'table.csv',
    ]
    assert json.loads((folder / 'demo.json').read_text())['recording'] is None
    counts = plain_columns(read_table(folder / 'table.csv'))['namespace']
    assert [counts.count(f'/{task.name}') for task in TASKS] == [3, 3 * 10, 3 * 2]


def test_the_graph_tells_what_is_computed_without_it(demo: Any, computed: Any) -> None:
    recorded, offline = (
        json.loads((folder / 'demo.json').read_text())['rows'] for folder, _ in (demo, computed)
    )
    for told, mine in zip(recorded, offline, strict=True):
        numbers = {name for name, value in mine.items() if isinstance(value, float)}
        assert {k: v for k, v in told.items() if k not in numbers} == {
            k: v for k, v in mine.items() if k not in numbers
        }
        for name in numbers:
            assert told[name] == pytest.approx(mine[name], abs=1e-9, nan_ok=True), name
    (one,) = residual_fields(Bag(demo[0] / 'recording').records(has_residuals))
    (other,) = compute_demo(['fish180'], [0.5])[1]
    for name in RESIDUALS.names or ():
        np.testing.assert_allclose(one.points[name], other.points[name], atol=1e-8)
    printed = computed[1].replace(str(computed[0]), str(demo[0])).splitlines()
    assert demo[1].splitlines() == [
        *printed[1:-1],
        f'  recording, table, and more pictures: {demo[0]}',
    ]


def test_a_process_that_fails_is_named_and_none_is_left(tmp_path: Path) -> None:
    need_ros()
    with (
        pytest.raises(GraphError, match=r"bad ended with status 2: .*'nothere' is neither"),
        Processes(tmp_path / 'logs') as processes,
    ):
        processes.start('good', ['run', 'localizer'])
        processes.start('bad', ['run', 'localizer', '--ros-args', '-p', 'lens:=nothere'])
        running = list(processes._running.values())
        processes.wait(['good'], 60.0)
    assert all(process.poll() is not None for process in running)
