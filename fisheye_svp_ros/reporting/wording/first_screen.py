"""The first screen of a report and of the terminal: the same words for both.

A headline says whether the lens may be used, how good it is and where; four lines say what is
wrong, by its size, and what to do.  Why, and all else, is below.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import cv2

from fisheye_svp_ros.diagnosis import (
    MAX_RMS_RATIO,
    RETAKE,
    UNLIKE,
    Comparison,
    Decision,
    Diagnosis,
    FlawKind,
    LensReason,
    Status,
    frames_of,
    status_of,
)
from fisheye_svp_ros.reporting.blocks import image_uri
from fisheye_svp_ros.reporting.wording.accuracy import accuracy, used_rays
from fisheye_svp_ros.reporting.wording.actions import (
    photographs_reason,
    photographs_words,
    target_words,
)
from fisheye_svp_ros.reporting.wording.adequacy import flaw_statement
from fisheye_svp_ros.reporting.wording.causes import (
    HUMAN_UNITS,
    belief,
    capital,
    chance,
    finding_reason,
    pixels,
    quantity,
    size,
    with_odds,
)
from fisheye_svp_ros.reporting.wording.decisions import bound_location, decision_reason
from fisheye_svp_ros.reporting.wording.diagnosis import (
    LENS_FILE,
    count_frames,
    frame_ranges,
    known_reference,
    known_rows,
    lens_words,
)
from fisheye_svp_ros.reporting.wording.external import travel_sentence
from fisheye_svp_ros.reporting.wording.headline import MAX_WORDS, headline
from fisheye_svp_ros.reporting.wording.next_steps import NextStep
from fisheye_svp_ros.reporting.wording.whats_wrong import wrong
from fisheye_svp_ros.scene.observations import photograph_names

_GIVEN_LENS = 'with the lens as given'
_MAX_NAMES = 4  # photographs, and candidates, by name
_MIN_CONFIDENCE = 0.5  # what is less is no reason for what a decision says
_LENS = 'Lens'
_THUMBNAIL = 96  # px, the longer side
_SELF_EXPLAINING = ('correct', 'measure_again', 'enough')  # answers that need no reason at first


class Photo(NamedTuple):
    """A photograph by its name; uri: a small picture of it, '' where the file is not at hand."""

    name: str
    uri: str


class AnswerLine(NamedTuple):
    """One line: about what, what to do, why, what it gains and how sure that is, photographs.

    below: whether the reason is no part of what is read first.
    """

    about: str
    do: str
    why: str
    sure: str
    photographs: tuple[Photo, ...]
    more: int
    below: bool = False

    @property
    def what(self) -> str:
        """What to do, with the names of what it is about."""
        names = ', '.join(photo.name for photo in self.photographs)
        names += f' and {self.more} more' if self.more else ''
        return f'{self.do}{names and f": {names}"}.'

    @property
    def brief(self) -> str:
        """As much of the reason as one reads at first; the first clause of a long one."""
        if self.below:
            return ''
        sure = f' ({self.sure})' if self.sure else ''
        first = len(f'{self.about}: {self.what}'.split())
        texts = (f'{self.why}{sure}.', f'{self.why.partition("; ")[0]}.')
        return next((text for text in texts if first + len(text.split()) <= MAX_WORDS), '')


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
        _flaws_to_add(d),
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
                decision.say in _SELF_EXPLAINING,
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


def _flaws_to_add(d: Diagnosis) -> tuple[str, ...]:
    """Return what the lines above do not say of the data; they bound the rays, with an angle."""
    said = f'{headline(d)} {wrong(d)}'.lower()
    told = FlawKind.LENS_UNKNOWN if used_rays(d) else None
    texts = [flaw_statement(flaw) for flaw in d.adequacy.flaws if flaw.kind is not told]
    return tuple(text for text in texts if text.lower() not in said)


def _reason(decision: Decision, d: Diagnosis) -> str:
    """Return why, with the photographs whose board is numbered from another end."""
    if decision is not d.decision['photographs']:
        return capital(decision_reason(decision))
    why = capital(photographs_reason(d))
    done = {
        True: 'numbered from another end of the board, and reordered',
        False: 'perhaps numbered from another end of the board, but used unchanged',
    }
    for corrected, words in done.items():
        names = [frame.photograph for frame in d.turned if frame.corrected == corrected]
        more = f' and {len(names) - _MAX_NAMES} more' if len(names) > _MAX_NAMES else ''
        why += f'; {words}: {", ".join(names[:_MAX_NAMES])}{more}' if names else ''
    return why


def terminal_lines(screen: Screen, step: NextStep | None = None) -> list[str]:
    """Return the headline, four lines of what is wrong and what to do, and the details below."""
    first, details = [*filter(None, [screen.travel]), screen.headline], [f'Data: {screen.facts}']
    first += [f'Wrong: {screen.wrong}.'] if screen.wrong else []
    details += [f'Flaw: {capital(flaw)}.' for flaw in screen.flaws]
    details += [f'Warning: {screen.warning}'] if screen.warning else []
    for action in screen.actions:
        shown, below = _answer_lines(action)
        first += shown
        details += below
        if action.about == _LENS and screen.accuracy:
            details.append(f'Accuracy: {screen.accuracy}.')
    details += [f'Causes: {screen.causes}'] if screen.causes else []
    details += [f'Against {screen.reference}: {screen.truth}'] if screen.truth else []
    details += [f'Not confirmed: {screen.candidates}'] if screen.candidates else []
    details += [f'Not excluded: {screen.bound}'] if screen.bound else []
    first += [f'Next, {step.purpose}: {step.command}'] if step else []
    return [*first, '', *details]


def _answer_lines(action: AnswerLine) -> tuple[list[str], list[str]]:
    """Return a line of what is read first, and of the details; the headline has the lens."""
    sure = f' ({action.sure})' if action.sure else ''
    if action.about == _LENS:
        return [], [f'{_LENS}: {action.do}{sure}. {action.why}.']
    below = (
        []
        if action.brief == f'{action.why}{sure}.'
        else [f'{action.about}, why: {action.why}{sure}.']
    )
    return [' '.join(filter(None, [f'{action.about}: {action.what}', action.brief]))], below


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
