"""Figures, decision and files that agree: on inputs that showed a fault, and on measured data."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.contradictions import check_document
from helpers.data import DATA

from fisheye_svp_ros import cli
from fisheye_svp_ros.io.csv_files import CsvTable
from fisheye_svp_ros.io.lens_files import save_lens
from fisheye_svp_ros.io.readers import read_observations
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.solve.lens_calibration import calibrate
from fisheye_svp_ros.solve.robust_calibration import calibrate_without_outliers

FAULTS = DATA.parent / 'faults'
# One process makes each diagnosis once.
pytestmark = pytest.mark.xdist_group('one_answer')
SETS = {
    'after_residuals': (FAULTS / 'after_residuals', 'observations.csv', False),
    'sound_lens': (FAULTS / 'sound_lens', 'train.csv', True),
    'half_diagnosis': (FAULTS / 'half_diagnosis', 'train.csv', True),
    'shutter_and_tilt': (FAULTS / 'shutter_and_tilt', 'train.csv', True),
    'ov_plane': (DATA / 'ov_plane', 'train.csv', True),
    'ov_cube': (DATA / 'ov_cube', 'train.csv', True),
}
# What is wrong with these lies in the data; only whether the answer contradicts itself is asked.
FLAWED = {
    'two_cameras_in_one': (FAULTS / 'two_cameras_in_one', 'obs.csv', False),
    'intrinsics_differ': (FAULTS / 'intrinsics_differ_by_frame', 'obs.csv', False),
    'sbs_bent_board': (FAULTS / 'sbs_bent_board', 'obs.csv', False),
    'keep_17deg': (FAULTS / 'keep_the_lens_17deg', 'k_center.csv', False),
    'enough_though_unknown': (FAULTS / 'enough_though_unknown', 'obs.csv', False),
    'sag_hides_the_bend': (FAULTS / 'sag_hides_the_bend', 'train.csv', True),
    'giant_landmark': (FAULTS / 'one_wrong_landmark', 'giant.csv', False),
    'scale10_shift': (FAULTS / 'scale10_shift', 'd2_x10.csv', False),
}
IMAGES = {
    'two_cameras_in_one': (2560, 960),
    'intrinsics_differ': (1280, 960),
    'sbs_bent_board': (2560, 960),
    'enough_though_unknown': (640, 480),
    'sag_hides_the_bend': (960, 600),
}


@pytest.fixture(scope='module')
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Folders of diagnoses, made when asked for."""
    return {'': tmp_path_factory.mktemp('sets')}


def diagnosed(results: dict[str, Path], name: str) -> tuple[Path, dict[str, Any]]:
    """Return the folder of a set's diagnosis and what its JSON holds."""
    folder, file, held_out = (SETS | FLAWED)[name]
    if not folder.exists():
        pytest.skip(f'{folder} is not there')
    out = results[''] / name
    if name not in results:
        results[name] = out
        lens = next(iter(sorted({*folder.glob('*.yaml')} - {folder / 'truth.yaml'})), None)
        if lens is None:
            lens = results[''] / f'{name}.yaml'
            save_lens(calibrated(folder / file, IMAGES.get(name, (1280, 800))), lens)
        more = ['--held-out', str(folder / 'test.csv')] if held_out else []
        if folder.parent == DATA or name in FLAWED:
            more.append('--quick')  # with all rounds it takes minutes
        command = ['diagnose', str(folder / file), '--lens', str(lens), *more, '-o', str(out)]
        with (results[''] / f'{name}.txt').open('w') as said, contextlib.redirect_stdout(said):
            assert cli.main(command) == 0
    return out, json.loads((out / 'diagnosis.json').read_text())


def calibrated(file: Path, size: tuple[int, int]) -> Lens:
    """Return the lens of observations, without its standard errors, which take longer than all."""
    found, _, _ = calibrate_without_outliers(
        read_observations(file), lambda rows: calibrate(rows, 'kannala_brandt', size)
    )
    return found.adjusted.lens


@pytest.mark.parametrize('name', SETS)
def test_the_error_falls_and_residuals_have_the_rms_that_is_reported(
    results: dict[str, Path], name: str
) -> None:
    out, found = diagnosed(results, name)
    base, named, extended = (found[one]['rms_px'] for one in ('base', 'named', 'extended'))
    assert base >= named >= extended
    table = CsvTable(out / 'residuals.csv', ['frame'])
    kept = ~table.integers('outlier').astype(bool)
    for side, rms in (('before', base), ('after', named)):
        squares = (table.numbers(f'du_{side}', f'dv_{side}')[kept] ** 2).sum(axis=1)
        assert np.sqrt(squares.mean()) == pytest.approx(rms, rel=1e-6)


@pytest.mark.parametrize('name', SETS)
def test_decision_verdict_and_report_agree(results: dict[str, Path], name: str) -> None:
    out, found = diagnosed(results, name)
    lens = found['decision']['lens']
    effects = {cause['effect'] for cause in found['causes']}
    assert not effects & {one['effect'] for one in found['candidates']}
    assert (found['verdict'] in ('explained', 'partly_explained')) == (
        bool(effects) or lens['say'] == 'recalibrate'
    )
    words = {
        'keep': 'Use this lens: ',
        'use_extended': 'Use extended_lens.yaml',
        'recalibrate': 'Do not use this lens',
        'undecided': 'Use this lens only where',
    }
    title = (out / 'report.html').read_text().partition('<h1>')[2].partition('</h1>')[0]
    assert words[lens['say']] in title
    if lens['say'] == 'use_extended':
        assert found['file']['extended_px'] < found['file']['given_px']
    if lens['say'] in ('keep', 'undecided'):
        assert lens['bound'] and all(one['edge_px'] > 0 for one in lens['bound'])


@pytest.mark.parametrize(
    'name', [*SETS, *(pytest.param(name, marks=pytest.mark.slow) for name in FLAWED)]
)
def test_nothing_contradicts_anything_else(results: dict[str, Path], name: str) -> None:
    _, found = diagnosed(results, name)
    check_document(found, (results[''] / f'{name}.txt').read_text())


def test_a_rolling_shutter_is_no_tilt(results: dict[str, Path]) -> None:
    """A false tilt made the prediction of the test frames worse."""
    _, found = diagnosed(results, 'shutter_and_tilt')
    names = {cause['effect'] for cause in found['causes']}
    assert 'rolling_shutter' in names and names <= {'rolling_shutter', 'target_shape'}


def test_a_better_lens_shows_as_such(results: dict[str, Path]) -> None:
    """Of the truth it is 16 times better; on the flat target it seemed worse."""
    _, found = diagnosed(results, 'sound_lens')
    assert found['lens']['heldout_rms_px'] > found['base']['heldout_rms_px']
    assert found['file']['gain'] > 0.7 and found['decision']['lens']['say'] == 'use_extended'
    given, extended = (found['lens']['ray_error_mrad'][side][1] for side in ('given', 'extended'))
    assert given['range_m'] == 1.0 and given['value'] > 8 * extended['value']


def test_what_half_a_diagnosis_would_make_worse_is_offered_with_its_other_half(
    results: dict[str, Path],
) -> None:
    """A shift of 4.7 mm is not named; with the bend alone the lens was three times worse."""
    _, found = diagnosed(results, 'half_diagnosis')
    (shift,) = (
        one for one in found['lens']['averaged_effects'] if one['effect'] == 'viewpoint_shift'
    )
    e0 = shift['parameters']['e0']
    assert shift['probability'] > 0.8 and abs(e0['value'] - 0.0047) < 2 * e0['stderr']
    given, extended = (found['lens']['ray_error_mrad'][side][1] for side in ('given', 'extended'))
    assert found['decision']['lens']['say'] == 'use_extended'
    assert found['file']['gain'] > 0 and extended['value'] < given['value']


@pytest.mark.parametrize('name', SETS)
def test_a_lens_that_is_not_recommended_is_not_offered(
    results: dict[str, Path], name: str
) -> None:
    """Neither by a command, nor as a correction of the target; the file itself says why."""
    out, found = diagnosed(results, name)
    offered = found['decision']['lens']['say'] in ('use_extended', 'recalibrate')
    page = (out / 'report.html').read_text()
    assert ('/extended_lens.yaml' in page) == offered
    assert ('Use it with extended_lens.yaml' in page) <= offered
    first = (out / 'extended_lens.yaml').read_text().partition('\n')[0]
    assert first.startswith('# It is not known to be better than') == (not offered)
