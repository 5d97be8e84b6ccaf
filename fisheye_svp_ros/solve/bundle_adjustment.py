"""Bundle adjustment: poses, rig, intrinsics and effects together, by least squares.

Any of them may have a Gaussian prior, or be held.  The frames are the blocks of one arrow
(`solve.least_squares`), so that the time grows as their number does.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, identity, log_derivative
from fisheye_svp_ros.scene.observations import Views
from fisheye_svp_ros.solve.least_squares import (
    UNDETERMINED_EIGENVALUE,
    Arrays,
    ArrowEquations,
    Minimum,
    arrow_covariance,
    arrow_information,
    arrow_step,
    levenberg_marquardt,
)
from fisheye_svp_ros.solve.rig_state import Linearization, RigState, RigViews, is_shared

MAX_LENS_ITERATIONS = 200
_STEP_FRACTIONS = (1.0, 0.3, 0.1, 0.03, 0.0)
# Of the sum of squares in a Gauss-Newton step: random effects may take up as much, and more where
# the columns say so and predictions move as they say, but for this share of the squares: boards
# that bend by a hundredth of their width take up three times as much.
_MAX_RISE, _LINEAR_SHARE = 1.5, 3e-3
_GAUSS_NEWTON_STEPS = 4


class PosePrior(NamedTuple):
    """What is known before of poses (P,): mean, root (P, R, 6).

    root: times the change from the mean (`Pose.difference`) it is of unit covariance.
    """

    mean: Pose
    root: Array


class Prior(NamedTuple):
    """What is known before of a state: a Gaussian of any of its parts.

    mean (K,), root (R, K): of the last K of free intrinsics and effect values, root times what is
    off the mean being of unit covariance; pose: of the frames (F,); rig: of the cameras (C - 1,)
    in the first.
    """

    mean: Array | None = None
    root: Array | None = None
    pose: PosePrior | None = None
    rig: PosePrior | None = None


def adjust(
    data: RigViews,
    state: RigState,
    free: Sequence[str],
    prior: Prior | None = None,
    held: Collection[str] | None = (),
) -> RigState:
    """Fit poses, rig, free intrinsics and effect values together, from a state on.

    held: effects whose values stay what they are; None: all but the poses does.
    """
    problem = Adjustment(data, state, free, held, prior)
    return problem.unpack(levenberg_marquardt(problem, problem.pack([state])).state)


def adjust_poses(data: RigViews, state: RigState) -> RigState:
    """Fit the poses of the frames alone."""
    return adjust(data, state, (), held=None)


def gauss_newton(
    linear: Linearization,
    solve: Callable[[Array, RigState], tuple[Array, Array]],
    tolerance: float,
) -> tuple[RigState, bool]:
    """Fit as `adjust` does, under a covariance of the residuals that the caller knows.

    Returns the state, and whether it has converged: far away, these columns may lead no further.

    solve: returns the step of poses (F, 6) and of what is shared (K,) from residuals (F, M) and
    their state, by the columns of this linearization, which change little.  tolerance: of what a
    step moves predictions by, root mean square, whitened.
    """
    data, state, free, residual = linear.data, linear.state, linear.free, linear.residual
    limit = _MAX_RISE * linear.sum_of_squares

    def is_linear(before: Array, change: Array, part: float, after: Array) -> bool:
        apart = after - (before - part * change)
        return float((apart**2).sum()) <= _LINEAR_SHARE * float(((part * change) ** 2).sum())

    for _ in range(_GAUSS_NEWTON_STEPS):
        frame, shared = solve(residual, state)
        change = (linear.frame_columns @ frame[..., None])[..., 0] + linear.shared_columns @ shared
        after = partial(state.retract, free, frame, shared)
        state, residual = shorten_step(
            data, free, after, limit, partial(is_linear, residual, change)
        )
        if np.sqrt((change**2).mean()) < tolerance:
            return state, True
    return state, False


def shorten_step(
    data: RigViews,
    free: Sequence[str],
    after: Callable[[float], RigState],
    limit: float = np.inf,
    is_linear: Callable[[float, Array], bool] = lambda *_: False,
) -> tuple[RigState, Array]:
    """Return the state after so much of a step that all points are seen, and its residual (F, M).

    A step far beyond where the columns hold may take points out of sight, or lead away from them.
    after: makes a state of a fraction of the step; limit: of the sum of squares, unless is_linear:
    whether a fraction leads to the residual that it ought to.
    """
    for part in _STEP_FRACTIONS:
        state = after(part)
        linear = Linearization(data, state, free)
        squares = linear.sum_of_squares
        if np.isfinite(squares) and (squares <= limit or is_linear(part, linear.residual)):
            break
    return state, linear.residual


class AdjustedLens(NamedTuple):
    """A lens and its V views after adjustment.

    covariance (K, K) of the parameters `names`; pose: camera in the target frame (V,), with
    pose_covariance (V, 6, 6) of the change in `Pose.retract`; both for noise of 1 / weight;
    residual (V, N, 2), px, measured minus predicted, NaN for padding; cost (V,): whitened sums of
    squares; converged.
    """

    lens: Lens
    names: tuple[str, ...]
    covariance: Array
    pose: Pose
    pose_covariance: Array
    residual: Array
    cost: Array
    converged: bool


def adjust_lens(lens: Lens, views: Views, pose: Pose, names: Sequence[str]) -> AdjustedLens:
    """Adjust named parameters of a lens and the poses (V,) of its views together.

    Raises GeometryError where a start lies outside the domain of the lens or the views do not
    determine the parameters.
    """
    data = RigViews.of_one_camera(views)
    state = RigState(pose, identity(1), lens, (), corrected=True)
    problem = Adjustment(data, state, names)
    solved = levenberg_marquardt(problem, problem.pack([state]), MAX_LENS_ITERATIONS)
    if not np.isfinite(solved.cost[0]):
        raise GeometryError(
            f'lens {lens.name!r} cannot image all landmarks from the start poses; check that '
            'landmarks, image points and image size belong together'
        )
    fitted = problem.unpack(solved.state)
    linear = Linearization(data, fitted, names)
    _, arrow = _arrow_equations(linear, linear.shared_columns)
    _check_determined(arrow, names)
    of_poses, of_lens = arrow_covariance(arrow)
    return AdjustedLens(
        fitted.lens,
        tuple(names),
        of_lens[0],
        fitted.pose,
        of_poses[0],
        linear.residual_px,
        (linear.residual**2).sum(axis=1),
        bool(solved.converged[0]),
    )


def adjust_lens_from(
    lens: Lens,
    views: Views,
    pose: Pose,
    values: Array,
    names: Sequence[str],
    max_iterations: int,
) -> Lens:
    """Return the lens that fits best of those adjusted from S starts: pose (S, V), values (S, K).

    names: of the K parameters; a start outside the lens's domain is left as it is.
    """
    states = [
        RigState(
            pose.take(i),
            identity(1),
            lens.with_parameters(names, value.tolist()),
            (),
            corrected=True,
        )
        for i, value in enumerate(values)
    ]
    problem = Adjustment(RigViews.of_one_camera(views), states[0], names)
    solved: Minimum = levenberg_marquardt(problem, problem.pack(states), max_iterations)
    return problem.unpack(solved.state, int(np.argmin(solved.cost))).lens


def rig_covariance(linear: Linearization, sigma: float, lenses: Array) -> Array:
    """Return the covariances (C - 1, 6, 6) of the cameras but the first, m and rad, poses free.

    Of the change in `Pose.retract`, for noise of sigma / weight; the free parameters of the
    linearization were fitted with a prior of an information (K, K), lenses.
    Raises GeometryError where the frames do not determine the rig.
    """
    cameras = linear.data.cameras - 1
    bodies = len(linear.state.rig.position) - 1  # and boards
    count = 6 * bodies
    names = [
        f'the place of {f"camera {i + 2}" if i < cameras else f"board {i - cameras + 2}"}'
        for i in range(bodies)
        for _ in range(6)
    ]
    _check_determined(_arrow_equations(linear, linear.shared_columns[..., :count])[1], names)
    information = arrow_information(_arrow_equations(linear, linear.shared_columns)[1])[0]
    information[count:, count:] += sigma**2 * lenses
    scale = np.sqrt(np.diag(information))
    inverse = np.linalg.inv(information / np.outer(scale, scale)) / np.outer(scale, scale)
    blocks = sigma**2 * inverse[:count, :count].reshape(bodies, 6, bodies, 6)
    return np.stack([blocks[i, :, i] for i in range(cameras)])


class Adjustment:
    """S arrow systems, see least_squares.LeastSquares: frames are blocks, all else is shared."""

    step = staticmethod(arrow_step)

    def __init__(
        self,
        data: RigViews,
        template: RigState,
        free: Sequence[str],
        held: Collection[str] | None = (),
        prior: Prior | None = None,
    ) -> None:
        """Take what to fit; held: effects that stay as they are, None for all but the poses."""
        self._data, self._template, self._free = data, template, tuple(free)
        self._prior = prior or Prior()
        self._poses_alone = held is None
        moving = [np.zeros(0, dtype=bool)]
        if held is not None:
            moving += [np.ones(6 * (len(template.rig.position) - 1) + len(self._free), dtype=bool)]
            moving += [
                np.full(len(term.values), term.name not in held)
                for term in template.terms
                if is_shared(term.effect)
            ]
        self._moving = np.concatenate(moving)

    def pack(self, states: Sequence[RigState]) -> Arrays:
        """Return the states as rotations and positions of poses and rig, and shared values."""
        parts = [(*state.pose, *state.rig, state.shared_values(self._free)) for state in states]
        return tuple(np.stack(arrays) for arrays in zip(*parts, strict=True))

    def unpack(self, packed: Arrays, system: int = 0) -> RigState:
        """Return one of the states."""
        rotation, position, rig_rotation, rig_position, values = (a[system] for a in packed)
        state = replace(
            self._template, pose=Pose(rotation, position), rig=Pose(rig_rotation, rig_position)
        )
        return state.with_shared_values(self._free, values)

    def linearize(self, state: Arrays, index: Index) -> tuple[Array, Arrays]:
        if not len(index):
            return np.zeros(0), ()
        costs, systems = zip(*(self._equations(state, i) for i in range(len(index))), strict=True)
        return (
            np.concatenate(costs),
            tuple(np.concatenate(parts) for parts in zip(*systems, strict=True)),
        )

    def retract(self, state: Arrays, step: Arrays) -> Arrays:
        frame, shared = step
        rotation, position, rig_rotation, rig_position, values = state
        if self._poses_alone:
            return (*Pose(rotation, position).retract(frame), *state[2:])
        bodies = rig_position.shape[1]
        move = np.zeros((len(shared), bodies, 6))
        move[:, 1:] = shared[:, : 6 * (bodies - 1)].reshape(len(shared), -1, 6)
        return (
            *Pose(rotation, position).retract(frame),
            *Pose(rig_rotation, rig_position).retract(move),
            values + shared[:, 6 * (bodies - 1) :],
        )

    def _equations(self, packed: Arrays, system: int) -> tuple[Array, Arrays]:
        return self._system(self.unpack(packed, system))

    def _system(self, state: RigState) -> tuple[Array, Arrays]:
        """Return cost (1,) and normal equations of one state, infinite for an impossible lens."""
        if any(lens.check() for lens in state.lenses):
            return np.array([np.inf]), self._empty_equations()
        linear = Linearization(self._data, state, self._free, self._poses_alone)
        if self._poses_alone:
            shared = np.zeros((*linear.residual.shape, 0))
        else:
            # A column of zeros leaves its parameter where it is.
            shared = linear.shared_columns * self._moving
        return self._with_prior(state, *_arrow_equations(linear, shared))

    def _empty_equations(self) -> Arrays:
        frames, count = self._data.frames, len(self._moving)
        return tuple(
            np.zeros((1, *shape))
            for shape in (
                (frames, 6, 6),
                (frames, 6, count),
                (count, count),
                (frames, 6),
                (count,),
            )
        )

    def _with_prior(self, state: RigState, cost: Array, normal: Arrays) -> tuple[Array, Arrays]:
        blocks, _, shared, block_gradient, shared_gradient = (array[0] for array in normal)
        prior = self._prior
        if prior.mean is not None and prior.root is not None:
            last = np.arange(len(shared))[-len(prior.mean) :]
            off = prior.root @ (state.shared_values(self._free)[-len(prior.mean) :] - prior.mean)
            cost = cost + off @ off
            shared[np.ix_(last, last)] += prior.root.T @ prior.root
            shared_gradient[last] += prior.root.T @ off
        if prior.pose is not None:
            off, columns = _pose_rows(prior.pose, state.pose)
            cost = cost + (off**2).sum()
            blocks += np.swapaxes(columns, -1, -2) @ columns
            block_gradient += (off[:, None] @ columns)[:, 0]
        if prior.rig is not None:
            off, columns = _pose_rows(prior.rig, state.rig.take(np.s_[1:]))
            cost = cost + (off**2).sum()
            for i, (column, row) in enumerate(zip(columns, off, strict=True)):
                slots = slice(6 * i, 6 * i + 6)
                shared[slots, slots] += column.T @ column
                shared_gradient[slots] += row @ column
        return cost, normal


def _pose_rows(prior: PosePrior, pose: Pose) -> tuple[Array, Array]:
    """Return residuals (P, R) of poses (P,) and their derivatives (P, R, 6) by `retract`."""
    change = pose.difference(prior.mean)
    columns = prior.root.copy()
    columns[..., 3:] = prior.root[..., 3:] @ log_derivative(change[..., 3:])
    return (prior.root @ change[..., None])[..., 0], columns


def _arrow_equations(linear: Linearization, shared: Array) -> tuple[Array, Arrays]:
    """Return cost (1,) and arrow of a linearization with shared columns (F, M, K)."""
    residual, block = linear.residual, linear.frame_columns
    cost = linear.sum_of_squares
    if not np.isfinite(cost):
        residual, block, shared = (np.zeros_like(a) for a in (residual, block, shared))
        cost = np.inf
    flat = shared.reshape(residual.size, shared.shape[-1])
    transposed = np.ascontiguousarray(np.swapaxes(block, -1, -2))
    equations = ArrowEquations(
        (transposed @ block)[None],
        (transposed @ shared)[None],
        (flat.T @ flat)[None],
        -(transposed @ residual[..., None])[None, ..., 0],
        -(flat.T @ residual.ravel())[None],
    )
    return np.array([cost]), tuple(equations)


def _check_determined(normal: Arrays, names: Sequence[str]) -> None:
    diagonal = np.diagonal(ArrowEquations(*normal).shared[0])
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    relative = arrow_information(normal)[0] / (scale[:, None] * scale)
    values, vectors = np.linalg.eigh(relative - np.diag(diagonal == 0))
    if len(names) and values[0] < UNDETERMINED_EIGENVALUE:
        name = names[int(np.argmax(np.abs(vectors[:, 0])))]
        raise GeometryError(
            f'{name} is confounded with the poses in these views; fix it, or add views in which '
            'the target is tilted and covers the image'
        )
