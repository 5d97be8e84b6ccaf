"""Fourth stage, the selection of causes: rounds of null model, tests and refit until none changes.

A round adds the effects that are accepted and removes those that are no longer needed
(`stepwise`); where nothing changes, single landmarks are asked for, then outliers, noise and the
finest image field are revised once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import count
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.cross_validation import fit_without_causes
from fisheye_svp_ros.diagnosis.effect_forms import simplest_form
from fisheye_svp_ros.diagnosis.effect_tests import SIGNIFICANCE, EffectTests
from fisheye_svp_ros.diagnosis.findings import Finding
from fisheye_svp_ros.diagnosis.fitted_model import FittedModel, refit
from fisheye_svp_ros.diagnosis.null_model import (
    FINEST_FIELD,
    NullModel,
)
from fisheye_svp_ros.diagnosis.problem import Problem, Progress
from fisheye_svp_ros.diagnosis.random_effects import NAMES
from fisheye_svp_ros.diagnosis.stepwise import (
    add_effects,
    eliminate_effects,
    find_single_landmarks,
)
from fisheye_svp_ros.diagnosis.variance_budget import NoiseGrowth, noise_growth
from fisheye_svp_ros.effects.base import Effect, ModelTerm, Untestable
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.effects.detection_effects import NoiseVsAngleEffect
from fisheye_svp_ros.effects.target_effects import LandmarkSurveyEffect
from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.mixed_model import Variances, pseudo_inverse
from fisheye_svp_ros.solve.bundle_adjustment import adjust, shorten_step
from fisheye_svp_ros.solve.outliers import (
    FAR_POINT,
    Outliers,
    relative_sigma,
    robust_scale,
    without_points,
)
from fisheye_svp_ros.solve.rig_state import RigState, RigViews, with_effect

_MAX_ROUNDS = 6
_REFITS_AFTER_REVISION = 2
_PROGRESS_DECAY = 0.6  # of the work left before a round, what is left after it
_FIELD_TEST_SIGMAS = 4.0  # standard errors
_LINEAR_LIMIT = 25.0  # a misfit so many times the noise's is not linear: one cause a round
_LEAST_SQUARES_LIMIT = 400.0  # and so many: its columns lead nowhere, least squares find the way
_MAX_EFFECTS = 20  # in one round
_REINSTATED_SIGMAS = 4.0  # below these a rejected point is like all others
_OUTLIER_PROBABILITY = 0.005  # probability of one such point among clean ones


class Revision(NamedTuple):
    """Data revised once the causes are known: outliers, and noise that grows with the angle."""

    outliers: Outliers
    growth: NoiseGrowth | None


@dataclass(frozen=True)
class Selection:
    """The causes that were found, in the null model around the state with them.

    first: the null model of the simulation, before any cause; trace: what was tried; refuted: by
    held-out frames, or since no lens can have so much.
    """

    problem: Problem
    first: NullModel
    null: NullModel
    revision: Revision
    trace: tuple[Finding, ...]
    refuted: tuple[str, ...] = ()

    @property
    def causes(self) -> list[ModelTerm]:
        """What was found: effects, their columns among what is shared, values."""
        return [term for term in self.null.terms if term.effect not in self.problem.given_effects]


@dataclass(frozen=True)
class _Search:
    """A search between two rounds; variances: to start from; revision: None before it is made."""

    data: RigViews
    state: RigState
    variances: Variances | None
    revision: Revision | None
    finest: bool
    trace: tuple[Finding, ...]
    refits_left: int

    def estimate_null_model(self, problem: Problem) -> NullModel:
        return NullModel.estimate(
            self.data,
            self.state,
            problem.free,
            self.variances,
            problem.options.left_out,
            self.finest,
        )


def select_causes(problem: Problem, progress: Progress) -> Selection:
    """Add causes to a fitted state until none is left that is significant and predicts better."""
    search = _begin(problem)
    first: NullModel | None = None
    for turn in count():
        progress(
            f'testing {len(CATALOGUE)} effects, round {turn + 1}',
            0.8 - 0.75 * _PROGRESS_DECAY**turn,
        )
        null = search.estimate_null_model(problem)
        first, before = first or null, replace(search, variances=null.variances)
        most = _MAX_EFFECTS if turn else _most_causes(null)
        search = _change_effects(problem, before, null, most)
        if not turn:
            problem.inputs.provisional(_names_found(problem, search))
        if search.state is before.state:
            search = _revise(problem, search, null)
        changed = search.state is not before.state
        if changed:
            search = replace(
                search, state=_refit(problem, search, null), refits_left=search.refits_left - 1
            )
        # The next one takes the memory of this one: fresh pages cost as much as sums over them.
        del null
        if not changed and search.finest == before.finest:
            break
        if not search.refits_left or turn + 1 == _MAX_ROUNDS:
            break
    assert first is not None
    search, null = _finish(problem, search, changed)
    revision = search.revision or Revision(problem.outliers, None)
    return Selection(problem, first, null, revision, search.trace)


def first_causes(problem: Problem) -> tuple[str, ...]:
    """Return the names of the causes that the first round finds."""
    search = _begin(problem)
    null = search.estimate_null_model(problem)
    search = replace(search, variances=null.variances)
    return _names_found(problem, _change_effects(problem, search, null, _most_causes(null)))


def _begin(problem: Problem) -> _Search:
    refits = 1 if problem.options.quick else _MAX_ROUNDS
    return _Search(problem.data, _include_effects(problem), None, None, False, (), refits)


def _names_found(problem: Problem, search: _Search) -> tuple[str, ...]:
    """Return the names of what was found, without what the lens came with."""
    terms = search.state.terms
    return tuple(term.name for term in terms if term.effect not in problem.given_effects)


def _most_causes(null: NullModel) -> int:
    """Return how many causes the first round may take in at once."""
    return 1 if _misfit(null) > _LINEAR_LIMIT else _MAX_EFFECTS


def _change_effects(problem: Problem, search: _Search, null: NullModel, most: int) -> _Search:
    """Remove effects and add others; where none changes, single landmarks that stand out."""
    tests, options = EffectTests(null), problem.options
    included, steps = eliminate_effects(tests, known_effects(problem), options.quick)
    gone = [step.effect for step in steps]
    # What was given up is not asked for again.
    refused = {step.effect for step in (*search.trace, *steps) if step.reason.is_removal}
    forms, tried = add_effects(tests, included, most, refused, options.quick)
    search = replace(search, trace=(*search.trace, *steps, *tried))
    if gone or forms:
        return replace(search, state=_change_state(null, included, gone, forms))
    name = LandmarkSurveyEffect.name
    if name in options.left_out or any(term.name == name for term in search.state.terms):
        return search
    found = find_single_landmarks(tests)
    if found is None:
        return search
    effect, offset, step = found
    return replace(
        search,
        state=with_effect(search.state, effect, offset),
        trace=(*search.trace, step),
        # Their random offsets must not stand in for them: drawn as those of most are.
        variances=replace(
            null.variances,
            weight=np.where(
                np.isin(null.random.landmark, effect.landmarks), 1.0, null.variances.weight
            ),
        ),
    )


def _revise(problem: Problem, search: _Search, null: NullModel) -> _Search:
    """Ask for the finest image field once the causes are known, then revise outliers and noise."""
    if problem.options.quick or search.revision is not None:
        return search
    fitted = FittedModel.solve_null_model(null)
    # Points of different frames err alike where they fall on the same place.
    if (
        not search.finest
        and fitted.place_correlation() > _FIELD_TEST_SIGMAS
        and null.calls_for_finest_field(search.data, search.state, problem.options.left_out)
    ):
        return replace(search, finest=True)
    return _revise_outliers(problem, search, fitted)


def _revise_outliers(problem: Problem, search: _Search, fitted: FittedModel) -> _Search:
    """Reinstate what the causes explain, reject what is too far off for the noise.

    Whether that grows with the angle is asked before.
    """
    squares, growth = fitted.standardized_squares(), None
    if 'noise_vs_angle' not in problem.options.left_out:
        growth = noise_growth(fitted)
        squares = squares / growth.variance
        growth = growth._replace(p_value=min(1.0, growth.p_value * len(CATALOGUE)))
        if growth.p_value > SIGNIFICANCE:
            growth = None
    data, kept = reinstate_outliers(search.data, fitted, problem.outliers)
    data, outliers = reject_outliers(data, fitted, kept, squares)
    changed = len(kept.rows) < len(problem.outliers.rows) or len(outliers.rows) > len(kept.rows)
    state = search.state
    if growth is not None:
        term = ModelTerm(NoiseVsAngleEffect(), np.array([growth.value]))
        state = replace(state, terms=(*state.terms, term))
    elif changed:
        state = replace(state)  # the same, to be fitted to other data
    return replace(
        search,
        data=data,
        state=state,
        revision=Revision(outliers, growth),
        refits_left=_REFITS_AFTER_REVISION,
    )


def _refit(problem: Problem, search: _Search, null: NullModel) -> RigState:
    state = search.state
    if _misfit(null) > _LEAST_SQUARES_LIMIT:
        state = adjust(search.data, state, problem.free)
    assert search.variances is not None
    return refit(search.data, state, problem.free, search.variances)


def _finish(problem: Problem, search: _Search, changed: bool) -> tuple[_Search, NullModel]:
    """Fit once more with the last variances, without what they no longer call for.

    changed: whether the state is another one than these variances are of.
    """
    free, options = problem.free, problem.options
    if changed and not options.quick:
        search = _renew_variances(problem, search)
    while True:
        # The last variances weigh the last fit.
        assert search.variances is not None
        state = refit(search.data, search.state, free, search.variances)
        null = NullModel.linearize(
            search.data, state, free, search.variances, options.left_out, search.finest
        )
        if not changed:
            return search, null  # all that is in the model was asked for beside these variances
        included, steps = eliminate_effects(
            EffectTests(null), known_effects(problem), options.quick
        )
        if not steps:
            return search, null
        gone = [step.effect for step in steps]
        state = _change_state(null, included, gone, ())
        search = replace(search, state=state, trace=(*search.trace, *steps))
        del null
        search = _renew_variances(problem, search)


def _renew_variances(problem: Problem, search: _Search) -> _Search:
    return replace(search, variances=search.estimate_null_model(problem).variances)


def without_cause(selection: Selection, name: str) -> Selection:
    """Return a selection without one of its causes: fitted, and its variances found, anew."""
    null, problem = selection.null, selection.problem
    free, left_out = problem.free, problem.options.left_out
    data, finest = null.linear.data, bool(null.variances.alive[NAMES.index(FINEST_FIELD)])
    state = fit_without_causes(null, [name], free)
    variances = NullModel.estimate(data, state, free, null.variances, left_out, finest).variances
    state = refit(data, state, free, variances)
    null = NullModel.linearize(data, state, free, variances, left_out, finest)
    return replace(selection, null=null)


def known_effects(problem: Problem) -> tuple[str, ...]:
    """Return what is not asked for: what the lens came with and what the user includes."""
    return (*problem.options.included, *(effect.name for effect in problem.given_effects))


def _misfit(null: NullModel) -> float:
    """Return the mean square of the residuals over that of the noise."""
    return float((null.linear.residual**2).mean()) / null.variances.sigma**2


def _change_state(
    null: NullModel, included: Index, gone: Sequence[str], forms: Sequence[int]
) -> RigState:
    """Return the state without some effects and with chosen forms of others."""
    kept = null.linear.state.without_effects(gone)
    estimated = _estimate_forms(null, included, forms)

    def take_step(fraction: float) -> RigState:
        return reduce(
            lambda state, one: with_effect(state, one[0], fraction * one[1]), estimated, kept
        )

    return shorten_step(null.linear.data, null.linear.free, take_step)[0]


def _estimate_forms(
    null: NullModel, included: Index, forms: Sequence[int]
) -> list[tuple[Effect, Array]]:
    """Return chosen forms with their joint estimates."""
    columns = [null.form_columns(form) for form in forms]
    every = np.concatenate([included, *columns])
    information = null.restrict_information(null.information, included)
    prior = np.concatenate(
        [
            np.zeros(len(included)),
            *(
                null.physical_precision(mine, null.fixed.forms.effects[form])
                for form, mine in zip(forms, columns, strict=True)
            ),
        ]
    )
    inverse = pseudo_inverse(information[np.ix_(every, every)] + np.diag(prior), 1e-12)
    values = (inverse @ information[every, -1]) / null.scale[every]
    estimated, at = [], len(included)
    for form, mine in zip(forms, columns, strict=True):
        estimated.append((null.fixed.forms.effects[form], values[at : at + len(mine)]))
        at += len(mine)
    return estimated


def _include_effects(problem: Problem) -> RigState:
    """Return the fitted state with the causes that the user knows of, in stated or simple forms.

    Raises ObservationError for one that the data cannot hold.
    """
    state = problem.start
    if not problem.options.included:
        return state
    stated = {effect.name: effect for effect in problem.options.stated}
    for name in problem.options.included:
        try:
            form = stated.get(name) or simplest_form(CATALOGUE[name], problem.linear)
            state = with_effect(state, form)
        except Untestable as why:
            raise ObservationError(f'{problem.observations.source}: {name}: {why}') from why
    return adjust(problem.data, state, problem.free)


def reject_outliers(
    data: RigViews, fitted: FittedModel, outliers: Outliers, squares: Array
) -> tuple[RigViews, Outliers]:
    """Reject points that are too far off once every random part is predicted.

    squares: of the standardised residuals (F, M).
    """
    views = data.views
    pairs = data.by_view(squares).sum(axis=-1)
    limit = -2 * np.log(_OUTLIER_PROBABILITY / max(int(views.used.sum()), 1))
    mask = views.used & (pairs > limit)
    mask &= (mask.sum(axis=1) < 0.5 * views.used.sum(axis=1))[:, None]
    # A landmark that is off in most of its views is not where it is said to be.
    every = np.bincount(views.landmark[views.used])
    off = np.bincount(views.landmark[mask], minlength=len(every))
    mask &= (off <= 0.3 * every)[np.where(views.used, views.landmark, 0)]
    px = np.linalg.norm(views.uv - fitted.linear.linear.uv, axis=-1)
    return without_points(data, mask), outliers.append(views.row[mask], px[mask], FAR_POINT)


def reinstate_outliers(
    data: RigViews, fitted: FittedModel, outliers: Outliers
) -> tuple[RigViews, Outliers]:
    """Reinstate points that were rejected, where the causes predict them as well as others.

    Beside a simulation that is wrong the nearest landmarks look like outliers.
    """
    views, again = data.views, np.zeros(len(outliers.rows), dtype=bool)
    off = np.linalg.norm(views.uv - fitted.linear.linear.uv, axis=-1) / relative_sigma(views)
    scale = robust_scale(np.where(views.used, off, np.nan))
    near = ~views.used & (views.landmark >= 0) & (off < _REINSTATED_SIGMAS * scale)
    weight, row, table = views.weight.copy(), views.row.copy(), data.observations
    for view, point in np.argwhere(near):
        known = (
            (table.frame[outliers.rows] == views.frame[view])
            & (table.camera[outliers.rows] == views.camera[view])
            & (table.landmark[outliers.rows] == views.landmark[view, point])
            & (table.uv[outliers.rows] == views.uv[view, point]).all(axis=1)
        )
        for i in np.flatnonzero(known & ~again)[:1]:
            again[i], row[view, point] = True, outliers.rows[i]
            weight[view, point] = 1 / np.nan_to_num(table.sigma[outliers.rows[i]], nan=1.0)
    why = tuple(one for one, back in zip(outliers.why, again, strict=True) if not back)
    return (
        replace(data, views=views._replace(weight=weight, row=row)),
        outliers._replace(rows=outliers.rows[~again], px=outliers.px[~again], why=why),
    )
