"""Third stage: score tests of every effect beside the null model; where p-values come from.

The statistic is Rao's; its p-value takes in what is not known of the null model: an F test with
Satterthwaite's degrees of freedom; where that is not beyond doubt, the likelihood ratio beside
what the effect may be mistaken for, and the scatter of the score from landmark to landmark.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import special

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.null_model import Alternative, NullModel
from fisheye_svp_ros.effects.base import Effect
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.mixed_model import (
    IDENTIFIABLE,
    FactoredEquations,
    Score,
    eliminate,
    integrate_columns,
    predict_rows,
    pseudo_inverse,
    satterthwaite_freedom,
    score_columns,
    score_each,
    subtract_fit,
)

# False alarms: this much for all effects together, the same again for the random components.
SIGNIFICANCE = 0.01
CONFOUNDED_P = 0.002  # of an effect beside another: above, the two are not told apart
_DOUBTFUL_P, _CERTAIN_STATISTIC = 0.01, 200.0  # between them more is asked
_TURN_SIZES = (0.5, 2.0, 8.0, 32.0, 128.0, 512.0)  # variance over noise of a coefficient
# Standard errors by which held-out frames must be predicted better to take an effect in, and to
# keep it: beside what was found since it need not show so clearly.
_ENTRY_SIGMAS, _STAY_SIGMAS = 1.5, 1.0
RARITY_ODDS = 4.0  # twice the log odds of an effect to one that looks alike and is rarer
_MIN_FRAMES = 3


@dataclass(frozen=True)
class Candidate:
    """One form of one effect with its test.

    form: its place among the forms; corrected: the p-value times the numbers of effects and of
    this effect's forms; criterion: twice the gain in log likelihood less what so many parameters
    do by chance (BIC).
    """

    form: int
    effect: Effect
    score: Score
    corrected: float
    criterion: float


@dataclass(frozen=True)
class HeldOutGain:
    """Gain in log predictive density of frames left out one by one, and its standard error."""

    value: float
    stderr: float

    @property
    def convincing(self) -> bool:
        """Whether the gain is worth more than its error, clearly."""
        return self.value > _ENTRY_SIGMAS * self.stderr

    @property
    def sufficient(self) -> bool:
        """Whether an effect that was taken in for its gain is still worth more than its error."""
        return self.value > _STAY_SIGMAS * self.stderr


@dataclass(frozen=True)
class EffectTests:
    """The tests of all effects beside a null model, those in it and those that could be added."""

    null: NullModel

    @cached_property
    def untestable(self) -> dict[str, str]:
        """Effects that the data cannot test, and why."""
        forms = self.null.fixed.forms
        remaining = eliminate(self.null.information, self.null.included_columns)
        ranks: dict[str, int] = {}
        for effect, score in zip(forms.effects, self._score_forms(remaining), strict=True):
            ranks[effect.name] = max(score.rank, ranks.get(effect.name, 0))
        taken = 'the estimated parameters absorb it'
        return forms.untestable | {name: taken for name, rank in ranks.items() if not rank}

    @property
    def effect_count(self) -> int:
        """How many effects are tested, single landmarks too: what p-values are corrected by."""
        return len(CATALOGUE) - len(self.null.fixed.forms.untestable)

    def score(self, remaining: Array, columns: Index) -> Score:
        """Test columns by the information that remains once what is in the model is eliminated."""
        return score_columns(remaining, columns, self.null.scale, self.null.variances.sigma**2)

    def _score_forms(self, remaining: Array) -> list[Score]:
        """Test all forms of the catalogue by the information that remains."""
        forms = range(len(self.null.fixed.forms.effects))
        return score_each(
            remaining,
            [self.null.form_columns(form) for form in forms],
            self.null.scale,
            self.null.variances.sigma**2,
        )

    def score_beside(self, included: Index, columns: Index) -> Score:
        """Test columns beside what is included, and no other effects."""
        remaining = self.null.remaining_information(self.null.information, included)
        return self.score(remaining, columns)

    def test_removal(self, included: Index, columns: Index, effect: Effect) -> Score:
        """Test an effect in the model given everything else that is included."""
        rest = np.setdiff1d(included, columns)
        return self.adjust_p_value(self.score_beside(rest, columns), rest, columns, effect)

    def log_odds(self, score: Score) -> float:
        """Return twice the logarithm of the odds that an effect of such a score is there (BIC).

        What counts as so many observations are the frames: points of one have errors in common.
        Before the data one of all effects that are tested is expected.
        Source: Raftery 1995, eq. 35; Pauler, The Schwarz criterion and related methods for normal
        linear models (1998), for the number; Scott and Berger, Bayes and empirical-Bayes
        multiplicity adjustment in the variable-selection problem (2010), for the prior.
        """
        return float(score.statistic - score.rank * self.parameter_cost - self.prior_log_odds)

    @property
    def parameter_cost(self) -> float:
        """What a parameter gains by chance, in twice the log likelihood."""
        return float(np.log(max(self.null.linear.data.frames, _MIN_FRAMES)))

    @property
    def prior_log_odds(self) -> float:
        """Twice the log odds against any one effect before the data."""
        return float(2 * np.log(max(self.effect_count, 1)))

    def candidates(
        self,
        included: Index,
        per_frame: bool = True,
        worth: Callable[[Score], bool] = lambda _: True,
    ) -> list[Candidate]:
        """Return all forms, best criterion first.

        per_frame: also those that differ by frame; worth: whether a score is worth a look.
        """
        null = self.null
        remaining = null.remaining_information(null.information, included)
        candidates = []
        for form, score in enumerate(self._score_forms(remaining)):
            effect = null.fixed.forms.effects[form]
            if not score.rank or effect.per_frame > per_frame or not worth(score):
                continue
            # Some sizes have a meaning only where they are positive.
            positive = np.array([parameter.positive for parameter in effect.parameters])
            if (score.estimate[positive] < 0).any() or effect.is_implausible(
                score.estimate, null.linear.scene
            ):
                continue
            gain, count = score.statistic, score.rank
            if effect.per_frame:  # what it is in single frames is one variance
                gain, count = random_gain(null, included, null.form_columns(form)), 1
                score = score._replace(p_value=float(special.chdtrc(1, max(gain, 0.0))) / 2)
            criterion = float(gain - count * np.log(null.full.rows))
            candidates.append(
                Candidate(form, effect, score, self.correct(effect, score.p_value), criterion)
            )
        return sorted(candidates, key=lambda candidate: -candidate.criterion)

    def likeliest_forms(self, included: Index, names: Sequence[str], most: int) -> list[Candidate]:
        """Return the best form of each named effect that has one of at most so many parameters."""
        best: dict[str, Candidate] = {}
        for candidate in self.candidates(included, per_frame=False):
            name = candidate.effect.name
            if name in names and len(candidate.effect.parameters) <= most:
                best.setdefault(name, candidate)
        return list(best.values())

    def significant_candidates(self, included: Index) -> Iterator[Candidate]:
        """Yield what is significant, best criterion first, the variances' uncertainty taken in."""
        for candidate in self._promising_candidates(included):
            if not candidate.effect.per_frame:  # that one holds at any size of the variances
                columns = self.null.form_columns(candidate.form)
                score = self.adjust_p_value(candidate.score, included, columns, candidate.effect)
                corrected = self.correct(candidate.effect, score.p_value)
                candidate = replace(candidate, score=score, corrected=corrected)
            if candidate.corrected < SIGNIFICANCE:
                yield candidate

    def _promising_candidates(self, included: Index, per_frame: bool = True) -> list[Candidate]:
        """Return what is significant beside the variances as they are, best criterion first."""
        return [
            candidate
            for candidate in self.candidates(included, per_frame)
            if candidate.corrected < SIGNIFICANCE and candidate.criterion > 0
        ]

    def correct(self, effect: Effect, p_value: float) -> float:
        """Return a p-value times the numbers of effects and of this one's forms (Bonferroni)."""
        count = self.null.fixed.forms.form_counts[effect.name]
        return min(1.0, p_value * self.effect_count * count)

    def adjust_p_value(
        self, score: Score, included: Index, columns: Index, effect: Effect | None = None
    ) -> Score:
        """Return the score with what the uncertainty of the null model does to its p-value.

        F test with Satterthwaite's degrees of freedom, of the direction that was estimated; where
        it is not beyond doubt, the likelihood ratio beside a smooth image field, too: the variance
        of one that was too small to be called for says nothing of its uncertainty.
        effect: what the columns are of; None for a field without a name.
        """
        null = self.null
        covariance = null.variances.covariance
        if covariance is None or not score.rank:
            return score
        info = null.factorization.information
        combination = np.zeros(len(info))
        combination[columns] = score.estimate * null.scale[columns]
        combination = subtract_fit(info, included, combination)
        freedom = satterthwaite_freedom(null.factorization, combination, covariance)
        p = float(special.fdtrc(score.rank, freedom, max(score.statistic, 0.0) / score.rank))
        if p < _DOUBTFUL_P and (
            score.statistic < _CERTAIN_STATISTIC or (effect and effect.abrupt)
        ):
            gain = _alternative_gain(null, included, columns, effect)
            p = max(p, float(special.chdtrc(score.rank, gain)))
            if effect is not None:
                p = max(p, _cluster_p_value(null, score, combination, included, columns))
        return score._replace(p_value=p, freedom=freedom)

    def held_out_gain(self, included: Index, columns: Index, effect: Effect) -> HeldOutGain:
        """Return what columns add to the log predictive density of frames left out one by one.

        Of log p(all) - log p(all but one); a wide normal prior keeps what the others do not tell.
        """
        null = self.null
        prior = np.diag(null.prior_precision(columns, effect))
        at = null.columns_and_residual(np.concatenate([included, columns]))
        whole, parts = (
            null.restrict_information(information, included, at)
            for information in (
                null.information[at[:, None], at],
                null.information_without_frames(at, self._held_out_columns),
            )
        )
        inside, more = np.searchsorted(at, included), np.searchsorted(at, columns)
        return sum_gains(
            _log_marginal(whole, inside, more, prior)
            - np.array([_log_marginal(part, inside, more, prior) for part in parts])
        )

    @cached_property
    def _held_out_columns(self) -> Index:
        """The border's columns that held-out frames may be asked about.

        What is in the model, what is significant beside it, and the residual.
        """
        null = self.null
        significant = [
            null.form_columns(candidate.form)
            for candidate in self._promising_candidates(null.included_columns, per_frame=False)
        ]
        return null.columns_and_residual(np.concatenate([*significant, null.included_columns]))


def sum_gains(gains: Array) -> HeldOutGain:
    """Return the sum of the gains (F,) of frames with its error.

    The frame that gains most counts like the next: a near frame may show many times as much of an
    effect as the others, which is no reason for doubt; nor is what it alone shows one for trust.
    """
    count = len(gains)
    if count < 2:
        return HeldOutGain(float(gains.sum()), np.inf)
    clipped = np.minimum(gains, np.sort(gains)[-2])
    return HeldOutGain(float(clipped.sum()), float(clipped.std(ddof=1) * np.sqrt(count)))


def _log_marginal(information: Array, included: Index, columns: Index, prior: Array) -> float:
    """Return what columns add to the log marginal likelihood, up to the prior's own constant."""
    chosen = np.concatenate([included, columns, [len(information) - 1]])
    remaining = eliminate(information[np.ix_(chosen, chosen)], np.arange(len(included)))
    block = remaining[len(included) : -1, len(included) : -1] + prior
    gradient = remaining[len(included) : -1, -1]
    fit = gradient @ pseudo_inverse(block, 1e-14) @ gradient
    return float(fit - np.linalg.slogdet(block)[1]) / 2


def random_gain(null: NullModel, included: Index, columns: Index) -> float:
    """Return twice the gain in log likelihood if the coefficients of columns are random.

    Of whatever size, beside what frames have of their own or in place of it, against what frames
    may have of their own without the columns.
    """
    count = null.full.rows - null.full.group_rank

    def cost(logs: float, information: Array) -> float:
        rest = null.remaining_information(information, included)
        return logs + count * float(np.log(rest[-1, -1]))

    parts: list[FactoredEquations] = [null.factorization, *null.frame_alternatives]
    return min(cost(f.log_determinant, f.information) for f in parts) - min(
        cost(*integrate_columns(f, columns, 1 / size)) for f in parts for size in _TURN_SIZES
    )


def _alternative_gain(
    null: NullModel, included: Index, columns: Index, effect: Effect | None
) -> float:
    """Return the likelihood ratio of columns, whatever the size of what resembles them.

    Its variance is found with the columns and without them.
    """
    count = null.full.rows - null.full.group_rank
    without, beside = np.inf, np.inf
    for logs, information in _alternatives(null, effect):
        rest = null.remaining_information(information, included)
        remaining = rest[-1, -1]
        without = min(without, logs + count * np.log(remaining))
        inverse = pseudo_inverse(rest[np.ix_(columns, columns)], least=IDENTIFIABLE)
        remaining -= rest[columns, -1] @ inverse @ rest[columns, -1]
        beside = min(beside, logs + count * np.log(remaining))
    return max(float(without - beside), 0.0)


def _alternatives(null: NullModel, effect: Effect | None) -> Iterator[Alternative]:
    """Yield null models with what an effect may be mistaken for.

    A smooth field of the image; for what varies in a rig what frames have of their own: no pose
    of a single view takes up most of that there; for what is abrupt smooth walks of intrinsics.
    """
    yield from null.field_alternatives
    if effect is not None and effect.of_recording and null.linear.data.cameras > 1:
        for f in null.frame_alternatives:
            yield f.log_determinant, f.information
    if effect is not None and effect.abrupt:
        yield from null.walk_alternatives


def _cluster_p_value(
    null: NullModel, score: Score, combination: Array, included: Index, columns: Index
) -> float:
    """Return the p-value with the scatter of the score from landmark to landmark.

    What a landmark has of its own need not be an offset of it: light of another color, a print
    that detectors find elsewhere from aslant.  Never less than the null model says.
    Source: Liang and Zeger, Longitudinal data analysis using generalized linear models,
    Biometrika 73 (1986).
    """
    info, both = null.factorization.information, np.concatenate([included, columns])
    residual = subtract_fit(info, both, null.residual_combination(included))
    weight, remaining = _border_rows(null, combination, residual)
    used = null.linear.row_mask
    landmark = np.repeat(null.random.columns.unit, 2, axis=-1)[used]
    parts = np.bincount(landmark, weights=(weight * remaining)[used])
    expected = float(combination @ info @ combination) * null.variances.sigma**2
    statistic = score.statistic / max(float(parts @ parts) / max(expected, 1e-300), 1.0)
    freedom = max(len(np.unique(landmark)) - score.rank, 1)
    return float(special.fdtrc(score.rank, freedom, statistic / score.rank))


def _border_rows(null: NullModel, combination: Array, residual: Array) -> Array:
    """Return two combinations of the border (2, F, M), what is random out.

    Of the second all but what landmarks have of their own.
    """
    f, eq = null.factorization, null.equations
    parts = [eq.split(*f.coefficients(column)) for column in (combination, residual)]
    frame, landmark, shared = (np.stack(both, axis=-1) for both in zip(*parts, strict=True))
    landmark[..., 1] = 0.0
    pose = null.linear.frame_columns / eq.group_scale[:, None]
    random = predict_rows(null.active_effects.columns, pose, frame, landmark, shared, eq.units)
    rows = null.fixed.border @ np.stack([combination, residual], axis=-1)
    return np.moveaxis(rows - random, -1, 0)
