"""Sentences about facts: the one place where tests hold wording."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.diagnoses import TARGET

from fisheye_svp_ros.diagnosis import (
    Action,
    Advice,
    Cause,
    Decision,
    Finding,
    LensFacts,
    LensReason,
    PhotographsFacts,
    PhotographsReason,
    Reason,
    Rival,
    TargetError,
    TargetFacts,
    TargetReason,
)
from fisheye_svp_ros.diagnosis.causes import Imitation
from fisheye_svp_ros.diagnosis.decision import EffectBound, Figure, FileFigure, LensOffset
from fisheye_svp_ros.reporting.wording.causes import finding_reason, outlier_rows
from fisheye_svp_ros.reporting.wording.decisions import (
    advised_action,
    decision_reason,
    separation,
    target_error,
)
from fisheye_svp_ros.reporting.wording.headline import headline_changes, provisional_headline
from fisheye_svp_ros.reporting.wording.metrics import metric_text
from fisheye_svp_ros.reporting.wording.poses import map_notes, wrong_landmark_notes
from fisheye_svp_ros.solve.outliers import WrongLandmark

LENS = LensFacts(
    lens_causes=['sensor_tilt'],
    causes=['sensor_tilt', 'focal_length'],
    named_gain=(0.1, 0.02),
    file=FileFigure(0.123, 0.081, 0.75, 0.6, 0.84, 0.93),
    offset=LensOffset(1.2, 3.0, 0.001, 1.5),
    bounds=[EffectBound('viewpoint_shift', 0.0092, 'm', 2.6, 0.32, 1.58)],
    noise_px=0.05,
    falling=True,
    frames=12,
)
PHOTOGRAPHS = PhotographsFacts(26, ['1.jpg'], ['1.jpg'], 0.9, 0.09, 'keep', is_target_off=True)
_MAX_WORDS = 25


def _reason(
    reason: LensReason | TargetReason | PhotographsReason,
    facts: LensFacts | TargetFacts | PhotographsFacts,
) -> str:
    return decision_reason(Decision('keep', reason, facts, Figure('', 0.0, ''), None))


ALL = [
    *((reason, LENS) for reason in LensReason),
    *((reason, TARGET) for reason in TargetReason),
    *((reason, PHOTOGRAPHS) for reason in PhotographsReason),
]


@pytest.mark.parametrize(('reason', 'facts'), ALL)
def test_every_reason_is_a_short_clause(
    reason: LensReason | TargetReason | PhotographsReason,
    facts: LensFacts | TargetFacts | PhotographsFacts,
) -> None:
    """The first screen had "Sensor_tilt is confirmed": a sentence begins with no effect."""
    text = _reason(reason, facts)
    assert text and not text.endswith('.') and '_' not in text.split()[0]
    assert all(len(clause.split()) <= _MAX_WORDS for clause in text.split(';'))


@pytest.mark.parametrize(
    ('reason', 'facts', 'text'),
    [
        (
            LensReason.LENS_IS_OFF,
            LENS,
            'the lens as given is off by at least 1.2 mrad (1.5 px) at 1 m, 3.0 times the '
            'combined standard error',
        ),
        (
            LensReason.PREDICTS_BETTER,
            LENS,
            'it predicts held-out frames to 0.081 px, compared with 0.123 px for the lens as '
            'given. Landmarks are placed where the other frames see them',
        ),
        (
            LensReason.EFFECT_POSSIBLE,
            LENS,
            'possible but not confirmed: viewpoint_shift, which may cause up to 0.32 px at the '
            'edge',
        ),
        (
            LensReason.EFFECT_POSSIBLE,
            LENS._replace(open={'viewpoint_shift': 0.23}),
            'possible (23 %) but not confirmed: viewpoint_shift, which may cause up to 0.32 px at '
            'the edge',
        ),
        (
            LensReason.EFFECT_POSSIBLE,
            LENS._replace(open={'viewpoint_shift': 0.78}),
            'likely (78 %) but not confirmed: viewpoint_shift, which may cause up to 0.32 px at '
            'the edge',
        ),
        (
            LensReason.NO_CAUSE_CONFIRMED,
            LENS._replace(offset=LensOffset(0.3, 0.8, 0.6, 0.1)),
            'no error of the lens is confirmed, and its parameters agree with these data within '
            'their errors',
        ),
        (
            TargetReason.OFFSETS_HARMLESS,
            TARGET,
            'landmarks are displaced by 0.04 mm rms, which causes 0.05 px and only 0.4 mrad of '
            'pose error',
        ),
        (
            TargetReason.CORRECTION_GAINS,
            TARGET,
            'board 0 is bent by 0.81 mm; held-out frames confirm it',
        ),
        (
            PhotographsReason.SOME_ARE_WRONG,
            PHOTOGRAPHS,
            '1 of 26 is an outlier as a whole',
        ),
        (
            PhotographsReason.FRAMES_NOT_PREDICTED,
            PHOTOGRAPHS,
            'the others do not predict 1 of 26',
        ),
        (
            PhotographsReason.TOO_FEW_FRAMES,
            PHOTOGRAPHS._replace(unit='view', frames=1),
            'one view is too few; take 8 or more',
        ),
        (
            PhotographsReason.FRAMES_PREDICTED,
            PHOTOGRAPHS,
            '26 frames; the error on held-out ones is 10.0 times what noise and scatter would '
            'leave (1 would be ideal); the rest comes from the target',
        ),
        (
            PhotographsReason.FRAMES_PREDICTED,
            PHOTOGRAPHS._replace(heldout_px=0.09),
            '26 frames; the error on held-out ones is what noise and scatter would leave',
        ),
    ],
)
def test_why_something_is_to_be_done(
    reason: LensReason | TargetReason | PhotographsReason,
    facts: LensFacts | TargetFacts | PhotographsFacts,
    text: str,
) -> None:
    assert _reason(reason, facts) == text


def test_a_lens_of_a_rig_is_told_by_its_camera() -> None:
    assert LENS.offset is not None
    left = LENS._replace(offset=LENS.offset._replace(camera='left'))
    assert _reason(LensReason.LENS_IS_OFF, left).startswith('the lens of left as given is off')


def test_views_are_planned_only_where_they_can_be() -> None:
    reason = PhotographsReason.LENS_UNDECIDED
    assert '--next' in _reason(reason, PHOTOGRAPHS)
    assert '--next' not in _reason(reason, PHOTOGRAPHS._replace(plannable=False))


@pytest.mark.parametrize(
    ('error', 'text'),
    [
        (TargetError('target_shape', 0.81e-3), 'the board is bent by 0.81 mm'),
        (TargetError('landmark_survey', 2), '2 landmarks are displaced'),
        (TargetError('landmark_survey', 1), '1 landmark is displaced'),
        (TargetError('landmark_scale', 0.0047), 'the scale of the board is off by 0.47 %'),
        (
            TargetError('landmark_scale', 0.002, stretched=True),
            'the board is stretched by 0.2 %',
        ),
        (TargetError('board_pose'), 'the relative poses of its boards are wrong'),
    ],
)
def test_the_largest_error_of_the_target_is_said(error: TargetError, text: str) -> None:
    assert target_error(error) == text


ANGLE = {'x': {'value': 0.03, 'stderr': 0.001, 'unit': 'm'}}


@pytest.mark.parametrize('reason', Reason)
def test_every_finding_has_a_short_reason(reason: Reason) -> None:
    rival = Rival('session_step', 'focal_drift')
    finding = Finding('viewpoint_shift(1)', reason, 1e-9, 1e-8, parameters=ANGLE, rival=rival)
    text = finding_reason(finding)
    assert text and '{' not in text and len(text.split()) <= _MAX_WORDS


def test_a_finding_names_its_size_and_its_rival() -> None:
    far = Finding('viewpoint_shift', Reason.IMPLAUSIBLE, 0.0, 0.0, parameters=ANGLE)
    assert finding_reason(far) == (
        'a shift of 30 mm is larger than in any real lens: are lengths in m?'
    )
    rival = Rival('session_step', 'focal_drift')
    needless = Finding('sensor_tilt', Reason.NEEDLESS_BESIDE_RIVAL, 0.0, 0.0, rival=rival)
    assert finding_reason(needless) == 'not significant if session_step replaces focal_drift'


CAUSE = Cause('sensor_tilt', {}, 1e-9, 0.2, True, 0.1, 0.3)


@pytest.mark.parametrize('action', Action)
def test_every_advice_says_what_to_do(action: Action) -> None:
    text = advised_action(Advice(action, value=1e-3, cause=CAUSE))
    assert text and '{' not in text and not text.endswith('.')


def test_advice_holds_its_figure() -> None:
    assert 'bends by 1.0 mm' in advised_action(Advice(Action.SUPPORT_BOARD, value=1e-3))
    assert 'ones and do not' in advised_action(Advice(Action.VARY_VIEWS, value=float('inf')))
    assert 'taken within 9 s' in advised_action(Advice(Action.VARY_VIEWS, value=9.0))
    assert '(odds 1e+06 to 1 or more)' in advised_action(Advice(Action.CHECK_NUMBERS, value=1e6))


def test_what_separates_a_cause_counts_what_it_imitates() -> None:
    dome = replace(CAUSE, imitations=(Imitation('dome_port', 1.2e-3),))
    text = separation(dome)
    assert text.startswith(CAUSE.effect_class.to_separate)
    assert text.endswith('; if it is a dome_port, a ray error of 1.2 mrad remains')


def test_people_read_mm_and_degrees() -> None:
    assert metric_text('position_error_m') == ('position_error', 'mm', 1e3)
    quantity, unit, factor = metric_text('rotation_error_rad')
    assert (quantity, unit, round(factor, 3)) == ('rotation_error', 'deg', 57.296)
    assert metric_text('rms_px').title() == 'rms, px'
    assert metric_text('ambiguous').title() == 'ambiguous'


def test_a_map_says_where_it_cannot_be_relied_on():
    assert not [*map_notes((), 0, 0.2, (0.001, 0.002))]
    missing, outside, corners, focal = map_notes((4, 7), 3, 0.7, (0.02, 0.001))
    assert '2 tags are not in the map (4, 7)' in missing and 'Add such images' in missing
    assert '3 sightings' in outside and 'field of view' in outside
    assert '0.70 px' in corners
    assert 'focal length +2.0 ± 0.1 %: calibrate the lens again' in focal


def test_wrong_landmarks_are_named_with_what_to_do():
    moved = WrongLandmark(3, 20, 25.3, np.array([0.0, 0.03, 0.04]))
    other = moved._replace(number=7, offset=np.array([0.012, 0.0, 0.0]))
    lost = WrongLandmark(9, 18, 300.2, np.full(3, np.nan))
    assert list(wrong_landmark_notes([moved, other, lost])) == [
        'landmarks 3 (50 mm) and 7 (12 mm) are not at their stated positions and are rejected. '
        'Measure them again',
        'landmark 9: its 18 points are 300 px off, and no other position explains them. They '
        'are rejected. Check its number',
    ]
    assert moved.to_dict()['offset'] == [0.0, 0.03, 0.04] and lost.to_dict()['offset'] is None


def test_wrong_corners_of_tags_are_named_by_the_tag():
    moved = [
        WrongLandmark(24 + corner, 20, 25.3, np.array([0.0, 0.03, 0.001 * corner]))
        for corner in range(4)
    ]
    lost = [
        WrongLandmark(36 + corner, 18, 300.2 - corner, np.full(3, np.nan)) for corner in (0, 1)
    ]
    assert list(wrong_landmark_notes([*moved, *lost], of_tags=True)) == [
        'tag 6 is 30.1 mm from its stated position and is rejected. Measure it again',
        'tag 9: its 36 points are 300 px off, and no other position explains them. They are '
        'rejected. Check its number',
    ]


def test_many_outliers_of_one_view_are_one_row() -> None:
    gross = [
        {
            'frame': 4,
            'camera': 'left',
            'photograph': 'left19.jpg',
            'landmark': n,
            'px': 10.0 + n,
            'why': 'all points of the view are off',
        }
        for n in range(40)
    ]
    gross += [{'frame': 7, 'landmark': 3, 'px': 99.0, 'why': 'far from its prediction'}]
    view, point = outlier_rows(gross)
    assert (view.where, view.camera, view.points, view.px) == ('left19.jpg', 'left', 40, 49.0)
    assert view.landmarks == '0, 1, 2, 3, 4, 5 and 34 more'
    assert (point.where, point.camera, point.landmarks) == ('frame 7', '', '3')


def answer(*names: str, candidates: tuple[Finding, ...] = ()) -> SimpleNamespace:
    causes = [SimpleNamespace(effect=name) for name in names]
    return SimpleNamespace(causes=causes, trace=[], candidates=[*candidates])


def test_the_first_cause_is_the_headline() -> None:
    assert provisional_headline(()) == 'Provisional: no model error found yet'
    said = provisional_headline(('viewpoint_shift', 'skew', 'skew'))
    assert said == 'Provisional: The viewpoint of the lens shifts with the angle (also skew)'


def test_what_has_changed_since_is_said() -> None:
    assert headline_changes(('skew',), answer('skew')) == []
    refuted = Finding(form='skew', reason=Reason.REFUTED_BY_FRAMES, p_value=0.0, p_corrected=0.0)
    assert headline_changes(('skew',), answer('aspect', candidates=(refuted,))) == [
        'Since the provisional answer: found: aspect; not confirmed: skew (held-out frames refute '
        'it).'
    ]
