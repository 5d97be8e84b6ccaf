"""What to do, and how to tell causes apart."""

from __future__ import annotations

import math

from fisheye_svp_ros.diagnosis import Action, Advice, Cause
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.solve.outliers import FRAME, VIEW

_WORDS = {
    Action.USE_EXTENDED: 'solve with the extended lens file',
    Action.DIAGNOSE_AIR: 'diagnose the photographs in air first, then these with the extended '
    'lens of that run: the lens already has errors in air',
    Action.CALIBRATE_AIR: 'the lens was adjusted within the errors of its calibration in air: '
    'take photographs in air that fill the image, or measure the target better',
    Action.MEASURE_BOARD: 'measure the board, or flatten or replace it',
    Action.MEASURE_LANDMARKS: 'measure the landmarks of the target, first those that are '
    'displaced most',
    Action.SUPPORT_BOARD: 'support the board or hold it upright: it bends by {mm:.1f} mm between '
    'lying face up and upright',
    Action.VARY_VIEWS: 'take photographs from more different poses: errors of landmarks repeat in '
    'similar ones{soon} and do not average out. Check that the paper is flat, nothing reflects, '
    'and nothing is printed near the corners',
    Action.RETAKE: 'take these photographs again: they scatter more than the others',
    Action.CHECK_VIEWS: f'check these photographs: {VIEW}',
    Action.CHECK_FRAMES: f'check these photographs: {FRAME}',
    Action.CHECK_HELD_OUT_VIEWS: f'check these held-out photographs: {VIEW}',
    Action.CHECK_HELD_OUT_FRAMES: f'check these held-out photographs: {FRAME}',
    Action.CHECK_HELD_OUT_RIG: 'check these held-out photographs: their relative camera poses '
    'differ from the others, so each view has its own pose. Check that the rig was not touched, '
    'the cameras are not exchanged, simultaneous photographs have one number, and points are '
    'numbered from the same end',
    Action.HOLD_OUT_SAME_TARGET: 'hold out photographs of the same target: in these, landmarks of '
    'the same numbers have other coordinates, so errors of the target are not predicted there',
    Action.TAKE_MORE_LIKE_THESE: 'take more photographs like these: the others do not predict '
    'them. Either only they cover a part of the image, or they are wrong; the held-out rms '
    'excludes them',
    Action.NUMBER_LIKE_OTHERS: 'corners are numbered from another end of the board (odds '
    '{value:.2g} to 1 or more): they were reordered like the others; number them so',
    Action.CHECK_NUMBERS: 'corners may be numbered from another end of the board (odds '
    '{value:.2g} to 1 or more): they were not reordered; check them',
    Action.SEPARATE_CAUSE: '{effect}: {how}',
}


def advised_action(advice: Advice) -> str:
    """Return what to do, as a clause that begins in lower case and ends without a stop."""
    cause, soon = advice.cause, ''
    if math.isfinite(advice.value):
        soon = f' and taken within {advice.value:.0f} s'
    return _WORDS[advice.action].format(
        value=advice.value,
        mm=1e3 * advice.value,
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
