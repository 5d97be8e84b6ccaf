"""The first screen of a report: what it warns of, and what its sentences say."""

from __future__ import annotations

import html
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast
from unittest.mock import Mock

import numpy as np
import pytest
from helpers.diagnoses import with_changes
from helpers.scenes import lens, observe, scene

from fisheye_svp_ros.diagnosis import (
    Action,
    Advice,
    Cause,
    Comparison,
    Diagnosis,
    DiagnosisOptions,
    Finding,
    Flaw,
    FlawKind,
    LensReason,
    Reason,
    diagnose,
)
from fisheye_svp_ros.diagnosis.adequacy import Adequacy, judge_data
from fisheye_svp_ros.diagnosis.decision import (
    EffectBound,
    Figure,
    TargetError,
    TargetFacts,
    TargetReason,
)
from fisheye_svp_ros.diagnosis.findings import MAX_SHIFT
from fisheye_svp_ros.diagnosis.variance_budget import Structure
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.optics.curves import Gennery
from fisheye_svp_ros.reporting.diagnosis_document import diagnosis_document
from fisheye_svp_ros.reporting.diagnosis_report import write_report
from fisheye_svp_ros.reporting.wording.accuracy import UsedRays
from fisheye_svp_ros.reporting.wording.actions import photographs_words, target_words
from fisheye_svp_ros.reporting.wording.adequacy import flaw_summary, frame_list
from fisheye_svp_ros.reporting.wording.causes import percent, size
from fisheye_svp_ros.reporting.wording.diagnosis import (
    known_reference,
    lens_contents,
    refusal_reason,
    verdict_sentences,
)
from fisheye_svp_ros.reporting.wording.first_screen import Photo, first_screen, terminal_lines
from fisheye_svp_ros.reporting.wording.headline import MAX_WORDS, headline, verdict_words
from fisheye_svp_ros.reporting.wording.next_steps import ReportInputs, next_step
from fisheye_svp_ros.reporting.wording.whats_wrong import nothing_named, wrong
from fisheye_svp_ros.scene.table_checks import MAX_TARGET_SIZE, target_size
from fisheye_svp_ros.solve.mirrored_points import Mirror

# Effects whose size is not one of their parameters.
_OWN_SIZE = (
    'target_shape',
    'viewpoint_shift',
    'landmark_scale',
    'landmark_survey',
    'sensor_tilt',
    'decentering',
    'skew',
)


@pytest.fixture(scope='module')
def found() -> Diagnosis:
    rng = np.random.default_rng(8)
    return diagnose(
        observe(lens(), (), *scene(rng, frames=8), 0.2, rng),
        lens(),
        options=DiagnosisOptions(quick=True),
    )


@pytest.mark.parametrize(('ratio', 'warned'), [(0.9, False), (1.008, False), (1.02, True)])
def test_a_rise_is_warned_of_where_it_is_one(found: Diagnosis, ratio: float, warned: bool) -> None:
    """Nearly a percent more is what another weighting of the same points makes."""
    named = found.figures.named
    risen = with_changes(
        found,
        named=type(named)(
            ratio * found.figures.base.rms_px, named.heldout_rms_px, named.chi2_per_dof
        ),
    )
    said = first_screen(risen, 'table').warning
    assert ('rms on the fitted frames, with the causes' in said) == warned


def test_bounds_are_read_in_percent_and_millimetres(found: Diagnosis) -> None:
    """A decentering "up to 0.0012" told nobody anything."""
    bounds = [
        EffectBound('decentering', 0.0012, '1', 0.7, 0.02, 0.05),
        EffectBound('viewpoint_shift', 0.0004, 'm', 0.7, 0.02, 0.05),
    ]
    said = first_screen(_deciding(found, 'lens', bound=bounds), 'table').bound
    assert 'decentering up to 0.12 % (' in said
    assert said.endswith('; px at the edge, 95 %')
    assert 'viewpoint_shift up to 0.4 mm (' in said


def test_the_terminal_names_photographs_after_what_to_do(found: Diagnosis) -> None:
    screen = first_screen(found, 'table')
    action = screen.actions[2]._replace(
        below=False,
        do='Take some again',
        why='2 of 26 scatter',
        sure='',
        photographs=(Photo('10.jpg', ''), Photo('8.jpg', '')),
        more=1,
    )
    lines = terminal_lines(screen._replace(actions=(action,)))
    assert 'Photographs: Take some again: 10.jpg, 8.jpg and 1 more. 2 of 26 scatter.' in lines
    long = action._replace(why=' '.join(['word'] * MAX_WORDS))
    lines = terminal_lines(screen._replace(actions=(long,)))
    assert 'Photographs: Take some again: 10.jpg, 8.jpg and 1 more.' in lines
    assert lines.index('') < lines.index(f'Photographs, why: {long.why}.')


def test_a_size_within_its_error_is_called_so(found: Diagnosis) -> None:
    """A cause may be certain by all its parameters together and each may be within its error."""
    assert (
        size(found, _tilt(-0.0005, 0.002)) == 'its size is within its error: x = -0.03 ± 0.11 deg'
    )
    assert size(found, _tilt(0.005, 0.002)) == 'x = 0.29 ± 0.11 deg'


def test_a_confounded_set_without_a_size_says_what_is_open(found: Diagnosis) -> None:
    """Once "sensor_tilt (89 %) or dome_port (11 %) (likely, more than 99 %: size within ...)"."""
    tilt = replace(
        _tilt(-0.0005, 0.002),
        indistinguishable_from=['dome_port'],
        odds={'sensor_tilt': 0.89, 'dome_port': 0.11},
    )
    alike = replace(found, causes=[tilt])
    table = (
        'sensor_tilt (89 %) or dome_port (11 %) (likely, more than 99 %: one of them is present, '
        'the size of each is unknown: x = -0.03 ± 0.11 deg)'
    )
    assert first_screen(alike, 'table').causes == table
    assert wrong(alike).startswith('The sensor is tilted, 89 % sure')


def test_an_impossible_shift_asks_for_the_unit_first(found: Diagnosis) -> None:
    """Boards in the wrong unit were to be photographed again, nearer and larger."""
    parameters = {'e0': {'value': 0.049, 'stderr': 0.001, 'unit': 'm'}}
    shift = Finding(
        'viewpoint_shift(order=1)', Reason.IMPLAUSIBLE, 1e-9, 1e-8, parameters=parameters
    )
    adequacy = judge_data(found.evaluation, [], found.components, {}, [shift])
    assert adequacy.flaws[0] == Flaw(FlawKind.SHIFT_TOO_LARGE, 0.049, MAX_SHIFT)
    assert _flawed(found, adequacy)[0] == (
        'Do not use this lens yet: the viewpoint would shift by 49 mm, more than in any real lens.'
    )


def test_a_shift_that_may_be_anything_is_no_impossible_one(found: Diagnosis) -> None:
    """Beside one that does the same, "76 mm, more than in any real lens" was 76 ± 39 mm."""
    parameters = {'e0': {'value': -0.076, 'stderr': 0.039, 'unit': 'm'}}
    shift = Finding(
        'viewpoint_shift(order=1)', Reason.IMPLAUSIBLE, 1e-9, 1e-8, parameters=parameters
    )
    flaws = judge_data(found.evaluation, [], found.components, {}, [shift]).flaws
    assert FlawKind.SHIFT_TOO_LARGE not in {flaw.kind for flaw in flaws}


def test_a_board_in_mm_is_no_reason_for_another_lens(found: Diagnosis) -> None:
    """Once "Use extended_lens.yaml" for a board of 200 m, its bend 1.3 m."""
    large = Flaw(FlawKind.TARGET_TOO_LARGE, 200.0, MAX_TARGET_SIZE)
    said = _flawed(replace(found, causes=[_tilt(0.005, 0.002)]), Adequacy((large,), 1.0))
    assert said[0] == (
        'Do not use this lens yet: the target is 200 m across: x, y, z must be in m, not mm.'
    )
    assert not any(line.startswith('Causes') for line in said)
    command = 'fisheye-svp diagnose IN_METERS.csv --lens l.yaml -o diagnosis'
    assert f'Next, with lengths in m: {command}' in said


def _flawed(found: Diagnosis, adequacy: Adequacy) -> list[str]:
    """Return the lines of a terminal about data of which something is wrong."""
    flawed = replace(found, adequacy=adequacy, decision=adequacy.revise(found.decision))
    inputs = ReportInputs('a.csv', ('l.yaml',), None, None, Path('out'), True)
    return terminal_lines(first_screen(flawed, 'table'), next_step(flawed, inputs))


@pytest.mark.parametrize('cameras', [('',), ('left', 'right')])
@pytest.mark.parametrize('say', ['use_extended', 'recalibrate', 'undecided'])
@pytest.mark.parametrize('kind', FlawKind)
def test_no_headline_of_flawed_data_is_long(
    kind: FlawKind, say: str, cameras: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    rays = UsedRays({'high': 4.6}, {}, 0.1, 1.6, 0.1, 0.0)
    monkeypatch.setattr('fisheye_svp_ros.reporting.wording.headline.used_rays', lambda _: rays)
    mirror = Mirror.IMAGE if kind is FlawKind.MIRRORED else None
    flaw = Flaw(kind, 1.2, 1.5, groups=((0,), (1,)), camera=cameras[0], mirror=mirror)
    reason = LensReason.NO_CAUSE_CONFIRMED if say == 'undecided' else LensReason.RAYS_BETTER
    flawed = SimpleNamespace(
        adequacy=Adequacy((flaw,), 1.0),
        decision={'lens': SimpleNamespace(say=say, reason=reason)},
        lenses=dict.fromkeys(cameras),
        offers_extended=say != 'undecided',
        is_lens_off=say == 'recalibrate',
    )
    said = headline(cast('Diagnosis', flawed))
    assert len(said.split()) <= MAX_WORDS
    assert said.startswith(('Use ', 'Do not use '))
    of_rays = say != 'recalibrate' and kind in (FlawKind.LENS_UNKNOWN, FlawKind.ANGLE_SHORT)
    told = '4.6 mrad (0.46 mm at 0.1 m; 95 % sure' if of_rays else flaw_summary(flaw)
    assert told.partition(': ')[0] in said


def test_data_that_no_lens_fits_have_a_next_step(found: Diagnosis) -> None:
    """The line "Next" was missing, and frames were cut: "frames 0, 2, 4, 6 and 4 more"."""
    groups = tuple(range(0, 16, 2)), tuple(range(1, 16, 2))
    mixed = Flaw(FlawKind.CAMERAS_MIXED, 4.5, 0.05, groups)
    said = _flawed(found, Adequacy((mixed,), 1.0))
    assert said[0] == (
        'Do not use a lens calibrated from these data: two groups of frames come from two cameras.'
    )
    assert said[1] == (
        'Wrong: One lens for all leaves 4.5 px: one camera took frames 0, 2, … 14; another '
        'frames 1, 3, … 15.'
    )
    assert (
        'Flaw: Two groups of frames come from two cameras, and one lens for all leaves 4.5 px '
        '(noise alone 0.071 px): one camera took frames 0, 2, … 14; another frames 1, 3, … 15.'
    ) in said
    size = f'{found.lens.width}x{found.lens.height}'
    assert (
        'Next, once for each group of frames: fisheye-svp calibrate ONE_GROUP.csv --image-size '
        f'{size} -o new_lens.yaml'
    ) in said
    assert not any(line.startswith(('Accuracy', 'Not ')) for line in said)


@pytest.mark.parametrize(
    ('frames', 'names', 'text'),
    [
        ([4], (), 'frame 4'),
        ([0, 1, 2, 3], (), 'frames 0 to 3'),
        ([0, 1, 5, 7, 8, 9], (), 'frames 0, 1, 5, 7 to 9'),
        ([1, 4, 7, 10], (), 'frames 1, 4, … 10'),
        (
            [*range(0, 30, 3), 31],
            (),
            'frames 0, 3, 6, 9, 12, 15, 18, 21 and 3 more',
        ),
        ([1, 2], ('1.jpg', '2.jpg'), '1.jpg, 2.jpg'),
    ],
)
def test_frames_are_listed_in_ranges(frames: list[int], names: tuple[str, ...], text: str) -> None:
    assert frame_list(frames, names) == text


@pytest.mark.parametrize(('say', 'lens'), [('keep', 'given'), ('use_extended', 'extended')])
def test_accuracy_is_that_of_the_lens_to_be_used(found: Diagnosis, say: str, lens: str) -> None:
    """A reader did not know what error to reckon with."""
    said = first_screen(_deciding(found, 'lens', say=say), 'table').accuracy
    error = found.ray_error_mrad()[lens][1]
    assert f'off by about {error["value"]:.2g} mrad at 1 m' in said
    assert f'The 95 % interval is {error["low"]:.2g} to {error["high"]:.2g} mrad' in said
    assert f'Within {np.degrees(found.adequacy.reached):.0f} deg' in said
    assert ('and rays of the lens as given by' in said) == (say == 'use_extended')


def test_an_undecided_lens_may_be_used_where_its_error_does_no_harm(found: Diagnosis) -> None:
    undecided = _deciding(found, 'lens', say='undecided')
    said = first_screen(undecided, 'table').accuracy
    assert 'rays of the lens as given' in said
    assert '. Until then, use the lens only where that is good enough' in said
    high = found.ray_error_mrad()['given'][1]['high']
    assert (
        f'Use this lens only where {high:.2g} mrad ({high:.2g} mm at 1 m; 95 % sure, out to '
        in headline(undecided)
    )


def test_of_a_lens_that_is_not_fitted_no_error_is_said(
    found: Diagnosis, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Diagnosis, 'ray_error_mrad', lambda _: {})
    kept = _deciding(found, 'lens', say='keep')
    assert not first_screen(kept, 'table').accuracy
    assert headline(kept) == 'Use this lens.'


def test_what_a_lens_claims_beyond_its_points_is_extrapolated(found: Diagnosis) -> None:
    claimed = min(lens.max_incidence for lens in found.lenses.values())
    short, whole = (
        first_screen(replace(found, adequacy=Adequacy((), reached)), 'table').accuracy
        for reached in (claimed / 2, claimed)
    )
    assert f' to {np.degrees(claimed):.0f} deg, the lens is extrapolated' in short
    assert 'extrapolated' not in whole


@pytest.mark.parametrize(
    ('bound', 'words'), [(1.2, ' only where '), (0.9, ': rays are accurate to ')]
)
def test_rays_that_may_be_off_by_over_a_millimeter_at_1_m_are_not_called_good(
    found: Diagnosis, monkeypatch: pytest.MonkeyPatch, bound: float, words: str
) -> None:
    """By the loss, whatever the noise of a point is."""
    rays = found.ray_error_mrad()
    given = [{**error, 'high': bound} for error in rays['given']]
    monkeypatch.setattr(Diagnosis, 'ray_error_mrad', lambda _: {**rays, 'given': given})
    kept = _deciding(found, 'lens', say='keep')
    assert f'Use this lens{words}{bound:.2g} mrad ({bound:.2g} mm at 1 m' in headline(kept)
    varied = replace(kept, adequacy=replace(kept.adequacy, frames_error=2e-3))
    assert f'this lens only where {np.hypot(bound, 2):.2g} mrad' in headline(varied)


def test_what_remains_is_said_beside_a_better_lens(found: Diagnosis) -> None:
    """Once "Use extended_lens.yaml" and "Enough" at seven times the noise."""
    left = 5 * 2**0.5 * found.noise_px
    better = _deciding(found, 'lens', say='use_extended')
    better = replace(better, file=found.file._replace(given_px=2 * left, extended_px=left))
    said = terminal_lines(first_screen(better, 'table'))
    mrad = 1e3 * left / next(iter(found.lenses.values())).fx
    off = f'ingle points are off by {left:.3f} px ({mrad:.2g} mrad), 5.0 times the noise'
    (accuracy,) = (line for line in said if line.startswith('Accuracy'))
    assert f'. S{off}' in accuracy
    followed = next_step(better, ReportInputs('a.csv', ('l.yaml',), None, None, Path(), False))
    assert ' --model-error ' in followed.command
    assert followed.purpose == 'to compute camera poses and their errors'
    noise = replace(better, file=found.file._replace(given_px=2 * left, extended_px=left / 5))
    assert 'ingle points' not in first_screen(noise, 'table').accuracy


def test_a_viewpoint_is_told_by_its_path_and_not_by_a_coefficient(found: Diagnosis) -> None:
    """Of e0 = 15.1 mm no point of the lens moved by more than 5.3 mm."""
    e0, angle = 0.015, 1.1
    moved = replace(found.lens, viewpoint_shift=Gennery(0.002, e0))
    cause = replace(
        _tilt(0.0, 0.0),
        form='viewpoint_shift',
        parameters={'e0': {'value': e0, 'stderr': 0.001, 'unit': 'm'}},
    )
    shifted = replace(found, causes=[cause], lenses={'': moved}, adequacy=Adequacy((), angle))
    path = 1e3 * e0 * (angle / np.sin(angle) - 1)
    assert wrong(shifted).startswith(
        f'The viewpoint of the lens moves by {path:.2g} mm from the axis to 63 deg; '
    )


def test_cards_derive_from_one_pair_of_figures(found: Diagnosis, tmp_path: Path) -> None:
    """Beside "0.091 → 0.091 px" stood "92 % of the squared error is removed", without a cause."""
    inputs = ReportInputs('obs.csv', ('l.yaml',), None, None, tmp_path, False)
    write_report(with_changes(found, causes=[]), {}, inputs)
    page = (tmp_path / 'report.html').read_text()
    assert 'no cause to correct' in page and 'is removed by' not in page
    write_report(replace(found, causes=[_tilt(0.005, 0.002)]), {}, inputs)
    page = (tmp_path / 'report.html').read_text()
    assert 'without and with the causes' in page and 'no cause to correct' not in page


def test_what_is_wrong_has_the_sizes_of_all_causes_or_counts_them(found: Diagnosis) -> None:
    """Once "also decentering and 1 more, see below"."""
    tilt = _tilt(0.005, 0.002)
    more = [replace(tilt, form=name) for name in ('decentering', 'skew')]
    assert wrong(replace(found, causes=[tilt, *more])).startswith(
        'The sensor is tilted (0.29 deg); decentering 0.29 deg; skew 0.29 deg; correction '
    )
    many = [replace(tilt, form=name) for name in CATALOGUE if name not in _OWN_SIZE]
    said = wrong(replace(found, causes=[tilt, *many]))
    assert len(said.split()) < MAX_WORDS and said.endswith(' more below')


def test_the_headline_says_that_the_target_is_imperfect_too(found: Diagnosis) -> None:
    """The decision was to measure the target again, and the headline spoke of the lens alone."""
    offsets = Figure('local_offsets', 0.38, 'px')
    again = replace(
        _deciding(
            found,
            'target',
            say='measure_again',
            reason=TargetReason.CAUSE_AND_OFFSETS,
            figure=offsets,
            facts=_facts(found)._replace(local_m=0.0003),
        ),
        causes=[_tilt(0.005, 0.002)],
    )
    assert wrong(again).startswith(
        'The sensor is tilted (0.29 deg); landmarks are displaced by 0.3 mm rms; correction '
    )
    harmless = _deciding(again, 'target', say='keep', reason=TargetReason.OFFSETS_HARMLESS)
    assert 'landmarks' not in wrong(harmless)


def _deciding(found: Diagnosis, about: str, **changes: object) -> Diagnosis:
    decided = {**found.decision, about: replace(found.decision[about], **changes)}
    return replace(found, decision=decided)


def _tilt(value: float, error: float) -> Cause:
    return Cause(
        'sensor_tilt',
        {'x': {'value': value, 'stderr': error, 'unit': 'rad'}},
        1e-9,
        0.2,
        True,
        0.1,
        0.3,
    )


@pytest.mark.parametrize(
    ('parameter', 'words'),
    [('relative', 'The scale of the target is wrong'), ('x_over_y', 'The target is stretched')],
)
def test_a_board_that_is_longer_one_way_is_not_one_of_another_scale(
    found: Diagnosis, parameter: str, words: str
) -> None:
    """Who reads that the scale is off by 0.47 % corrects the size of a square."""
    scale = replace(
        _tilt(0.0, 0.0),
        form='landmark_scale',
        parameters={parameter: {'value': 0.0047, 'stderr': 0.0002, 'unit': '1'}},
    )
    tilt = replace(
        _tilt(0.005, 0.001),
        indistinguishable_from=['decentering'],
        odds={'sensor_tilt': 0.6, 'decentering': 0.4},
    )
    said = wrong(replace(found, causes=[tilt]))
    assert said.startswith('The sensor is tilted (0.29 deg), 60 % sure')
    across = 4.7 * target_size(found.evaluation.problem.observations)
    assert wrong(replace(found, causes=[scale])).startswith(f'{words} ({across:.2g} mm, 0.47 %)')


def test_the_likelier_one_of_a_confounded_set_comes_first(found: Diagnosis) -> None:
    tilt = replace(
        _tilt(0.005, 0.001),
        indistinguishable_from=['frame_sag'],
        odds={'sensor_tilt': 0.005, 'frame_sag': 0.995},
    )
    assert wrong(replace(found, causes=[tilt])).startswith(
        'Bend of the board that follows its tilt'
    )


@pytest.mark.parametrize(
    ('error', 'words'),
    [
        (
            TargetError('target_shape', 0.0019),
            'flatten or replace it; a straightedge laid across it shows the gap of 1.9 mm',
        ),
        (
            TargetError('landmark_scale', 0.01, stretched=True),
            'measure its width and height with a steel ruler, to 0.5 mm',
        ),
        (
            TargetError('board_pose'),
            'measure how its boards are mounted to each other, with a steel ruler',
        ),
        (None, 'measure the distances between its landmarks with calipers, to 0.1 mm'),
    ],
)
def test_how_to_measure_a_target_is_said(
    found: Diagnosis, error: TargetError | None, words: str
) -> None:
    """Once "measure the target", and not with what, nor how precisely."""
    facts = _facts(found)._replace(largest=error, local_m=0.0003, bend_m=0.0, contradicted=False)
    again = _deciding(found, 'target', say='measure_again', facts=facts)
    assert target_words(again) == f'For better poses, {words}'
    bends = _deciding(again, 'target', facts=facts._replace(bend_m=0.0004))
    stiff = 'For better poses, mount it on a stiff plate'
    of_shape = error is None or error.effect == 'target_shape'
    assert target_words(bends) == (stiff if of_shape else f'{stiff}, and {words}')


def test_the_pair_of_figures_stays_beside_a_bend_between_frames(found: Diagnosis) -> None:
    """Of 1.19 px, which correction lowers to 0.27 px, nothing was said."""
    facts = _facts(found)._replace(bend_m=0.00033, bend_share=0.2)
    named = found.figures.named
    better = replace(
        with_changes(
            _deciding(found, 'target', facts=facts),
            named=type(named)(named.rms_px, 0.27, named.chi2_per_dof),
        ),
        causes=[replace(_tilt(0.005, 0.002), form='pupil_decentering')],
    )
    before = found.figures.base.heldout_rms_px
    assert wrong(better) == (
        'The entrance pupil moves sideways with the angle (0.29 deg); board bends 0.33 mm '
        f'rms between frames; correction: held-out error {before:.3f} → 0.270 px'
    )


def test_of_long_reasons_the_first_is_read_first(found: Diagnosis) -> None:
    """Once "Take 6 more", and how not before the details."""
    action = (
        first_screen(found, 'table')
        .actions[2]
        ._replace(
            do='Take 6 more',
            why=f'Go near, tilt the target; {" ".join(["word"] * 20)}',
            below=False,
        )
    )
    lines = terminal_lines(first_screen(found, 'table')._replace(actions=(action,)))
    assert 'Photographs: Take 6 more. Go near, tilt the target.' in lines
    assert f'Photographs, why: {action.why}.' in lines[lines.index('') :]


def _facts(found: Diagnosis) -> TargetFacts:
    facts = found.decision['target'].facts
    assert isinstance(facts, TargetFacts)
    return facts


def test_terminal_report_and_document_say_the_same(found: Diagnosis, tmp_path: Path) -> None:
    inputs = ReportInputs('obs.csv', ('l.yaml',), None, None, tmp_path, False)
    write_report(found, {}, inputs)
    page = html.unescape((tmp_path / 'report.html').read_text())
    lines = terminal_lines(first_screen(found, 'obs.csv'), next_step(found, inputs))
    first, card = lines[: lines.index('')], page.partition('<div class="verdict">')[2]
    said = diagnosis_document(found)['first_screen']
    assert first[0] == said['headline']
    assert first[1] == f'Wrong: {said["wrong"]}.'
    for about in ('target', 'photographs'):
        assert any(line.startswith(f'{about.capitalize()}: {said[about]}') for line in first)
    shown = ' '.join(re.sub('<[^>]*>', ' ', card.partition('<b>Data</b>')[0]).split())
    for line in first[1:-1]:
        about, _, text = line.partition(': ')
        assert f'{about} {text}' in shown
    assert first[0] in shown and next_step(found, inputs).command in shown


def test_missing_photographs_are_counted(found: Diagnosis) -> None:
    """Once "Take more", and not how many."""
    few = Flaw(FlawKind.FEW_FRAMES, 1, 8), Flaw(FlawKind.LENS_UNKNOWN, 0.0027, 0.001)
    adequacy = Adequacy(few, 0.9)
    flawed = replace(found, adequacy=adequacy, decision=adequacy.revise(found.decision))
    assert photographs_words(flawed) == 'Take 6 more'
    one = Mock(wraps=flawed, frames=1, adequacy=adequacy, decision=flawed.decision, advice=[])
    assert photographs_words(one) == 'Take 7 more'
    said = _flawed(found, adequacy)
    assert said[0] == 'Do not use this lens yet: one frame is too few to judge the lens.'
    assert said[1].startswith('Wrong: Rays are uncertain by up to ')
    assert '95 % sure, out to 52 deg off axis)' in said[1]
    assert (
        'Photographs: Take 6 more. Go near, tilt the target, and cover the image out to its edges.'
    ) in said


def test_frames_that_differ_are_told_in_mrad(found: Diagnosis) -> None:
    """Once "differs between frames by up to 4.4 %", which says little of what that costs."""
    ends = (0, 1, 2, 3), (4, 5, 6, 7)
    varies = Flaw(FlawKind.FOCAL_VARIES, 0.044, 0.006, ends)
    said = _flawed(found, Adequacy((varies,), 1.0, 0.0063))
    assert said[1] == (
        'Wrong: Single frames are off by 6.3 mrad (6.3 mm at 1 m): frames 0 to 3 differ from '
        '4 to 7.'
    )
    scattered = tuple(range(0, 90, 7)), tuple(b for a in range(3, 90, 9) for b in (a, a + 2))
    many = _flawed(found, Adequacy((replace(varies, groups=scattered),), 1.0, 0.0063))
    assert len(many[1].split()) <= MAX_WORDS
    assert 'frames 0, 7, … 84 differ from 3, 5, 12, ' in many[1] and many[1].endswith(' more.')


def test_an_undecided_lens_is_not_called_sure(found: Diagnosis) -> None:
    """Once "Not significantly smaller (96 % sure)" read as if that were sure."""
    lens = _deciding(found, 'lens', say='undecided', confidence=0.96)
    assert first_screen(lens, 'table').actions[0].sure == ''
    unlikely = _deciding(found, 'lens', say='recalibrate', confidence=0.2)
    assert first_screen(unlikely, 'table').actions[0].sure == ''


@pytest.mark.parametrize(('say', 'warned'), [('keep', False), ('use_extended', True)])
def test_only_an_extended_lens_that_is_offered_is_warned_of(
    found: Diagnosis, say: str, warned: bool
) -> None:
    """Beside "Keep the lens" stood that the error rises with a lens nobody was to use."""
    worse = _deciding(found, 'lens', say=say)
    worse = replace(worse, file=found.file._replace(given_px=0.1, extended_px=0.2))
    assert ('extended lens on one target' in first_screen(worse, 'table').warning) == warned


@pytest.mark.parametrize(
    ('share', 'words'),
    [
        (0.5, '50 %'),
        (0.9963, '99.6 %'),
        (0.99996, '100 %'),
        (0.0042, '0.4 %'),
        (0.0003, '0.03 %'),
        (-1e-9, '0 %'),
        (0.0, '0 %'),
        (-0.004, '-0.4 %'),
        (1.0, '100 %'),
    ],
)
def test_a_share_is_not_rounded_to_nothing_or_all(share: float, words: str) -> None:
    """Reports had "-0 % (-0 % to 0 %)", and gains of "100 % (100 % to 100 %)"."""
    assert percent(share) == words


def test_a_likely_shift_is_not_told_as_no_model_error(found: Diagnosis) -> None:
    """The headline was "No model error shows in these data. Use extended_lens.yaml."."""
    likely = replace(_deciding(found, 'lens', say='use_extended'), causes=[], remaining=[])
    assert likely.verdict == 'adequate'
    assert headline(likely).startswith(
        'Use extended_lens.yaml, not this lens: rays are accurate to '
    )
    assert wrong(likely) == 'No model error is confirmed in these data'
    assert verdict_words(likely) == 'Adequate: no model error is confirmed in these data'
    nothing, gained, _ = verdict_sentences(likely)
    assert nothing.startswith('Nothing is confirmed to be wrong in these data')
    assert 'the extended lens leaves' in gained


def test_a_lens_that_is_off_is_all_that_is_wrong(found: Diagnosis) -> None:
    """The verdict was explained, and the sentence below it "no effect explains them: ."."""
    off = replace(_deciding(found, 'lens', say='recalibrate'), causes=[], remaining=[])
    wrong, gained, _ = verdict_sentences(off)
    assert off.verdict == 'explained'
    assert wrong.startswith('Nothing except the intrinsics as given is wrong in these data')
    assert 'no extension improves' not in gained
    assert verdict_words(off) == 'Explained: the lens as given is off'
    more = replace(off, remaining=[Structure('theta', 1e-9, 0.1)])
    assert 'intrinsics as given are wrong. Fitted' in verdict_sentences(more)[0]
    assert verdict_words(more) == (
        'Partly explained: the lens as given is off; some of the residual error is unexplained'
    )


def test_an_imperfect_target_is_told_in_every_sentence(found: Diagnosis) -> None:
    """Once "Only the target is imperfect", and below: nothing is wrong, without a pattern."""
    figure = Figure('local_offsets', 0.38, 'px')
    again = replace(
        _deciding(found, 'target', say='measure_again', figure=figure),
        causes=[],
        remaining=[Structure('landmark', 1e-9, 0.9)],
    )
    assert again.verdict == 'adequate'
    wrong, *_ = verdict_sentences(again)
    assert wrong.startswith('Nothing except the target is wrong in these data')
    assert wrong.endswith(' and displaced landmarks.')


def test_outliers_alone_are_no_riddle_in_the_verdict(found: Diagnosis) -> None:
    gross = [{'frame': 4, 'landmark': 17, 'px': 12.3, 'why': 'far off'}]
    clean = with_changes(
        found, causes=[], remaining=[Structure('outliers', 0.0, 0.5)], gross=gross
    )
    assert 'nothing else is wrong' in wrong(clean)
    assert verdict_words(clean) == 'Unexplained: outliers; nothing else is wrong'


def test_words_about_the_target_agree_with_its_decision(found: Diagnosis) -> None:
    """diagnosis.json had `correct`; the terminal said to measure the target."""
    bent = replace(_tilt(0.0, 0.0), form='target_shape')
    kept = replace(_deciding(found, 'target', say='correct'), causes=[bent])
    assert not kept.offers_extended
    assert target_words(kept).startswith('For better poses, ')
    offered = _deciding(kept, 'lens', say='use_extended')
    assert target_words(offered).startswith('Use it with extended_lens.yaml')


def test_without_a_cause_the_truth_is_told_once(found: Diagnosis) -> None:
    """Once "1.55 mm → 1.55 mm" beside "Use extended_lens.yaml" read as if it gained nothing."""
    known = {'position_error_m': Comparison(0.002, 0.002, -1e-9, 0.0, 0.0)}
    assert first_screen(replace(found, causes=[]), 'table', known).truth == 'position error 2 mm'
    tilted = replace(found, causes=[_tilt(0.005, 0.002)])
    assert first_screen(tilted, 'table', known).truth == 'position error 2 mm → 2 mm'


def test_the_command_to_go_on_solves_the_same_problem(found: Diagnosis) -> None:
    """It left out the poses and the free intrinsics, and planned what was planned already."""
    inputs = ReportInputs(
        'a b.csv',
        ('l.yaml',),
        'p.csv',
        None,
        Path('out'),
        True,
        settings=('--poses', 'p.csv', '--free', 'intrinsics'),
    )
    lens_open = {'lens': SimpleNamespace(say='undecided')}
    open_ = SimpleNamespace(
        decision=lens_open,
        lenses={'': None},
        offers_extended=False,
        frames=20,
        evaluation=SimpleNamespace(problem=SimpleNamespace(plannable=True)),
        is_lens_off=False,
        adequacy=SimpleNamespace(is_misfit=False, flaws=()),
        candidates=[],
        file=SimpleNamespace(given_px=0.2),
        noise_px=0.2,
    )
    assert next_step(open_, inputs) == (
        'to list 6 views to photograph',
        "fisheye-svp diagnose 'a b.csv' --lens l.yaml --poses p.csv --free intrinsics --next 6 "
        '-o next',
    )
    assert next_step(open_, inputs._replace(planned=True)).command.startswith(
        "fisheye-svp localize 'a b.csv' --lens l.yaml"
    )


def test_no_plan_is_promised_that_the_target_does_not_allow(found: Diagnosis) -> None:
    """The command that the report printed ended with "the target is not one flat board"."""
    assert not found.evaluation.problem.plannable
    inputs = ReportInputs('a.csv', ('l.yaml',), None, None, Path('out'), True)
    step = next_step(_deciding(found, 'lens', say='undecided'), inputs)
    assert step.purpose == 'with more photographs'
    assert step.command == 'fisheye-svp diagnose MORE.csv --lens l.yaml -o more'


def test_photographs_are_named_only_beside_what_to_do_with_them(found: Diagnosis) -> None:
    """Once "Enough: frame 3. 16 frames, ..." did not say what was to be done with frame 3."""
    bad = replace(found, advice=[Advice(Action.CHECK_FRAMES, frames=[3])])
    for say, names in (('enough', []), ('more', []), ('retake', ['frame 3'])):
        action = first_screen(_deciding(bad, 'photographs', say=say), 'table').actions[2]
        assert [photo.name for photo in action.photographs] == names


def test_a_step_without_an_error_is_not_within_it(found: Diagnosis) -> None:
    step = replace(
        _tilt(0.0, 0.0),
        form='quantisation',
        parameters={'step': {'value': 0.25, 'stderr': 0.0, 'unit': 'px'}},
    )
    assert size(found, step) == 'step = 0.25 px'


def test_the_report_of_a_likely_shift_claims_no_causes(found: Diagnosis, tmp_path: Path) -> None:
    """Once "The lens with its causes" stood below "Causes: none", and "1 points" in outliers."""
    gross = [{'frame': 4, 'landmark': 17, 'px': 12.3, 'why': 'far off'}]
    likely = with_changes(_deciding(found, 'lens', say='use_extended'), causes=[], gross=gross)
    write_report(
        likely,
        {},
        ReportInputs('obs.csv', ('l.yaml',), None, None, tmp_path, False),
    )
    page = (tmp_path / 'report.html').read_text()
    assert f'is the lens {lens_contents(likely)}; every command' in page
    assert 'with its causes' not in page
    assert 'fits and pictures: 1 point<' in page


def test_what_is_only_assumed_is_told_so(found: Diagnosis) -> None:
    """With `--with target_shape` a sound board was "bent by 0.046 mm", p = 0.8 far below."""
    slight = replace(_tilt(0.0005, 0.002), p_value=0.8)
    known = replace(found, causes=[slight])
    assert 'assumed' not in wrong(known)
    options = DiagnosisOptions(quick=True, included=('sensor_tilt',))
    selection = found.evaluation.selection
    told = replace(
        known,
        evaluation=replace(
            found.evaluation,
            selection=replace(selection, problem=replace(selection.problem, options=options)),
        ),
    )
    assert wrong(told).startswith('The sensor is tilted (assumed, not significant); ')
    assert 'sensor_tilt, assumed by --with' in verdict_sentences(told)[0]


def test_one_frame_does_not_blame_the_target(found: Diagnosis) -> None:
    """Once "Only the target is imperfect", beside: one frame does not tell lens from target."""
    figure = Figure('local_offsets', 0.38, 'px')
    one = Mock(
        wraps=found,
        frames=1,
        causes=[],
        candidates=[],
        remaining=[],
        verdict='adequate',
        decision=_deciding(found, 'target', figure=figure).decision,
    )
    assert nothing_named(one) == 'there are errors, but one frame cannot show their cause'


def test_evidence_tells_what_was_not_confirmed_in_the_end(
    found: Diagnosis, tmp_path: Path
) -> None:
    """The table ended with "predicts better"; the first screen, "held-out frames refute it"."""
    refuted = Finding('sensor_tilt', Reason.REFUTED_BY_FRAMES, 1e-9, 1e-9)
    step = Finding('sensor_tilt', Reason.PREDICTS_BETTER, 1e-9, 1e-9, 99.0, 2, 93.0, 27.0)
    table = with_changes(found, causes=[], trace=[step], candidates=[refuted])
    write_report(
        table,
        {},
        ReportInputs('obs.csv', ('l.yaml',), None, None, tmp_path, False),
    )
    page = (tmp_path / 'report.html').read_text()
    assert 'predicts better; not confirmed: held-out frames refute it</td>' in page


def test_an_extended_lens_that_held_out_frames_refute_is_not_offered(found: Diagnosis) -> None:
    """Beside "use the extended lenses" a warning said that their held-out error is larger."""
    off = _deciding(found, 'lens', say='recalibrate')
    better = replace(off, file=found.file._replace(given_px=0.2, extended_px=0.1))
    assert headline(better) == 'Do not use this lens; calibrate again, or use extended_lens.yaml.'
    worse = replace(off, file=found.file._replace(given_px=0.1, extended_px=0.2))
    assert headline(worse) == 'Do not use this lens; calibrate again.'
    assert not first_screen(worse, 'table').warning and 'held-out frames' in refusal_reason(worse)
    inputs = ReportInputs('a.csv', ('l.yaml',), None, None, Path('out'), True)
    size = f'{found.lens.width}x{found.lens.height}'
    assert next_step(worse, inputs) == (
        'to calibrate again',
        f'fisheye-svp calibrate a.csv --image-size {size} -o recalibrated.yaml',
    )


def test_the_truth_is_named_only_where_poses_are_given(found: Diagnosis) -> None:
    """Depths of a stereo pair on a measured target were told as "Against the truth"."""
    known = {'depth_error_m': Comparison(0.002, 0.002, -1e-9, 0.0, 0.0)}
    lines = terminal_lines(first_screen(found, 'table', known))
    assert any(line.startswith('Against the target: ') for line in lines)
    assert not any('truth' in line for line in lines)
    assert known_reference(found) == 'the target'
    model = found.evaluation.fixed_model
    held = SimpleNamespace(
        fixed_model=SimpleNamespace(data=replace(model.data, poses=model.state.pose))
    )
    assert known_reference(Mock(evaluation=held)) == 'the truth'
