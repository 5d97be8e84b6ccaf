"""Causes: estimates, what they are confounded with, whether they remain significant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import isnan
from typing import Any, NamedTuple

import numpy as np
from scipy import special

from fisheye_svp_ros.arrays import Array, Index, flat_rows
from fisheye_svp_ros.diagnosis.checks.medium import Medium
from fisheye_svp_ros.diagnosis.effect_tests import (
    CONFOUNDED_P,
    RARITY_ODDS,
    SIGNIFICANCE,
    EffectTests,
)
from fisheye_svp_ros.diagnosis.findings import Status, probability_of, status_of
from fisheye_svp_ros.diagnosis.posterior import EffectPosterior
from fisheye_svp_ros.diagnosis.random_effects import SAG
from fisheye_svp_ros.diagnosis.sagging import SagOdds, bend_over_sag
from fisheye_svp_ros.diagnosis.variance_budget import NoiseGrowth
from fisheye_svp_ros.effects.base import Effect, ModelTerm
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.effects.ray_effects import FlatPortEffect, RadialProfileEffect
from fisheye_svp_ros.effects.target_effects import TargetShapeEffect
from fisheye_svp_ros.mixed_model import project_out, pseudo_inverse
from fisheye_svp_ros.scene.observations import Observations, photograph_entry
from fisheye_svp_ros.solve.outliers import Outliers
from fisheye_svp_ros.solve.port_fit import MEDIUM_INDEX, THICKNESS

_PORT_UNITS = {
    MEDIUM_INDEX: '',
    'port_distance': 'm',
    'port_tilt_x': 'rad',
    'port_tilt_y': 'rad',
    THICKNESS: 'm',
}


class Imitation(NamedTuple):
    """An effect that a cause may stand for, and the ray error, rad, rms, that would remain."""

    effect: str
    ray_error: float


@dataclass(frozen=True)
class Cause:
    """One named cause with its parameters, evidence and what it may be mistaken for.

    form: `Effect.key`; p_value: corrected for the effects and forms that were tested; share: of
    the misfit of the simulation; survives: whether it is still needed with any one other cause
    left out; heldout_rms_px: of held-out frames once it is in the model, after those before it;
    gain: of what held-out frames lose without it; imitations: effects
    that are not tested and that it may stand for; refuted_by_frames: first and last frame of
    contiguous thirds that are predicted worse with it; odds: of each of the confounded set, of
    which this is the first, where one of them is there; of a bend also against a sag of the board,
    where it sags; {} of a cause alone; posterior: how probable it is, or one of the set, by all
    likely models, None where these do not ask for it.
    """

    form: str
    parameters: dict[str, dict[str, Any]]
    p_value: float
    share: float
    survives: bool
    heldout_rms_px: float
    gain: float
    indistinguishable_from: list[str] = field(default_factory=list)
    imitations: tuple[Imitation, ...] = ()
    refuted_by_frames: tuple[tuple[int, int], ...] = ()
    odds: Mapping[str, float] = field(default_factory=dict)
    posterior: float | None = None

    @property
    def effect(self) -> str:
        """The name of the effect."""
        return self.form.partition('(')[0]

    @property
    def probability(self) -> float:
        """How probable the cause is, or one of its confounded set."""
        return probability_of(self.p_value) if self.posterior is None else self.posterior

    @property
    def status(self) -> Status:
        """Confirmed where it predicts better, or moves no prediction, and is probable enough.

        Not where nothing of it is larger than its error.
        """
        helps = isnan(self.heldout_rms_px) or self.gain > 0
        return status_of(self.probability, helps and not self.is_within_error)

    @property
    def is_within_error(self) -> bool:
        """Whether all of its parameters may as well be zero, by their standard errors."""
        return bool(self.parameters) and all(
            abs(entry['value']) < entry['stderr'] for entry in self.parameters.values()
        )

    @property
    def effect_class(self) -> type[Effect]:
        """The class of the effect, which says what it is."""
        return CATALOGUE[self.effect]

    @property
    def stage(self) -> str:
        """The part of the variance budget that it belongs to: lens, target, frame or noise."""
        return self.effect_class.budget_stage()

    @property
    def members(self) -> list[str]:
        """What its parameters are of (PART.NAME): single boards or landmarks, say."""
        return list(dict.fromkeys(name.partition('.')[0] for name in self.parameters))


def selected_causes(
    tests: EffectTests,
    posterior: EffectPosterior,
    found: Sequence[ModelTerm],
    errors: Array,
    shares: dict[str, float],
    held_out: Sequence[tuple[float, float]],
) -> list[Cause]:
    """Return the causes that move predictions; held_out: rms and gain once each is in.

    A cause is as probable as that it, or one of its confounded set, is there.
    """
    causes = []
    for term, (rms, gain) in zip(found, held_out, strict=True):
        effect, columns, name = term.effect, term.columns, term.name
        odds = confounded_odds(tests, posterior, term)
        alike = [rival for rival in odds if rival != name]
        sag = bend_over_sag(tests, columns) if name == TargetShapeEffect.name else None
        if sag is not None:
            odds = _with_sag(odds or {name: 1.0}, name, sag)
            alike += [SAG] * sag.confounded
        score = tests.test_removal(tests.null.included_columns, columns, effect)
        causes.append(
            Cause(
                form=effect.key,
                parameters=parameters_of(term, errors),
                p_value=tests.correct(effect, score.p_value),
                share=shares[name],
                survives=_survives(tests, effect, columns),
                heldout_rms_px=rms,
                gain=gain,
                indistinguishable_from=alike,
                odds=odds,
                posterior=posterior.probability_beside(name, odds),
                imitations=_imitations(tests, alike, columns),
            )
        )
    return causes


def medium_cause(medium: Medium, stderr: dict[str, float], rms: float, gain: float) -> Cause:
    """Return a medium behind a port as a cause.

    stderr by name; rms, gain: of held-out frames once it is in.
    """
    values = medium.state.lens.parameters
    if MEDIUM_INDEX in stderr:
        # Nothing seen through the port tells the index from the focal length in air.
        told = float(np.hypot(stderr[MEDIUM_INDEX], medium.focal_error * values[MEDIUM_INDEX]))
        stderr = {**stderr, MEDIUM_INDEX: told}
    parameters = {
        name.removeprefix('port_'): {
            'value': float(values[name]),
            'stderr': stderr.get(name, 0.0),
            'unit': unit,
        }
        for name, unit in _PORT_UNITS.items()
        if name in (MEDIUM_INDEX, *medium.names)
    }
    return Cause(
        form=f'{FlatPortEffect.name}(medium)',
        parameters=parameters,
        p_value=medium.p_value,
        share=medium.share,
        survives=True,
        heldout_rms_px=rms,
        gain=gain,
        indistinguishable_from=[RadialProfileEffect.name] if medium.alike else [],
    )


def _imitations(tests: EffectTests, alike: Sequence[str], columns: Index) -> tuple[Imitation, ...]:
    """Return the effects that are not tested and that a cause may stand for."""
    return tuple(
        Imitation(effect.name, _error_of_imitation(tests, at, columns))
        for effect, at in tests.null.look_alikes
        if effect.name in alike
    )


def _error_of_imitation(tests: EffectTests, true: Index, columns: Index) -> float:
    """Return the ray error, rad, rms, where an effect is true and a cause is fitted for it.

    true: the border's columns of the effect, of the size that it has in the place of the cause.
    """
    null, linear = tests.null, tests.null.linear
    rest = np.setdiff1d(null.included_columns, columns)
    values = tests.score_beside(rest, true).estimate * null.scale[true]
    border = null.fixed.border
    both = np.append(
        border[..., null.included_columns], border[..., true] @ values[:, None], axis=-1
    )
    both = flat_rows(project_out(both, linear.frame_columns))
    fitted, moved = both[:, :-1], both[:, -1]
    remaining = moved - fitted @ (pseudo_inverse(fitted.T @ fitted) @ (fitted.T @ moved))
    return linear.rms_px_of(remaining.reshape(linear.residual.shape)) / linear.state.lens.focal


def parameters_of(term: ModelTerm, errors: Array) -> dict[str, dict[str, Any]]:
    """Return value, standard error and unit of each parameter of an effect, by name.

    errors (K,): standard errors of all that is shared.
    """
    effect, values = term.effect, term.effect.report_values(term.values)
    return {
        p.name: {'value': float(v), 'stderr': float(e), 'unit': p.unit}
        for p, v, e in zip(effect.parameters, values, errors[term.columns], strict=True)
    }


def _survives(tests: EffectTests, effect: Effect, columns: Index) -> bool:
    """Whether an effect is needed whichever one other cause is left out."""
    for other in (term.columns for term in tests.null.terms):
        included = np.setdiff1d(tests.null.included_columns, other)
        if not np.array_equal(other, columns) and (
            tests.correct(effect, tests.test_removal(included, columns, effect).p_value)
            > SIGNIFICANCE
        ):
            return False
    return True


def confounded_effects(
    tests: EffectTests, posterior: EffectPosterior, term: ModelTerm
) -> list[str]:
    """Return the effects that may be there in the place of one."""
    return [rival for rival in confounded_odds(tests, posterior, term) if rival != term.name]


def confounded_odds(
    tests: EffectTests, posterior: EffectPosterior, term: ModelTerm
) -> dict[str, float]:
    """Return how probable each of a confounded set is, one of them being there; {} for one alone.

    The effect is the first; the others are those that likely models have in its place, and those
    that are tested only where the user states them and do what it does.
    """
    name, columns = term.name, term.columns
    if term.effect.per_frame or term.effect.asked_last:
        return {}
    if name not in posterior.probabilities:
        posterior = EffectPosterior.of_null_model(tests.null)  # as if it need not be there
    chance = posterior.probabilities.get(name, 0.0)
    odds = {name: chance, **posterior.in_place_of(name)}
    if CATALOGUE[name].budget_stage() == 'lens':
        rest = np.setdiff1d(tests.null.included_columns, columns)
        score = tests.score_beside(rest, columns)
        for effect, at in tests.null.look_alikes:
            theirs = tests.score_beside(rest, at)
            beside = tests.score_beside(np.concatenate([rest, at]), columns)
            if beside.p_value > CONFOUNDED_P and not tests.null.effect_kinds & {*effect.kinds}:
                log_odds = tests.log_odds(theirs) - tests.log_odds(score) - RARITY_ODDS
                odds[effect.name] = chance * float(np.exp(min(log_odds, 0.0) / 2))
    total = sum(odds.values())
    return {rival: share / total for rival, share in odds.items()} if len(odds) > 1 else {}


def _with_sag(odds: Mapping[str, float], name: str, sag: SagOdds) -> dict[str, float]:
    """Return the odds of a confounded set with a sag of the board against the bend of a name."""
    logs = np.log(np.maximum([*odds.values()], 1e-300))
    logs = np.append(logs, logs[[*odds].index(name)] - sag.log_odds / 2)
    return dict(zip([*odds, SAG], special.softmax(logs).tolist(), strict=True))


def _plain_cause(
    name: str, part: str, value: float, stderr: float, unit: str, p_value: float = 0.0
) -> Cause:
    """Return a cause that moves no prediction: it lies in the table or in the noise."""
    parameters = {part: {'value': value, 'stderr': stderr, 'unit': unit}}
    return Cause(
        form=name,
        parameters=parameters,
        p_value=p_value,
        share=0.0,
        survives=True,
        heldout_rms_px=float('nan'),
        gain=0.0,
    )


def table_causes(observations: Observations, outliers: Outliers, step: float) -> list[Cause]:
    """Return causes in the table: wrong ids, and rounding to a step (px; 0 for none)."""
    causes = []
    swapped = outliers.swap_count
    # One of many outliers is chance.
    if swapped > 1 or 2 * swapped >= len(outliers.rows) > 0:
        fraction = swapped / len(observations)
        error = fraction / np.sqrt(swapped)
        causes.append(_plain_cause('wrong_ids', 'fraction', fraction, error, '1'))
    if step:
        causes.append(_plain_cause('quantisation', 'step', step, 0.0, 'px'))
    return causes


def growth_cause(growth: NoiseGrowth | None) -> list[Cause]:
    """Return noise that grows with the angle as a cause, if it does."""
    if growth is None:
        return []
    return [
        _plain_cause(
            'noise_vs_angle', 'growth', growth.value, growth.stderr, '1/rad^2', growth.p_value
        )
    ]


def outlier_rows(
    observations: Observations, outliers: Outliers, where: str = ''
) -> list[dict[str, Any]]:
    """Return outliers by frame and landmark, the farthest first."""
    found = []
    for i in np.argsort(-outliers.px, kind='stable'):
        row = outliers.rows[i]
        frame = int(observations.frame[row])
        camera = observations.cameras[observations.camera[row]]
        found.append(
            {
                'frame': frame,
                **photograph_entry(observations, frame, camera),
                'landmark': int(observations.landmark[row]),
                'px': float(outliers.px[i]),
                'why': where + outliers.why[i],
                **({'camera': camera} if len(observations.cameras) > 1 else {}),
            }
        )
    return found
