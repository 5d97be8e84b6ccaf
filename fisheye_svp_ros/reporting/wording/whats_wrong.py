"""The line of what is wrong: all named causes by their sizes, the largest first."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.diagnosis import (
    CONFIRMED_PROBABILITY,
    NAMED_P,
    Action,
    Cause,
    Diagnosis,
    FlawKind,
    Status,
    TargetFacts,
    TargetReason,
    status_of,
)
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.reporting.wording.accuracy import mrad_in_mm, used_rays
from fisheye_svp_ros.reporting.wording.adequacy import common_residual, flaw_statement, group_lists
from fisheye_svp_ros.reporting.wording.causes import (
    COMPONENTS,
    HUMAN_UNITS,
    ONE_IS_THERE,
    SIZE_OPEN,
    belief,
    capital,
    chance,
    describe_effect,
    pixels,
    significance,
    size,
    with_odds,
)
from fisheye_svp_ros.reporting.wording.decisions import decision_reason, frame_bend, open_effect
from fisheye_svp_ros.reporting.wording.diagnosis import is_assumed, only_gross
from fisheye_svp_ros.reporting.wording.headline import MAX_WORDS, flaw_in_headline
from fisheye_svp_ros.scene.table_checks import target_size

_MIN_SIGMAS = 2.0  # a size nearer to 0 stands in no headline
_NATURAL_UNITS = {'m', 'rad', 's', 'px'}  # of sizes that say how much it is without the model
_MAX_RUNS = 8  # of frame numbers of a group
_DISPLACED = (TargetReason.CAUSE_AND_OFFSETS, TargetReason.OFFSETS_COST)
_BRIEF = {
    'target_shape': 'bent board',
    'landmark_scale': 'target size error',
    'landmark_survey': 'displaced:',
    'board_pose': 'misplaced boards',
    'session_step': 'intrinsics jump',
    'radial_profile': 'lens curve error',
    'viewpoint_shift': 'viewpoint movement',
    'pupil_decentering': 'sideways pupil movement',
}


def wrong(d: Diagnosis) -> str:
    """Return what is wrong, largest first, with its size, as a clause of less than MAX_WORDS.

    '' where the headline says it.
    """
    if d.adequacy.is_misfit:
        texts = _misfit_clauses(d)
    elif d.causes:
        texts = _named(d)
    elif d.adequacy.flaws:
        texts = _flaws_below(d)
    else:
        texts = iter([nothing_named(d)])
    return capital(next((text for text in texts if len(text.split()) < MAX_WORDS), ''))


def _named(d: Diagnosis) -> Iterator[str]:
    """Yield the causes, what else is wrong and what correction gains, in ever fewer words."""
    causes = sorted(d.causes, key=lambda cause: (-cause.share, cause.p_value))
    full = [_sentence(d, cause) for cause in causes]
    brief = [_in_few_words(d, cause) for cause in causes]
    first = _plain_statement(d, causes[0])
    forms = [full, [*full[:1], *brief[1:]], [first, *brief[1:]]]
    others = [*_target_errors(d), *_motion(d), *_possible_lens_errors(d)]
    gains = [[gain] for gain in _gains(d)]
    for count in range(len(others), -1, -1):
        kept = [
            [other.full for other in others[:count]],
            [other.brief for other in others[:count]],
        ]
        for rest in (*(also + gain for gain in gains for also in kept), *kept):
            yield from (_join_clauses([*form, *rest]) for form in forms)
    yield _join_clauses(brief)
    for count in range(len(brief) - 1, 0, -1):
        yield _join_clauses([first, *brief[1:count], f'{len(brief) - count} more below'])


def _join_clauses(clauses: Iterable[str]) -> str:
    return '; '.join(map(_lower, clauses))


def _misfit_clauses(d: Diagnosis) -> Iterator[str]:
    """Yield by how much no one lens fits, and in which frames, of these ever fewer."""
    flaw, off, meaning = d.adequacy.flaws[0], '', ''
    if flaw.kind is FlawKind.MIRRORED:
        yield 'the points fit a lens, but poses from them are mirror images'
        return
    if flaw.kind is FlawKind.CAMERAS_MIXED:
        off, _, meaning = common_residual(flaw).partition(' (')
        meaning = f' ({meaning}'
    elif d.adequacy.frames_error:
        mrad = 1e3 * d.adequacy.frames_error
        off, meaning = f'single frames are off by {mrad:.2g} mrad', f' ({mrad_in_mm(mrad, 1.0)})'
    for most in range(_MAX_RUNS, 0, -1):
        for words in (f'{off}{meaning}', off):
            yield ': '.join(filter(None, [words, group_lists(flaw, most)]))


def _flaws_below(d: Diagnosis) -> Iterator[str]:
    """Yield the flaws that the headline does not name, of these ever fewer."""
    named, rays = flaw_in_headline(d), used_rays(d)
    texts = {flaw.kind: flaw_statement(flaw) for flaw in d.adequacy.flaws if flaw.kind != named}
    if rays is not None and FlawKind.LENS_UNKNOWN in texts:
        texts[FlawKind.LENS_UNKNOWN] = f'rays are uncertain by up to {rays.known_to}'
    if FlawKind.ANGLE_SHORT in texts:
        texts[FlawKind.ANGLE_SHORT] += ', so the lens is extrapolated beyond'
    if not texts and named is FlawKind.LENS_UNKNOWN:
        yield 'no model error is visible, but these photographs do not determine the lens better'
    for count in range(len(texts), 0, -1):
        yield '; '.join([*texts.values()][:count])


def _gains(d: Diagnosis) -> list[str]:
    """Return what correcting the causes gains on frames left out, in words and in fewer."""
    base, named = (quality.heldout_rms_px for quality in (d.figures.base, d.figures.named))
    if all(cause.effect_class.stage == 'noise' for cause in d.causes):
        return []
    before, after = pixels(base), pixels(named)
    if before == after:
        return ['correction gains nothing on left-out frames']
    verb = 'lowers' if named < base else 'raises'
    return [
        f'correction {verb} the error on left-out frames from {before} to {after} px',
        f'correction: held-out error {before} → {after} px',
    ]


class _Error(NamedTuple):
    """An error without a named cause, with its size: as a clause, and in few words."""

    full: str
    brief: str


def _target_errors(d: Diagnosis) -> list[_Error]:
    """Return what is wrong with the target beside the named causes."""
    target, errors = d.decision['target'], []
    if not isinstance(target.facts, TargetFacts):
        return []
    bend, far = (f'{1e3 * rms:.2g} mm rms' for rms in (target.facts.bend_m, target.facts.local_m))
    if target.facts.bend_m:
        errors.append(_Error(frame_bend(target.facts), f'board bends {bend} between frames'))
    if target.reason in _DISPLACED and target.facts.local_m:
        errors.append(_Error(f'landmarks are displaced by {far}', f'displaced landmarks {far}'))
    return errors


def _motion(d: Diagnosis) -> list[_Error]:
    """Return by how much the camera moves while an image is read."""
    turns = [advice.value for advice in d.advice if advice.action is Action.HOLD_STILL]
    return [
        _Error(
            f'the camera turns by {np.degrees(turn):.2g} deg rms while an image is read',
            f'motion within images {np.degrees(turn):.2g} deg rms',
        )
        for turn in turns
    ]


def _possible_lens_errors(d: Diagnosis) -> list[_Error]:
    """Return what may be wrong with the lens beside the named causes."""
    if d.open_lens is not None:
        text = open_effect(d.open_lens)
        return [_Error(text, text)]
    if not d.offers_extended:
        return []
    likely = {
        one.effect.name.replace('_', ' '): chance(one.weight)
        for one in d.evaluation.averaged_model.effects
        if status_of(one.weight, False) is Status.LIKELY
        and CATALOGUE[one.effect.name].budget_stage() == 'lens'
    }
    return [
        _Error(f'{name} is likely ({sure})', f'{name} likely ({sure})')
        for name, sure in likely.items()
    ]


def nothing_named(d: Diagnosis) -> str:
    """Return what is wrong where no cause is named."""
    lens, target = d.decision['lens'], d.decision['target']
    if d.frames < 2 and (d.candidates or target.figure.value > 0):
        return 'there are errors, but one frame cannot show their cause'
    if lens.say == 'recalibrate':
        return decision_reason(lens)
    of_lens, of_target, motion = (
        [error.full for error in errors]
        for errors in (_possible_lens_errors(d), _target_errors(d), _motion(d))
    )
    if of_lens or motion:
        return _join_clauses([*of_lens, *of_target, *motion])
    if only_gross(d):
        count = len(d.gross)
        which = f'{count} image points are outliers' if count > 1 else 'one point is an outlier'
        return f'{which}; nothing else is wrong'
    if of_target:
        return ('only the target: ' if d.verdict == 'adequate' else '') + _join_clauses(of_target)
    if d.verdict == 'adequate':
        confirmed = 'confirmed' if d.offers_extended else 'visible'
        return f'no model error is {confirmed} in these data'
    left, noise = d.figures.base.heldout_rms_px, 2**0.5 * d.noise_px
    return (
        f'the error on left-out frames is {pixels(left)} px, noise alone would leave '
        f'{pixels(noise)} px; no effect of the catalog explains the rest'
    )


def _sentence(d: Diagnosis, cause: Cause) -> str:
    """Return a cause as a sentence, its size in it, and whether nothing but the user claims it."""
    if is_assumed(d, cause):
        doubt = ' (assumed, not significant)' if cause.p_value > NAMED_P else ''
    else:
        doubt = _doubt(cause)
    likeliest = _likeliest(cause)
    if likeliest != cause.effect:
        return (
            f'{capital(_describe(likeliest))} ({chance(cause.odds[likeliest])} sure), or '
            f'{_lower(_statement(d, cause))} ({chance(cause.odds[cause.effect])}){doubt}'
        )
    if cause.odds.get(cause.effect, 1.0) < CONFIRMED_PROBABILITY:
        others = ' or '.join(
            with_odds(cause, name, _describe(name)) for name in cause.indistinguishable_from
        )
        sure = chance(cause.odds[cause.effect])
        doubt = f', {sure} sure, or {others}{doubt}'
    return _statement(d, cause) + doubt


def _plain_statement(d: Diagnosis, cause: Cause) -> str:
    """Return the likeliest one of a confounded set with how sure it is, without the others."""
    likeliest = _likeliest(cause)
    words = _statement(d, cause) if likeliest == cause.effect else _describe(likeliest)
    sure = cause.odds.get(likeliest, 1.0)
    return words if sure >= CONFIRMED_PROBABILITY else f'{words}, {chance(sure)} sure'


def _likeliest(cause: Cause) -> str:
    return max(cause.odds, key=lambda name: cause.odds[name], default=cause.effect)


def _describe(name: str) -> str:
    return COMPONENTS.get(name) or describe_effect(name)


def _doubt(cause: Cause) -> str:
    """Return how probable a cause is that is not confirmed; of a confounded set, what is open."""
    if cause.status is Status.CONFIRMED:
        return ''
    words = belief(cause.status, cause.probability)
    if cause.is_within_error and cause.indistinguishable_from:
        return f': {ONE_IS_THERE} ({words}), {SIZE_OPEN}'
    return f' ({words})'


def _statement(d: Diagnosis, cause: Cause) -> str:
    """Return a cause as a sentence with its size."""
    how_large = _size(d, cause)
    if cause.effect == 'target_shape':
        boards = d.board_maps((cause.effect,))
        several = len(np.unique(d.evaluation.problem.observations.board)) > 1
        worst = max(boards, key=lambda board: board.peak_to_valley).board
        return f'{f"board {worst}" if several else "the board"} is bent by {how_large}'
    if cause.effect == 'viewpoint_shift':
        angle = f'{np.degrees(d.adequacy.reached):.0f} deg'
        return f'the viewpoint of the lens moves by {how_large} from the axis to {angle}'
    if cause.effect == 'landmark_scale':
        how_large += f', {100 * _relative(cause):.2g} %'
    words = cause.effect_class.headline or describe_effect(cause.effect)
    if cause.effect == 'landmark_scale' and 'relative' not in cause.parameters:
        words = 'The target is stretched'
    return f'{words} ({how_large})' if how_large else words


def _in_few_words(d: Diagnosis, cause: Cause) -> str:
    """Return a cause in few words, and its size."""
    words = _BRIEF.get(cause.effect) or cause.effect.replace('_', ' ')
    return f'{words} {_size(d, cause)}'.strip()


def _size(d: Diagnosis, cause: Cause) -> str:
    """Return how large a cause is in a unit that people read, or else in the image."""
    if cause.effect == 'target_shape':
        worst = max(board.peak_to_valley for board in d.board_maps((cause.effect,)))
        return f'{1e3 * worst:.2g} mm'
    if cause.effect == 'viewpoint_shift':
        return f'{1e3 * viewpoint_path(d):.2g} mm'
    if cause.effect == 'landmark_scale':
        across = _relative(cause) * target_size(d.evaluation.problem.observations)
        return f'{1e3 * across:.2g} mm'
    if cause.effect_class.target_map:
        return size(d, cause)
    name = max(cause.parameters, key=lambda part: significance(cause.parameters[part]), default='')
    entry = cause.parameters.get(name)
    if entry is None or (entry['stderr'] > 0 and significance(entry) < _MIN_SIGMAS):
        return ''
    if entry['unit'] not in _NATURAL_UNITS:
        return f'{pixels(cause.share**0.5 * d.figures.base.rms_px)} px' if cause.share > 0 else ''
    factor, unit = HUMAN_UNITS.get(entry['unit'], (1.0, entry['unit']))
    alike = [
        other['value']
        for part, other in cause.parameters.items()
        if part.rpartition('.')[0] == name.rpartition('.')[0] and other['unit'] == entry['unit']
    ]
    return f'{factor * np.linalg.norm(alike):.2g} {unit}'


def _relative(cause: Cause) -> float:
    """Return by which share a target is too large, or too long one way."""
    name = 'relative' if 'relative' in cause.parameters else 'x_over_y'
    entry = cause.parameters.get(name) or next(iter(cause.parameters.values()))
    return float(abs(entry['value']))


def viewpoint_path(d: Diagnosis) -> float:
    """Return how far, m, the viewpoint moves from the axis to where points are; e0 is no length.

    Of several cameras, the farthest.
    """
    ends = np.array([0.0, d.adequacy.reached])
    return max(
        (
            float(np.ptp(lens.viewpoint_shift.value_and_slope(ends, np.tan(ends / 2))[0]))
            for lens in d.lenses.values()
            if lens.viewpoint_shift is not None
        ),
        default=0.0,
    )


def _lower(text: str) -> str:
    return text[:1].lower() + text[1:]
