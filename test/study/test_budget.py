"""The budget of the SVP error, and the command that tells it."""

import json
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from helpers.nodes import ROOT
from matplotlib.figure import Figure

from fisheye_svp_ros.cli import main
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import LensError, ParameterError
from fisheye_svp_ros.io.lens_files import load_lens, save_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.optics.ports import FlatGlass
from fisheye_svp_ros.pose import axis_angle_between, identity
from fisheye_svp_ros.scene.observations import views_of
from fisheye_svp_ros.scene.rigs import rig
from fisheye_svp_ros.solve.localization import localize
from fisheye_svp_ros.study.budget import (
    QUANTITIES,
    Setup,
    at_point,
    default_spread,
    make_budget,
    widest_spread,
)

LENS = load_lens(lens_path('fish214'))
SPREAD = np.radians(80.0)


@pytest.fixture(scope='module')
def budget():
    return make_budget(Setup(LENS, rig('parallel'), 0.3), spreads=6, ranges=12)


@pytest.mark.parametrize(
    ('reached', 'spread'),
    [(80.0, 80.0), (80, 80.0), (300.0, 106.0), ('far', 106.0), (None, 106.0)],
)
def test_where_no_spread_is_named_a_calibration_says_how_far_it_reached(reached, spread):
    calibrated = replace(LENS, calibration={'reached_deg': reached} if reached else None)
    assert np.degrees(default_spread(calibrated)) == pytest.approx(spread, abs=0.1)


def point(budget, quantity, spread=SPREAD, working_range=0.5, **limits):
    found = at_point(budget, spread, working_range, limits)
    return found[QUANTITIES.index(quantity)]


def test_errors_shrink_or_stay_with_range(budget):
    for quantity in ('axis', 'residual', 'epipolar'):
        assert np.all(np.diff(budget.error[quantity], axis=1) < 0), quantity
    near, far = budget.error['position'][:, [5, -1]].T
    np.testing.assert_allclose(near, far, rtol=0.1)
    for quantity in ('position', 'depth'):
        assert np.all(np.diff(budget.noise[quantity][:, 1:], axis=1) > 0), quantity


def test_errors_are_those_of_localization(budget):
    """Recompute one entry from landmarks spread at random over the same cap."""
    rng = np.random.default_rng(2)
    cosine = rng.uniform(np.cos(budget.spreads[3]), 1, 4000)
    azimuth = rng.uniform(0, 2 * np.pi, 4000)
    sine = np.sqrt(1 - cosine**2)
    directions = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], axis=-1)
    points = budget.ranges[6] * directions[None]
    uv = ForwardModel(LENS).predict(identity(1), views_of(points, np.zeros((1, 4000, 2)))).uv
    solved = localize(ForwardModel(LENS.svp()), views_of(points, uv), identity(1))
    position = np.linalg.norm(solved.pose.position[0])
    assert budget.error['position'][3, 6] == pytest.approx(position, rel=0.15)
    residual = np.linalg.norm(solved.residual, axis=-1).mean()
    assert budget.error['residual'][3, 6] == pytest.approx(residual, rel=0.15)


def test_noise_is_the_scatter_of_noisy_solves(budget):
    rng = np.random.default_rng(3)
    i, j = 4, 7
    fine = make_budget(Setup(LENS, rig('parallel'), 0.3), spreads=6, ranges=12)
    np.testing.assert_array_equal(fine.noise['position'], budget.noise['position'])
    spiral = np.arange(48)
    cap = 1 - spiral / 47 * (1 - np.cos(budget.spreads[i]))
    azimuth = spiral * np.pi * (3 - np.sqrt(5))
    sine = np.sqrt(1 - cap**2)
    points = budget.ranges[j] * np.stack(
        [sine * np.cos(azimuth), sine * np.sin(azimuth), cap], axis=-1
    )
    count = 400
    uv = (
        ForwardModel(LENS.svp())
        .predict(identity(count), views_of(points, np.zeros((count, 48, 2))))
        .uv
    )
    noisy = views_of(points, uv + rng.normal(0, 0.3, uv.shape))
    solved = localize(ForwardModel(LENS.svp()), noisy, identity(count))
    scatter = np.sqrt((solved.pose.position**2).sum(axis=-1).mean())
    assert budget.noise['position'][i, j] == pytest.approx(scatter, rel=0.08)
    # Only turns across it turn the viewing axis, not the roll about it.
    turn = np.sqrt((axis_angle_between(solved.pose, identity(count)) ** 2).mean())
    assert budget.noise['axis'][i, j] == pytest.approx(turn, rel=0.08)


def test_at_the_nearest_range_the_limit_is_just_kept(budget):
    limit = 0.5
    found = point(budget, 'residual', residual=limit)
    assert not found.kept
    assert found.limit == pytest.approx(limit)
    there = point(budget, 'residual', working_range=found.nearest_range, residual=limit)
    assert there.error == pytest.approx(limit, rel=1e-6)
    beyond = point(budget, 'residual', working_range=1.01 * found.nearest_range, residual=limit)
    assert beyond.kept
    narrower = point(budget, 'residual', spread=0.99 * found.largest_spread, residual=limit)
    assert narrower.kept
    wider = point(budget, 'residual', spread=1.01 * found.largest_spread, residual=limit)
    assert not wider.kept


def test_limits_that_are_always_or_never_kept(budget):
    easy = point(budget, 'position', position=1.0)
    assert easy.kept
    assert easy.nearest_range == pytest.approx(budget.ranges[0])
    assert easy.largest_spread == pytest.approx(widest_spread(LENS))
    hard = point(budget, 'position', position=1e-7)
    assert not hard.kept
    assert np.isnan(hard.nearest_range)
    assert np.isnan(hard.largest_spread)


def test_noise_is_the_limit_where_none_is_stated(budget):
    found = point(budget, 'epipolar')
    assert found.limit == pytest.approx(found.noise)
    assert found.noise == pytest.approx(2 / np.sqrt(np.pi) * 0.3)


@pytest.mark.parametrize(
    ('spread', 'working_range', 'limits', 'reason'),
    [
        (np.radians(120), 0.5, {}, 'spread is 120 degrees; this lens and budget allow 15 to 106'),
        (SPREAD, 0.001, {}, 'range is 0.001 m; this lens and budget allow'),
        (SPREAD, 0.5, {'axis': -1.0}, 'limit of axis is -1 rad; it must be above 0'),
        (SPREAD, 0.5, {'depth': float('nan')}, 'limit of depth is nan m; it must be above 0'),
    ],
)
def test_impossible_questions(budget, spread, working_range, limits, reason):
    with pytest.raises(ParameterError, match=reason):
        at_point(budget, spread, working_range, limits)


def test_a_lens_without_a_shift_needs_no_budget():
    with pytest.raises(LensError, match=r"lens 'fish214' has no viewpoint_shift, .*diagnose"):
        make_budget(Setup(LENS.svp(), rig('parallel'), 0.3))


@pytest.mark.parametrize('noise', [0.0, -1.0, float('nan'), 1e9])
def test_impossible_noise(noise):
    with pytest.raises(ParameterError, match=r'noise is .* px; above 0 and up to'):
        make_budget(Setup(LENS, rig('parallel'), noise))


def test_a_noise_that_overflows_is_refused():
    """The answer divided by limits of 0."""
    with pytest.raises(ParameterError, match='noise is 1e-300 px; at least 1e-06 px'):
        make_budget(Setup(LENS, rig('parallel'), 1e-300))


def test_the_command_says_yes_and_no(tmp_path, capsys, drawn):
    assert main(['budget', '--lens', 'fish214', '--max-residual', '100']) == 0
    said = ' '.join(capsys.readouterr().out.split())
    assert 'Yes: for landmarks within 106 degrees of the axis at 0.5 m SVP keeps every' in said
    folder = tmp_path / 'out'
    assert (
        main(
            [
                'budget',
                '--lens',
                'fish214',
                '--spread',
                '80',
                '--max-position',
                '1',
                '--max-residual',
                '0.5',
                '-o',
                str(folder),
            ]
        )
        == 0
    )
    said = ' '.join(capsys.readouterr().out.split())
    assert 'No: for landmarks within 80 degrees of the axis at 0.5 m SVP breaks 2 of 2' in said
    written = json.loads((folder / 'budget.json').read_text(encoding='utf-8'))
    assert written['negligible'] is False
    assert written['answer'] in said
    by_name = {row['quantity']: row for row in written['at_point']}
    assert list(by_name) == list(QUANTITIES)
    assert by_name['position']['limit'] == pytest.approx(1e-3)
    assert by_name['position']['limit_is'] == 'given'
    assert by_name['depth']['limit_is'] == 'noise'
    # The paper's Fish214 at 0.5 m: millimetres.
    assert 1e-3 < by_name['position']['error'] < 8e-3
    assert (folder / 'budget.png').read_bytes().startswith(b'\x89PNG')


@pytest.mark.parametrize(
    ('limits', 'negligible', 'answer'),
    [
        ([], None, 'Not known: {} SVP keeps 3 of 5 limits; epipolar distance and stereo'),
        (
            ['--max-axis', '1e-9', '--max-depth', '1'],
            False,
            'No: {} SVP breaks 1 of 2 limits; the',
        ),
        (['--max-axis', '1'], True, 'Yes: {} SVP keeps every limit.'),
    ],
)
def test_what_no_camera_pair_sees_breaks_no_limit(limits, negligible, answer, tmp_path, capsys):
    """Left and right look away from each other, 5 m apart."""
    assert (
        main(
            [
                'budget',
                '--lens',
                'fish180',
                '--style',
                'divergent',
                '--baseline',
                '5',
                *limits,
                '-o',
                str(tmp_path),
            ]
        )
        == 0
    )
    said = ' '.join(capsys.readouterr().out.split())
    where = 'for landmarks within 89 degrees of the axis at 0.5 m'
    assert answer.format(where) in said and 'nan' not in said
    written = json.loads((tmp_path / 'budget.json').read_text(encoding='utf-8'))
    assert written['negligible'] is negligible
    assert [row['kept'] for row in written['at_point']][-1] is None


def test_the_picture_draws_the_limits_that_hold(tmp_path, monkeypatch):
    figures = []

    @contextmanager
    def kept(*_):
        figures.append(Figure(layout='constrained'))
        yield figures[-1]

    monkeypatch.setattr('fisheye_svp_ros.reporting.budget_report.picture', kept)
    limits = ['--max-position', '2', '--max-epipolar', '0.5']
    for given in (limits, []):
        assert main(['budget', '--lens', 'fish214', *given, '-o', str(tmp_path)]) == 0
    titles = [[axis.get_title() for axis in figure.axes] for figure in figures]
    named = {title.partition(':')[0] for title in titles[0] if ': limit' in title}
    assert named == {'position of the camera', 'epipolar distance'}
    assert sum(': limit' in title for title in titles[1]) == 5
    texts = [' '.join(t.get_text() for a in figure.axes for t in a.texts) for figure in figures]
    assert ['caused by noise' in text for text in texts] == [False, True]
    # Hatches ended half a cell before the border of the picture.
    written = json.loads((tmp_path / 'budget.json').read_text(encoding='utf-8'))
    shown = figures[0].axes[0]
    assert list(shown.get_xlim()) == pytest.approx([written['ranges_m'][i] for i in (0, -1)])
    assert list(np.radians(shown.get_ylim())) == pytest.approx(
        [written['spreads_rad'][i] for i in (0, -1)]
    )


@pytest.mark.parametrize(
    ('arguments', 'reason'),
    [
        (['--lens', 'none.yaml'], 'none.yaml: cannot be read'),
        (['--lens', 'fish180', '--style', 'crossed'], "style 'crossed' is unknown"),
        (['--lens', 'fish180', '--baseline', '0'], 'baseline is 0.0 m; it must be above 0'),
        (
            ['--lens', 'fish180', '--baseline', '1e9'],
            'baseline is 1e+09 m; a budget covers 0.001 to',
        ),
        (['--lens', 'fish180', '--noise', 'much'], 'invalid float value'),
    ],
)
def test_bad_input_is_one_line(arguments, reason, capsys):
    try:
        code = main(['budget', *arguments])
    except SystemExit as stop:
        code = stop.code
    assert code == 2
    error = capsys.readouterr().err
    assert reason in error
    assert error.count('\n') == 1


def test_a_lens_file_of_the_user(tmp_path, capsys):
    path = tmp_path / 'mine.yaml'
    save_lens(LENS.svp(), path)
    assert main(['budget', '--lens', str(path)]) == 2
    assert 'no viewpoint_shift' in capsys.readouterr().err


def test_the_readme_says_what_the_budget_says():
    text = (ROOT / 'README.md').read_text(encoding='utf-8')
    text = ' '.join(text.split())
    for words in ('nearer than 0.5 m', 'within 67° of the axis', 'beyond 13 m if'):
        assert words in text
    one, other = (
        make_budget(Setup(load_lens(lens_path(name)), rig('parallel'), 0.3))
        for name in ('fish180', 'fish214')
    )

    def nearest(found, degrees):
        return max(p.nearest_range for p in at_point(found, np.radians(degrees), 1.0, {}))

    assert max(nearest(one, degrees) for degrees in range(15, 89)) < 0.505
    assert max(nearest(other, degrees) for degrees in range(15, 68)) < 1.75
    assert 13 < nearest(other, 88) < 14
    position = at_point(other, np.radians(60), 1.0, {})[0]
    assert np.degrees(position.largest_spread) == pytest.approx(67, abs=0.5)


def test_a_calibration_in_air_is_not_for_water(tmp_path, capsys):
    """Behind a flat port nothing is seen beyond the critical angle, and all seems nearer."""
    wet = replace(LENS, port=FlatGlass(0.03, 1.333), max_incidence=np.radians(85.0))
    assert np.sin(widest_spread(wet) + np.radians(1.0)) == pytest.approx(
        np.sin(np.radians(85.0)) / 1.333
    )
    table = make_budget(Setup(wet, rig('parallel'), 0.3), spreads=4, ranges=6)
    far = table.error['position'][0, -1] / table.ranges[-1]
    assert far == pytest.approx(1 - 1 / 1.333, abs=0.02)
    save_lens(wet, tmp_path / 'wet.yaml')
    assert main(['budget', '--lens', str(tmp_path / 'wet.yaml'), '--range', '1']) == 0
    assert 'the lens in air breaks 5 of 5 limits' in capsys.readouterr().out
