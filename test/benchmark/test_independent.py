"""The second generator of blind sets: each effect does what its cause does, and sets are valid."""

from __future__ import annotations

import ast
import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from benchmark.studies import independent
from benchmark.studies.independent import report, run
from benchmark.studies.independent.adjust import Free
from benchmark.studies.independent.background import draw_background
from benchmark.studies.independent.camera import (
    behind_window,
    draw_lens,
    incidence,
    intrinsic_jacobian,
    point_jacobian,
    project,
)
from benchmark.studies.independent.effects import EFFECTS
from benchmark.studies.independent.formation import Departure, form, observed, simulated
from benchmark.studies.independent.generator import (
    CATALOGUE,
    GIVEN,
    MODES,
    SIZES,
    generate,
    plan,
    write,
)
from benchmark.studies.independent.oracle import amplitudes, finds
from benchmark.studies.independent.outside import OUTSIDE
from benchmark.studies.independent.scene import draw_scene, in_camera
from benchmark.studies.independent.score import score, stage_right
from fisheye_svp_ros.cli import main

SEED = 5


def scene_of(kind='board', model='equidistant', *, stereo=False, moving=False, fitted=False):
    rng = np.random.default_rng(SEED)
    while True:
        scene = draw_scene(
            rng,
            draw_lens(rng, model, 1.4),
            kind,
            fitted=fitted,
            stereo=stereo,
            moving=moving,
            noise=0.1,
        )
        if scene is not None:
            return scene


def hidden(name, scene, amount):
    """Return the departure of an effect, and how it moves the image points."""
    departure = CATALOGUE[name].draw(np.random.default_rng(SEED), scene)(amount)
    return departure, form(scene, [departure]) - simulated(scene)


def from_center(scene):
    return simulated(scene) - [scene.lens.cx, scene.lens.cy]


def local_points(scene):
    world = scene.target.points[scene.landmark]
    return in_camera(scene, world, np.zeros(len(world)))


def test_the_package_is_not_imported():
    for path in Path(independent.__file__).parent.glob('*.py'):
        for node in ast.walk(ast.parse(path.read_text())):
            names = (
                [a.name for a in node.names]
                if isinstance(node, ast.Import)
                else [node.module]
                if isinstance(node, ast.ImportFrom)
                else []
            )
            for name in names:
                assert not name.startswith('fisheye_svp_ros'), path
                assert not name.startswith('benchmark.') or name.startswith(
                    'benchmark.studies.independent'
                ), path


@pytest.mark.parametrize('model', ['orthographic', 'equisolid', 'stereographic', 'kannala_brandt'])
def test_jacobians(model):
    lens = draw_lens(np.random.default_rng(SEED), model, 1.5)
    points = np.random.default_rng(1).normal(size=(20, 3)) * 0.3 + [0, 0, 1]
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        numeric = (project(lens, points + step) - project(lens, points - step)) / 2e-6
        np.testing.assert_allclose(point_jacobian(lens, points)[..., axis], numeric, atol=1e-4)
    rows = intrinsic_jacobian(lens, points)
    wider = replace(lens, fx=lens.fx + 1e-3)
    numeric = (project(wider, points) - project(lens, points)) / 1e-3
    np.testing.assert_allclose(rows[..., 0], numeric, atol=1e-6)
    for i, k in enumerate(lens.k):
        bent = replace(lens, k=(*lens.k[:i], k + 1e-6, *lens.k[i + 1 :]))
        numeric = (project(bent, points) - project(lens, points)) / 1e-6
        np.testing.assert_allclose(rows[..., 4 + i], numeric, atol=1e-4)


def test_viewpoint_shift_solves_the_equation_of_the_design():
    scene = scene_of()
    points = local_points(scene)
    pupil = hidden('viewpoint_shift', scene, 0.01)[0].pupil
    theta, azimuth = incidence(points, pupil)
    entrance = pupil(theta, azimuth)
    s, r = entrance[:, 2], np.hypot(points[:, 0], points[:, 1])
    assert np.abs(entrance[:, :2]).max() == 0
    left = r * np.cos(theta) - (points[:, 2] - s) * np.sin(theta)
    assert np.abs(left).max() < 1e-13
    near_axis = np.array([1e-3, 2e-3])
    small = pupil(near_axis, near_axis)[:, 2]
    np.testing.assert_allclose(np.abs(small), 0.01 * near_axis**2 / 6, rtol=1e-4)


def test_flat_port_refracts_and_is_the_shift_of_a_window():
    points, index, thickness = local_points(scene_of()), 1.5, 0.01
    theta, _ = behind_window(points, thickness, index)
    inside = np.arcsin(np.sin(theta) / index)
    r = np.hypot(points[:, 0], points[:, 1])
    walked = (points[:, 2] - thickness) * np.tan(theta) + thickness * np.tan(inside)
    np.testing.assert_allclose(walked, r, atol=1e-12)
    s = thickness * (1 - np.tan(inside) / np.tan(theta))
    left = r * np.cos(theta) - (points[:, 2] - s) * np.sin(theta)
    assert np.abs(left).max() < 1e-12


def test_effects_on_the_intrinsics():
    scene = scene_of()
    q = from_center(scene)
    moved = {
        name: hidden(name, scene, amount)[1]
        for name, amount in (
            ('focal_length', 0.01),
            ('principal_point', 2.0),
            ('aspect', 0.01),
            ('skew', 0.01),
        )
    }
    np.testing.assert_allclose(np.abs(moved['focal_length']), 0.01 * np.abs(q), atol=1e-9)
    assert np.ptp(moved['principal_point'], axis=0).max() < 1e-9
    assert np.linalg.norm(moved['principal_point'][0]) == pytest.approx(2.0)
    np.testing.assert_allclose(
        moved['aspect'][:, 0] * q[:, 1], -moved['aspect'][:, 1] * q[:, 0], atol=1e-9
    )
    assert np.abs(moved['skew'][:, 1]).max() < 1e-9
    np.testing.assert_allclose(np.abs(moved['skew'][:, 0]), 0.01 * np.abs(q[:, 1]), atol=1e-9)
    profile = hidden('radial_profile', scene, 2.0)[1]
    assert np.abs(profile[:, 0] * q[:, 1] - profile[:, 1] * q[:, 0]).max() < 1e-7


def test_decentering_is_thrice_as_strong_along_the_radius():
    scene = scene_of()
    field = hidden('decentering', scene, 1.0)[0].field
    angle = np.linspace(0, 2 * np.pi, 361)
    circle = 100 * np.c_[np.cos(angle), np.sin(angle)]
    moved = field(circle + np.array([scene.lens.cx, scene.lens.cy]))
    radial = (moved * circle).sum(1) / 100
    across = (moved[:, 1] * circle[:, 0] - moved[:, 0] * circle[:, 1]) / 100
    assert radial.max() == pytest.approx(3 * across.max(), rel=1e-3)


def test_sensor_tilt_leaves_its_axis_in_place_and_lines_straight():
    scene = scene_of()
    field = hidden('sensor_tilt', scene, 0.05)[0].field
    middle = np.array([scene.lens.cx, scene.lens.cy])
    angle = np.linspace(0, np.pi, 20001)
    moved = np.linalg.norm(field(middle + 200 * np.c_[np.cos(angle), np.sin(angle)]), axis=1)
    assert moved.min() < 1e-3 < 1 < moved.max()
    line = middle + [50, -120] + np.linspace(0, 1, 5)[:, None] * np.array([30, 250])
    bent = line + field(line)
    assert np.linalg.svd(bent - bent.mean(0))[1][1] < 1e-9


@pytest.mark.parametrize('name', ['focal_drift', 'session_step'])
def test_lens_changes_over_time(name):
    scene = scene_of()
    moved = hidden(name, scene, 0.01)[1]
    q = from_center(scene)
    views = [scene.frame == frame for frame in range(scene.frames)]
    zoom = np.array([np.polyfit(q[on].ravel(), moved[on].ravel(), 1)[0] for on in views])
    if name == 'session_step':
        still = np.array([np.abs(moved[on]).max() == 0 for on in views])
        assert 0 < still.sum() < scene.frames
        assert np.all(np.diff(still.astype(int)) <= 0)
    else:
        assert zoom.std() == pytest.approx(0.01, rel=0.05)
        turns = np.diff(np.sign(np.diff(zoom)))
        assert np.count_nonzero(turns) <= 4


def test_effects_on_the_target():
    scene = scene_of('cube')
    target = scene.target
    survey, moved = hidden('landmark_survey', scene, 0.01)
    bad = np.linalg.norm(survey.landmarks, axis=1) > 0
    assert 1 <= bad.sum() <= 4
    np.testing.assert_array_equal(np.abs(moved).max(1) > 1e-9, bad[scene.landmark])
    stretch = hidden('landmark_scale', scene, 0.01)[0].landmarks
    bow = hidden('target_shape', scene, 0.01)[0].landmarks
    askew = hidden('board_pose', scene, 1e-5)[0].landmarks
    for board in np.unique(target.board):
        on = target.board == board
        across = target.axes[on, 2]
        assert np.linalg.matrix_rank(stretch[on], tol=1e-9) == 1
        assert np.abs(np.einsum('ij,ij->i', stretch[on], across)).max() < 1e-12
        assert np.abs(np.cross(bow[on], across)).max() < 1e-12
        x, y = target.local[on].T
        smooth = np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], 1)
        height = np.einsum('ij,ij->i', bow[on], across)
        fitted = smooth @ np.linalg.lstsq(smooth, height)[0]
        np.testing.assert_allclose(fitted, height, atol=1e-12)
        before, after = target.points[on], target.points[on] + askew[on]
        np.testing.assert_allclose(
            np.linalg.norm(after - after[0], axis=1),
            np.linalg.norm(before - before[0], axis=1),
            atol=1e-9,
        )
    apart = np.linalg.norm(target.points + askew - target.points[0] - askew[0], axis=1)
    assert np.abs(apart - np.linalg.norm(target.points - target.points[0], axis=1)).max() > 1e-6


def test_dots_are_seen_displaced_by_the_square_of_their_size():
    scene = scene_of()
    small, large = (hidden('dot_centroid', scene, a)[1] for a in (0.1, 0.2))
    np.testing.assert_allclose(large, 4 * small, atol=0.05 * np.abs(large).max())


def test_detector_bias_repeats_with_the_pixel():
    lock = hidden('detector_bias', scene_of(), 0.1)[0].lock
    uv = np.random.default_rng(1).uniform(0, 500, (50, 2))
    np.testing.assert_allclose(lock(uv), lock(uv + np.array([3, 7])), atol=1e-9)
    assert np.ptp(lock(uv)) > 0.1


def test_rolling_shutter_shows_each_row_at_its_time():
    scene = scene_of(moving=True)
    moved = hidden('rolling_shutter', scene, 0.02)[1]
    seen = simulated(scene) + moved
    late = 0.02 * (seen[:, 1] / scene.lens.height - 0.5)
    world = scene.target.points[scene.landmark]
    np.testing.assert_allclose(project(scene.lens, in_camera(scene, world, late)), seen, atol=1e-3)
    assert np.abs(moved).max() > 0.5


def test_effects_on_the_rig():
    scene = scene_of(stereo=True, moving=True)
    right = scene.camera == 1
    for name in ('stereo_time_offset', 'rig_flex'):
        moved = hidden(name, scene, 0.01)[1]
        assert np.abs(moved[~right]).max() < 1e-9
        assert np.median(np.linalg.norm(moved[right], axis=1)) > 0.1
    late = hidden('stereo_time_offset', scene, 0.01)[0].delay(simulated(scene))
    assert set(np.abs(np.unique(late))) == {0.0, 0.01}


def test_effects_on_table_and_noise():
    scene, rng = scene_of(), np.random.default_rng(SEED)
    swaps = hidden('wrong_ids', scene, 1.0)[0]
    assert len(swaps.swaps) == 5
    _, named = observed(rng, scene, [swaps], 0.0)
    changed = np.flatnonzero(named.landmark != scene.landmark)
    assert sorted(changed) == sorted(swaps.swaps.ravel())
    for first, second in swaps.swaps:
        assert scene.frame[first] == scene.frame[second]
        assert named.landmark[first] == scene.landmark[second]
    uv, _ = observed(rng, scene, [Departure(lattice=0.25)], 0.0)
    assert np.abs(uv * 4 - np.round(uv * 4)).max() < 1e-9
    spread = hidden('noise_vs_angle', scene, 0.5)[0].spread
    angle = incidence(local_points(scene))[0]
    order = np.argsort(angle)
    assert np.all(np.diff(spread[order]) >= -1e-9)
    assert np.sqrt(np.mean((spread - 1) ** 2)) == pytest.approx(0.5)


def test_ripple_has_a_tenth_of_the_picture_for_its_period():
    scene = scene_of()
    field = hidden('ripple', scene, 1.0)[0].field
    angle = np.linspace(0, np.pi, 181)
    period = scene.lens.width / 10 * np.c_[np.cos(angle), np.sin(angle)]
    start = np.random.default_rng(1).uniform(0, 500, (40, 1, 2))
    after = field((start + period).reshape(-1, 2)).reshape(40, 181, 2)
    assert np.abs(after - field(start[:, 0])[:, None]).max((0, 2)).min() < 0.1


@pytest.mark.parametrize(
    'name',
    [
        'viewpoint_shift',
        'sensor_tilt',
        'dot_centroid',
        'board_pose',
        'rolling_shutter',
        'rig_flex',
        *(name for name in OUTSIDE if not OUTSIDE[name].direct),
    ],
)
def test_sizes_are_what_poses_and_intrinsics_leave(name):
    blind = generate(SEED, 1, ((name, 0.5),), 0.0)
    scene = blind.scene
    assert blind.hidden[0].amount <= CATALOGUE[name].limit
    left = Free.of(scene).step(blind.uv - simulated(scene)).left
    excess = np.mean(left**2) / scene.noise**2 - 1
    parameters = 6 * scene.frames + 6 * (scene.rig is not None) + 8 * scene.fitted
    expected = 0.25 - parameters / (2 * len(left))
    assert excess == pytest.approx(expected, abs=6 / np.sqrt(len(left)))


@pytest.mark.parametrize('size', [0.0, 0.5, 1.0])
def test_background_is_as_large_as_stated(size):
    scene = scene_of('cube', stereo=True)
    free = Free.of(scene)
    background = draw_background(np.random.default_rng(SEED), scene, size, free)
    left = free.size(form(scene, background.departures) - simulated(scene))
    assert left == pytest.approx(size * scene.noise, rel=0.03)
    assert 0 <= background.outliers <= 0.02
    assert set(background.parts) == (set() if not size else {'board', 'frame', 'static'})
    uv, _ = observed(np.random.default_rng(1), scene, [], 0.02)
    far = np.linalg.norm(uv - simulated(scene), axis=1) > 0.75
    assert np.mean(far) == pytest.approx(0.02, abs=0.001)


def test_fitted_lens_is_a_fit():
    for index in range(20):
        blind = generate(SEED, index, (), 0.0)
        if blind.scene.fitted and blind.scene.lens.model == 'kannala_brandt':
            break
    kept = ~blind.scene.held[blind.scene.frame]
    points = local_points(blind.scene)
    fitted = (
        Free.of(blind.scene, blind.lens)
        .step(project(blind.lens, points) - simulated(blind.scene))
        .left
    )
    assert blind.lens != blind.scene.lens
    assert np.sqrt(np.mean(fitted[kept] ** 2)) < 0.2 * blind.scene.noise
    degrees = 2 * kept.sum() - 6 * (~blind.scene.held).sum() - 14
    expected = blind.scene.noise * np.sqrt(degrees / kept.sum())
    assert blind.rms_px == pytest.approx(expected, rel=0.05)


def test_sets_follow_from_the_seed(tmp_path):
    def written(index, name):
        wanted = plan('one', SEED, index)
        write(generate(SEED, index, wanted, 0.5), tmp_path / name, tmp_path / f'{name}.json')
        files = {path.name: path.read_text() for path in (tmp_path / name).iterdir()}
        # The last digits of a fit depend on where in memory an array lies.
        numbers = [float(word) for word in re.findall(r'-?\d+\.\d+', files.pop('lens.yaml'))]
        return files, numbers

    (first, numbers), (again, numbers_again) = written(2, 'first'), written(2, 'again')
    assert first == again and numbers == pytest.approx(numbers_again, rel=1e-9)
    assert first['observations.csv'] != written(3, 'other')[0]['observations.csv']
    assert set(first) == {'observations.csv', 'held_out.csv'}


def test_plans_go_through_all_effects_and_sizes():
    count = len(EFFECTS)
    one = [plan('one', SEED, i)[0] for i in range(3 * count)]
    assert set(one) == {(name, size) for name in EFFECTS for size in SIZES}
    for i in range(2 * count):
        first, second = plan('two', SEED, i)
        assert first[0] != second[0]
        if i % 9 == 0:
            assert len(generate(SEED, i, (first, second), 0.0).hidden) == 2
    assert {plan('outside', SEED, i)[0][0] for i in range(len(OUTSIDE))} == set(OUTSIDE)
    assert plan('clean', SEED, 0) == ()


@pytest.mark.parametrize('name', ['decentering', 'board_pose', 'stereo_time_offset'])
def test_the_command_line_reads_what_is_written(name, tmp_path):
    blind = generate(SEED, 0, ((name, 0.5),), 0.5)
    write(blind, tmp_path, tmp_path / 'truth.json')
    for table in ('observations', 'held_out'):
        rows = list(csv.DictReader((tmp_path / f'{table}.csv').open()))
        held = table == 'held_out'
        assert len(rows) == (blind.scene.held[blind.scene.frame] == held).sum()
    output = tmp_path / 'out'
    assert not main(
        [
            'localize',
            str(tmp_path / 'held_out.csv'),
            '--lens',
            str(tmp_path / 'lens.yaml'),
            '-o',
            str(output),
        ]
    )
    found = [json.loads(path.read_text()) for path in output.rglob('localize.json')]
    assert len(found) == 1 + (blind.scene.rig is not None)
    assert sum(one['observations'] for one in found) > 0.9 * len(rows)
    assert max(one['rms_px'] for one in found) < 30 * blind.scene.noise
    document = yaml.safe_load((tmp_path / 'lens.yaml').read_text())
    assert ('calibration' in document) == blind.scene.fitted
    truth = json.loads((tmp_path / 'truth.json').read_text())
    assert truth['hidden'][0]['effect'] == name


def said(*causes, verdict='explained', components=()):
    return {
        'verdict': verdict,
        'causes': [
            {'effect': effect, 'indistinguishable_from': alike, 'p_value': 1e-9}
            for effect, alike in causes
        ],
        'components': list(components),
        'seconds': 1.0,
    }


def component(stage, sd, p=1e-6):
    return {'name': stage, 'stage': stage, 'sd_px': sd, 'p_value': p}


def test_scores():
    truth = {
        'hidden': [{'effect': 'flat_port', 'size': 1.0, 'amount': 0.01, 'stage': 'lens'}],
        **dict.fromkeys(
            (
                'noise_px',
                'target',
                'model',
                'fitted',
                'stereo',
                'moving',
                'frames',
                'observations',
                'background',
            )
        ),
    }
    facts = score(
        truth,
        said(
            ('viewpoint_shift', ['flat_port']),
            ('skew', []),
            components=[
                component('lens', 0.2),
                component('target', 0.1),
                component('frame', 0.5, 0.2),
            ],
        ),
    )
    assert (facts['found'], facts['exactly'], facts['false']) == ([True], [False], ['skew'])
    assert facts['stage_right'] == [True]
    assert stage_right('lens or frame', {'frame': 1.0, 'lens': 0.1})
    facts = score(truth, said(verdict='unexplained', components=[component('target', 0.1)]))
    assert (facts['found'], facts['false'], facts['stage_right']) == ([False], [], [False])
    assert score(truth, {'failed': 'exit 1', 'seconds': 2.0})['verdict'] == 'failed'


@pytest.mark.parametrize('mode', MODES)
def test_trials_are_not_diagnosed_twice_and_reported(mode, tmp_path, monkeypatch):
    answers = iter([said(('skew', [])), said(('aspect', []), components=[component('lens', 1)])])
    monkeypatch.setattr(run, 'diagnose', lambda given, output: next(answers))
    this = run.Run(mode, SEED, 0.5, 2)
    scores = [run.trial(this, i, tmp_path) for i in range(2)]
    assert scores == [run.trial(this, i, tmp_path) for i in range(2)]
    report.write_reports(
        tmp_path / 'docs/results', this.name, {**this._asdict(), 'scores': scores}
    )
    table = json.loads((tmp_path / f'docs/results/blind/independent_{this.name}.json').read_text())
    assert table['scores'] == scores
    page = (tmp_path / 'docs/results/blind_independent.md').read_text()
    assert f'--seed {SEED} --background 0.5 --mode {mode}' in page
    assert 'explained' in page


# More of them are in docs/results/blind_independent.md.
FIXED = (
    'viewpoint_shift',
    'radial_profile',
    'sensor_tilt',
    'focal_drift',
    'board_pose',
    'decentering',
    'wrong_ids',
)


def diagnosed(wanted, seed, folder):
    """Return the score of a set, given to the command line as files."""
    write(generate(seed, 0, wanted, 0.0), folder, folder / 'truth.json')
    files = [str(folder / name) for name in GIVEN]
    arguments = [files[0], '--lens', files[1], '--held-out', files[2], '-o', str(folder / 'out')]
    assert not main(['diagnose', *arguments])
    told = json.loads((folder / 'out' / 'diagnosis.json').read_text())
    return score(json.loads((folder / 'truth.json').read_text()), {**told, 'seconds': 0.0})


@pytest.mark.parametrize('name', FIXED)
def test_a_hidden_effect_is_named(name, tmp_path):
    facts = diagnosed(((name, 1.0),), SEED, tmp_path)
    assert facts['found'] == [True] and not facts['false']


@pytest.mark.slow
def test_fresh_sets_with_nothing_hidden_have_no_name(tmp_path):
    """False names are at most 1 in 20: two in six sets would be met once in thirty runs."""
    seed = int(np.random.SeedSequence().generate_state(1)[0])
    false = [diagnosed((), seed + i, tmp_path / str(i))['false'] for i in range(6)]
    assert sum(map(bool, false)) <= 2, f'seed {seed}: {false}'


def test_the_oracle_is_normal_without_and_finds_what_is_large():
    scene = scene_of()
    free = Free.of(scene)
    departure = CATALOGUE['decentering'].draw(np.random.default_rng(SEED), scene)(1.0)
    rng = np.random.default_rng(SEED)
    clean = [
        amplitudes(scene, free, observed(rng, scene, [], 0.0)[0], [departure])[0]
        for _ in range(60)
    ]
    assert abs(np.mean(clean)) < 0.5 and 0.7 < np.std(clean) < 1.3
    uv, _ = observed(rng, scene, [departure], 0.0)
    (strong,) = amplitudes(scene, free, uv, [departure])
    assert strong > 5 and finds(strong, 23) and not finds(2.0, 23)
    assert amplitudes(scene, free, uv, [Departure(lattice=0.1)]) == [None]
