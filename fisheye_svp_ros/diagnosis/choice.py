"""Which effects: one at a time, by score test and by the prediction of held-out frames."""

from __future__ import annotations

from collections.abc import Container, Iterator
from dataclasses import dataclass, replace
from itertools import chain, takewhile

import numpy as np
from scipy import special

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.doubt import confident, random_gain
from fisheye_svp_ros.diagnosis.evidence import Evidence, Score, pseudo_inverse, swept
from fisheye_svp_ros.effects.base import Effect

# False alarms: this much for all effects together, the same again for the random components.
SIGNIFICANCE = 0.01
# What is named is surer than that: a local error now and then has the form of an effect.
NAMED = 0.002
# An effect is in the class of another unless, with it in the model, the other is still needed.
CLASS_SIGNIFICANCE = 0.002
CLASS_STRENGTH = 0.3
_ODDS = 4.0  # twice the log odds of an effect to one that looks alike and is rarer
# Standard errors by which held-out frames must be predicted better to take an effect in, and to
# keep it: beside what was found since it need not show so clearly.
_HELD_OUT, _KEPT = 1.5, 1.0


@dataclass(frozen=True)
class Candidate:
    """One form of one effect with its test.

    form: its place among the forms; corrected: the p-value times the numbers of effects and of
    this effect's forms; merit: twice the gain in log likelihood less what so many parameters do
    by chance (BIC).
    """

    form: int
    effect: Effect
    score: Score
    corrected: float
    merit: float


@dataclass(frozen=True)
class HeldOutGain:
    """Gain in log predictive density of frames left out in turn, and its standard error."""

    value: float
    stderr: float

    @property
    def convincing(self) -> bool:
        """Whether the gain is worth more than its error, clearly."""
        return self.value > _HELD_OUT * self.stderr

    @property
    def enough(self) -> bool:
        """Whether an effect that was taken in for its gain is still worth more than its error."""
        return self.value > _KEPT * self.stderr


@dataclass(frozen=True)
class TraceStep:
    """One line of the trace: what was tried, its evidence, and what came of it."""

    effect: str
    statistic: float
    rank: int
    p_value: float
    corrected: float
    held_out: float
    held_out_stderr: float
    accepted: bool
    why: str


def candidates(
    evidence: Evidence, included: Index, per_frame: bool = True
) -> list[Candidate]:
    """Return all forms, best merit first; per_frame: also those that differ in each frame."""
    remaining = evidence.remaining(evidence.information, included)
    found = []
    for form, effect in enumerate(evidence.forms.effects):
        columns = evidence.columns_of(form)
        score = evidence.score(remaining, columns)
        if not score.rank or _impossible(effect, score) or effect.per_frame > per_frame:
            continue
        if effect.absurd(score.estimate, evidence.linear.scene):
            continue
        gain, count = score.statistic, score.rank
        if effect.per_frame:  # what it is in single frames is one variance, as in its twins
            gain, count = random_gain(evidence, included, columns), 1
            score = score._replace(p_value=float(special.chdtrc(1, max(gain, 0.0))) / 2)
        merit = float(gain - count * np.log(evidence.full.rows))
        found.append(Candidate(form, effect, score, _corrected(evidence, effect, score), merit))
    return sorted(found, key=lambda candidate: -candidate.merit)


def _corrected(evidence: Evidence, effect: Effect, score: Score) -> float:
    forms = evidence.forms
    return min(1.0, score.p_value * forms.names() * forms.count[effect.name])


def _impossible(effect: Effect, score: Score) -> bool:
    """Whether a size comes out negative where only a positive one has a meaning."""
    sizes = zip(score.estimate, effect.parameters, strict=True)
    return any(value < 0 for value, parameter in sizes if parameter.positive)


def eligible(evidence: Evidence, included: Index) -> Iterator[Candidate]:
    """Yield what is significant, best merit first, the variances' uncertainty taken in."""
    for candidate in candidates(evidence, included):
        if candidate.corrected >= SIGNIFICANCE or candidate.merit <= 0:
            continue
        if not candidate.effect.per_frame:  # that one holds at any size of the variances
            columns = evidence.columns_of(candidate.form)
            score = confident(
                evidence, candidate.score, included, columns, candidate.effect)
            corrected = _corrected(evidence, candidate.effect, score)
            candidate = replace(candidate, score=score, corrected=corrected)
        if candidate.corrected < SIGNIFICANCE:
            yield candidate


def held_out_gain(
    evidence: Evidence, included: Index, columns: Index, effect: Effect
) -> HeldOutGain:
    """Return what columns add to the log predictive density of frames left out in turn.

    Of log p(all) - log p(all but one); a wide normal prior keeps what the others do not tell.
    """
    prior = np.diag(evidence.wide_prior(columns, effect))
    at = evidence.with_residual(np.concatenate([included, columns]))
    everything, parts = (
        evidence.restored(information, included, at)
        for information in (evidence.information[at[:, None], at], evidence.in_turn(at))
    )
    inside, more = np.searchsorted(at, included), np.searchsorted(at, columns)
    return counted(_marginal(everything, inside, more, prior) - np.array([
        _marginal(part, inside, more, prior) for part in parts
    ]))


def counted(gains: Array) -> HeldOutGain:
    """Return the sum of the gains (F,) of frames with its error.

    The frame that gains most counts like the next: a near frame may show many times as much of an
    effect as the others, which is no reason for doubt; nor is what it alone shows one for trust.
    """
    count = len(gains)
    if count < 2:
        return HeldOutGain(float(gains.sum()), np.inf)
    clipped = np.minimum(gains, np.sort(gains)[-2])
    return HeldOutGain(float(clipped.sum()), float(clipped.std(ddof=1) * np.sqrt(count)))


def _marginal(information: Array, included: Index, columns: Index, prior: Array) -> float:
    """Return what columns add to the log marginal likelihood, up to the prior's own constant."""
    chosen = np.concatenate([included, columns, [len(information) - 1]])
    remaining = swept(information[np.ix_(chosen, chosen)], np.arange(len(included)))
    block = remaining[len(included) : -1, len(included) : -1] + prior
    gradient = remaining[len(included) : -1, -1]
    inverse, _ = pseudo_inverse(block, 1e-14)
    return float(gradient @ inverse @ gradient - np.linalg.slogdet(block)[1]) / 2


@dataclass
class Choice:
    """The forms that were chosen, in order, and the trace."""

    forms: list[int]
    trace: list[TraceStep]


def choose(
    evidence: Evidence, included: Index, most: int, refused: Container[str], quick: bool
) -> Choice:
    """Add forms for as long as one is significant and predicts held-out frames better.

    included: the border's columns in the model; refused: effects that are not asked again; quick:
    do without held-out frames.
    """
    choice, failed = Choice([], []), set()
    while len(choice.forms) < most:
        remaining = (c for c in eligible(evidence, included)
                     if c.form not in failed and c.effect.name not in refused)
        best = _best(remaining)
        if best is None:
            break
        columns = evidence.columns_of(best.form)
        gain = HeldOutGain(np.inf, 0.0)
        if not (best.effect.per_frame or quick):
            gain = held_out_gain(evidence, included, columns, best.effect)
        choice.trace.append(_step(best, gain))
        if gain.convincing:
            included = np.concatenate([included, columns])
            choice.forms.append(best.form)
        else:
            failed.add(best.form)
    return choice


def _best(remaining: Iterator[Candidate]) -> Candidate | None:
    """Return the first that is sure enough to be named, or what is likelier than it."""
    weaker: list[Candidate] = []
    for candidate in remaining:
        if candidate.corrected < NAMED:
            return _likelier(candidate, chain(weaker, remaining))
        weaker.append(candidate)
    return None


def _likelier(best: Candidate, others: Iterator[Candidate]) -> Candidate:
    """Return what stands for the best candidate: a part of it, or a look-alike, more common."""
    if best.effect.asked_after:
        return next((c for c in others if c.effect.name in best.effect.asked_after), best)
    near = takewhile(lambda c: c.merit > best.merit - _ODDS, others)
    if not best.effect.rarer_than:
        return best
    size = len(best.effect.parameters)
    return next((c for c in near if c.effect.name == best.effect.rarer_than
                 and len(c.effect.parameters) == size), best)


def _step(candidate: Candidate, gain: HeldOutGain) -> TraceStep:
    score = candidate.score
    why = 'significant and predicts better' if gain.convincing else 'does not predict better'
    return TraceStep(
        candidate.effect.key, score.statistic, score.rank, score.p_value, candidate.corrected,
        gain.value, gain.stderr, gain.convincing, why,
    )
