"""The headline: whether the lens may be used, how good it is and where; the verdict beside it."""

from __future__ import annotations

from collections.abc import Sequence
from math import degrees

from fisheye_svp_ros.diagnosis import (
    Diagnosis,
    FlawKind,
    LensFacts,
    LensReason,
)
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.reporting.wording.accuracy import mrad_in_mm, used_rays
from fisheye_svp_ros.reporting.wording.adequacy import flaw_statement, flaw_summary
from fisheye_svp_ros.reporting.wording.causes import describe_effect, finding_reason
from fisheye_svp_ros.reporting.wording.decisions import unconfirmed_effects
from fisheye_svp_ros.reporting.wording.diagnosis import (
    LENS_FILE,
    is_short_of_angle,
    lens_words,
    only_gross,
)

MAX_WORDS = 25  # of the headline, and of each line below it
_VERDICTS = {
    'adequate': 'Adequate: the lens model describes these data',
    'explained': 'Explained: the model error is identified',
    'partly_explained': 'Partly explained: some of the residual error is unexplained',
    'unexplained': 'Unexplained: no effect of the catalog explains the residual error',
}
NO_CONFIRMED_ERROR = 'no model error is confirmed in these data'
_OF_RAYS = {FlawKind.LENS_UNKNOWN, FlawKind.ANGLE_SHORT}  # the bound of the rays says it


def headline(d: Diagnosis) -> str:
    """Return whether the lens may be used, how good it is and where, or why not."""
    say = d.decision['lens'].say
    if say == 'recalibrate':
        return _recalibrate(d)
    if is_short_of_angle(d):
        return _within_angle(d)
    flaw, rays, lens = flaw_in_headline(d), used_rays(d), _lens_in_use(d)
    if flaw not in (None, FlawKind.LENS_UNKNOWN):
        return _of_flawed_data(d)
    if rays is None:
        return f'{lens_words(d)}.'
    if say == 'undecided' or d.adequacy.flaws or not rays.is_accurate:
        return f'Use {lens} only where {rays.known_to} is good enough.'
    instead = f', not {_given(d)}' if say == 'use_extended' and len(d.lenses) == 1 else ''
    return f'Use {lens}{instead}: rays are accurate to {rays.accurate_to}.'


def flaw_in_headline(d: Diagnosis) -> FlawKind | None:
    """Return which flaw of the data the headline names; of rays, it is their bound."""
    kinds = [flaw.kind for flaw in d.adequacy.flaws]
    if {*kinds} <= _OF_RAYS and d.decision['lens'].say != 'recalibrate':
        return FlawKind.LENS_UNKNOWN if FlawKind.LENS_UNKNOWN in kinds else None
    return kinds[0]


def _given(d: Diagnosis) -> str:
    return 'these lenses' if len(d.lenses) > 1 else 'this lens'


def _lens_in_use(d: Diagnosis) -> str:
    """Return which lens is to be used."""
    if not d.offers_extended:
        return _given(d)
    return 'the extended lenses' if len(d.lenses) > 1 else LENS_FILE


def _recalibrate(d: Diagnosis) -> str:
    """Return that the lens as given is off, by how much, and what to use instead."""
    words, lens = lens_words(d), d.decision['lens']
    if d.adequacy.flaws:
        return f'{words.partition(";")[0]}; {flaw_summary(d.adequacy.flaws[0])}.'
    off = lens.facts.offset if isinstance(lens.facts, LensFacts) else None
    if lens.reason is not LensReason.LENS_IS_OFF or off is None:
        return f'{words}.'
    rays = f'{"Their" if len(d.lenses) > 1 else "Its"} rays are off by at least'
    return f'{words}. {rays} {off.mrad:.2g} mrad ({mrad_in_mm(off.mrad, 1.0)}).'


def _within_angle(d: Diagnosis) -> str:
    """Return where a lens may be used that reaches farther than its points."""
    rays, angle = used_rays(d), f'{degrees(d.adequacy.reached):.0f} deg'
    axis = 'their axes' if len(d.lenses) > 1 else 'its axis'
    good = f', where rays are accurate to {rays.error}' if rays else ''
    return f'Use {_given(d)} only within {angle} of {axis}{good}.'


def _of_flawed_data(d: Diagnosis) -> str:
    """Return what the lens may be used for, and the worst flaw of the data, cut to MAX_WORDS."""
    flaw, words = flaw_summary(d.adequacy.flaws[0]), lens_words(d)
    link = ', but ' if d.decision['lens'].say in ('use_extended', 'keep') else ': '
    if len(f'{words}{link}{flaw}'.split()) > MAX_WORDS:
        flaw = flaw.partition(':')[0]  # the line below has the rest
    return f'{words}{link}{flaw}.'


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
