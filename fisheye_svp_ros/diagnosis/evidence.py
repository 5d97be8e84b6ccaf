"""What every effect explains beside the random parts of the null model: generalised score tests.

One factorisation serves all: poses and random parts are eliminated, what is left is a small
information matrix of everything fixed, the forms of the catalogue among it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import special

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.diagnosis.candidates import Forms, forms_of
from fisheye_svp_ros.diagnosis.components import called, find_variances
from fisheye_svp_ros.diagnosis.fields import intrinsic_paths, mean_fields
from fisheye_svp_ros.diagnosis.left_out import LeftOut, left_out_in_turn
from fisheye_svp_ros.diagnosis.mixed import Equations, Factored, equations, factored
from fisheye_svp_ros.diagnosis.model import Data, Linearised, State, flat_rows
from fisheye_svp_ros.diagnosis.random_effects import NAMES, STAGE_OF, Design, design
from fisheye_svp_ros.diagnosis.reml import (
    GONE,
    Variances,
    estimate,
    nothing_random,
    start_variances,
)
from fisheye_svp_ros.effects.base import Effect
from fisheye_svp_ros.effects.catalogue import CATALOGUE

_OF_FRAMES = np.array([stage == 'frame' for stage in STAGE_OF.values()])  # components
_FIELDS = (0.5, 2.0, 8.0, 32.0)  # what a bump adds to the variance where it is, over noise
_PATHS = tuple(8.0 * 4.0**i for i in range(12))  # of the slowest wave of a path
_ANEW = 6  # steps: the likelihood is flat around the best variances
IDENTIFIABLE = 1e-8  # of a normalised column's square: what is left less cannot be told apart

Placed = tuple[Effect, Index, Array]  # an effect, its columns among what is shared, its values


class Score(NamedTuple):
    """A score test: statistic, rank, p-value, estimate (P,), degrees of freedom of its scale."""

    statistic: float
    rank: int
    p_value: float
    estimate: Array
    freedom: float


@dataclass(frozen=True)
class Evidence:
    """A linearised state with its null model and everything that could be added to it.

    scale (X,): norms that the border's columns were divided by: what is in the model (the first
    `own` of them), then the forms, then probes and paths (`fields`); full: equations of all of
    them and all components.
    """

    linear: Linearised
    forms: Forms
    design: Design
    full: Equations
    variances: Variances
    own: int
    scale: Array
    border: Array
    probes: dict[str, Index]
    paths: Index
    roughness: Array

    def around(
        self, data: Data, state: State, free: Sequence[str], left_out: Sequence[str], finest: bool
    ) -> Evidence:
        """Return the evidence around another state of the same data, the variances as they are."""
        bare = _multiplied(data, state, free, left_out, finest)
        return replace(bare, variances=self.variances)

    @cached_property
    def equations(self) -> Equations:
        """The equations of the components that are there."""
        return self.full.trimmed(self.variances.alive)

    @cached_property
    def random(self) -> Design:
        """The design of the components that are there."""
        return self.design.kept(self.variances.alive)

    @cached_property
    def factored(self) -> Factored:
        """The equations of the components that are there, factored."""
        return factored(self.equations, self.variances.lam, self.variances.weight)

    @cached_property
    def information(self) -> Array:
        """Information (X + 1, X + 1) of the border, its last row and column the gradient."""
        return self.factored.information / self.variances.sigma**2

    @cached_property
    def left_out(self) -> LeftOut:
        """Each frame seen from all the others."""
        return left_out_in_turn(self.factored, self.random, self.linear.frame_columns, self.border)

    def in_turn(self, at: Index) -> Array:
        """Return the information (F, m, m) of all frames but one, of some of the border (m,)."""
        frames = self.left_out.information[:, at[:, None], at]
        return self.information[at[:, None], at] - frames / self.variances.sigma**2

    @cached_property
    def untestable(self) -> dict[str, str]:
        """Effects that the data cannot test, and why."""
        remaining = swept(self.information, np.arange(self.own))
        ranks: dict[str, int] = {}
        for form, effect in enumerate(self.forms.effects):
            rank = self.score(remaining, self.columns_of(form)).rank
            ranks[effect.name] = max(rank, ranks.get(effect.name, 0))
        taken = 'what it would do is taken up by what is free already'
        return self.forms.untestable | {name: taken for name, rank in ranks.items() if not rank}

    @property
    def terms(self) -> list[Placed]:
        """Each effect in the model, its columns among what is shared, and its values."""
        terms = [t for t in self.linear.state.terms if t[0].stage != 'noise']
        start = self.own - sum(len(values) for _, values in terms)
        placed = []
        for effect, values in terms:
            placed.append((effect, np.arange(start, start + len(values)), values))
            start += len(values)
        return placed

    @property
    def kinds(self) -> set[str]:
        """Names of the effects in the model, for each camera of a rig that has one for itself."""
        return {kind for effect, _ in self.linear.state.terms for kind in effect.kinds}

    def with_residual(self, columns: Index) -> Index:
        """Return what is in the model, further columns and, last, the residual of the border."""
        return np.unique(np.concatenate([np.arange(self.own), columns, [len(self.scale)]]))

    def restored(self, information: Array, kept: Index, at: Index | None = None) -> Array:
        """Return information (..., m, m) as if only these of the effects were fitted.

        at (m,): what it is of, the residual last; None for the whole border.
        """
        way = self.residual_with(kept) if at is None else self.residual_with(kept)[at]
        found = information.copy()
        found[..., -1] = information @ way
        found[..., -1, :] = found[..., -1]
        found[..., -1, -1] = found[..., -1] @ way
        return found

    def residual_with(self, kept: Index) -> Array:
        """Return the combination (X + 1,) of the border that is the residual with only these."""
        way = np.zeros(self.border.shape[-1])
        way[-1] = 1.0
        for _, columns, values in self.terms:
            gone = ~np.isin(columns, kept)
            way[columns[gone]] = (values * self.scale[columns])[gone]
        return way

    def remaining(self, information: Array, included: Index) -> Array:
        """Return what is left of information once what is included, and no more, is swept out."""
        return swept(self.restored(information, included), included)

    def ordinary(self, landmarks: Sequence[int]) -> Variances:
        """Return the variances with the offsets of some landmarks drawn as those of most are."""
        now = self.variances
        own = np.isin(self.design.landmark, landmarks)
        return replace(now, weight=np.where(own, 1.0, now.weight))

    def columns_of(self, form: int) -> Index:
        """Return the border's columns of a form."""
        return self.forms.at[form] + self.own

    def wide_prior(self, columns: Index, effect: Effect) -> Array:
        """Return precisions (P,) of an effect's normalised columns: it is hardly beyond large."""
        large = np.array([parameter.large for parameter in effect.parameters])
        return np.asarray(1 / (large * self.scale[columns]) ** 2)

    def score(self, remaining: Array, columns: Index) -> Score:
        """Test columns by the information that remains once what is in the model is swept out."""
        block, gradient = remaining[np.ix_(columns, columns)], remaining[columns, -1]
        # A normalised column alone has information 1 / sigma^2.
        inverse, rank = pseudo_inverse(
            block, least=IDENTIFIABLE / self.variances.sigma**2
        )
        estimate = inverse @ gradient
        statistic = float(estimate @ gradient)
        p = float(special.chdtrc(rank, max(statistic, 0.0))) if rank else 1.0
        return Score(statistic, rank, p, estimate / self.scale[columns], np.inf)

    @cached_property
    def with_field(self) -> list[tuple[float, Array]]:
        """Log determinant and information of the border, for image fields of several sizes."""
        kind = NAMES.index('image_broad')
        found = [(self.factored.log_determinant, self.factored.information)]
        own = start_variances(self.full, 1.0).lam[kind]
        if own >= GONE:
            return found
        with_it = self.variances.alive | (np.arange(len(NAMES)) == kind)
        eq = self.full.trimmed(with_it).at_the_border(kind)
        f = factored(eq, self.variances.lam, self.variances.weight)
        count = len(f.information) - len(self.border[0, 0])
        for more in _FIELDS:
            prior = own * self.full.rows / count / more
            logs, information = integrated(f, np.arange(count), prior)
            found.append((logs, information[count:, count:]))
        return found

    @cached_property
    def with_paths(self) -> list[tuple[float, Array]]:
        """Log determinant and information of the border, for smooth paths of several sizes."""
        return [integrated(self.factored, self.paths, self.roughness / size) for size in _PATHS]

    @cached_property
    def without_frames(self) -> Factored:
        """The equations without what single frames have of their own, factored."""
        return self._factored_by(
            replace(self.variances, lam=np.where(_OF_FRAMES, GONE, self.variances.lam)))

    @cached_property
    def frames_anew(self) -> Factored:
        """The equations with all that single frames have of their own found anew, factored.

        Beside the whole catalogue its effects that change with time take a part of that.
        """
        eq = self.beside(np.arange(self.own))
        start = np.where(_OF_FRAMES, start_variances(eq).lam, self.variances.lam)
        found, _ = estimate(eq, replace(self.variances, lam=start), _ANEW)
        return self._factored_by(found)

    def _factored_by(self, variances: Variances) -> Factored:
        return factored(self.full.trimmed(variances.alive), variances.lam, variances.weight)

    def beside(self, chosen: Index) -> Equations:
        """Return the equations of all components with chosen columns as their whole border."""
        columns = self.border[..., :-1]
        return self.full.bordered(identifiable(self.linear.frame_columns, columns, chosen))


def gather_evidence(
    data: Data, state: State, free: Sequence[str], before: Variances | None = None,
    left_out: Sequence[str] = (), finest: bool = False,
) -> Evidence:
    """Linearise a state, find the variances of its null model, multiply out all forms.

    before: variances to start from; left_out: effects; finest: with the finest image field.
    """
    bare = _multiplied(data, state, free, left_out, finest)
    return replace(bare, variances=find_variances(_all_free(bare), before))


def finest_called(
    data: Data, state: State, free: Sequence[str], variances: Variances, left_out: Sequence[str]
) -> bool:
    """Return whether the data call for the finest image field beside all that has a variance."""
    name = 'image_finest'
    there = variances.alive | (np.array(NAMES) == name)
    bare = _multiplied(data, state, free, left_out, True, there)
    return called(_all_free(bare), variances, name)


def _all_free(bare: Evidence) -> Equations:
    """Return the equations with what is in the model and the whole catalogue free."""
    chosen = np.concatenate([np.arange(bare.own), bare.own + bare.forms.generic])
    return bare.beside(chosen)


def bare_evidence(
    data: Data, state: State, free: Sequence[str], variances: Variances | None = None
) -> Evidence:
    """Return the evidence around a state with nothing to be added.

    variances: of the null model; None for nothing random.
    """
    finest = variances is not None and bool(variances.alive[NAMES.index('image_finest')])
    there = variances or nothing_random(len(np.unique(data.views.landmark[data.views.used])))
    bare = _multiplied(data, state, free, tuple(CATALOGUE), finest, there.alive)
    return replace(bare, variances=there)


def _multiplied(
    data: Data, state: State, free: Sequence[str], left_out: Sequence[str], finest: bool,
    alive: Mask | None = None,
) -> Evidence:
    """Return the evidence around a state before any variance is known.

    alive: the components that there are; None for all.
    """
    linear = Linearised(data, state, free)
    forms = forms_of(linear, left_out)
    fields, (paths, roughness) = mean_fields(linear), intrinsic_paths(linear)
    columns = np.concatenate(
        [linear.shared_columns, forms.columns, *fields.values(), paths], axis=-1)
    scale = np.sqrt((columns**2).sum(axis=(0, 1)))
    scale = np.where(scale > 0, scale, 1.0)
    border = np.concatenate([columns / scale, linear.residual[..., None]], axis=-1)
    random = design(linear, finest)
    if alive is not None:
        random = random.kept(alive)
    full = equations(random, linear.frame_columns, border)
    own = linear.shared_columns.shape[-1]
    probes, at = {}, own + forms.columns.shape[-1]
    for name, field in fields.items():
        probes[name] = np.arange(at, at + field.shape[-1])
        at += field.shape[-1]
    nothing, paths_at = start_variances(full), np.arange(at, at + paths.shape[-1])
    return Evidence(
        linear, forms, random, full, nothing, own, scale, border, probes, paths_at, roughness)


def integrated(f: Factored, columns: Index, prior: float | Array) -> tuple[float, Array]:
    """Return log determinant and information with columns of the border random; prior: lambda."""
    priors = np.broadcast_to(prior, columns.shape)
    inner = f.information[np.ix_(columns, columns)] + np.diag(priors)
    across = f.information[columns]
    logs = f.log_determinant + np.linalg.slogdet(inner)[1] - np.log(priors).sum()
    return float(logs), f.information - across.T @ np.linalg.solve(inner, across)


def identifiable(pose: Array, columns: Array, chosen: Index) -> Array:
    """Return combinations (K, m) of chosen columns (F, M, K), orthonormal once poses are out."""
    part = columns[..., chosen]
    q = block_basis(pose)
    clean = part - q @ (np.swapaxes(q, -1, -2) @ part)
    flat = flat_rows(clean)
    values, vectors = np.linalg.eigh(flat.T @ flat)
    kept = values > IDENTIFIABLE
    basis = np.zeros((columns.shape[-1], int(kept.sum())))
    basis[chosen] = vectors[:, kept] / np.sqrt(values[kept])
    return basis


def pseudo_inverse(
    matrix: Array, floor: float = IDENTIFIABLE, least: float = 1e-300
) -> tuple[Array, int]:
    """Return the pseudoinverse of a symmetric matrix and its rank.

    floor: of its largest eigenvalue, and least: below which an eigenvalue is taken as nothing.
    """
    if not len(matrix):
        return matrix, 0
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    kept = values > max(floor * float(values[-1]), least)
    return (vectors[:, kept] / values[kept]) @ vectors[:, kept].T, int(kept.sum())


def swept(information: Array, included: Index) -> Array:
    """Return the information with what is included swept out."""
    inverse, _ = pseudo_inverse(information[np.ix_(included, included)])
    return np.asarray(information - information[:, included] @ inverse @ information[included])


def block_basis(columns: Array) -> Array:
    """Orthonormal bases (B, M, 6) of each block's columns; zero columns where rank is missing."""
    scale = np.sqrt((columns**2).sum(axis=1, keepdims=True))
    u, s, _ = np.linalg.svd(columns / np.maximum(scale, 1e-300), full_matrices=False)
    return np.asarray(u * (s > 1e-9)[:, None, :])
