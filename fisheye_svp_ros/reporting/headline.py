"""A diagnosis in one line: the largest cause, and what to do about the lens."""

from __future__ import annotations

import numpy as np

from fisheye_svp_ros.diagnosis import NAMED_P, Cause, Diagnosis
from fisheye_svp_ros.reporting.cause_text import describe_effect, most_significant, size
from fisheye_svp_ros.reporting.diagnosis_text import (
    LENS_FILE,
    is_assumed,
    lens_words,
    only_gross,
)

_VERDICTS = {
    'adequate': 'Adequate: the simulation of the lens describes these data',
    'explained': 'Explained: the model error is identified',
    'partly_explained': 'Partly explained: some of the residual error is unexplained',
    'unexplained': 'Unexplained: no effect of the catalog explains the residual error',
}
TARGET = {
    'keep': 'Keep the target',
    'correct': f'Correct it by {LENS_FILE} (valid for this target only)',
    'measure_again': 'Measure the target',
}
PHOTOGRAPHS = {
    'enough': 'Enough', 'more': 'Take more', 'retake': 'Take some again',
}
NO_CONFIRMED_ERROR = 'no model error is confirmed in these data'
_HEADLINES = {
    'viewpoint_shift': 'The viewpoint of the lens shifts with the angle',
    'radial_profile': 'The image-height curve of the lens is wrong',
    'focal_length': 'The focal length is wrong',
    'principal_point': 'The principal point is wrong',
    'aspect': 'The aspect of the pixels is wrong',
    'skew': 'The image axes are not at right angles',
    'decentering': 'The lens is decentered',
    'sensor_tilt': 'The sensor is tilted',
    'flat_port': 'The camera looks through a port',
    'dome_port': 'The camera is beside the center of its dome',
    'focal_drift': 'The focal length drifts',
    'session_step': 'The intrinsics jump between groups of frames',
    'landmark_survey': 'Single landmarks are displaced',
    'landmark_scale': 'The scale of the target is wrong',
    'board_pose': 'The relative poses of the boards are wrong',
    'rolling_shutter': 'Rows are exposed one after the other',
    'rig_flex': 'The rig bends',
}


def headline(d: Diagnosis) -> str:
    """Return the largest cause and the decision about the lens."""
    return f'{largest_cause(d)}{_displaced_landmarks(d)}. {lens_words(d)}.'


def verdict_words(d: Diagnosis) -> str:
    """Return the verdict as a sentence that agrees with the headline."""
    if d.verdict == 'unexplained' and only_gross(d):
        return 'Unexplained: outliers; nothing else is wrong'
    if d.verdict == 'adequate' and d.offers_extended:
        return f'Adequate: {NO_CONFIRMED_ERROR}'
    if not d.causes and d.decision['lens'].say == 'recalibrate':
        rest = '; some of the residual error is unexplained' if d.remaining else ''
        return f'{_VERDICTS[d.verdict].partition(":")[0]}: the lens as given is off{rest}'
    return _VERDICTS[d.verdict]


def target_words(d: Diagnosis) -> str:
    """Return what to do about the target."""
    say = d.decision['target'].say
    if say == 'keep':
        return TARGET[say]
    by_file = d.offers_extended or say != 'correct'
    words = TARGET[say] if by_file else 'Correct the target: measure it'
    bent = any(cause.effect == 'target_shape' for cause in d.causes)
    return f'{words}, or {"flatten or " if bent else ""}replace it'


def largest_cause(d: Diagnosis) -> str:
    """Return the causes of the largest shares of the variance, or what stands in their place.

    Two where the lens and the target each have one.
    """
    causes = sorted(d.causes, key=lambda cause: (-cause.share, cause.p_value))
    if causes:
        first, stage = causes[0], causes[0].effect_class.budget_stage()
        other = next((one for one in causes if {stage, one.effect_class.budget_stage()}
                      == {'lens', 'target'}), None)
        second = _sentence(d, other) if other else ''
        return _sentence(d, first) + (f', and {second[0].lower()}{second[1:]}' if second else '')
    if d.frames < 2 and (d.candidates or d.decision['target'].figure.value > 0):
        return 'Errors show in one frame, which does not tell their cause'
    if d.decision['lens'].say == 'recalibrate':
        return _capital(d.decision['lens'].why)
    if only_gross(d):
        count = len(d.gross)
        return (f'{count} image points are outliers; nothing else is wrong' if count > 1 else
                'An image point is an outlier; nothing else is wrong')
    if d.decision['target'].say == 'measure_again' or (
            d.verdict == 'adequate' and d.decision['target'].figure.value > 0):
        which = 'Only the target' if d.verdict == 'adequate' else 'The target'
        return f'{which} is imperfect: {d.decision["target"].why}'
    if d.verdict == 'adequate':
        return (_capital(NO_CONFIRMED_ERROR) if d.offers_extended else
                'No model error shows in these data')
    return 'No effect of the catalog explains the residual error'


def _displaced_landmarks(d: Diagnosis) -> str:
    """Return that the target is to be measured again, where the causes are all of others."""
    target = d.decision['target']
    if (target.say != 'measure_again' or target.figure.name != 'local_offsets' or not d.causes
            or target.confidence is None):
        return ''
    return f', and landmarks of the target are displaced ({target.figure.value:.2g} px)'


def _sentence(d: Diagnosis, cause: Cause) -> str:
    """Return a cause as a sentence, its size in it, and whether nothing but the user claims it."""
    assumed = is_assumed(d, cause) and cause.p_value > NAMED_P
    return _statement(d, cause) + (' (assumed, not significant)' if assumed else '')


def _statement(d: Diagnosis, cause: Cause) -> str:
    if cause.effect == 'target_shape':
        worst = max(d.board_maps((cause.effect,)), key=lambda one: one.peak_to_valley)
        several = len(np.unique(d.problem.observations.board)) > 1
        which = f'Board {worst.board}' if several else 'The board'
        return f'{which} is bent by {1e3 * worst.peak_to_valley:.2g} mm'
    words = _HEADLINES.get(cause.effect, _capital(describe_effect(cause.effect)))
    if cause.effect == 'landmark_scale' and 'relative' not in cause.parameters:
        words = 'The target is stretched'
    # Of several parameters, the most significant one.
    how = size(d, cause) if cause.effect_class.target_map else most_significant(cause.parameters)
    return f'{words} ({how})' if how else words


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
