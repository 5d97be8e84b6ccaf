"""The benchmark: harness, rows at tiny sizes with whatever peers are there, report."""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from functools import partial

import numpy as np
import pytest

from benchmark.speed import (
    commands,
    effort,
    growth,
    localization,
    maps,
    projection,
    report,
    stereo,
    variants,
)
from benchmark.speed.adjustment import exact_view, moved, scipy_pose
from benchmark.speed.compiled import Kernel
from benchmark.speed.harness import (
    Goal,
    Row,
    Side,
    Timing,
    available,
    exponent,
    measure,
    require,
)
from benchmark.speed.scenes import localization as scene_of
from benchmark.speed.scenes import on_board, points, shift_lens, svp_lens
from benchmark.speed.worker import worker
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.scene.observations import views_of

AGREES = 1e-10  # m
pytestmark = pytest.mark.xdist_group('engines')  # compiled once


def test_sides_take_turns_after_a_warm_up():
    calls = []

    def busy(name):
        calls.append(name)
        end = time.process_time() + 0.03
        while time.process_time() < end:
            pass

    sides = [Side(name, partial(busy, name), 2.0) for name in 'ab']
    timings = measure(sides, 3)
    assert calls[-6:] == ['a', 'b'] * 3
    assert [len(timing.seconds) for timing in timings] == [3, 3]
    assert min(timings[0].seconds) >= 0.015  # two units of work in 30 ms


def test_what_is_not_there_is_left_out_with_a_reason():
    def missing():
        require('no_such_module')

    sides, left_out = available({'here': lambda: Side('here', int), 'missing': missing})
    assert [side.name for side in sides] == ['here']
    assert 'no_such_module' in left_out['missing']


def test_a_ratio_is_how_many_times_faster():
    row = Row(
        'work',
        'ms',
        1e-3,
        [Timing('fisheye-svp, x', (1.0, 2.0, 9.0)), Timing('b', (6.0,))],
        goals=[Goal('fisheye-svp, x', 'b', 2.5), Goal('fisheye-svp, x', 'c', 1.0)],
    )
    assert row.ratio('fisheye-svp, x', 'b') == 3.0
    assert row.ratio('fisheye-svp, x', 'c') is None
    assert [line[-1] for line in report.goals([row]).rows] == ['yes', '-']


def test_exponents_are_those_of_the_growth():
    sizes = [10, 100, 1000]
    assert exponent(sizes, [2 * size**1.5 for size in sizes]) == pytest.approx(1.5)


@pytest.mark.parametrize('lens', [shift_lens(), svp_lens()], ids=['shift', 'svp'])
@pytest.mark.skipif(shutil.which('cc') is None, reason='no C compiler')
def test_the_hand_written_kernel_is_right(lens):
    kernel, model = Kernel(lens), ForwardModel(lens)
    world = points(500, np.radians(80.0))
    pose = Pose(rotation_from_vector(np.array([0.1, -0.2, 0.05])), np.array([0.01, 0.02, -0.03]))
    linear = model.linearize(
        Pose(*(array[None] for array in pose)), views_of(world, np.zeros((1, 500, 2)))
    )
    uv, jacobian = kernel.linearize(world, *pose)
    np.testing.assert_allclose(uv, linear.uv[0], atol=1e-7)
    np.testing.assert_allclose(jacobian, linear.d_pose[0], rtol=1e-7, atol=1e-5)
    camera = pose.into_body(world)
    np.testing.assert_allclose(
        kernel.project(np.ascontiguousarray(camera)), linear.uv[0], atol=1e-7
    )


def test_a_worker_that_dies_leaves_its_row_out():
    """The benchmark ended with an error of JSON when mrcal did."""
    with worker([sys.executable, '-c', 'exit(3)']) as ask:
        sides, left_out = available({'dead': lambda: Side('dead', ask())})
    assert not sides and left_out == {'dead': 'its process ended with 3'}


def test_a_worker_answers_each_time_it_is_asked():
    answer = 'import sys\nfor line in sys.stdin: print(\'{"wall": 2.5}\', flush=True)'
    with worker([sys.executable, '-c', answer]) as ask:
        assert [ask(), ask()] == [{'wall': 2.5}] * 2


def test_the_common_answer_is_a_minimum():
    scene = scene_of(shift_lens(), 2)
    view = exact_view(scene.lens, scene.landmarks, scene.views.uv[1])
    pose = scipy_pose(view, scene.start.take(1), 1e-14, exact=True)
    residuals, columns = view(*pose)
    step = np.linalg.lstsq(columns, residuals, rcond=None)[0]
    assert np.abs(step).max() < 1e-12


def test_moved_differentiates_by_the_change():
    start = Pose(rotation_from_vector(np.array([0.3, 0.1, -0.2])), np.array([1.0, 2.0, 3.0]))
    change, small = np.array([0.1, -0.2, 0.3, 0.5, -0.4, 0.2]), 1e-6
    pose, derivative = moved(start, change)
    for column, axis in zip(derivative.T, np.eye(6), strict=True):
        further = start.retract(change + small * axis).difference(pose) / small
        np.testing.assert_allclose(further, column, atol=1e-5)


def test_projections_agree():
    for row in projection.rows(count=300, repeats=1):
        assert any(timing.name.startswith('fisheye-svp') for timing in row.timings)
        for timing in row.timings:
            assert timing.error < 1e-6, (row.title, timing.name)


def test_maps_agree():
    for row in maps.rows(repeats=1):
        assert any(timing.name.startswith('fisheye-svp') for timing in row.timings)
        for timing in row.timings:
            assert timing.error < 1e-3, (row.title, timing.name)


def test_localizations_agree():
    for row in localization.rows(many=12, looped=3, repeats=1):
        for timing in row.timings:
            if timing.name not in ('pycolmap', 'cv2.fisheye.solvePnP'):
                assert timing.error < (AGREES if 'fisheye' in timing.name else 1e-8), timing


def test_rigs_agree():
    for row in stereo.rows(views=4, repeats=1):
        for timing in row.timings:
            assert timing.error < (AGREES if 'fisheye' in timing.name else 1e-8), timing


def test_variants_and_growth_can_be_measured():
    assert len(variants.work_of('localization', 7)().pose.position) == 7
    assert variants.work_of('projection', 300)().uv.shape == (1, 300, 2)
    for work in growth.growths()[:5]:
        line = growth.line(work._replace(sizes=(6, 12)), repeats=1)
        assert line[2] == '6 12' and np.isfinite(float(line[4]))


def test_the_report_is_markdown_with_versions_goals_and_reasons():
    row = Row(
        'work',
        'ms',
        1e-3,
        [Timing('fisheye-svp, numpy', (1e-3,), 2e-12)],
        'm',
        {'peer': 'not installed'},
        [Goal('fisheye-svp, numpy', 'peer', 2.0)],
    )
    text = report.document('python -m benchmark.speed', 0.3, [row])
    assert '| fisheye-svp, numpy | 1 | 1 to 1 | 2.0e-12 |' in text
    assert '- peer did not take part: not installed.' in text
    assert '| work | numpy | peer | 2 × | not measured | - |' in text


def test_every_frame_of_the_board_has_its_own_pose():
    table, names = on_board(3, 32, 2)
    assert len(table) == 3 * 32 * 2 and table.cameras == names
    centers = [
        table.uv[(table.frame == frame) & (table.camera == 0)].mean(axis=0) for frame in range(3)
    ]
    assert min(np.linalg.norm(centers[i] - centers[i - 1]) for i in range(3)) > 10.0


def test_commands_are_timed_to_their_end_and_until_a_text(tmp_path):
    assert commands._seconds([*commands._COMMAND, '--help'], tmp_path) > 0
    assert commands._seconds([*commands._COMMAND, 'localize'], tmp_path, code=2) > 0
    with pytest.raises(subprocess.CalledProcessError):
        commands._seconds([*commands._COMMAND, 'localize'], tmp_path)
    assert commands._seconds_until('localize', tmp_path, b'required') > 0


def test_effort_counts_what_child_processes_take(monkeypatch):
    monkeypatch.setattr(effort, 'COLUMNS', 300)
    child = [sys.executable, '-c', 'import time\nwhile time.process_time() < 0.3: pass']
    seconds, unit, units = map(float, effort._effort(partial(subprocess.run, child, check=True)))
    assert seconds >= 0.3 and unit > 0
    assert units == pytest.approx(seconds / unit, rel=0.05)
