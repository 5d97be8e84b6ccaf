"""The first screen of a report: what it warns of, and what its sentences say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.diagnoses import with_changes
from helpers.scenes import lens, observe, scene

from fisheye_svp_ros.diagnosis import Cause, Diagnosis, DiagnosisOptions, diagnose
from fisheye_svp_ros.diagnosis.decision import Bound, Figure
from fisheye_svp_ros.reporting.cause_text import size
from fisheye_svp_ros.reporting.first_screen import Photo, first_screen, terminal_lines
from fisheye_svp_ros.reporting.headline import headline, target_words


@pytest.fixture(scope='module')
def found() -> Diagnosis:
    rng = np.random.default_rng(8)
    return diagnose(observe(lens(), (), *scene(rng, frames=8), 0.2, rng), lens(),
                    options=DiagnosisOptions(quick=True))


@pytest.mark.parametrize(('ratio', 'warned'), [(0.9, False), (1.003, False), (1.05, True)])
def test_a_rise_is_warned_of_where_it_is_one(
    found: Diagnosis, ratio: float, warned: bool
) -> None:
    """Half a percent more is what another weighting of the same points makes."""
    named = found.figures.named
    risen = with_changes(found, named=type(named)(
        ratio * found.figures.base.rms_px, named.heldout_rms_px, named.chi2_per_dof))
    said = first_screen(risen, 'table').warning
    assert ('rms on the fitted frames, with the causes' in said) == warned


def test_bounds_are_read_in_percent_and_millimetres(found: Diagnosis) -> None:
    """A decentering "up to 0.0012" told nobody anything."""
    bounds = [Bound('decentering', 0.0012, '1', 0.7, 0.02, 0.05),
              Bound('viewpoint_shift', 0.0004, 'm', 0.7, 0.02, 0.05)]
    said = first_screen(_deciding(found, 'lens', bound=bounds), 'table').bound
    assert 'decentering up to 0.12 % (' in said
    assert 'viewpoint_shift up to 0.4 mm (' in said


def test_the_terminal_names_photographs_after_what_to_do(found: Diagnosis) -> None:
    screen = first_screen(found, 'table')
    action = screen.actions[2]._replace(
        do='Take some again', why='2 of 26 scatter', sure='',
        photographs=(Photo('10.jpg', ''), Photo('8.jpg', '')), more=1)
    lines = terminal_lines(screen._replace(actions=(action,)), '')
    assert ('Photographs: Take some again: 10.jpg, 8.jpg and 1 more. 2 of 26 scatter.'
            in lines)


def test_a_size_within_its_error_is_called_so(found: Diagnosis) -> None:
    """A cause may be certain by all its parameters together and each may be within its error."""
    assert size(found, _tilt(-0.0005, 0.002)) == 'size within its error: x = -0.03 ± 0.11 deg'
    assert size(found, _tilt(0.005, 0.002)) == 'x = 0.29 ± 0.11 deg'


def test_the_headline_says_that_the_target_is_imperfect_too(found: Diagnosis) -> None:
    """The decision was to measure the target again, and the headline spoke of the lens alone."""
    offsets = Figure('local_offsets', 0.38, 'px')
    again = replace(_deciding(found, 'target', say='measure_again', figure=offsets),
                    causes=[_tilt(0.005, 0.002)])
    assert headline(again).startswith(
        'The sensor is tilted (x = 0.29 ± 0.11 deg), and landmarks of the target are displaced '
        '(0.38 px). ')
    assert 'landmarks' not in headline(_deciding(again, 'target', say='keep'))


def _deciding(found: Diagnosis, about: str, **changes: object) -> Diagnosis:
    decided = {**found.decision, about: replace(found.decision[about], **changes)}
    return replace(found, conclusion=replace(found.conclusion, decision=decided))


def _tilt(value: float, error: float) -> Cause:
    return Cause('sensor_tilt', 'sensor_tilt', {'x': {
        'value': value, 'stderr': error, 'unit': 'rad'}}, 1e-9, 0.2, True, 0.1, 0.3, [], '')


@pytest.mark.parametrize(('parameter', 'words'), [
    ('relative', 'The scale of the target is wrong'), ('x_over_y', 'The target is stretched')])
def test_a_board_that_is_longer_one_way_is_not_one_of_another_scale(
    found: Diagnosis, parameter: str, words: str
) -> None:
    """Who reads that the scale is off by 0.47 % corrects the size of a square."""
    scale = replace(_tilt(0.0, 0.0), effect='landmark_scale', parameters={
        parameter: {'value': 0.0047, 'stderr': 0.0002, 'unit': '1'}})
    assert headline(replace(found, causes=[scale])).startswith(f'{words} ({parameter} = 0.47')


def test_only_a_bent_target_is_to_be_flattened(found: Diagnosis) -> None:
    again = _deciding(found, 'target', say='measure_again')
    assert target_words(replace(again, causes=[])) == 'Measure the target, or replace it'
    bent = replace(_tilt(0.0, 0.0), effect='target_shape')
    assert target_words(replace(again, causes=[bent])) == (
        'Measure the target, or flatten or replace it')


def test_an_undecided_lens_is_not_called_sure(found: Diagnosis) -> None:
    """"Not significantly smaller (96 % sure)" read as if that were sure."""
    lens = _deciding(found, 'lens', say='undecided', confidence=0.96)
    assert first_screen(lens, 'table').actions[0].sure == ''


@pytest.mark.parametrize(('say', 'warned'), [('keep', False), ('recalibrate', True)])
def test_only_an_extended_lens_that_is_offered_is_warned_of(
    found: Diagnosis, say: str, warned: bool
) -> None:
    """Beside "Keep the lens" stood that the error rises with a lens nobody was to use."""
    worse = _deciding(found, 'lens', say=say)
    worse = replace(worse, conclusion=replace(
        worse.conclusion, file=found.file._replace(given_px=0.1, extended_px=0.2)))
    assert ('extended lens on one target' in first_screen(worse, 'table').warning) == warned
