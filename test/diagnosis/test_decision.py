"""Decisions about lens, target and photographs from the figures behind them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.diagnoses import TARGET

from fisheye_svp_ros.diagnosis.causes import Cause
from fisheye_svp_ros.diagnosis.conclusion import Action, _largest_error, _measure_landmarks
from fisheye_svp_ros.diagnosis.decision import (
    EffectBound,
    FileFigure,
    LensFacts,
    LensOffset,
    LensReason,
    PhotographsFacts,
    PhotographsReason,
    TargetError,
    TargetReason,
    decide_lens,
    decide_photographs,
    decide_target,
    least_likely_offset,
)

BETTER = FileFigure(0.123, 0.081, 0.75, 0.6, 0.84, 1.0)
WORSE = FileFigure(0.337, 0.345, -0.4, -0.8, -0.05, 0.03)
SAME = FileFigure(0.1, 0.1, 0.01, -0.2, 0.2, 0.55)
SMALL = EffectBound('viewpoint_shift', 0.0004, 'm', 0.7, 0.02, 0.05)
LIKELY = EffectBound('viewpoint_shift', 0.0092, 'm', 2.6, 0.62, 1.12)
SOUND = LensFacts(
    [], [], (0.0, 0.0), SAME, LensOffset(0.3, 0.8, 0.6, 0.1), [SMALL], 0.05, True, 12
)


def test_a_sound_lens_is_kept_with_the_bound() -> None:
    found = decide_lens(SOUND)
    assert found.say == 'keep' and found.bound == [SMALL] and found.confidence == 0.95
    assert found.reason == LensReason.NO_CAUSE_CONFIRMED


@pytest.mark.parametrize('causes', [[], ['target_shape']])
def test_a_lens_off_by_three_of_its_errors_is_to_be_calibrated_again(causes: list[str]) -> None:
    """It was silently fitted anew, and called adequate."""
    off = SOUND._replace(offset=LensOffset(1.2, 3.0, 0.001, 1.5), causes=causes, file=BETTER)
    found = decide_lens(off)
    assert (found.say, found.reason) == ('recalibrate', LensReason.LENS_IS_OFF)
    assert found.figure == ('ray_error', 1.2, 'mrad')
    assert found.confidence == 1.0


def test_a_lens_is_calibrated_again_only_where_that_makes_it_twice_as_good() -> None:
    off = LensOffset(1.2, 3.0, 0.001, 1.5, better=0.3)
    assert decide_lens(SOUND._replace(offset=off)).say == 'keep'
    assert decide_lens(SOUND._replace(offset=off._replace(better=0.9))).say == 'recalibrate'


def test_a_lens_that_is_off_by_less_than_matters_is_not() -> None:
    little = LensOffset(0.02, 4.0, 0.001, 0.004)
    assert decide_lens(SOUND._replace(offset=little)).say == 'keep'
    unstated = LensOffset(0.15, 2.1, 0.01, 0.045, stated=False)
    assert decide_lens(SOUND._replace(offset=unstated)).say == 'keep'


def test_the_extended_lens_is_used_where_it_predicts_better_on_the_same_target() -> None:
    facts = SOUND._replace(causes=['target_shape'], named_gain=(0.8, 0.7), file=BETTER)
    found = decide_lens(facts)
    assert found.say == 'use_extended' and found.figure == ('file_gain', 0.75, '1')


def test_a_lens_that_is_expected_to_be_better_is_offered_named_cause_or_not() -> None:
    found = decide_lens(SOUND._replace(file=BETTER))
    assert (found.say, found.reason) == ('use_extended', LensReason.PREDICTS_BETTER)
    halved = decide_lens(SOUND._replace(rays=(1.2, 0.5), file=SAME._replace(sure=0.9)))
    assert (halved.say, halved.reason) == ('use_extended', LensReason.RAYS_BETTER)
    assert decide_lens(SOUND._replace(rays=(0.9, 0.5))).say == 'keep'
    refuted = SOUND._replace(rays=(1.2, 0.5), file=WORSE)
    assert decide_lens(refuted).say == 'keep'
    caused = SOUND._replace(causes=['target_shape'], named_gain=(-0.1, -0.2), file=BETTER)
    assert decide_lens(caused).say != 'use_extended'


def test_rays_that_ought_to_be_better_are_offered_only_where_held_out_frames_agree() -> None:
    """One such lens was 4 times worse: its gain was as likely a loss."""
    halved = SOUND._replace(rays=(1.2, 0.5), file=SAME._replace(sure=0.9))
    assert decide_lens(halved).reason == LensReason.RAYS_BETTER
    assert decide_lens(halved._replace(file=SAME._replace(sure=0.7))).say == 'keep'


def test_what_is_possible_and_not_confirmed_keeps_the_lens_from_being_kept() -> None:
    found = decide_lens(SOUND._replace(bounds=[LIKELY]))
    assert (found.say, found.reason) == ('undecided', LensReason.EFFECT_POSSIBLE)
    known = decide_lens(SOUND._replace(bounds=[LIKELY], open={'viewpoint_shift': 0.23}))
    assert (known.say, known.confidence) == ('undecided', 0.23)


def test_an_error_that_rises_on_the_fitted_frames_recommends_nothing() -> None:
    facts = SOUND._replace(
        causes=['target_shape'], named_gain=(0.8, 0.7), file=BETTER, falling=False
    )
    found = decide_lens(facts)
    assert found.say == 'undecided' and found.confidence == 0.0


def test_the_target_is_judged_by_what_poses_on_it_lose() -> None:
    """The same board was to be kept at .1 px of noise, and to be measured again at .03 px."""
    assert decide_target(TARGET).say == 'correct'
    costly = TARGET._replace(pose_error=1.2e-3)
    assert decide_target(costly).reason == TargetReason.CAUSE_AND_OFFSETS
    assert decide_target(TARGET._replace(contradicted=True)).say == 'measure_again'
    alone = costly._replace(largest=None)
    assert decide_target(alone).reason == TargetReason.OFFSETS_COST
    harmless = decide_target(alone._replace(pose_error=0.9e-3))
    assert (harmless.say, harmless.reason) == ('keep', TargetReason.OFFSETS_HARMLESS)
    none = alone._replace(local_px=0.0, local_m=0.0, pose_error=0.0)
    assert decide_target(none).say == 'keep'


def test_a_correction_that_gains_nothing_is_not_blamed_on_offsets_of_nothing() -> None:
    """Once "In addition, local offsets cause 0 px (0 % sure)" stood beside an assumed board."""
    found = decide_target(TARGET._replace(gain=(-0.2, -0.5, 0.0)))
    assert found.reason == TargetReason.CORRECTION_GAINS_NOTHING
    assert found.confidence is None


@pytest.mark.parametrize(('low', 'answer'), [(0.01, 'correct'), (-0.01, 'measure_again')])
def test_a_target_is_corrected_where_the_low_end_of_the_gain_is_above_zero(
    low: float, answer: str
) -> None:
    """Not where the gain is: as likely as not it would be a loss."""
    found = decide_target(TARGET._replace(gain=(0.5, low, 0.9)))
    assert found.say == answer and found.figure == ('gain', 0.5, '1')


@pytest.mark.parametrize(('pose_error', 'harmless'), [(0.99e-3, True), (1.01e-3, False)])
def test_offsets_are_harmless_up_to_a_milliradian(pose_error: float, harmless: bool) -> None:
    facts = TARGET._replace(largest=None, pose_error=pose_error, local_p=0.02)
    found = decide_target(facts)
    assert found.say == ('keep' if harmless else 'measure_again')
    assert found.confidence == pytest.approx(0.98)


def test_photographs_are_enough_or_not() -> None:
    facts = PhotographsFacts(26, [], [], 0.1, 0.09, 'keep')
    assert decide_photographs(facts).say == 'enough'
    assert decide_photographs(facts._replace(bad=['1.jpg', '2.jpg', '3.jpg'])).say == 'retake'
    assert decide_photographs(facts._replace(bad=['1.jpg'])).say == 'enough'
    known = facts._replace(bad=['1.jpg', '2.jpg', '3.jpg'], known=True)
    assert decide_photographs(known).say == 'enough'  # the lens is good without them
    few = facts._replace(frames=9)
    assert decide_photographs(few._replace(bad=['1.jpg'])).say == 'retake'
    alone = decide_photographs(few._replace(unlike=['1.jpg']))
    assert alone.reason == PhotographsReason.FRAMES_NOT_PREDICTED
    assert decide_photographs(facts._replace(frames=5)).say == 'more'
    assert decide_photographs(facts._replace(lens='undecided')).say == 'more'
    assert decide_photographs(facts._replace(unlike=['1', '2', '3', '4'])).say == 'more'


def test_enough_photographs_with_a_large_error_say_where_it_is_from() -> None:
    """Once "Enough. Held-out error 15.6 times what noise leaves" asked for a reason."""
    facts = PhotographsFacts(26, [], [], 0.9, 0.09, 'keep', is_target_off=True)
    assert facts.target_causes_rest
    assert not facts._replace(heldout_px=0.1).target_causes_rest


def test_all_that_is_likely_is_named() -> None:
    """Of three effects that are alike, only one was."""
    tilt = EffectBound('sensor_tilt', 0.002, 'rad', 2.7, 0.61, 1.1)
    found = decide_lens(SOUND._replace(bounds=[LIKELY, SMALL, tilt]))
    assert (found.say, found.reason) == ('undecided', LensReason.EFFECT_POSSIBLE)
    assert isinstance(found.facts, LensFacts) and found.facts.possible_effects == [LIKELY, tilt]


def test_one_frame_decides_nothing() -> None:
    """A board bent by 1.5 mm was called sound from one photograph, 95 % sure."""
    lens = decide_lens(SOUND._replace(frames=1))
    assert (lens.say, lens.reason) == ('undecided', LensReason.ONE_FRAME) and not lens.bound
    target = decide_target(TARGET._replace(largest=None, local_px=0.0, local_m=0.0, frames=1))
    assert target.confidence is None and target.reason == TargetReason.ONE_FRAME
    displaced = decide_target(TARGET._replace(largest=None, frames=1))
    assert displaced.say == 'keep' and displaced.reason == target.reason


def test_the_gain_of_all_offsets_is_not_that_of_one_landmark() -> None:
    """Once "Measure these landmarks (landmark 45)" was to remove 95 % of the held-out variance."""
    offset = np.full((20, 3), 1e-3)
    offset[7] = 4e-3
    offsets = SimpleNamespace(offset=offset, landmark=np.arange(20))
    (one,) = _measure_landmarks(SimpleNamespace(offsets=offsets), 0.95)  # type: ignore[arg-type]
    assert one.landmarks == [7]
    assert one.action is Action.MEASURE_LANDMARKS


def test_the_worst_of_several_lenses_may_be_so_by_chance() -> None:
    """Of two sound lenses one is below the limit of one nearly twice as often."""
    off = LensOffset(1.2, 2.5, 0.03, 1.5, camera='left')
    sound = LensOffset(0.2, 0.9, 0.6, 0.2, camera='right')
    alone, both = least_likely_offset([off]), least_likely_offset([sound, off])
    assert alone is not None and alone.matters(0.05) and least_likely_offset([]) is None
    assert both == off._replace(p_value=0.06) and not both.matters(0.05)
    certain = least_likely_offset([sound, sound])
    assert certain is not None and certain.p_value == 1.0


@pytest.mark.parametrize(
    ('effect', 'values', 'expected'),
    [
        ('landmark_survey', {'7.x': 1e-3, '7.y': 2e-3, '9.z': 1e-3}, (2, False)),
        ('landmark_survey', {'7.x': 1e-3, '7.y': 2e-3}, (1, False)),
        ('landmark_scale', {'relative': -0.0047}, (0.0047, False)),
        ('landmark_scale', {'x_over_y': 0.002}, (0.002, True)),
        ('board_pose', {'1.x': 1e-3}, (0.0, False)),
    ],
)
def test_the_largest_error_of_the_target(
    effect: str, values: dict[str, float], expected: tuple[float, bool]
) -> None:
    cause = Cause(
        effect,
        {name: {'value': value} for name, value in values.items()},
        1e-9,
        0.2,
        True,
        0.1,
        0.3,
    )
    smaller = replace(
        cause, form='board_pose' if effect != 'board_pose' else 'landmark_survey', share=0.1
    )
    largest = _largest_error(None, [smaller, cause])  # type: ignore[arg-type]
    size, stretched = expected
    assert largest == TargetError(effect, size, stretched=stretched)


def test_a_lens_is_not_kept_beside_a_likely_effect_that_costs_a_user_much() -> None:
    """Kept beside a shift of probability .87 that may cost more than 1 mrad."""
    likely = EffectBound('viewpoint_shift', 0.021, 'm', 1.9, 0.44, 1.2)
    facts = SOUND._replace(bounds=[likely])
    assert decide_lens(facts).say == 'keep'
    likely_there = facts._replace(open={'viewpoint_shift': 0.87})
    assert decide_lens(likely_there).say == 'undecided'
    cheap = replace(likely, edge_mrad=0.9)
    assert decide_lens(likely_there._replace(bounds=[cheap])).say == 'keep'
