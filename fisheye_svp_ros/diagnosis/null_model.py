"""Second stage, the null model: fixed what is legitimately free, random what has no name.

Poses, rig, intrinsics and effects in the model are fixed columns;
targets, frames and lenses have random effects whose variances come from the data.  Columns of
everything that could be added stand beside them, so that one factorization serves all tests.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.diagnosis.effect_forms import (
    EffectForms,
    effect_forms,
    intrinsic_walks,
    smooth_fields,
)
from fisheye_svp_ros.diagnosis.random_effects import (
    NAMES,
    STAGE_OF,
    RandomEffects,
    make_random_effects,
)
from fisheye_svp_ros.effects.base import Effect, ModelTerm
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.mixed_model import (
    LAMBDA_ABSENT,
    Equations,
    FactoredEquations,
    LeaveOneOut,
    Variances,
    eliminate,
    estimate_variances,
    factor_equations,
    find_variances,
    identifiable_basis,
    initial_variances,
    integrate_columns,
    is_called_for,
    leave_groups_out,
    make_equations,
    no_variances,
    remove_contradicted,
)
from fisheye_svp_ros.solve.rig_state import Linearization, RigState, RigViews, is_shared

FINEST_FIELD = 'image_finest'
_OF_FRAMES = np.array([stage == 'frame' for stage in STAGE_OF.values()])  # components
_FIELD_SIZES = (0.5, 2.0, 8.0, 32.0)  # what a bump adds to the variance where it is, over noise
_WALK_SIZES = tuple(8.0 * 4.0**i for i in range(12))  # of the slowest wave of a walk
_FRAME_STEPS = 6  # the likelihood is flat around the best variances
_SIMILAR_POSE = 0.1  # of the distance, or rad
_MIN_CLUSTERS = 3  # fewer are no sample

Alternative = tuple[float, Array]  # log determinant and information of the border


@dataclass(frozen=True)
class FixedColumns:
    """The fixed columns that all frames share: of the model, and what could be added to it.

    border (F, M, X + 1): normalized columns and, last, the residual; scale (X,): norms that they
    were divided by.  The first `own` are in the model; the forms of the catalogue follow, then
    smooth fields, by variable, and walks of the intrinsics with their roughness.
    """

    border: Array
    scale: Array
    own: int
    forms: EffectForms
    fields: dict[str, Index]
    walks: Index
    roughness: Array

    @classmethod
    def gather(cls, linear: Linearization, left_out: Sequence[str]) -> FixedColumns:
        """Return the columns of a linearized state, without the effects left out."""
        forms = effect_forms(linear, left_out)
        fields, (walks, roughness) = smooth_fields(linear), intrinsic_walks(linear)
        parts = [linear.shared_columns, forms.columns, *fields.values(), walks]
        columns = np.concatenate(parts, axis=-1)
        scale = column_norms(columns)
        ends = np.cumsum([part.shape[-1] for part in parts])
        own, _, *where, walks_at = np.split(np.arange(len(scale)), ends[:-1])
        return cls(
            border_of(linear, columns / scale),
            scale,
            len(own),
            forms,
            dict(zip(fields, where, strict=True)),
            walks_at,
            roughness,
        )


@dataclass(frozen=True)
class NullModel:
    """A linearized state with its random effects, their variances, and all that could be added.

    random, full: of all components; variances: of those that the data call for.
    """

    linear: Linearization
    fixed: FixedColumns
    random: RandomEffects
    full: Equations
    variances: Variances

    @classmethod
    def estimate(
        cls,
        data: RigViews,
        state: RigState,
        free: Sequence[str],
        before: Variances | None = None,
        left_out: Sequence[str] = (),
        finest: bool = False,
    ) -> NullModel:
        """Linearize a state and estimate the variances of its random effects (REML).

        before: variances to start from; left_out: effects; finest: with the finest image field.
        """
        bare = cls._linearize(data, state, free, left_out, finest)
        all_free = bare._all_free()
        variances = find_variances(all_free, before)
        own = bare.equations_of(bare.included_columns)
        return bare._with_priors(
            remove_contradicted(all_free.select(variances.alive), own, variances)
        )

    @classmethod
    def with_variances(
        cls,
        data: RigViews,
        state: RigState,
        free: Sequence[str],
        variances: Variances | None = None,
    ) -> NullModel:
        """Return the null model of known variances, without effects that could be added.

        variances: None for nothing random.
        """
        finest = variances is not None and bool(variances.alive[NAMES.index(FINEST_FIELD)])
        landmarks = len(np.unique(data.views.landmark[data.views.used]))
        known = variances or no_variances(len(NAMES), landmarks)
        bare = cls._linearize(data, state, free, tuple(CATALOGUE), finest, known.alive)
        return bare._with_priors(known)

    @classmethod
    def linearize(
        cls,
        data: RigViews,
        state: RigState,
        free: Sequence[str],
        variances: Variances,
        left_out: Sequence[str],
        finest: bool,
    ) -> NullModel:
        """Linearize a state; variances: found around a similar one."""
        return cls._linearize(data, state, free, left_out, finest)._with_priors(variances)

    @classmethod
    def _linearize(
        cls,
        data: RigViews,
        state: RigState,
        free: Sequence[str],
        left_out: Sequence[str],
        finest: bool,
        alive: Mask | None = None,
    ) -> NullModel:
        """Return the model before any variance is known; alive: its components, None for all."""
        linear = Linearization(data, state, free)
        linear.check_images()
        fixed, random = FixedColumns.gather(linear, left_out), make_random_effects(linear, finest)
        if alive is not None:
            random = random.select(alive)
        full = make_equations(random.columns, linear.frame_columns, fixed.border)
        return cls(linear, fixed, random, full, initial_variances(full))

    def _with_priors(self, variances: Variances) -> NullModel:
        """Return the model with variances, and the priors of its effects beside their noise."""
        products = prior_products(self.linear, self.linear.state, self.scale, variances.sigma)
        return replace(self, variances=variances, full=self.full.add_products(products))

    def calls_for_finest_field(
        self, data: RigViews, state: RigState, left_out: Sequence[str]
    ) -> bool:
        """Return whether a state calls for the finest image field beside these variances."""
        alive = self.variances.alive | (np.array(NAMES) == FINEST_FIELD)
        bare = self._linearize(data, state, self.linear.free, left_out, True, alive)
        return is_called_for(bare._all_free(), self.variances, NAMES.index(FINEST_FIELD))

    def _all_free(self) -> Equations:
        """Return the equations with what is in the model and the whole catalogue free."""
        generic = self.fixed.own + self.fixed.forms.generic
        return self.equations_of(np.concatenate([self.included_columns, generic]))

    def equations_of(self, chosen: Index) -> Equations:
        """Return the equations of all components with chosen columns as their whole border."""
        columns = self.fixed.border[..., :-1]
        return self.full.combine_columns(
            identifiable_basis(self.linear.frame_columns, columns, chosen)
        )

    @property
    def column_count(self) -> int:
        """How many of the fixed columns are in the model."""
        return self.fixed.own

    @property
    def included_columns(self) -> Index:
        """The fixed columns in the model."""
        return np.arange(self.fixed.own)

    @property
    def scale(self) -> Array:
        """The norms (X,) that the fixed columns were divided by."""
        return self.fixed.scale

    @property
    def freedom(self) -> int:
        """Numbers in the residual less all fixed coefficients."""
        return self.full.rows - self.full.group_rank - self.column_count

    @cached_property
    def equations(self) -> Equations:
        """The equations of the components that have a variance."""
        return self.full.select(self.variances.alive)

    @cached_property
    def active_effects(self) -> RandomEffects:
        """The random effects that have a variance."""
        return self.random.select(self.variances.alive)

    @cached_property
    def factorization(self) -> FactoredEquations:
        """The equations of the components that have a variance, factored."""
        return factor_equations(self.equations, self.variances.lam, self.variances.weight)

    @cached_property
    def information(self) -> Array:
        """Information (X + 1, X + 1) of the border, its last row and column the score."""
        return self.factorization.information / self.variances.sigma**2

    def leave_one_out(self, at: Index, likely: Index | None = None) -> LeaveOneOut:
        """Return each frame, seen from all the others, of some of the border (m,).

        likely: what else may be asked for; together they take little more than one alone.
        """
        for known, found in self._leave_one_out_cache:
            if np.isin(at, known).all():
                return found.select(np.searchsorted(known, at))
        columns = np.unique(at if likely is None else np.concatenate([at, likely]))
        self._leave_one_out_cache.append((columns, self._leave_one_out(columns)))
        return self.leave_one_out(at)

    @cached_property
    def _leave_one_out_cache(self) -> list[tuple[Index, LeaveOneOut]]:
        """What was asked for: columns of the border and the frames seen from all the others."""
        return []

    def _leave_one_out(self, at: Index) -> LeaveOneOut:
        return leave_groups_out(
            self.factorization.select_border(at),
            self.active_effects.columns,
            self.linear.frame_columns,
            self.fixed.border[..., at],
        )

    def information_without_frames(self, at: Index, likely: Index | None = None) -> Array:
        """Return the information (F, m, m) of all frames but one, of some of the border (m,).

        likely: see `leave_one_out`.
        """
        frames = self.leave_one_out(at, likely).information
        return self.information[at[:, None], at] - frames / self.variances.sigma**2

    def information_without_poses(self, at: Index) -> Array:
        """Return the information (C, m, m) of all but the frames of one pose (`cluster_frames`).

        As if what these tell did not depend on each other.
        """
        whole, cluster = self.information[at[:, None], at], cluster_frames(self.linear)
        lost = np.zeros((cluster.max() + 1, *whole.shape))
        np.add.at(lost, cluster, whole - self.information_without_frames(at))
        return np.asarray(whole - lost)

    @property
    def terms(self) -> list[ModelTerm]:
        """Each effect in the model, with its columns among what is shared."""
        terms = [term for term in self.linear.state.terms if is_shared(term.effect)]
        ends = np.cumsum([0, *(len(term.values) for term in terms)])
        columns = np.split(self.included_columns, self.column_count - ends[-1] + ends)[1:-1]
        return [replace(term, columns=at) for term, at in zip(terms, columns, strict=True)]

    @property
    def effect_kinds(self) -> set[str]:
        """Names of the effects in the model, for each camera of a rig that has one for itself."""
        return {kind for term in self.linear.state.terms for kind in term.effect.kinds}

    def form_columns(self, form: int) -> Index:
        """Return the border's columns of a form."""
        return self.fixed.forms.at[form] + self.column_count

    @property
    def look_alikes(self) -> list[tuple[Effect, Index]]:
        """Effects that are not tested, with their columns of the border."""
        return [(effect, at + self.column_count) for effect, at in self.fixed.forms.look_alikes]

    def prior_precision(self, columns: Index, effect: Effect) -> Array:
        """Return precisions (P,) of an effect's normalized columns: it is hardly beyond large."""
        large = np.array([parameter.large for parameter in effect.parameters])
        return np.asarray(1 / (large * self.scale[columns]) ** 2)

    def physical_precision(self, columns: Index, effect: Effect) -> Array:
        """Return precisions (P,) of an effect's normalized columns by its prior, 0 without one."""
        return np.asarray((effect.prior_sigma(self.linear.scene) * self.scale[columns]) ** -2.0)

    def columns_and_residual(self, columns: Index) -> Index:
        """Return what is in the model, further columns and, last, the residual of the border."""
        return np.unique(np.concatenate([self.included_columns, columns, [len(self.scale)]]))

    def residual_combination(self, included: Index) -> Array:
        """Return the combination (X + 1,) of the border that is the residual with only these.

        An effect whose columns are not among those included has its displacement in it.
        """
        combination = np.zeros(len(self.scale) + 1)
        combination[-1] = 1.0
        for term in self.terms:
            gone = ~np.isin(term.columns, included)
            displaced = term.values * self.scale[term.columns]
            combination[term.columns[gone]] = displaced[gone]
        return combination

    def restrict_information(
        self, information: Array, included: Index, at: Index | None = None
    ) -> Array:
        """Return information (..., m, m) as if only the included effects were fitted.

        at (m,): what it is of, the residual last; None for the whole border.
        """
        combination = self.residual_combination(included)
        combination = combination if at is None else combination[at]
        restricted = information.copy()
        restricted[..., -1] = information @ combination
        restricted[..., -1, :] = restricted[..., -1]
        restricted[..., -1, -1] = restricted[..., -1] @ combination
        return restricted

    def remaining_information(self, information: Array, included: Index) -> Array:
        """Return the information with what is included, and no more, fitted and eliminated."""
        return eliminate(self.restrict_information(information, included), included)

    @cached_property
    def field_alternatives(self) -> list[Alternative]:
        """This model, and the same with smooth image fields of several sizes."""
        kind = NAMES.index('image_broad')
        alternatives = [(self.factorization.log_determinant, self.factorization.information)]
        own = initial_variances(self.full, 1.0).lam[kind]
        if own >= LAMBDA_ABSENT:
            return alternatives
        alive = self.variances.alive | (np.arange(len(NAMES)) == kind)
        eq = self.full.select(alive).free_component(kind)
        f = factor_equations(eq, self.variances.lam, self.variances.weight)
        count = len(f.information) - len(self.scale) - 1
        fields = (
            integrate_columns(f, np.arange(count), own * self.full.rows / count / size)
            for size in _FIELD_SIZES
        )
        return alternatives + [(logs, part[count:, count:]) for logs, part in fields]

    @cached_property
    def walk_alternatives(self) -> list[Alternative]:
        """The same with smooth walks of the intrinsics of several sizes."""
        fixed = self.fixed
        return [
            integrate_columns(self.factorization, fixed.walks, fixed.roughness / size)
            for size in _WALK_SIZES
        ]

    @cached_property
    def frame_alternatives(self) -> tuple[FactoredEquations, FactoredEquations]:
        """The equations without random effects of frames, and with these estimated anew.

        Beside the whole catalogue its effects that change with time take a part of them.
        """
        lam = np.where(_OF_FRAMES, LAMBDA_ABSENT, self.variances.lam)
        eq = self.equations_of(self.included_columns)
        start = np.where(_OF_FRAMES, initial_variances(eq).lam, self.variances.lam)
        anew, _ = estimate_variances(eq, replace(self.variances, lam=start), _FRAME_STEPS)
        without, estimated = (
            factor_equations(self.full.select(now.alive), now.lam, now.weight)
            for now in (replace(self.variances, lam=lam), anew)
        )
        return without, estimated


def prior_products(linear: Linearization, state: RigState, scale: Array, sigma: float) -> Array:
    """Return what the priors of effects add to the products (X + 1, X + 1) of a border.

    A pseudo-observation each (`Effect.prior_sigma`), for values of a state; scale (X,): norms of
    the columns, which begin with those that are shared; sigma: of the whitened noise.
    Source: Theil and Goldberger, On pure and mixed statistical estimation in economics,
    International Economic Review 2 (1961).
    """
    terms = [term for term in state.terms if is_shared(term.effect)]
    values = np.concatenate([np.zeros(0), *(term.values for term in terms)])
    expected = np.concatenate(
        [np.zeros(0), *(term.effect.prior_sigma(linear.scene) for term in terms)]
    )
    at = linear.shared_columns.shape[-1] - len(values) + np.arange(len(values))
    rows = np.zeros((len(values), len(scale) + 1))
    rows[np.arange(len(values)), at] = 1 / scale[at]
    rows[:, -1] = -values
    rows *= (sigma / expected)[:, None]
    return np.asarray(rows.T @ rows)


def cluster_frames(linear: Linearization) -> Index:
    """Return the cluster (F,) of each frame: those in which the target is seen in one pose.

    What light, detector and board do to such frames they do to all alike: no independent
    witnesses.  Poses of a cluster differ by at most a tenth, of the distance or a radian; each
    frame has its own where there are fewer than three.
    Source: Efron and Tibshirani, An Introduction to the Bootstrap (1993), chapter 11; by clusters:
    Bell and McCaffrey, Survey Methodology 28 (2002).
    """
    pose, points = linear.state.pose, linear.data.views.points[linear.data.views.used]
    frames = np.arange(len(pose.position))
    if len(frames) < _MIN_CLUSTERS:
        return frames
    middle = pose.into_body(np.broadcast_to(points.mean(axis=0), (len(frames), 1, 3)))[:, 0]
    away = np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-300)
    turn = pose.rotation.reshape(-1, 9) / np.sqrt(2)  # so far apart as the angle, if small
    places = np.concatenate([middle / away, np.log(away), turn], axis=1)
    squares = (places**2).sum(axis=1)
    apart = squares[:, None] + squares - 2 * places @ places.T
    if np.sum(apart < _SIMILAR_POSE**2) == len(frames):  # each is near itself alone
        return frames
    hierarchy = scipy.cluster.hierarchy  # not loaded for most calibrations
    tree = hierarchy.linkage(places, 'complete')
    cluster = hierarchy.fcluster(tree, _SIMILAR_POSE, 'distance').astype(np.int64) - 1
    return frames if cluster.max() + 1 < _MIN_CLUSTERS else cluster


def border_of(linear: Linearization, columns: Array) -> Array:
    """Return columns (F, M, K) and, last, the residual."""
    return np.concatenate([columns, linear.residual[..., None]], axis=-1)


def column_norms(columns: Array) -> Array:
    """Return the norms (K,) of columns (F, M, K), 1 for those that are zero."""
    norms = np.sqrt((columns**2).sum(axis=(0, 1)))
    return np.where(norms > 0, norms, 1.0)
