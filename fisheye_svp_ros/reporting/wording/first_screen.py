"""The first screen of a report and of the terminal: the same words for both.

A headline says whether the lens may be used, how good it is and where; four lines say what is
wrong, by its size, and what to do.  Why, and all else, is below.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from fisheye_svp_ros.diagnosis import (
    CONFIRMED_PROBABILITY,
    MAX_RMS_RATIO,
    NAMED_P,
    RETAKE,
    UNLIKE,
    Cause,
    Comparison,
    Decision,
    Diagnosis,
    FlawKind,
    LensReason,
    Status,
    frames_of,
    status_of,
)
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.reporting.blocks import image_uri
from fisheye_svp_ros.reporting.wording.accuracy import accuracy, used_rays
from fisheye_svp_ros.reporting.wording.adequacy import flaw_headline, flaw_statement
from fisheye_svp_ros.reporting.wording.causes import (
    COMPONENTS,
    HUMAN_UNITS,
    ONE_IS_THERE,
    SIZE_OPEN,
    belief,
    chance,
    describe_effect,
    finding_reason,
    most_significant,
    pixels,
    quantity,
    size,
    with_odds,
)
from fisheye_svp_ros.reporting.wording.decisions import (
    bound_location,
    decision_reason,
    frame_bend,
    unconfirmed_effects,
)
from fisheye_svp_ros.reporting.wording.diagnosis import (
    LENS_FILE,
    count_frames,
    frame_ranges,
    is_assumed,
    is_short_of_angle,
    known_reference,
    known_rows,
    lens_words,
    only_gross,
)
from fisheye_svp_ros.reporting.wording.external import travel_sentence
from fisheye_svp_ros.scene.observations import photograph_names

_GIVEN_LENS = 'with the lens as given'
_MAX_NAMES = 4  # photographs, and candidates, by name
_MIN_SIGMAS = 2.0  # a size nearer to 0 stands in no headline
_MIN_CONFIDENCE = 0.5  # what is less is no reason for what a decision says
_LENS = 'Lens'
_THUMBNAIL = 96  # px, the longer side
MAX_WORDS = 25  # of the headline, and of each line below it
_VERDICTS = {
    'adequate': 'Adequate: the lens model describes these data',
    'explained': 'Explained: the model error is identified',
    'partly_explained': 'Partly explained: some of the residual error is unexplained',
    'unexplained': 'Unexplained: no effect of the catalog explains the residual error',
}
TARGET = {
    'keep': 'Keep the target',
    'correct': f'Use it with {LENS_FILE}',
    'measure_again': 'For better poses, measure the target',
    'undecided': 'Undecided',
}
PHOTOGRAPHS = {
    'enough': 'Enough for this answer',
    'more': 'Take more',
    'retake': 'For a better answer, retake some',
}
NO_CONFIRMED_ERROR = 'no model error is confirmed in these data'


class Photo(NamedTuple):
    """A photograph by its name; uri: a small picture of it, '' where the file is not at hand."""

    name: str
    uri: str


class AnswerLine(NamedTuple):
    """One line: about what, what to do, why, what it gains and how sure that is, photographs."""

    about: str
    do: str
    why: str
    sure: str
    photographs: tuple[Photo, ...]
    more: int


class Screen(NamedTuple):
    """What is read first; warning: '' unless an error rises with the causes in the model.

    wrong: what is, with its size, and what correcting it gains; flaws: of the data; accuracy: what
    to reckon with, '' where nothing is known of it; travel: '' unless there is another set.
    """

    headline: str
    wrong: str
    flaws: tuple[str, ...]
    facts: str
    warning: str
    actions: tuple[AnswerLine, ...]
    causes: str
    candidates: str
    bound: str
    truth: str
    reference: str
    accuracy: str
    travel: str = ''


def first_screen(
    d: Diagnosis, source: str, known: Mapping[str, Comparison] | None = None
) -> Screen:
    """Return the first screen; source: what was diagnosed; known: of `known_rows`."""
    paths = _paths(d)
    kind = {'retake': RETAKE, 'more': UNLIKE}.get(d.decision['photographs'].say, '')
    about = frames_of(d.advice, kind) if kind and not d.adequacy.is_misfit else []
    answers: tuple[tuple[str, str, Decision, list[str]], ...] = (
        (_LENS, lens_words(d), d.decision['lens'], []),
        ('Target', target_words(d), d.decision['target'], []),
        (
            'Photographs',
            photographs_words(d),
            d.decision['photographs'],
            about,
        ),
    )
    return Screen(
        headline(d),
        wrong(d),
        tuple(map(flaw_statement, d.adequacy.flaws)),
        _facts(d, source),
        _warning(d),
        tuple(
            AnswerLine(
                title,
                do,
                _reason(decision, d),
                _confidence(decision),
                tuple(Photo(name, _thumbnail(paths.get(name))) for name in some[:_MAX_NAMES]),
                max(len(some) - _MAX_NAMES, 0),
            )
            for title, do, decision, some in answers
        ),
        _causes(d),
        _candidates(d),
        _bound_text(d.decision['lens']),
        '; '.join(
            f'{name} {before}' + (f' → {after}' if after != '-' else '')
            for name, before, after, _ in known_rows(d, known or {})
        ),
        known_reference(d),
        accuracy(d),
        '' if d.against is None else travel_sentence(d.against),
    )


def _reason(decision: Decision, d: Diagnosis) -> str:
    """Return why, with the photographs whose board is numbered from another end."""
    why = _capital(decision_reason(decision))
    if decision is not d.decision['photographs'] or not d.turned:
        return why
    done = {
        True: 'numbered from another end of the board, and reordered',
        False: 'perhaps numbered from another end of the board, but used unchanged',
    }
    for corrected, words in done.items():
        names = [frame.photograph for frame in d.turned if frame.corrected == corrected]
        more = f' and {len(names) - _MAX_NAMES} more' if len(names) > _MAX_NAMES else ''
        why += f'; {words}: {", ".join(names[:_MAX_NAMES])}{more}' if names else ''
    return why


def terminal_lines(screen: Screen, command: str) -> list[str]:
    """Return the headline, four lines of what is wrong and what to do, and the details below."""
    first, details = [*filter(None, [screen.travel]), screen.headline], [f'Data: {screen.facts}']
    first += [f'Wrong: {screen.wrong}.'] if screen.wrong else []
    details += [f'Flaw: {_capital(flaw)}.' for flaw in screen.flaws]
    details += [f'Warning: {screen.warning}'] if screen.warning else []
    for action in screen.actions:
        names = ', '.join(photo.name for photo in action.photographs)
        names += f' and {action.more} more' if action.more else ''
        do = f'{action.about}: {action.do}{names and f": {names}"}.'
        sure = f' ({action.sure})' if action.sure else ''
        why = f'{action.why}{sure}.'
        if action.about == _LENS:
            details.append(f'{_LENS}: {action.do}{sure}. {action.why}.')
            details += [f'Accuracy: {screen.accuracy}.'] if screen.accuracy else []
        elif len(f'{do} {why}'.split()) <= MAX_WORDS:
            first.append(f'{do} {why}')
        else:
            first.append(do)
            details.append(f'{action.about}, why: {why}')
    details += [f'Causes: {screen.causes}'] if screen.causes else []
    details += [f'Against {screen.reference}: {screen.truth}'] if screen.truth else []
    details += [f'Not confirmed: {screen.candidates}'] if screen.candidates else []
    details += [f'Not excluded: {screen.bound}'] if screen.bound else []
    first += [f'Next: {command}'] if command else []
    return [*first, '', *details]


def _facts(d: Diagnosis, source: str) -> str:
    base, named = (quality.heldout_rms_px for quality in (d.figures.base, d.figures.named))
    given, refitted = d.evaluation.as_given_px, bool(d.evaluation.intrinsics)
    errors = [] if given is None else [f'{pixels(given)} px {_GIVEN_LENS}']
    if given is None or pixels(given) != pixels(base):
        errors.append(
            f'{pixels(base)} px {"with intrinsics refitted" if refitted else _GIVEN_LENS}'
        )
    if d.causes and not d.adequacy.is_misfit:
        errors.append(f'{pixels(named)} px with the causes corrected')
    return (
        f'{source}: {d.observations} points in {count_frames(d)}. Held-out error: '
        f'{", ".join(errors)}. Noise alone would leave {pixels(2**0.5 * d.noise_px)} px.'
    )


def _warning(d: Diagnosis) -> str:
    """Return which error is larger after than before, by more than rounding shows."""
    base, named, extended = d.figures.base, d.figures.named, d.figures.extended
    pairs = [
        ('rms on the fitted frames, with the causes', base.rms_px, named.rms_px),
        ('rms on the fitted frames, with local offsets', named.rms_px, extended.rms_px),
        ('held-out rms, with the causes', base.heldout_rms_px, named.heldout_rms_px),
    ]
    if d.offers_extended:
        pairs.append(
            (
                'held-out rms, with the extended lens on one target',
                d.file.given_px,
                d.file.extended_px,
            )
        )
    rising = [
        f'{name}: {pixels(before)} → {pixels(after)} px'
        for name, before, after in pairs
        if after > MAX_RMS_RATIO * before
    ]
    return ('an error rises: ' + '; '.join(rising)) if rising else ''


def _confidence(decision: Decision) -> str:
    if (
        decision.confidence is None
        or decision.say == 'undecided'
        or decision.confidence < _MIN_CONFIDENCE
    ):
        return ''
    if decision.reason is LensReason.NO_CAUSE_CONFIRMED:
        return ''  # how sure bounds are stands beside them
    better = ' that it is better' if decision.say == 'use_extended' else ''
    return f'{chance(decision.confidence)} sure{better}'


def _causes(d: Diagnosis) -> str:
    """Return the confirmed causes by name, what is not told apart from each, and their sizes.

    Also which frames the others predict worse with it.
    """
    if d.adequacy.is_misfit:
        return ''  # none can be trusted in such data
    found = []
    for cause in d.causes:
        worse = frame_ranges(d, cause.refuted_by_frames)
        every = [cause.effect, *cause.indistinguishable_from]
        names = ' or '.join(with_odds(cause, name) for name in every)
        doubt = (
            ''
            if cause.status is Status.CONFIRMED
            else f'{belief(cause.status, cause.probability)}: '
        )
        harm = f'; makes {worse} worse' if worse else ''
        found.append(f'{names} ({doubt}{size(d, cause)}{harm})')
    return '; '.join(found)


def _candidates(d: Diagnosis) -> str:
    if d.adequacy.is_misfit:
        return ''
    included = f'{LENS_FILE} includes ' if d.offers_extended else ''
    averaged = d.evaluation.averaged_model.effects
    names = {one.effect.name for one in averaged}
    others = [candidate for candidate in d.candidates if candidate.effect not in names]
    words = []
    for one in averaged[:_MAX_NAMES]:
        status = status_of(one.weight, False)
        name, first = next(iter(one.parameters.items()))
        told = f': {included}{name} = {quantity(first)}'
        told = told if included or status is not Status.NOT_NEEDED else ''
        name = ' '.join((*one.effect.cameras, one.effect.name))
        words.append(f'{name} ({belief(status, one.weight)}{told})')
    words += [
        f'{finding.effect} ({belief(finding.status, finding.probability)}: '
        f'{finding_reason(finding)})'
        for finding in others[:_MAX_NAMES]
    ]
    more = len(others) - _MAX_NAMES
    return '; '.join(words) + (f'; and {more} more' if more > 0 else '')


def _bound_text(decision: Decision) -> str:
    words = []
    for bound in decision.bound:
        factor, unit = HUMAN_UNITS.get(bound.unit, (1.0, ''))
        words.append(
            f'{bound.effect} up to {factor * bound.value:.2g} {unit}'.rstrip()
            + f' ({bound.edge_px:.2g} px)'
        )
    place = f'; px {bound_location(decision.bound[0])}, 95 %' if decision.bound else ''
    return '; '.join(words) + place


def _paths(d: Diagnosis) -> dict[str, str]:
    table = d.evaluation.problem.observations
    by = {(frame, camera): path for frame, camera, path in table.photographs}
    return {name: by[key] for key, name in photograph_names(table).items()}


def _thumbnail(path: str | None) -> str:
    if path is None or not Path(path).is_file():
        return ''
    image = cv2.imread(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        return ''
    zoom = _THUMBNAIL / max(image.shape)
    small = cv2.resize(image, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_AREA)
    return image_uri(cv2.imencode('.jpg', small)[1].tobytes(), 'jpeg')


def photographs_words(d: Diagnosis) -> str:
    """Return what to do about the photographs."""
    if d.adequacy.is_misfit:
        kind = d.adequacy.flaws[0].kind
        if kind.is_unit:
            return 'Do not use this table as it is'
        if kind is FlawKind.NO_FIT:
            return 'Check them'
        return 'Do not use them' + (' together' if kind is FlawKind.CAMERAS_MIXED else '')
    if d.adequacy.flaws and d.adequacy.flaws[0].kind.is_of_table:
        return 'Check them'
    return PHOTOGRAPHS[d.decision['photographs'].say]


def headline(d: Diagnosis) -> str:
    """Return whether the lens may be used, how good it is and where, or what is wrong instead."""
    lens, rays = lens_words(d), used_rays(d)
    if d.adequacy.flaws:
        known = f'. Rays within are {rays.bound}' if rays and is_short_of_angle(d) else ''
        flaw, answer = flaw_headline(d.adequacy.flaws[0]), f'{lens}{known}.'
        if len(f'{flaw} {answer}'.split()) > MAX_WORDS:
            flaw = flaw.partition(':')[0]  # the line below has the rest
        return f'{flaw}. {answer}'
    if d.decision['lens'].say != 'recalibrate' and rays:
        undecided = d.decision['lens'].say == 'undecided'
        lens += f'. {"Until then, rays" if undecided else "Rays"} are {rays.quality}'
    return f'{lens}.'


def wrong(d: Diagnosis) -> str:
    """Return what is wrong, largest first, with its size, as a clause of at most MAX_WORDS.

    '' where the headline says it.
    """
    if d.adequacy.is_misfit:
        statement = flaw_statement(d.adequacy.flaws[0])
        return _capital(statement) if len(statement.split()) < MAX_WORDS else ''
    if d.adequacy.flaws and not d.causes:
        return ''
    more = len(d.causes) - len(_headline_causes(d))
    parts = [f'{largest_cause(d)}{_displaced_landmarks(d)}']
    if d.causes and d.open_lens is not None:
        parts.append(unconfirmed_effects(d.open_lens))
    gain = _gain(d)
    others = [_other_causes(d, more)] if more > 0 else []
    text = '; '.join([*parts, *others, *filter(None, [gain])])
    if len(text.split()) < MAX_WORDS or not d.causes:
        return text
    first, rest = _headline_causes(d)[0], len(d.causes) - 1
    likeliest = max(first.odds, key=lambda name: first.odds[name], default=first.effect)
    short = _statement(d, first) if likeliest == first.effect else _describe(likeliest)
    parts = [_capital(short)] + ['alternatives below'] * bool(first.indistinguishable_from)
    parts += [_other_causes(d, rest)] if rest else []
    words = len(f'Wrong: {"; ".join([*parts, gain])}'.split())
    return '; '.join([*parts, gain] if gain and words <= MAX_WORDS else parts)


def _gain(d: Diagnosis) -> str:
    """Return what correcting the causes gains on frames left out: the one pair of figures."""
    base, named = (quality.heldout_rms_px for quality in (d.figures.base, d.figures.named))
    moving = any(cause.effect_class.stage != 'noise' for cause in d.causes)
    before, after = pixels(base), pixels(named)
    if not moving:
        return ''
    if before == after:
        return f'the held-out error stays at {after} px'
    return (
        f'correction {"lowers" if named < base else "raises"} the held-out error from {before} '
        f'to {after} px'
    )


def _other_causes(d: Diagnosis, count: int) -> str:
    """Return the next one of the causes that are not told in full, and how many there are."""
    causes = sorted(d.causes, key=lambda cause: (-cause.share, cause.p_value))
    name = causes[-count].effect.replace('_', ' ')
    return f'also {name}' + (f' and {count - 1} more, see below' if count > 1 else ', see below')


def verdict_words(d: Diagnosis) -> str:
    """Return the verdict as a sentence that agrees with the headline."""
    if d.adequacy.is_misfit:
        return f'Inadequate data: {flaw_statement(d.adequacy.flaws[0])}'
    if d.verdict == 'adequate' and d.adequacy.flaws:
        return f'Adequate where there are points; {flaw_statement(d.adequacy.flaws[0])}'
    if d.verdict == 'unexplained' and only_gross(d):
        return 'Unexplained: outliers; nothing else is wrong'
    if d.verdict == 'adequate' and d.offers_extended:
        return f'Adequate: {NO_CONFIRMED_ERROR}'
    if d.verdict == 'unexplained' and d.open_lens is not None:
        return f'Unexplained: {unconfirmed_effects(d.open_lens)}'
    if not d.causes and d.decision['lens'].say == 'recalibrate':
        rest = '; some of the residual error is unexplained' if d.remaining else ''
        return f'{_VERDICTS[d.verdict].partition(":")[0]}: the lens as given is off{rest}'
    return _VERDICTS[d.verdict]


def tone(d: Diagnosis) -> str:
    """Return the verdict whose color the headline has: that of adequate data reassures."""
    if d.adequacy.is_misfit:
        return 'unexplained'
    if d.adequacy.flaws:
        return 'partly_explained'
    settled = d.decision['lens'].say == 'keep' and d.decision['photographs'].say == 'enough'
    return 'partly_explained' if d.verdict == 'adequate' and not settled else d.verdict


def target_words(d: Diagnosis) -> str:
    """Return what to do about the target."""
    say = d.decision['target'].say
    if say == 'keep' and frame_bend(d.decision['target'].facts):
        return 'Mount it on a stiff plate before you take more. The lens does not need more'
    if say in ('keep', 'undecided'):
        return TARGET[say]
    by_file = d.offers_extended or say != 'correct'
    words = TARGET[say] if by_file else 'For better poses, correct the target: measure it'
    if d.causes and _headline_causes(d)[0].effect == 'board_pose':
        return f'{words}, or measure how its boards are mounted to each other'
    bent = any(cause.effect == 'target_shape' for cause in d.causes)
    words = f'{words}, or {"flatten or " if bent else ""}replace it'
    holds = '. The lens works anywhere; the target correction, only on this target'
    return words + (holds if say == 'correct' and by_file else '')


def largest_cause(d: Diagnosis) -> str:
    """Return the causes of the largest shares of the variance, or what stands in their place.

    Two where the lens and the target each have one.
    """
    causes = [_sentence(d, cause) for cause in _headline_causes(d)]
    if causes:
        return ', and '.join(
            [causes[0], *(f'{other[0].lower()}{other[1:]}' for other in causes[1:])]
        )
    if d.frames < 2 and (d.candidates or d.decision['target'].figure.value > 0):
        return 'There are errors, but one frame cannot show their cause'
    if d.decision['lens'].say == 'recalibrate':
        return _capital(decision_reason(d.decision['lens']))
    if d.open_lens is not None:
        return _capital(unconfirmed_effects(d.open_lens))
    if only_gross(d):
        count = len(d.gross)
        return (
            f'{count} image points are outliers; nothing else is wrong'
            if count > 1
            else 'An image point is an outlier; nothing else is wrong'
        )
    if d.decision['target'].say == 'measure_again' or (
        d.verdict == 'adequate' and d.decision['target'].figure.value > 0
    ):
        which = 'Only the target' if d.verdict == 'adequate' else 'The target'
        return f'{which} is imperfect: {decision_reason(d.decision["target"])}'
    bend = frame_bend(d.decision['target'].facts)
    if bend:
        return _capital(bend)
    if d.verdict == 'adequate':
        return (
            _capital(NO_CONFIRMED_ERROR)
            if d.offers_extended
            else 'No model error is visible in these data'
        )
    return 'No effect of the catalog explains the residual error'


def _headline_causes(d: Diagnosis) -> list[Cause]:
    """Return the cause of the largest share, of lens and target one of each."""
    causes = sorted(d.causes, key=lambda cause: (-cause.share, cause.p_value))
    stages = {'lens', 'target'}
    others = [rival for rival in causes if {causes[0].stage, rival.stage} == stages]
    return [*causes[:1], *others[:1]]


def _displaced_landmarks(d: Diagnosis) -> str:
    """Return that the target is to be measured again, where the causes are all of others."""
    target = d.decision['target']
    if (
        target.say != 'measure_again'
        or target.figure.name != 'local_offsets'
        or not d.causes
        or target.confidence is None
    ):
        return ''
    return f', and landmarks are displaced ({target.figure.value:.2g} px)'


def _sentence(d: Diagnosis, cause: Cause) -> str:
    """Return a cause as a sentence, its size in it, and whether nothing but the user claims it."""
    if is_assumed(d, cause):
        doubt = ' (assumed, not significant)' if cause.p_value > NAMED_P else ''
    else:
        doubt = _doubt(cause)
    likeliest = max(cause.odds, key=lambda name: cause.odds[name], default=cause.effect)
    if likeliest != cause.effect:
        words = _describe(likeliest)
        own = _statement(d, cause)
        return (
            f'{_capital(words)} ({chance(cause.odds[likeliest])} sure), or '
            f'{own[:1].lower()}{own[1:]} ({chance(cause.odds[cause.effect])}){doubt}'
        )
    if cause.odds.get(cause.effect, 1.0) < CONFIRMED_PROBABILITY:
        others = ' or '.join(
            with_odds(cause, name, _describe(name)) for name in cause.indistinguishable_from
        )
        sure = chance(cause.odds[cause.effect])
        doubt = f', {sure} sure, or {others}{doubt}'
    return _statement(d, cause) + doubt


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
    if cause.effect == 'target_shape':
        worst = max(d.board_maps((cause.effect,)), key=lambda board: board.peak_to_valley)
        several = len(np.unique(d.evaluation.problem.observations.board)) > 1
        which = f'Board {worst.board}' if several else 'The board'
        return f'{which} is bent by {1e3 * worst.peak_to_valley:.2g} mm'
    if cause.effect == 'viewpoint_shift':
        return f'The viewpoint of the lens moves by {viewpoint_path(d)}'
    words = cause.effect_class.headline or _capital(describe_effect(cause.effect))
    if cause.effect == 'landmark_scale' and 'relative' not in cause.parameters:
        words = 'The target is stretched'
    # Of several parameters, the most significant one.
    how = (
        size(d, cause)
        if cause.effect_class.target_map
        else most_significant(cause.parameters, _MIN_SIGMAS)
    )
    return f'{words} ({how})' if how else words


def viewpoint_path(d: Diagnosis) -> str:
    """Return how far the viewpoint moves from the axis to where points are; e0 is no length.

    Of several cameras, the farthest.
    """
    angle = d.adequacy.reached
    ends = np.array([0.0, angle])
    moved = max(
        (
            float(np.ptp(lens.viewpoint_shift.value_and_slope(ends, np.tan(ends / 2))[0]))
            for lens in d.lenses.values()
            if lens.viewpoint_shift is not None
        ),
        default=0.0,
    )
    return f'{1e3 * moved:.2g} mm from the axis to {np.degrees(angle):.0f} deg'


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def provisional_headline(names: Sequence[str]) -> str:
    """Return the first of some causes as a headline, the others by name."""
    if not names:
        return 'Provisional: no model error found yet'
    first, *others = dict.fromkeys(names)
    words = CATALOGUE[first].headline or describe_effect(first)
    return f'Provisional: {words}' + (f' (also {", ".join(others)})' if others else '')


def headline_changes(names: Sequence[str], d: Diagnosis) -> list[str]:
    """Return sentences: which causes were found since, and which are none after all."""
    final = [cause.effect for cause in d.causes]
    why = {step.effect: f' ({finding_reason(step)})' for step in (*d.trace, *d.candidates)}
    gone = [f'{name}{why.get(name, "")}' for name in dict.fromkeys(names) if name not in final]
    new = [name for name in dict.fromkeys(final) if name not in names]
    parts = [f'found: {", ".join(new)}'] if new else []
    parts += [f'not confirmed: {", ".join(gone)}'] if gone else []
    return [f'Since the provisional answer: {"; ".join(parts)}.'] if parts else []
