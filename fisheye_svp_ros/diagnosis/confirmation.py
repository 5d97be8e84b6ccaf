"""Which causes are confirmed: what held-out frames refute, or another effect explains, is not."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.causes import confounded_effects, parameters_of
from fisheye_svp_ros.diagnosis.cross_validation import HeldOut, cross_validate
from fisheye_svp_ros.diagnosis.effect_tests import SIGNIFICANCE, EffectTests
from fisheye_svp_ros.diagnosis.evaluation import Evaluation
from fisheye_svp_ros.diagnosis.selection import Selection, without_cause
from fisheye_svp_ros.effects.base import Effect

_FAR_SHIFT = 0.025  # m: no lens of a machine is known to move its viewpoint by more
REFUTED_BY_FRAMES = 'held-out frames refute it'
REFUTED_BY_FILE = 'the held-out file refutes it'
NO_GAIN = 'its gain on held-out frames is not significant'
NO_OTHER_FRAME = 'there is no other frame to confirm it'


@dataclass(frozen=True)
class UnconfirmedCause:
    """An effect that is significant, and yet no confirmed cause; why: the reason."""

    effect: str
    parameters: dict[str, dict[str, Any]]
    p_value: float
    why: str


class HeldOutChange(NamedTuple):
    """By how much the sum of squares of held-out frames falls, px^2, and its standard error."""

    value: float
    stderr: float

    @property
    def z(self) -> float:
        """In standard errors."""
        return self.value / max(self.stderr, 1e-300)


def change_between(before: HeldOut, after: HeldOut) -> HeldOutChange:
    """Return by how much the sum of squares falls, with its error over the frames."""
    change = before.squares - after.squares
    count = len(change)
    error = float(change.std(ddof=1) * np.sqrt(count)) if count > 1 else np.inf
    return HeldOutChange(float(change.sum()), error)


class Doubt(NamedTuple):
    """Why a cause is not confirmed; z: of what it gains on held-out frames."""

    effect: str
    z: float
    why: str


def weakest_cause(evaluation: Evaluation) -> Doubt | None:
    """Return the cause that is confirmed least, if there is one that is not."""
    selection, null = evaluation.selection, evaluation.null
    tests, full = EffectTests(null), cross_validate(null)
    kept, twins = full.is_predictable, _confounded_pairs(EffectTests(null))
    other = None if evaluation.held_out is None else evaluation.predict()
    doubts = []
    for effect, columns, values in selection.causes:
        if effect.name in selection.problem.options.included or effect.per_frame:
            continue
        change = change_between(
            cross_validate(null, [effect.name]).take(kept), full.take(kept))
        why = _refutation(change) if len(kept) > 1 else NO_OTHER_FRAME
        if not why and other is not None and change_between(
                evaluation.predict([effect.name]), other).z < -1:
            why = REFUTED_BY_FILE
        why = why or find_confounder(tests, effect, columns, twins) or _implausible(effect, values)
        if why:
            doubts.append(Doubt(effect.name, change.z, why))
    return min(doubts, key=lambda one: one.z, default=None)


def _refutation(change: HeldOutChange) -> str:
    if change.z > 1:
        return ''
    return REFUTED_BY_FRAMES if change.z < -1 else NO_GAIN


def _confounded_pairs(tests: EffectTests) -> list[tuple[str, Index, list[str]]]:
    """Return the name and columns of each effect in the model, and what it is confounded with."""
    return [(effect.name, columns, confounded_effects(tests, effect.name, columns))
            for effect, columns, _ in tests.null.terms if not effect.per_frame]


def find_confounder(
    tests: EffectTests, effect: Effect, columns: Index,
    twins: Sequence[tuple[str, Index, list[str]]],
) -> str:
    """Return which effect in the place of another cause makes this one needless."""
    null = tests.null
    for other, theirs, names in twins:
        if other == effect.name or not names:
            continue
        rest = np.setdiff1d(null.included_columns, np.concatenate([columns, theirs]))
        # One with as many parameters as both causes explains nothing more simply than they do.
        for twin in tests.likeliest_forms(rest, names, len(theirs) + len(columns) - 1):
            beside = np.concatenate([rest, null.form_columns(twin.form)])
            place = f'if {twin.effect.name} replaces {other}'
            if tests.score_beside(beside, columns).p_value * tests.effect_count > SIGNIFICANCE:
                return f'not significant {place}'
            if not tests.held_out_gain(beside, columns, effect).sufficient:
                return f'no significant gain on held-out frames {place}'
    return ''


def _implausible(effect: Effect, values: Array) -> str:
    if effect.name == 'viewpoint_shift' and abs(values[0]) > _FAR_SHIFT:
        return f'a shift of {1e3 * abs(values[0]):.0f} mm is larger than in any real lens'
    return ''


def confirm(
    selection: Selection, evaluate: Callable[[Selection], Evaluation]
) -> tuple[Evaluation, list[UnconfirmedCause]]:
    """Take out causes that are not confirmed, the weakest first; fit the rest anew each time."""
    candidates: dict[str, UnconfirmedCause] = {}
    while True:
        evaluation = evaluate(selection)
        doubt = weakest_cause(evaluation)
        if doubt is None:
            return evaluation, _add_refused_causes(selection, candidates)
        effect, columns, values = next(
            cause for cause in selection.causes if cause[0].name == doubt.effect)
        test = EffectTests(selection.null).test_removal(
            selection.null.included_columns, columns, effect)
        candidates[doubt.effect] = UnconfirmedCause(
            doubt.effect, parameters_of(effect, values, evaluation.errors[columns]), test.p_value,
            doubt.why)
        selection = without_cause(selection, doubt.effect)
        if doubt.why in (REFUTED_BY_FRAMES, REFUTED_BY_FILE) or _implausible(effect, values):
            selection = replace(selection, refuted=(*selection.refuted, doubt.effect))


def _add_refused_causes(
    selection: Selection, found: Mapping[str, UnconfirmedCause]
) -> list[UnconfirmedCause]:
    """Return also what was significant in the selection and did not predict better."""
    causes = {effect.name for effect, _, _ in selection.causes}
    every = dict(found)
    why = NO_GAIN if selection.null.linear.data.frames > 1 else NO_OTHER_FRAME
    for step in selection.trace:
        if (not step.accepted and step.why.endswith('does not predict better')
                and step.name not in causes and step.name not in every):
            every[step.name] = UnconfirmedCause(step.name, {}, step.corrected, why)
    return list(every.values())
