"""What is to be done about lens, target and photographs, and why."""

from __future__ import annotations

import math
from collections.abc import Mapping
from math import degrees
from typing import Any

from fisheye_svp_ros.diagnosis import (
    CONFIRMED_PROBABILITY,
    MIN_FRAMES,
    Action,
    Advice,
    Cause,
    Decision,
    EffectBound,
    LensFacts,
    LensReason,
    PhotographsFacts,
    PhotographsReason,
    TargetError,
    TargetFacts,
    TargetReason,
)
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.reporting.wording.adequacy import flaw_reason
from fisheye_svp_ros.reporting.wording.causes import chance, pixels
from fisheye_svp_ros.solve.outliers import FRAME, VIEW

COVERAGE = 'cover the image out to its edges, at different distances'
_GOOD_RATIO = 1.5  # of a held-out error to noise and scatter: more has a reason
_IDEAL_RATIO = 0.05  # so near to 1, a held-out error is what noise leaves
_SUBJECTS = {LensFacts: 'lens', TargetFacts: 'target', PhotographsFacts: 'photographs'}
_ONE_FRAME = 'one frame cannot separate errors of the lens from those of the target'
_ACTIONS = {
    Action.USE_EXTENDED: 'solve with the extended lens file',
    Action.DIAGNOSE_AIR: 'the lens already has errors in air: diagnose photographs in air '
    'first, then these with the extended lens of that run',
    Action.CALIBRATE_AIR: 'the lens was adjusted within the errors of its calibration in air. '
    'Take photographs in air that fill the image, or measure the target more precisely',
    Action.MEASURE_BOARD: 'measure the board, or flatten or replace it',
    Action.MEASURE_LANDMARKS: 'measure the landmarks of the target, starting with the largest '
    'errors',
    Action.SUPPORT_BOARD: 'support the board or hold it upright: lying face up, it bends by '
    '{mm:.1f} mm',
    Action.HOLD_STILL: 'hold camera and target still, or use a global shutter: while an image is '
    'read, the camera turns by {degrees:.2g} deg rms against the target',
    Action.VARY_VIEWS: 'take photographs from more different poses: errors of landmarks repeat '
    'in similar ones{soon} and do not average out. Check that the paper is flat, that nothing '
    'reflects, and that nothing is printed near the corners',
    Action.RETAKE: 'look at these photographs: they scatter more than the others (light, blur)',
    Action.CHECK_VIEWS: f'check these photographs: {VIEW}',
    Action.CHECK_FRAMES: f'check these photographs: {FRAME}',
    Action.CHECK_HELD_OUT_VIEWS: f'check these held-out photographs: {VIEW}',
    Action.CHECK_HELD_OUT_FRAMES: f'check these held-out photographs: {FRAME}',
    Action.CHECK_HELD_OUT_RIG: 'check these held-out photographs: their relative camera poses '
    'differ from the others, so each view has its own pose. Check that the rig was not '
    'moved and the cameras were not exchanged. Check that simultaneous photographs have the '
    'same number, and that points are numbered from the same end',
    Action.HOLD_OUT_SAME_TARGET: 'hold out photographs of the same target: in these, the same '
    'landmark numbers have other coordinates, so the errors of the target cannot be predicted',
    Action.TAKE_MORE_LIKE_THESE: 'take more photographs like these: the others do not predict '
    'them. Either they alone cover a part of the image, or they are wrong. The held-out rms '
    'excludes them',
    Action.NUMBER_LIKE_OTHERS: 'corners are numbered from another end of the board (odds '
    '{value:.2g} to 1 or more): they were reordered like the others; number them that way',
    Action.CHECK_NUMBERS: 'corners may be numbered from another end of the board (odds '
    '{value:.2g} to 1 or more): they were not reordered; check them',
    Action.SEPARATE_CAUSE: '{effect}: {how}',
}


def decision_reason(decision: Decision) -> str:
    """Return why, as a clause that begins in lower case and ends without a stop."""
    # What is to be done about a target in spite of flaws has its own reason.
    if decision.flaws and decision.say not in ('correct', 'measure_again'):
        return flaw_reason(decision.flaws, _SUBJECTS[type(decision.facts)])
    return _reasons(decision.facts)[decision.reason]


def _reasons(facts: LensFacts | TargetFacts | PhotographsFacts) -> Mapping[Any, str]:
    if isinstance(facts, LensFacts):
        return _lens_reasons(facts)
    if isinstance(facts, TargetFacts):
        return _target_reasons(facts)
    return _photographs_reasons(facts)


def _lens_reasons(facts: LensFacts) -> dict[LensReason, str]:
    """Return the clause of each reason."""
    file = facts.file
    return {
        LensReason.FITTED_ERROR_RISES: 'with the causes in the model, the error on the fitted '
        'frames rises, so nothing is recommended',
        LensReason.LENS_IS_OFF: _offset(facts),
        LensReason.ONE_FRAME: f'{_ONE_FRAME}; take {MIN_FRAMES} frames or more',
        LensReason.INTRINSICS_WRONG: 'the lens as given is wrong in '
        f'{", ".join(facts.wrong_intrinsics)}',
        LensReason.PREDICTS_BETTER: f'it predicts held-out frames to {pixels(file.extended_px)} '
        f'px, compared with {pixels(file.given_px)} px for the lens as given. Landmarks are '
        f'placed where the other frames see them{_unconfirmed_clause(facts)}',
        LensReason.RAYS_BETTER: f'the expected error of its rays is {facts.rays[1]:.2g} mrad, '
        f'compared with {facts.rays[0]:.2g} mrad for the lens as '
        f'given{_unconfirmed_clause(facts)}',
        LensReason.GAIN_UNCERTAIN: f'it is uncertain whether {", ".join(facts.lens_causes)} in '
        f'the lens reduces the held-out error ({pixels(file.given_px)} → '
        f'{pixels(file.extended_px)} px): the probability is {100 * file.sure:.0f} %',
        LensReason.EFFECT_POSSIBLE: _possible_effects(facts),
        LensReason.NO_CAUSE_CONFIRMED: _no_cause_clause(facts),
    }


def _unconfirmed_clause(facts: LensFacts) -> str:
    """Return what the extended lens has without a confirmed cause, as a clause; '' for nothing."""
    if facts.written:
        parts = ' and '.join(f'the {name.replace("_", " ")}' for name in facts.written)
        return f'. Part of the gain comes from {parts}, whose cause is unknown'
    if facts.lens_causes:
        return ''
    return '. Its parameters are estimated together with errors of the target'


def _offset(facts: LensFacts) -> str:
    off = facts.offset
    if off is None:
        return ''
    return (
        f'the lens{off.camera and f" of {off.camera}"} as given is off by at least '
        f'{off.mrad:.2g} mrad ({off.px:.2g} px) at 1 m, {off.ratio:.1f} times the combined '
        'standard error'
    )


def unconfirmed_effects(facts: LensFacts) -> str:
    """Return the effects for which the lens is undecided, as a clause that says how likely."""
    effects = [bound.effect for bound in facts.possible_effects]
    how, by = 'likely' if any(map(facts.is_likely, effects)) else 'possible', ''
    if len(effects) == 1 and effects[0] in facts.open:
        probability = facts.open[effects[0]]
        how += f' ({chance(probability)})'
        # All else that a cause needs it has.
        by = ' by held-out frames' if probability >= CONFIRMED_PROBABILITY else ''
    return f'{how} but not confirmed{by}: {" or ".join(effects)}'


def open_effect(facts: LensFacts) -> str:
    """Return the effect for which the lens is undecided, and how large it may be."""
    bound = facts.possible_effects[0]
    name, at_most = bound.effect.replace('_', ' '), f'{bound.edge_px:.2g} px at the edge'
    if facts.is_likely(bound.effect):
        return f'{name} is likely but not confirmed (up to {at_most})'
    return f'{name} cannot be excluded (up to {at_most})'


def _possible_effects(facts: LensFacts) -> str:
    possible = facts.possible_effects
    if not possible:
        return ''
    return (
        f'{unconfirmed_effects(facts)}, '
        f'which may cause up to {possible[0].edge_px:.2g} px {bound_location(possible[0])}'
    )


def _no_cause_clause(facts: LensFacts) -> str:
    agrees = facts.offset is not None and facts.offset.is_chance
    fit = ', and its parameters agree with these data within their errors' if agrees else ''
    return f'no error of the lens is confirmed{fit}'


def bound_location(bound: EffectBound) -> str:
    """Return the angles and ranges that a bound holds for."""
    if bound.edge is None or bound.ranges is None:
        return 'at the edge'
    low, high = (f'{degrees(angle):.0f}' for angle in bound.edge)
    near, far = bound.ranges
    return f'at the edge of the points ({low} to {high} deg, {near:.2g} to {far:.2g} m)'


def _target_reasons(facts: TargetFacts) -> dict[TargetReason, str]:
    """Return the clause of each reason."""
    local = f'local offsets cause {facts.local_px:.2g} px'
    if facts.local_m:
        local = (
            f'landmarks are displaced by {1e3 * facts.local_m:.2g} mm rms, which causes '
            f'{facts.local_px:.2g} px'
        )
    largest = target_error(facts.largest) if facts.largest else ''
    reasons = {
        TargetReason.CAMERAS_CONTRADICT: 'the cameras disagree about its shape',
        TargetReason.CORRECTION_GAINS: f'{largest}; held-out frames confirm it',
        TargetReason.CORRECTION_GAINS_NOTHING: f'{largest}; the correction does not lower the '
        'held-out error significantly',
        TargetReason.CAUSE_AND_OFFSETS: f'{largest}; in addition, {local} and '
        f'{1e3 * facts.pose_error:.2g} mrad of pose error',
        TargetReason.ONE_FRAME: f'its errors are unknown: {_ONE_FRAME}',
        TargetReason.OFFSETS_COST: f'{local} and {1e3 * facts.pose_error:.2g} mrad of pose error',
        TargetReason.OFFSETS_HARMLESS: f'{local} and only {1e3 * facts.pose_error:.2g} mrad of '
        'pose error',
        TargetReason.BELOW_NOISE: 'its errors are below the noise',
    }
    if not facts.bend_m:
        return reasons
    bend = (
        f'{frame_bend(facts)} ({100 * facts.bend_share:.0f} % of the error above the noise): '
        'mount it on a stiff plate'
    )
    return {reason: f'{text}; {bend}' for reason, text in reasons.items()}


def frame_bend(facts: TargetFacts) -> str:
    """Return by how much the board bends from frame to frame."""
    return f'the board bends from frame to frame by {1e3 * facts.bend_m:.2g} mm rms'


def target_error(error: TargetError) -> str:
    """Return how large the largest error of the target is, as the start of a sentence."""
    if error.effect == 'target_shape':
        which = 'the board' if error.board is None else f'board {error.board}'
        return f'{which} is bent by {1e3 * error.size:.2g} mm'
    if error.effect == 'landmark_survey':
        return f'{error.size:.0f} landmark{"s are" if error.size > 1 else " is"} displaced'
    if error.effect == 'landmark_scale':
        what = 'the board is stretched' if error.stretched else 'the scale of the board is off'
        return f'{what} by {100 * error.size:.2g} %'
    if error.effect == 'board_pose':
        return 'the relative poses of its boards are wrong'
    return f'confirmed cause: {error.effect}'


def _photographs_reasons(facts: PhotographsFacts) -> dict[PhotographsReason, str]:
    """Return the clause of each reason."""
    count, unit = facts.frames, facts.unit
    bad, unlike = len(facts.bad), len(facts.unlike)
    wrong = 'are outliers' if bad > 1 else 'is an outlier'
    few = f'one {unit} is' if count == 1 else f'{count} {unit}s are'
    remedy = COVERAGE
    if facts.plannable:
        remedy = '--next 6 lists the views that would decide it'
    rest = '; the rest comes from the target' if facts.target_causes_rest else ''
    times, good = '', ''
    if abs(facts.ratio - 1) >= _IDEAL_RATIO:
        times = f'{facts.ratio:.1f} times '
        good = ' (good)' if facts.ratio < _GOOD_RATIO else ' (1 would be ideal)'
    return {
        PhotographsReason.SOME_ARE_WRONG: f'{bad} of {count} {wrong} as a whole',
        PhotographsReason.TOO_FEW_FRAMES: f'{few} too few; take {MIN_FRAMES} or more',
        PhotographsReason.LENS_UNDECIDED: f'the lens is undecided; {remedy}',
        PhotographsReason.FRAMES_NOT_PREDICTED: f'the others do not predict {unlike} of {count}',
        PhotographsReason.FRAMES_PREDICTED: f'{count} {unit}s; the error on held-out ones is '
        f'{times}what noise and scatter would leave{good}{rest}',
    }


def advised_action(advice: Advice) -> str:
    """Return what to do, as a clause that begins in lower case and ends without a stop."""
    cause, soon = advice.cause, ''
    if math.isfinite(advice.value):
        soon = f' and taken within {advice.value:.0f} s'
    return _ACTIONS[advice.action].format(
        value=advice.value,
        mm=1e3 * advice.value,
        degrees=math.degrees(advice.value),
        soon=soon,
        effect=cause.effect if cause else '',
        how=separation(cause) if cause else '',
    )


def separation(cause: Cause) -> str:
    """Return how to tell a cause from others, and what would remain if it is another one."""
    others = [
        f'{CATALOGUE[imitation.effect].to_separate}; if it is a {imitation.effect}, a ray error '
        f'of {1e3 * imitation.ray_error:.2g} mrad remains'
        for imitation in cause.imitations
    ]
    return '; '.join([cause.effect_class.to_separate, *others])
