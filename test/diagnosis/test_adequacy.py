"""Where data are not adequate, nothing reassures, and what is wrong with them is said."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from helpers.contradictions import check
from helpers.flawed_sets import board, flawed

from fisheye_svp_ros.cli import main
from fisheye_svp_ros.commands.lenses import load_with_notes
from fisheye_svp_ros.diagnosis import DiagnosisOptions, FlawKind, diagnose
from fisheye_svp_ros.io.lens_files import save_lens
from fisheye_svp_ros.io.readers import write_observations
from fisheye_svp_ros.optics.camera import back_project
from fisheye_svp_ros.reporting.wording.first_screen import first_screen, terminal_lines
from fisheye_svp_ros.reporting.wording.headline import MAX_WORDS, tone, verdict_words
from fisheye_svp_ros.reporting.wording.next_steps import NextStep
from fisheye_svp_ros.scene.observations import group_views
from fisheye_svp_ros.solve.frame_groups import find_frame_groups
from fisheye_svp_ros.solve.lens_calibration import calibrate

EVEN, ODD = tuple(range(0, 16, 2)), tuple(range(1, 16, 2))


@cache
def diagnosed(name):
    table, size = flawed(name)
    lens = calibrate(table, 'kannala_brandt', size).adjusted.lens
    return diagnose(table, lens, options=DiagnosisOptions(quick=True))


def screen(found):
    return ' '.join(terminal_lines(first_screen(found, 'set.csv')))


FLAWED = {
    'v upwards': FlawKind.MIRRORED,
    'zoom alternates': FlawKind.FOCAL_VARIES,
    'zoom in groups': FlawKind.FOCAL_VARIES,
    'stabilizer': FlawKind.CENTER_VARIES,
    'two cameras of one kind': FlawKind.CAMERAS_MIXED,
    'central': FlawKind.ANGLE_SHORT,
    'tiny board': FlawKind.LENS_UNKNOWN,
}


def once(name):
    """Return the mark of tests that share a diagnosis."""
    return pytest.mark.xdist_group(f'adequacy of {name}')


@pytest.mark.parametrize('name', [pytest.param(name, marks=once(name)) for name in FLAWED])
def test_nothing_reassures_on_inadequate_data(name):
    found = diagnosed(name)
    assert found.adequacy.flaws[0].kind == FLAWED[name]
    answers = {about: one.say for about, one in found.decision.items()}
    assert 'keep' not in answers.values()
    assert answers['photographs'] == ('retake' if found.adequacy.is_misfit else 'more')
    assert not any(one.bound or one.confidence is not None for one in found.decision.values())
    check(found)
    text = screen(found).replace('1 m; 95 % sure', '')  # of a bound
    assert 'Keep' not in text and 'Enough' not in text and '% sure' not in text
    assert tone(found) != 'adequate'  # no green headline
    assert 'describes these data' not in verdict_words(found)
    if found.adequacy.is_misfit:
        assert found.verdict == 'unexplained'


def _mirror_numbers(table, frames):
    """Return a table in which corners of some frames are numbered from the right."""
    points = board()
    x, y = np.round(points[:, :2].T / 0.03).astype(int)
    mirrored = 9 * y + 8 - x
    landmark = np.where(np.isin(table.frame, frames), mirrored[table.landmark], table.landmark)
    return replace(table, landmark=landmark, xyz=points[landmark])


UNKNOWN = {
    'few': (lambda: flawed('sound', frames=4), FlawKind.FEW_FRAMES),
    'noisy': (lambda: flawed('sound', noise=2.0), FlawKind.NOISE_TOO_LARGE),
    'mirrored': (
        lambda: (_mirror_numbers(flawed('sound')[0], [1, 5, 9, 13]), (1280, 960)),
        FlawKind.SIDES_DIFFER,
    ),
    'size': (lambda: (flawed('sound')[0], (1600, 1200)), FlawKind.OFF_CENTER),
    'breathing': (lambda: flawed('autofocus'), FlawKind.FOCAL_VARIES),
}


@pytest.mark.parametrize('name', UNKNOWN)
def test_where_the_loss_is_not_known_that_comes_first(name):
    """Two frames, 2 px of noise, mirrored corners and a wrong image size were "Keep, Enough"."""
    make, kind = UNKNOWN[name]
    table, size = make()
    lens = calibrate(table, 'kannala_brandt', size).adjusted.lens
    found = diagnose(table, lens, options=DiagnosisOptions(quick=True))
    assert found.adequacy.flaws[0].kind == kind
    assert {one.say for one in found.decision.values()} <= {'undecided', 'more', 'retake'}
    check(found)
    if kind == FlawKind.SIDES_DIFFER:
        assert found.adequacy.flaws[0].groups == ((1, 5, 9, 13),)
    if kind == FlawKind.FOCAL_VARIES:
        assert found.adequacy.frames_error > 5e-3  # 2 %
        (in_use,) = (one for one in found.ray_error_mrad()['in_use'] if one['range_m'] == 1.0)
        assert in_use['value'] > 5.0


@once('sound')
def test_sound_data_are_adequate():
    found = diagnosed('sound')
    check(found)
    assert not found.adequacy.flaws
    assert [one.say for one in found.decision.values()] == ['keep', 'keep', 'enough']
    assert tone(found) == 'adequate' and 'describes these data' in verdict_words(found)


@pytest.mark.parametrize(
    'name', [pytest.param(name, marks=once(name)) for name in (*FLAWED, 'sound')]
)
def test_what_is_read_first_is_short(name):
    """A headline of at most 25 words, and four lines of as many; all else is below."""
    step = NextStep('to compute camera poses', 'fisheye-svp localize a --lens b -o poses')
    lines = terminal_lines(first_screen(diagnosed(name), 'set.csv'), step)
    first = lines[: lines.index('')]
    assert len(first) <= 5
    assert max(len(line.split()) for line in first) <= MAX_WORDS


@once('zoom alternates')
def test_alternating_zoom_is_told_in_percent_and_by_frames():
    flaw = diagnosed('zoom alternates').adequacy.flaws[0]
    assert flaw.size == pytest.approx(0.06, rel=0.2)
    assert set(flaw.groups) == {EVEN, ODD}


@once('stabilizer')
def test_shifted_images_are_told_in_pixels():
    flaw = diagnosed('stabilizer').adequacy.flaws[0]
    assert 5 < flaw.size < 20


@once('two cameras of one kind')
def test_frames_of_two_cameras_are_told_by_number():
    assert set(diagnosed('two cameras of one kind').adequacy.flaws[0].groups) == {EVEN, ODD}


@once('central')
def test_angle_of_the_points_is_told():
    flaw = diagnosed('central').adequacy.flaws[0]
    assert np.degrees(flaw.size) == pytest.approx(11, abs=3)
    said = screen(diagnosed('central'))
    assert re.match(
        r'Use this lens only within \d+ deg of its axis, where rays are accurate to [\d.]+ mrad '
        r'\([\d.]+ mm at 1 m; 95 % sure\)\. '
        r"Wrong: Points reach \d+ of the lens's \d+ deg, so the lens is extrapolated beyond\. ",
        said,
    )


def test_landmarks_that_were_not_seen_reach_no_angle():
    """Landmarks behind the edge of the image counted: 130 deg instead of 90."""
    table, (width, height) = flawed('sound')
    inside = np.hypot(*(table.uv - [width / 2, height / 2]).T) < 250
    part = table.take(np.flatnonzero(inside))
    lens = calibrate(part, 'kannala_brandt', (width, height)).adjusted.lens
    found = diagnose(part, lens, options=DiagnosisOptions(quick=True))
    assert found.adequacy.reached == pytest.approx(
        back_project(lens, part.uv).theta.max(), abs=0.01
    )


def test_a_lens_known_in_part_is_told_by_every_command(tmp_path, capsys):
    table, size = flawed('central')
    lens = calibrate(table, 'kannala_brandt', size).adjusted.lens
    wide = replace(lens, image_height=type(lens.image_height)(), max_incidence=np.radians(95))
    save_lens(wide, tmp_path / 'lens.yaml')
    load_with_notes(tmp_path / 'lens.yaml')
    assert 'reach 12 deg of 95 deg; beyond, the lens is extrapolated' in capsys.readouterr().err


def test_calibrate_does_not_pass_over_what_no_lens_explains(tmp_path, capsys):
    """Without a stated sigma nothing was said of 4 px, at a noise of .05 px."""
    table, (width, height) = flawed('two cameras in blocks', frames=8)
    write_observations(tmp_path / 'points.csv', replace(table, sigma=np.full(len(table), np.nan)))
    points, lens = (str(tmp_path / name) for name in ('points.csv', 'lens.yaml'))
    main(['calibrate', points, '--image-size', f'{width}x{height}', '-o', lens])
    assert re.search(r'px is \d+\.\d times the image noise', capsys.readouterr().err)


@once('sound')
def test_bounds_name_their_angles_and_ranges():
    assert re.search(
        r'at the edge of the points \(\d+ to 85 deg, 0.\d+ to 0.\d+ m\)',
        screen(diagnosed('sound')),
    )


def test_groups_of_frames_are_found_where_no_lens_fits():
    table, size = flawed('two cameras in blocks', frames=10)
    views = group_views(table)
    groups = find_frame_groups(views, size, 0.05)
    assert [group.tolist() for group in groups] == [[*range(5)], [*range(5, 10)]]
