"""Selection: which effects, one at a time, and which others the data cannot tell from them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.diagnosis.correlation import Correlation, judge_correlation
from fisheye_svp_ros.diagnosis.held_out import held_out_gain
from fisheye_svp_ros.diagnosis.model import Data, Linearised, State, fit, is_shared, survey_of
from fisheye_svp_ros.diagnosis.projection import Nuisance, score
from fisheye_svp_ros.diagnosis.screening import Candidate, merit, screen, transferred
from fisheye_svp_ros.diagnosis.structure import Structure, mean_fields, remaining_structure
from fisheye_svp_ros.effects.base import Effect, Untestable
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.effects.landmark_survey import LandmarkSurveyEffect
from fisheye_svp_ros.effects.session_step import SessionStepEffect

# False alarms: this much for all effects together, the same again for what is left.
SIGNIFICANCE = 0.01
# An effect is in the class of another unless, with it in the model, the other is still needed.
CLASS_SIGNIFICANCE = 0.002
# So many landmarks are not single ones any more, nor so many steps single events.
MANY = 0.12
# A cause less than so many times stronger than what stays unexplained must be more than a field
# over the image.
_DOUBT = 3.0
MAX_STEPS = 20
_GAPS = 4


@dataclass(frozen=True)
class Step:
    """One line of the trace: what was tried, its evidence, and what came of it."""

    effect: str
    statistic: float
    rank: int
    p_value: float
    corrected: float
    held_out: dict[str, float]
    accepted: bool
    why: str


@dataclass
class Selection:
    """The state with its effects; the trace; what could not be tested; the last correlation."""

    state: State
    trace: list[Step]
    untestable: dict[str, str]
    correlation: Correlation
    evidence: dict[str, Candidate]


def select(
    data: Data, state: State, free: Sequence[str], progress: Callable[[str], None],
    before: Selection | None = None,
) -> Selection:
    """Add effects to a fitted state for as long as each is significant and predicts better.

    Every candidate must have a corrected p-value below SIGNIFICANCE and lower the misfit of
    frames, landmarks and range bands that were held out.  before: what led to the state.
    """
    trace = [] if before is None else before.trace
    evidence = {} if before is None else before.evidence
    untestable: dict[str, str] | None = None if before is None else before.untestable
    refused: set[str] = set()
    while True:
        progress(f'screening {len(CATALOGUE)} effects, step {len(trace) + 1}')
        linear = Linearised(data, state, free)
        correlation = judge_correlation(linear, generic_columns(linear))
        nuisance = Nuisance(linear)
        screening = screen(linear, nuisance, correlation)
        if untestable is None:
            untestable = screening.untestable
        eligible = [
            c for c in screening.eligible(SIGNIFICANCE)
            if c.effect.key not in refused and (c.merit > 0 or not _is_survey(c.effect))
        ]
        if not eligible or len(trace) >= MAX_STEPS:
            break
        chosen = _first(eligible)
        gains = held_out_gain(data, linear, nuisance, free, chosen.effect)
        good = _worth(chosen, gains, linear, correlation)
        trace.append(_step(chosen, gains, good))
        if not good:
            refused.add(chosen.effect.key)
            continue
        state = extended(data, state, chosen, free)
        evidence.setdefault(chosen.effect.name, chosen)
    return Selection(state, trace, untestable, correlation, evidence)


def generic_columns(linear: Linearised) -> Array:
    """Columns (F, M, P) of the catalogue's effects, each in its richest form of few parameters."""
    blocks = [linear.effect_columns(step) for step in _session_gaps(linear)]
    for kind in CATALOGUE.values():
        if kind.stage == 'noise' or kind.name in ('landmark_survey', 'session_step'):
            continue
        try:
            forms = kind.candidates(linear.scene)
        except Untestable:
            continue
        richest = max(forms, key=lambda form: len(form.parameters))
        blocks.append(linear.effect_columns(richest))
    return np.concatenate(blocks, axis=-1)


def _session_gaps(linear: Linearised) -> list[Effect]:
    """Return steps at the longest pauses between frames, where sessions are likely to change."""
    try:
        steps = list(CATALOGUE['session_step'].candidates(linear.scene))
    except Untestable:
        return []
    starts = np.array([step.starts[0] for step in steps if isinstance(step, SessionStepEffect)])
    pauses = np.diff(starts, prepend=starts[:1])
    return [steps[i] for i in np.sort(np.argsort(-pauses, kind='stable')[:_GAPS])]


def with_effect(state: State, effect: Effect, values: Array | None = None) -> State:
    """Return the state with one more effect, joined with an earlier form of the same."""
    start = np.zeros(len(effect.parameters)) if values is None else values
    for i, (old, known) in enumerate(state.terms):
        if old.name == effect.name:
            joined = old.joined(effect)
            both = transferred(old, known, joined) + transferred(effect, start, joined)
            return replace(state, terms=(*state.terms[:i], (joined, both), *state.terms[i + 1 :]))
    return replace(state, terms=(*state.terms, (effect, start)))


def extended(data: Data, state: State, chosen: Candidate, free: Sequence[str]) -> State:
    """Return the fit with one more effect, from its linear estimate or, out of reach, from 0."""
    for values in (chosen.score.estimate, np.zeros_like(chosen.score.estimate)):
        found = fit(data, with_effect(state, chosen.effect, values), free)
        if np.isfinite(Linearised(data, found, free).residual).all():
            break
    return found


def without_effect(state: State, name: str) -> State:
    """Return the state without one effect."""
    return replace(state, terms=tuple(term for term in state.terms if term[0].name != name))


def settle(data: Data, selection: Selection, free: Sequence[str]) -> Selection:
    """Ask of each effect again, given the others, whether it is needed and the best of its kind.

    A first choice may have been a compromise between two causes that only together explain.
    """
    state, trace = selection.state, selection.trace
    if len(state.terms) < 2 or survey_of(state.terms) is not None:
        return selection
    for name in [effect.name for effect, _ in state.terms]:
        rest = fit(data, without_effect(state, name), free)
        linear = Linearised(data, rest, free)
        screening = screen(linear, Nuisance(linear), selection.correlation)
        eligible = screening.eligible(SIGNIFICANCE)
        own = [c for c in eligible if c.effect.name == name]
        if not own:
            state = rest
            trace.append(_gone(name, 'the other causes explain it'))
            selection.evidence.pop(name, None)
        elif eligible[0].effect.name != name and not _in_model(state, eligible[0].effect.name):
            better = eligible[0]
            if better.merit > own[0].merit + 6:
                state = extended(data, rest, better, free)
                trace.append(_gone(name, f'{better.effect.name} explains more'))
                selection.evidence.pop(name, None)
                selection.evidence[better.effect.name] = better
    return replace(selection, state=state)


def withdraw(
    data: Data, selection: Selection, free: Sequence[str], stated: bool
) -> tuple[Selection, list[Structure]]:
    """Take back causes that explain little beside what no effect explains; return what is left.

    An effect outside the catalogue lends every effect a little of itself.  What is not clearly
    stronger than its remainder is no name for it.
    """
    while True:
        linear = Linearised(data, selection.state, free)
        left = significant(remaining_structure(linear, Nuisance(linear), stated))
        misfit = float((linear.residual**2).sum())
        unexplained = max((s.weighty * s.share for s in left), default=0.0) * misfit
        weak = [
            name for name, candidate in selection.evidence.items()
            if candidate.score.statistic < unexplained or (
                candidate.score.statistic < _DOUBT * unexplained
                and _any_field_does(data, selection.state, name, free)
            )
        ]
        if left and not weak:
            weak = _scattered(selection.state, data)
        if not weak:
            return selection, left
        name = min(weak, key=lambda n: selection.evidence[n].score.statistic)
        state = fit(data, without_effect(selection.state, name), free)
        selection.evidence.pop(name)
        selection.trace.append(_gone(name, 'explains little beside what stays unexplained'))
        selection = replace(selection, state=state)


def _any_field_does(data: Data, state: State, name: str, free: Sequence[str]) -> bool:
    """Whether an effect is no longer needed once any smooth field over the image is allowed."""
    effect, _ = next(term for term in state.terms if term[0].name == name)
    if not is_shared(effect):
        return False
    linear = Linearised(data, fit(data, without_effect(state, name), free), free)
    nuisance = Nuisance(linear, mean_fields(linear)['image'])
    return score(nuisance, linear.effect_columns(effect)).p_value > CLASS_SIGNIFICANCE


def _scattered(state: State, data: Data) -> list[str]:
    """Return the effects that were added piece by piece until they stand for something else."""
    known = len(np.unique(data.views.landmark[data.views.used]))
    names = []
    for effect, _ in state.terms:
        if isinstance(effect, LandmarkSurveyEffect) and not effect.everywhere:
            pieces, whole = len(effect.landmarks), known
        elif isinstance(effect, SessionStepEffect):
            pieces, whole = len(effect.starts), data.frames
        else:
            continue
        if pieces > max(3, MANY * whole):
            names.append(effect.name)
    return names


def significant(found: Sequence[Structure]) -> list[Structure]:
    """Return the structures below the significance that all of them share."""
    return [structure for structure in found if structure.p_value < SIGNIFICANCE]


def indistinguishable(
    data: Data, state: State, name: str, free: Sequence[str], correlation: Correlation
) -> tuple[Candidate, list[str]]:
    """Return the evidence for an effect given the others, and the effects it may be mistaken for.

    Another effect is in its class where, with the other one in the model, this one is no longer
    needed (p above CLASS_SIGNIFICANCE): then the data cannot refuse the other one.
    """
    effect, _ = next(term for term in state.terms if term[0].name == name)
    rest = without_effect(state, name)
    if effect.stage == 'target' and not _is_survey(effect):
        # Free landmarks contain every other effect on the target: ask without them.
        rest = without_effect(rest, 'landmark_survey')
    rest = fit(data, rest, free)
    linear = Linearised(data, rest, free)
    nuisance = Nuisance(linear)
    own = screen(linear, nuisance, correlation, [name]).candidates[0]
    columns = None if _is_survey(effect) else linear.effect_columns(effect)
    alone = None if columns is None else score(nuisance, columns, correlation.inflation)
    strength = own.score.statistic if alone is None else alone.statistic
    same = []
    for other in screen(linear, nuisance, correlation).candidates:
        known = other.effect.name in same or other.effect.name == name
        if known or _in_model(rest, other.effect.name) or columns is None:
            continue
        if other.score.statistic < 0.3 * strength or _is_survey(other.effect):
            continue
        extended = Nuisance(linear, linear.effect_columns(other.effect))
        left = score(extended, columns, correlation.inflation)
        if left.p_value > CLASS_SIGNIFICANCE:
            same.append(other.effect.name)
    if alone is not None:
        own = replace(own, effect=effect, score=alone, merit=merit(nuisance, alone))
    return own, same


def _first(eligible: Sequence[Candidate]) -> Candidate:
    """Return the candidate to try: the best, but freeing every landmark explains nearly anything.

    It comes last, and only where it describes the data better than a few single landmarks.
    """
    every = [c for c in eligible if _is_survey(c.effect)]
    if not every:
        return eligible[0]
    single = [c for c in eligible if c.effect.name == 'landmark_survey' and c not in every]
    if every[0].merit < sum(max(c.merit, 0.0) for c in single):
        return next(c for c in eligible if c not in every)
    return next((c for c in eligible if c.effect.name != 'landmark_survey'), every[0])


def _worth(
    candidate: Candidate, gains: dict[str, float], linear: Linearised, correlation: Correlation
) -> bool:
    """Whether held-out data gain a fair part of what the fitted data gain.

    Held-out landmarks and range bands may object, landmarks not to a survey of single ones, of
    which the others say nothing.  Where residuals depend on each other, a cause must also explain
    a hundredth of the misfit.
    """
    effect, explained = candidate.effect, candidate.score.statistic
    fair = gains['landmarks' if effect.per_frame else 'frames'] > 0.2 * explained
    if not _is_survey(effect):
        objections = ['range_bands']
        if effect.name != LandmarkSurveyEffect.name:
            objections.append('landmarks')
        fair = fair and all(gains[name] > 0 for name in objections)
    material = explained > 0.01 * float((linear.residual**2).sum())
    return fair and (material or not correlation.dependent)


def _is_survey(effect: Effect) -> bool:
    return bool(getattr(effect, 'everywhere', False))


def _in_model(state: State, name: str) -> bool:
    return any(effect.name == name for effect, _ in state.terms)


def _step(candidate: Candidate, gains: dict[str, float], accepted: bool) -> Step:
    result = candidate.score
    why = 'significant and predicts better' if accepted else 'does not predict better'
    return Step(
        candidate.effect.key, result.statistic, result.rank, result.p_value,
        candidate.corrected, gains, accepted, why,
    )


def _gone(name: str, why: str) -> Step:
    return Step(name, 0.0, 0, 1.0, 1.0, {}, False, f'removed: {why}')
