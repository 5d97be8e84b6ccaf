"""The search for causes: rounds of evidence, choice and refit until nothing changes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.adjustment import fit as refit_by_least_squares
from fisheye_svp_ros.diagnosis.candidates import simplest_form
from fisheye_svp_ros.diagnosis.choice import (
    SIGNIFICANCE,
    HeldOutGain,
    TraceStep,
    choose,
    held_out_gain,
)
from fisheye_svp_ros.diagnosis.doubt import confident
from fisheye_svp_ros.diagnosis.evidence import (
    Evidence,
    Placed,
    Score,
    finest_called,
    gather_evidence,
    pseudo_inverse,
)
from fisheye_svp_ros.diagnosis.model import Data, Linearised, State
from fisheye_svp_ros.diagnosis.noise import (
    Gross,
    NoiseCause,
    noise_growth,
    outlying,
    taken_back,
    with_noise_growth,
)
from fisheye_svp_ros.diagnosis.refit import Fitted, fit_of, in_sight, refit
from fisheye_svp_ros.diagnosis.reml import Variances
from fisheye_svp_ros.diagnosis.residuals import ripples, standardised_squares
from fisheye_svp_ros.diagnosis.single_landmarks import single_landmarks
from fisheye_svp_ros.diagnosis.wanted import Wanted
from fisheye_svp_ros.effects.base import Effect, Untestable
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.effects.landmark_survey import LandmarkSurveyEffect
from fisheye_svp_ros.errors import ObservationError

_ROUNDS = 6
_PACE = 0.6  # of the work left before a round, what is left after it
_RIPPLES = 4.0  # standard errors
_FAR = 25.0  # a misfit so many times the noise's is not linear: one cause a round
_ASTRAY = 400.0  # and so many: its columns lead nowhere, least squares find the way


@dataclass
class Found:
    """The state with its causes, the evidence around it, the fit, the trace.

    simulated: the simulation as it was fitted, without what the user knows; base: the first
    evidence; growth: of the noise with the angle, if it is a cause; given: the
    effects that the lens came with.
    """

    state: State
    evidence: Evidence
    fitted: Fitted
    trace: list[TraceStep]
    simulated: Linearised
    base: Evidence
    gross: Gross
    growth: NoiseCause | None
    given: tuple[Effect, ...]

    @property
    def causes(self) -> list[Placed]:
        """What was found: effects, their columns among what is shared, values."""
        return [term for term in self.evidence.terms if term[0] not in self.given]


def search(
    data: Data, state: State, free: Sequence[str], wanted: Wanted, gross: Gross,
    progress: Callable[[str, float], None],
) -> Found:
    """Add causes to a fitted state until none is left that is significant and predicts better."""
    trace: list[TraceStep] = []
    before: Variances | None = None
    base: Evidence | None = None
    dropped: set[str] = set()
    growth: NoiseCause | None = None
    cleaned = settled = finest = False
    given = tuple(effect for effect, _ in state.terms)
    # What the lens came with is as little asked for as what the user knows.
    known = (*wanted.included, *(effect.name for effect in given))
    simulated = Linearised(data, state, free)
    state = _with_wanted(data, state, free, wanted)
    for turn in range(_ROUNDS):
        progress(f'weighing {len(CATALOGUE)} effects beside local errors, round {turn + 1}',
                 0.8 - 0.75 * _PACE**turn)
        evidence = gather_evidence(data, state, free, before, wanted.left_out, finest)
        base, before = base or evidence, evidence.variances
        included, steps = _needed(evidence, known, wanted.quick)
        trace += steps
        gone = _names(steps)
        dropped.update(gone)
        choice = choose(evidence, included, _most(evidence, turn), dropped, wanted.quick)
        trace += choice.trace
        changed = bool(gone or choice.forms)
        if changed:
            state = _changed(evidence, state, included, gone, choice.forms)
        elif (found := _landmarks(evidence, state, wanted)) is not None:
            effect, offset, step = found
            trace.append(step)
            state, changed = with_effect(state, effect, offset), True
            # Their random offsets must not stand in for them.
            before = evidence.ordinary(effect.landmarks)
        fitted: Fitted | None = None
        if not (changed or wanted.quick or (cleaned and finest)):
            fitted = fit_of(evidence)
        if fitted is not None and not cleaned:
            # Once the causes are known: what is far off even beside random errors, and the noise.
            data, gross, growth, changed = _cleaned(data, fitted, gross, wanted)
            cleaned = True
            if growth is not None:
                state = with_noise_growth(state, growth.value)
        if fitted is not None and not finest and ripples(fitted) > _RIPPLES:
            # Points of different frames err alike where they fall on the same place.
            finest = finest_called(data, state, free, before, wanted.left_out)
            if finest and not changed:
                continue
        if not changed:
            break
        if _misfit(evidence) > _ASTRAY:
            state = refit_by_least_squares(data, state, free)
        state = refit(data, state, free, before)
        if wanted.quick or (cleaned and settled):
            break
        settled = cleaned
    if changed and not wanted.quick:
        evidence = gather_evidence(data, state, free, before, wanted.left_out, finest)
    while True:
        # The last variances weigh the last fit.
        state = refit(data, state, free, evidence.variances)
        evidence = evidence.around(data, state, free, wanted.left_out, finest)
        if not changed:
            break  # all that is in the model was asked for beside these variances
        included, steps = _needed(evidence, known, wanted.quick)
        if not steps:
            break
        trace += steps
        state = _changed(evidence, state, included, _names(steps), ())
        evidence = gather_evidence(data, state, free, evidence.variances, wanted.left_out, finest)
    fitted = fit_of(evidence)
    assert base is not None
    return Found(
        evidence.linear.state, evidence, fitted, trace, simulated, base, gross, growth, given)


def _names(steps: Sequence[TraceStep]) -> list[str]:
    return [step.effect.partition('(')[0] for step in steps]


def _most(evidence: Evidence, turn: int) -> int:
    """Return how many causes may be taken in at once."""
    return 1 if _misfit(evidence) > _FAR and not turn else 20


def _misfit(evidence: Evidence) -> float:
    """Return the mean square of the residuals over that of the noise."""
    return float((evidence.linear.residual**2).mean()) / evidence.variances.sigma**2


def _changed(
    evidence: Evidence, state: State, included: Index, gone: Sequence[str], forms: Sequence[int]
) -> State:
    """Return the state without some effects and with chosen forms of others."""
    kept = state.without(gone)
    estimated = _estimated(evidence, included, forms)

    def after(part: float) -> State:
        return reduce(lambda state, one: with_effect(state, one[0], part * one[1]),
                      estimated, kept)

    return in_sight(evidence.linear.data, evidence.linear.free, after)[0]


def _cleaned(
    data: Data, fitted: Fitted, gross: Gross, wanted: Wanted
) -> tuple[Data, Gross, NoiseCause | None, bool]:
    """Take back what the causes explain, set aside what is too far off for the noise.

    Whether that grows with the angle is asked before.
    """
    squares = standardised_squares(fitted)
    growth: NoiseCause | None = None
    if 'noise_vs_angle' not in wanted.left_out:
        growth = noise_growth(fitted, squares)
        squares = squares / growth.variance
        if growth.p_value * len(CATALOGUE) > SIGNIFICANCE:
            growth = None
    cleaned, kept = taken_back(data, fitted, gross)
    cleaned, more = outlying(cleaned, fitted, kept, squares)
    changed = len(kept.rows) < len(gross.rows) or len(more.rows) > len(kept.rows)
    return cleaned, more, growth, growth is not None or changed


def _with_wanted(data: Data, state: State, free: Sequence[str], wanted: Wanted) -> State:
    """Return the state with the causes that the user knows of, in their simplest forms.

    Raises ObservationError for one that the data cannot hold.
    """
    if not wanted.included:
        return state
    linear = Linearised(data, state, free)
    for name in wanted.included:
        try:
            state = with_effect(state, simplest_form(CATALOGUE[name], linear))
        except Untestable as why:
            raise ObservationError(f'{data.observations.source}: {name}: {why}') from why
    return refit_by_least_squares(data, state, free)


def _needed(
    evidence: Evidence, known: Sequence[str], quick: bool
) -> tuple[Index, list[TraceStep]]:
    """Return the columns of what is still needed, given the others, and why the rest is not.

    The weakest goes first: what is no longer significant, then what held-out frames no longer
    want.
    """
    included = np.arange(evidence.own)
    gone: list[TraceStep] = []
    while True:
        weakest: tuple[float, Index, TraceStep] | None = None
        for effect, columns, _ in evidence.terms:
            if effect.name in known or not np.isin(columns, included).all():
                continue
            step = _doubt(evidence, included, effect, columns, quick)
            if step is not None and (weakest is None or step.corrected > weakest[0]):
                weakest = step.corrected, columns, step
        if weakest is None:
            return included, gone
        gone.append(weakest[2])
        included = np.setdiff1d(included, weakest[1])


def _doubt(
    evidence: Evidence, included: Index, effect: Effect, columns: Index, quick: bool
) -> TraceStep | None:
    """Return why an effect is not needed beside everything else that is included, if so."""
    score = drop_test(evidence, included, columns, effect)
    corrected = min(1.0, score.p_value * evidence.forms.names())
    gain, why = HeldOutGain(np.nan, np.nan), 'removed: the other causes explain it'
    if corrected < SIGNIFICANCE:
        if quick or effect.per_frame:
            return None
        gain = held_out_gain(evidence, np.setdiff1d(included, columns), columns, effect)
        if gain.enough:
            return None
        why = 'removed: it does not predict better any more'
    return TraceStep(effect.key, score.statistic, score.rank, score.p_value, corrected,
                gain.value, gain.stderr, False, why)


def drop_test(evidence: Evidence, included: Index, columns: Index, effect: Effect) -> Score:
    """Test an effect in the model given everything else that is included."""
    rest = np.setdiff1d(included, columns)
    remaining = evidence.remaining(evidence.information, rest)
    return confident(evidence, evidence.score(remaining, columns), rest, columns, effect)


def _estimated(
    evidence: Evidence, included: Index, forms: Sequence[int]
) -> list[tuple[Effect, Array]]:
    """Return chosen forms with their joint estimates."""
    columns = [evidence.columns_of(form) for form in forms]
    every = np.concatenate([included, *columns])
    information = evidence.restored(evidence.information, included)
    inverse, _ = pseudo_inverse(information[np.ix_(every, every)], 1e-12)
    values = (inverse @ information[every, -1]) / evidence.scale[every]
    found, at = [], len(included)
    for form, mine in zip(forms, columns, strict=True):
        found.append((evidence.forms.effects[form], values[at : at + len(mine)]))
        at += len(mine)
    return found


def _landmarks(
    evidence: Evidence, state: State, wanted: Wanted
) -> tuple[LandmarkSurveyEffect, Array, TraceStep] | None:
    name = LandmarkSurveyEffect.name
    if name in wanted.left_out or any(effect.name == name for effect, _ in state.terms):
        return None
    return single_landmarks(evidence)


def with_effect(state: State, effect: Effect, values: Array | None = None) -> State:
    """Return the state with one more effect, joined with an earlier form of the same."""
    start = np.zeros(len(effect.parameters)) if values is None else values
    for i, (old, known) in enumerate(state.terms):
        if old.name == effect.name:
            joined = old.joined(effect)
            both = transferred(old, known, joined) + transferred(effect, start, joined)
            return replace(state, terms=(*state.terms[:i], (joined, both), *state.terms[i + 1 :]))
    return replace(state, terms=(*state.terms, (effect, start)))


def transferred(old: Effect, values: Array, new: Effect) -> Array:
    """Return start values of a form of an effect from another form's, by parameter name."""
    known = dict(zip((p.name for p in old.parameters), values, strict=True))
    return np.array([known.get(parameter.name, 0.0) for parameter in new.parameters])
