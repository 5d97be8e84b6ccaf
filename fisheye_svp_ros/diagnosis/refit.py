"""Estimates under the null model: generalised least squares, and predicted local offsets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.sparse.linalg import eigsh

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.adjustment import moved
from fisheye_svp_ros.diagnosis.evidence import Evidence
from fisheye_svp_ros.diagnosis.gathered import MILLIMETRE
from fisheye_svp_ros.diagnosis.mixed import Equations, Factored, equations, factored
from fisheye_svp_ros.diagnosis.model import Data, Linearised, State
from fisheye_svp_ros.diagnosis.products import multiplied_by
from fisheye_svp_ros.diagnosis.random_effects import (
    NAMES,
    Design,
    Grid,
    bump_values,
    design,
)
from fisheye_svp_ros.diagnosis.reml import Variances
from fisheye_svp_ros.diagnosis.similar_views import SimilarViews
from fisheye_svp_ros.diagnosis.solution import Solution, posterior, solve
from fisheye_svp_ros.diagnosis.target_map import at_landmarks

_PARTS = (1.0, 0.3, 0.1, 0.03, 0.0)  # of a step
_WORSE = 1.5  # times the misfit: what is random may take up a rise, but no more
_ROUNDS = 4
_MODE, _MOST_MODES = 0.01, 12  # of all, what one way for landmarks to be off explains
_SETTLED = 3e-3  # of the noise: what a step moves predictions by


class Fitted(NamedTuple):
    """A state under a null model, with the equations around it and their solution."""

    state: State
    linear: Linearised
    design: Design
    factored: Factored
    solution: Solution
    scale: Array


class Local(NamedTuple):
    """Predicted local offsets: of landmarks (L, 3), m, of the image (grids, (K, 2) px), of views.

    views: what landmarks err by alike in similar views, where they do.
    """

    landmark: Index
    offset: Array
    grids: tuple[tuple[Grid, Array], ...]
    views: SimilarViews | None = None

    @property
    def of_image(self) -> Local:
        """What of them another target has, too."""
        return self._replace(offset=np.zeros_like(self.offset), views=None)

    def applied(self, data: Data) -> Data:
        """Return data with landmarks where they are predicted and the image field taken out.

        What hangs on the views takes poses, and stays.
        """
        views = data.views
        points = views.points + at_landmarks(views, self.landmark, self.offset)
        uv = views.uv.copy()
        for grid, values in self.grids:
            mine = views.used & (data.camera_of[:, None] == grid.camera)
            moved_by = bump_values(views.uv, mine, grid.centres, grid.pitch) @ values
            uv -= moved_by.reshape(uv.shape)
        return replace(data, views=views._replace(points=points, uv=uv))


def refit(data: Data, state: State, free: Sequence[str], variances: Variances) -> State:
    """Fit poses, rig, free intrinsics and effects by Gauss-Newton with the null's covariance.

    All steps are solved with the equations of the first: its columns change little.
    """
    fitted = fit_linear(Linearised(data, state, free), variances)
    linear, eq = fitted.linear, fitted.factored.equations
    e, r, values = fitted.solution.e, fitted.solution.r, fitted.solution.values
    most = _WORSE * float((linear.residual**2).sum())
    for turn in range(_ROUNDS):
        frame, _, _ = eq.sorted(e, r)
        change = frame[:, :6] / eq.pose_scale, values / fitted.scale
        moves = (linear.frame_columns @ change[0][..., None])[..., 0]
        moves += linear.shared_columns @ change[1]
        state, residual = in_sight(data, free, partial(_after, data, state, free, change), most)
        if turn == _ROUNDS - 1 or np.sqrt((moves**2).mean()) < _SETTLED * variances.sigma:
            break
        pose = linear.frame_columns / eq.pose_scale[:, None]
        e, r = eq.placed(*multiplied_by(fitted.design, pose, residual))
        x = np.einsum('fmk,fm->k', linear.shared_columns, residual) / fitted.scale
        parts = fitted.factored.solved(e[..., None], r[:, None], x[:, None])
        e, r, values = (part[..., 0] for part in parts)
    return state


def _after(
    data: Data, state: State, free: Sequence[str], change: tuple[Array, Array], part: float
) -> State:
    return moved(data, state, free, *(part * step for step in change))


def in_sight(
    data: Data, free: Sequence[str], after: Callable[[float], State], most: float = np.inf
) -> tuple[State, Array]:
    """Return the state after so much of a step that all points are still seen, and its residual.

    A step far beyond where the columns hold may take points out of sight, or lead away from them.
    after: makes a state of a part of the step, 1 for all of it; most: sum of squares allowed.
    """
    for part in _PARTS:
        state = after(part)
        residual = Linearised(data, state, free).residual
        squares = float((residual**2).sum())
        if np.isfinite(squares) and squares <= most:
            break
    return state, residual


def fit_linear(linear: Linearised, variances: Variances) -> Fitted:
    """Solve the mixed-model equations of one linearisation."""
    finest = bool(variances.alive[NAMES.index('image_finest')])
    random = design(linear, finest).kept(variances.alive)
    scale = np.sqrt((linear.shared_columns**2).sum(axis=(0, 1)))
    scale = np.where(scale > 0, scale, 1.0)
    border = np.concatenate(
        [linear.shared_columns / scale, linear.residual[..., None]], axis=-1
    )
    eq = equations(random, linear.frame_columns, border).trimmed(variances.alive)
    return _solved(linear, random, eq, variances, scale)


def fit_of(evidence: Evidence) -> Fitted:
    """Solve the mixed-model equations of evidence for what is in its model."""
    basis = np.eye(len(evidence.scale), evidence.own)
    random = evidence.random
    return _solved(evidence.linear, random, evidence.equations.bordered(basis),
                   evidence.variances, evidence.scale[: evidence.own])


def _solved(
    linear: Linearised, random: Design, eq: Equations, variances: Variances, scale: Array
) -> Fitted:
    # What the data leave open stays where it is.
    ridge = np.append(np.full(len(scale), 1e-9), 0.0)
    eq = replace(eq, blocks=eq.blocks._replace(xx=eq.blocks.xx + np.diag(ridge)))
    f = factored(eq, variances.lam, variances.weight)
    return Fitted(linear.state, linear, random, f, solve(f), scale)


def local_offsets(fitted: Fitted) -> Local:
    """Return what the random parts of target and lens are predicted to be."""
    eq, random = fitted.factored.equations, fitted.design
    e, r = fitted.solution.e[..., None], fitted.solution.r[:, None]
    in_target = np.einsum('la,lab->lb', _offsets(fitted, e, r)[..., 0], random.axes) * MILLIMETRE
    shared, grids = eq.sorted(e, r)[2][:, 0], []
    for grid in random.grids:
        values, shared = np.split(shared, [2 * len(grid.centres)])
        grids.append((grid, values.reshape(-1, 2)))
    return Local(random.landmark, in_target, tuple(grids))


def target_modes(fitted: Fitted, sigma: float) -> tuple[Array, Array]:
    """Return how far the landmarks may be off: modes (L, 3, K) and alone (L, 3), m.

    Along the axes of their boards; the mean square about zero, given the data, of predicted
    offsets: of a sum of the modes, each with a factor of variance 1, and of what each landmark has
    alone.  sigma: of the whitened noise.
    """
    known, eq = posterior(fitted.factored), fitted.factored.equations
    shape, count = fitted.solution.e.shape, fitted.solution.e.size
    mean = _offsets(fitted, fitted.solution.e[..., None], fitted.solution.r[:, None])
    width = known.root.shape[1]
    root = _offsets(fitted, known.root[:count].reshape(*shape, width), known.root[count:])
    root = np.concatenate([sigma * root, mean], axis=-1).reshape(mean.size, width + 1)
    square = root @ root.T
    if not eq.by_frame:  # what a landmark's own block leaves open
        there = (fitted.design.landmark_label >= 0)[eq.landmarks]
        own = 3 * eq.landmarks[:, None] + np.arange(3)
        square[own[:, :, None], own[:, None]] += np.where(
            there[:, :, None] & there[:, None], sigma**2 * known.block, 0.0)
    count = len(square)
    if not square.any():
        return np.zeros((count // 3, 3, 0)), np.zeros((count // 3, 3))
    start = np.random.default_rng(0).standard_normal(count)  # the same modes every time
    values, vectors = eigsh(square, min(_MOST_MODES, count - 1), v0=start)
    kept = values > _MODE * np.trace(square)
    modes = vectors[:, kept] * np.sqrt(values[kept])
    alone = np.sqrt(np.maximum(np.diag(square) - (modes**2).sum(axis=1), 0.0))
    return (MILLIMETRE * modes.reshape(count // 3, 3, -1), MILLIMETRE * alone.reshape(-1, 3))


def _offsets(fitted: Fitted, e: Array, r: Array) -> Array:
    """Return what coefficients (E, k, C), (R, C) displace each landmark by: (L, 3, C)."""
    eq, random = fitted.factored.equations, fitted.design
    _, landmark, shared = eq.sorted(e, r)
    offset = np.zeros((len(random.landmark), 3, r.shape[-1]))
    if len(eq.landmarks):
        there = random.landmark_label[eq.landmarks] >= 0
        offset[eq.landmarks] = np.where(there[..., None], landmark, 0.0)
    at = sum(2 * len(grid.centres) for grid in random.grids)
    for field in random.fields:
        for axis in field.axes:
            count = field.values.shape[1]
            offset[:, axis] += field.values @ shared[at : at + count]
            at += count
    return offset
