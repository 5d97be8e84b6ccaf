"""The model fitted under its null model: generalized least squares, residuals, predicted offsets.

Fifth stage of a diagnosis: what random effects are predicted to be, and what is left beside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.effect_forms import bump_values
from fisheye_svp_ros.diagnosis.null_model import (
    FINEST_FIELD,
    NullModel,
    border_of,
    column_norms,
    prior_products,
)
from fisheye_svp_ros.diagnosis.random_effects import (
    BEND,
    MILLIMETRE,
    MOTION,
    NAMES,
    SAG,
    ImageGrid,
    RandomEffects,
    board_bends,
    make_random_effects,
)
from fisheye_svp_ros.diagnosis.similar_views import SimilarViews
from fisheye_svp_ros.effects.target_map import KnownTarget, at_landmarks
from fisheye_svp_ros.mixed_model import (
    Equations,
    FactoredEquations,
    Solution,
    Variances,
    combine_offsets,
    factor_equations,
    make_equations,
    multiply_rows,
    posterior_covariance,
    predict_rows,
    solve_equations,
)
from fisheye_svp_ros.solve.bundle_adjustment import gauss_newton
from fisheye_svp_ros.solve.rig_state import Linearization, RigState, RigViews

_STEP_TOLERANCE = 3e-3  # of the noise: what a step moves predictions by
_LINEARIZATIONS = 2
_MIN_MODE, _MAX_MODES = 0.01, 12  # of all, what one way for landmarks to be off explains
_PROBES = 24
_PAIR_REACH = 80  # of the image: how near to each other points have the same place
MIN_PAIRS = 100


class PredictedOffsets(NamedTuple):
    """Predicted random effects of landmarks (L, 3), m, of the image (grids, (K, 2) px), of views.

    views: what landmarks err by alike in similar views, where they do.
    """

    landmark: Index
    offset: Array
    grids: tuple[tuple[ImageGrid, Array], ...]
    views: SimilarViews | None = None

    @property
    def of_image(self) -> PredictedOffsets:
        """What of them is valid for another target, too."""
        return self._replace(offset=np.zeros_like(self.offset), views=None)

    def apply(self, data: RigViews) -> RigViews:
        """Return data with landmarks where they are predicted and the image field taken out.

        What depends on the views takes poses, and stays.
        """
        views = data.views
        points = views.points + at_landmarks(views, self.landmark, self.offset)
        uv = views.uv.copy()
        for grid, values in self.grids:
            mine = views.used & (data.camera_of[:, None] == grid.camera)
            shift = bump_values(views.uv, mine, grid.centers, grid.pitch) @ values
            uv -= shift.reshape(uv.shape)
        return replace(data, views=views._replace(points=points, uv=uv))


@dataclass(frozen=True)
class FittedModel:
    """A linearized state under a null model, with its equations and their solution.

    scale (K,): norms that the fixed columns of the model were divided by.
    """

    linear: Linearization
    random: RandomEffects
    factored: FactoredEquations
    solution: Solution
    scale: Array

    @classmethod
    def solve_null_model(cls, null: NullModel) -> FittedModel:
        """Solve the mixed-model equations of a null model for what is in the model."""
        eq = null.equations.combine_columns(np.eye(len(null.scale), null.column_count))
        return cls._solve(
            null.linear, null.active_effects, eq, null.variances, null.scale[: null.column_count]
        )

    @classmethod
    def of_state(cls, linear: Linearization, variances: Variances) -> FittedModel:
        """Solve the mixed-model equations of one linearization, with given variances."""
        finest = bool(variances.alive[NAMES.index(FINEST_FIELD)])
        random = make_random_effects(linear, finest).select(variances.alive)
        scale = column_norms(linear.shared_columns)
        border = border_of(linear, linear.shared_columns / scale)
        eq = make_equations(random.columns, linear.frame_columns, border).select(variances.alive)
        eq = eq.add_products(prior_products(linear, linear.state, scale, variances.sigma))
        return cls._solve(linear, random, eq, variances, scale)

    @classmethod
    def _solve(
        cls,
        linear: Linearization,
        random: RandomEffects,
        eq: Equations,
        variances: Variances,
        scale: Array,
    ) -> FittedModel:
        # What the data leave open stays where it is.
        f = factor_equations(eq.with_ridge(1e-9), variances.lam, variances.weight)
        return cls(linear, random, f, solve_equations(f), scale)

    @property
    def state(self) -> RigState:
        """The state around which the model is linear."""
        return self.linear.state

    @property
    def pose_columns(self) -> Array:
        """Columns (F, M, 6) of the frames' poses, as the equations have them."""
        return self.linear.frame_columns / self.factored.equations.group_scale[:, None]

    def predict_rows(self, e: Array, r: Array, values: Array) -> Array:
        """Return what coefficients (E, k, C), (R, C) and fixed values (K, C) add to the rows."""
        eq = self.factored.equations
        rows = predict_rows(self.random.columns, self.pose_columns, *eq.split(e, r), eq.units)
        return np.asarray(rows + self.linear.shared_columns @ (values / self.scale[:, None]))

    def solve_rows(self, rows: Array, pull: Array | float = 0.0) -> tuple[Array, Array, Array]:
        """Return the coefficients (E, k, C), (R, C), (K, C) that rows (F, M, C) call for.

        pull (K, C): products of pseudo-observations with the normalized shared columns.
        """
        e, r = self.factored.equations.join(
            *multiply_rows(self.random.columns, self.pose_columns, rows)
        )
        x = np.einsum('fmk,fmc->kc', self.linear.shared_columns, rows, optimize=True)
        return self.factored.solve(e, r, x / self.scale[:, None] + pull)

    def residuals(self, of_frames: bool = False) -> Array:
        """Return whitened residuals (F, M), every random effect at its prediction.

        of_frames: those of single frames alone; what landmarks and the image have stays in.
        """
        e, r = self.solution.e[..., None], self.solution.r[:, None]
        eq = self.factored.equations
        if of_frames:
            group, _, shared = eq.split(e, r)
            e, r = eq.join(group, np.zeros((*self.random.axes.shape[:2], 1)), 0 * shared)
        rows = self.predict_rows(e, r, self.solution.values[:, None])[..., 0]
        return np.asarray((self.linear.residual - rows) * self.linear.row_mask)

    def leverages(self) -> Array:
        """Return the diagonal (F, M) of the hat matrix, from random signs.

        Source: Hutchinson, A stochastic estimator of the trace of the influence matrix,
        Communications in Statistics 19 (1990).
        """
        shape, used = self.linear.residual.shape, self.linear.row_mask
        signs = np.random.default_rng(0).choice([-1.0, 1.0], (*shape, _PROBES)) * used[..., None]
        hat = self.predict_rows(*self.solve_rows(signs))
        return np.asarray(np.clip((signs * hat).mean(axis=-1), 0.0, 0.8))

    @cached_property
    def standardized_residuals(self) -> Array:
        """Residuals (F, M) over their standard deviations."""
        return np.asarray(
            self.residuals() / np.sqrt((1 - self.leverages()) * self.solution.variance)
        )

    def standardized_squares(self) -> Array:
        """Return squared residuals (F, M) over their expected squares: each about 1 on average."""
        return np.asarray(self.standardized_residuals**2)

    def point_pairs(self) -> tuple[Index, Index]:
        """Return pairs of points (P, 2) of different frames on the same place, and frames (N,).

        The closest come first.  Points have numbers among the used ones of (F, M / 2).
        """
        linear = self.linear
        uv = linear.data.blocks(np.nan_to_num(linear.linear.uv)[..., None, :])
        used = linear.row_mask[:, ::2]
        frame = np.nonzero(used)[0]
        at = uv[used]
        reach = float(np.ptp(at, axis=0).max()) / _PAIR_REACH
        pairs = scipy.spatial.cKDTree(at).query_pairs(reach, output_type='ndarray')
        pairs = pairs[frame[pairs[:, 0]] != frame[pairs[:, 1]]]
        apart = np.linalg.norm(at[pairs[:, 0]] - at[pairs[:, 1]], axis=1)
        return pairs[np.argsort(apart, kind='stable')], frame

    def place_correlation(self) -> float:
        """Return how alike points of different frames err on the same place, in standard errors.

        Residuals with everything predicted that are finer than the image fields have room for.
        """
        pairs, _ = self.point_pairs()
        if len(pairs) < MIN_PAIRS:
            return 0.0
        errors = self.residuals()[self.linear.row_mask].reshape(-1, 2)
        products = (errors[pairs[:, 0]] * errors[pairs[:, 1]]).sum(axis=1)
        typical = np.clip(products, *np.quantile(products, (0.005, 0.995)))
        return float(typical.mean() / max(typical.std(), 1e-300) * np.sqrt(len(pairs)))

    def predicted_offsets(self) -> PredictedOffsets:
        """Return what the random effects of target and lens are predicted to be."""
        eq, random = self.factored.equations, self.random
        e, r = self.solution.e[..., None], self.solution.r[:, None]
        offset = self._landmark_offsets(e, r)[..., 0]
        in_target = np.einsum('la,lab->lb', offset, random.axes) * MILLIMETRE
        shared, grids = eq.split(self.solution.e, self.solution.r)[2], []
        for grid in random.grids:
            values, shared = np.split(shared, [2 * len(grid.centers)])
            grids.append((grid, values.reshape(-1, 2)))
        return PredictedOffsets(random.landmark, in_target, tuple(grids))

    def board_sags(self) -> Array:
        """Return how far boards bend as their normals turn, by gravity (boards, 3, 3), mm.

        x^2, xy and y^2 over the size of a board, by each component of its normal.
        """
        shared = self.factored.equations.split(self.solution.e, self.solution.r)[2]
        sag = self.random.columns.shared_label == NAMES.index(SAG)
        return np.asarray(shared[sag].reshape(-1, 3, 3))

    def frame_coefficients(self, *names: str) -> Array:
        """Return what frames are predicted to have of their own (F, B), by some components."""
        group = self.factored.equations.split(self.solution.e, self.solution.r)[0]
        label = self.random.columns.group_label  # after the columns of the pose
        own = group[:, group.shape[1] - len(label) :]
        return np.asarray(own[:, np.isin(label, [NAMES.index(name) for name in names])])

    def frame_bends(self) -> Array:
        """Return by how much landmarks leave their boards in each frame (F, L), mm."""
        target = KnownTarget.from_views(self.linear.data.views)
        return board_bends(target, self.frame_coefficients(BEND))

    def turn_while_read(self) -> float:
        """Return the rms angle, rad, by which frames turn while their points are read.

        From the first to the last row of the larger extent of the points.
        """
        turns = self.frame_coefficients(MOTION)[:, 3:]
        return float(2 * np.sqrt((turns**2).sum(axis=1).mean()))

    def target_modes(self, sigma: float) -> tuple[Array, Array]:
        """Return how far the landmarks may be off: modes (L, 3, K) and alone (L, 3), m.

        Along the axes of their boards; the mean square about zero, given the data, of predicted
        offsets: of a sum of the modes, each with a factor of variance 1, and of what each landmark
        has alone.  A motion of the whole target is none of them: it is in the poses.
        sigma: of the whitened noise.
        """
        square = _without_motion(self._offset_squares(sigma), self._target_motions())
        count = len(square)
        if not square.any():
            return np.zeros((count // 3, 3, 0)), np.zeros((count // 3, 3))
        eigsh = scipy.sparse.linalg.eigsh  # not loaded for a calibration
        start = np.random.default_rng(0).standard_normal(count)  # the same modes every time
        values, vectors = eigsh(square, min(_MAX_MODES, count - 1), v0=start)
        kept = values > _MIN_MODE * np.trace(square)
        modes = vectors[:, kept] * np.sqrt(values[kept])
        alone = np.sqrt(np.maximum(np.diag(square) - (modes**2).sum(axis=1), 0.0))
        return (MILLIMETRE * modes.reshape(count // 3, 3, -1), MILLIMETRE * alone.reshape(-1, 3))

    def _offset_squares(self, sigma: float) -> Array:
        """Return the mean squares (3 L, 3 L) of landmarks' offsets about zero, mm^2."""
        posterior, eq = posterior_covariance(self.factored), self.factored.equations
        shape, count = self.solution.e.shape, self.solution.e.size
        mean = self._landmark_offsets(self.solution.e[..., None], self.solution.r[:, None])
        width = posterior.root.shape[1]
        root = self._landmark_offsets(
            posterior.root[:count].reshape(*shape, width), posterior.root[count:]
        )
        root = np.concatenate([sigma * root, mean], axis=-1).reshape(mean.size, width + 1)
        square = root @ root.T
        if not eq.by_group:  # what a landmark's own block leaves open
            present = (self.random.columns.unit_label >= 0)[eq.units]
            own = 3 * eq.units[:, None] + np.arange(3)
            square[own[:, :, None], own[:, None]] += np.where(
                present[:, :, None] & present[:, None], sigma**2 * posterior.block, 0.0
            )
        return np.asarray(square)

    def _target_motions(self) -> Array:
        """Return the rigid motions (3 L, 6) of the target, along the axes of its boards."""
        views, random = self.linear.data.views, self.random
        _, first = np.unique(views.landmark[views.used], return_index=True)
        arm = views.points[views.used][first]
        arm = arm - arm.mean(axis=0)
        turns = np.cross(np.eye(3), arm[:, None])  # (L, 3 turns, 3)
        moves = np.concatenate([np.broadcast_to(np.eye(3), turns.shape), turns], axis=1)
        return np.asarray((random.axes @ moves.swapaxes(1, 2)).reshape(-1, 6))

    def _landmark_offsets(self, e: Array, r: Array) -> Array:
        """Return what coefficients (E, k, C), (R, C) displace each landmark by: (L, 3, C)."""
        eq = self.factored.equations
        _, landmark, shared = eq.split(e, r)
        return combine_offsets(self.random.columns, landmark, shared, eq.units)


def _without_motion(square: Array, motions: Array) -> Array:
    """Return mean squares (M, M) in the datum that has none of some motions (M, k).

    Source: Baarda, S-transformations and criterion matrices (1973): inner constraints.
    """
    values, vectors = np.linalg.eigh(motions.T @ motions)
    kept = values > 1e-9 * values[-1]  # points on a line turn about it in vain
    basis = motions @ vectors[:, kept] / np.sqrt(values[kept])
    across = basis.T @ square
    cross = basis @ across
    return np.asarray(square - cross - cross.T + basis @ (across @ basis) @ basis.T)


def refit(data: RigViews, state: RigState, free: Sequence[str], variances: Variances) -> RigState:
    """Fit poses, rig, free intrinsics and effects by Gauss-Newton with the null's covariance.

    All steps are solved with the equations of the first: its columns change little, or are made
    anew where these steps do not converge, as beside boards that bend much.
    """
    for _ in range(_LINEARIZATIONS):
        state, converged = _gauss_newton(data, state, free, variances)
        if converged:
            break
    return state


def _gauss_newton(
    data: RigViews, state: RigState, free: Sequence[str], variances: Variances
) -> tuple[RigState, bool]:
    linear = Linearization(data, state, free)
    linear.check_images()
    fitted = FittedModel.of_state(linear, variances)
    eq = fitted.factored.equations

    def solve(residual: Array, state: RigState) -> tuple[Array, Array]:
        pull = prior_products(fitted.linear, state, fitted.scale, variances.sigma)[:-1, -1:]
        e, r, values = (part[..., 0] for part in fitted.solve_rows(residual[..., None], pull))
        return eq.split(e, r)[0][:, :6] / eq.group_scale, values / fitted.scale

    return gauss_newton(fitted.linear, solve, _STEP_TOLERANCE * variances.sigma)
