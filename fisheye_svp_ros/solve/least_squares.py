"""Levenberg-Marquardt on many independent systems at once, dense or arrow-shaped.

An arrow has V small blocks and K shared parameters a system: a row depends on one block (the pose
of its view) and on what all views share (a lens, a rig).  Eliminating the blocks leaves K
equations (Schur complement; Triggs et al., Bundle Adjustment - A Modern Synthesis, 2000, section
6.1).  No sparse solver is needed.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.optics.engines.marquardt import (
    FIRST_DAMPING,
    FIRST_GROWTH,
    MAX_ITERATIONS,
    STUCK,
    is_better,
    is_last,
    update_damping,
)

Arrays = tuple[Array, ...]

UNDETERMINED_EIGENVALUE = 1e-13  # of the information, relative; rounding leaves about 1e-15
_RIDGE = 2e-14  # beyond rounding, and less than what counts as determined
_FLOOR = 1e-15  # keeps an exactly singular system solvable; far below any data's weight
# Of the cost: what a step promises where derivatives that are not exact end
_STALL_TOLERANCE = 1e-6
FALSE_ALARM = 1e-4  # probability that sound observations fail the test of their misfit
_SINGULAR = 1e-14  # relative eigenvalue below which shared parameters are left where they are


class LeastSquares(Protocol):
    """S independent least-squares systems; `index` (A,) says which of them are asked for.

    States, normal equations and steps are tuples of arrays whose leading axis is the system.
    """

    def linearize(self, state: Arrays, index: Index) -> tuple[Array, Arrays]:
        """Return the costs (A,), inf outside the domain, and the normal equations."""

    def step(self, normal: Arrays, damping: Array) -> tuple[Arrays, Array]:
        """Solve (H + damping diag H) d = -g; return d and |J d|^2, (A,)."""

    def retract(self, state: Arrays, step: Arrays) -> Arrays:
        """Apply a step to the states."""


class Minimum(NamedTuple):
    """state; cost (S,): sum of squared whitened residuals; converged (S,); iterations (S,).

    normal: the normal equations there, as of the last step but one.
    """

    state: Arrays
    cost: Array
    converged: Mask
    iterations: Index
    normal: Arrays


def levenberg_marquardt(
    problem: LeastSquares, start: Arrays, max_iterations: int = MAX_ITERATIONS
) -> Minimum:
    """Minimise every system from its own start, with a damping of its own.

    Its rules are those of `optics.engines.marquardt`.  A step that leaves the domain of the lens
    costs infinity and is refused; the last one is taken without another look.
    """
    systems = start[0].shape[0]
    active: Index = np.arange(systems)
    total, normal = problem.linearize(start, active)
    state = tuple(array.copy() for array in start)
    converged, iterations = np.zeros(systems, dtype=np.bool_), np.zeros(systems, dtype=np.int64)
    damping, growth = np.full(systems, FIRST_DAMPING), np.full(systems, FIRST_GROWTH)
    moved_before = np.zeros(systems)
    active = active[np.isfinite(total)]
    for _ in range(max_iterations):
        if not active.size:
            break
        iterations[active] += 1
        step, moved = problem.step(_take_rows(normal, active), damping[active])
        trial = problem.retract(_take_rows(state, active), step)
        before = total[active]
        done = is_last(moved, moved_before[active], before, damping[active])
        if np.count_nonzero(done):
            last, on = active[done], ~done
            converged[last] = True
            total[last] = np.maximum(before - moved, 0.0)[done]
            state = _with_rows(state, last, trial, done)
            active, before, moved = active[on], before[on], moved[on]
            trial = tuple(array[on] for array in trial)
            if not active.size:
                break
        cost, fresh = problem.linearize(trial, active)
        better = is_better(cost, before)
        accepted = active[better]
        total[accepted], moved_before[accepted] = cost[better], moved[better]
        state = _with_rows(state, accepted, trial, better)
        normal = _with_rows(normal, accepted, fresh, better)
        damping[active], growth[active] = update_damping(
            damping[active], growth[active], better, before - cost, moved
        )
        active = active[damping[active] < STUCK]
    unconverged = np.flatnonzero(~converged & np.isfinite(total))
    if unconverged.size:
        # Some effects have derivatives that are not exact: no step keeps what it promises.
        _, moved = problem.step(_take_rows(normal, unconverged), np.zeros(len(unconverged)))
        converged[unconverged] = moved <= _STALL_TOLERANCE * total[unconverged]
    return Minimum(state, total, converged, iterations, normal)


def solve_damped(hessian: Array, gradient: Array, damping: Array) -> Array:
    """Solve (H + damping diag H) d = -g for H (..., P, P), g (..., P), damping (...).

    A parameter that nothing depends on stays where it is.
    """
    scaled, scale = with_unit_diagonal(hessian, damping)
    right = (gradient / scale)[..., None]
    step: Array = -never_singular(lambda h: np.linalg.solve(h, right), scaled)[..., 0] / scale
    return step


def never_singular(operation: Callable[[Array], Any], scaled: Array) -> Array:
    """Return what an operation makes of matrices (..., P, P) with a unit diagonal.

    Where rounding has made a pivot of any exactly zero, with a little more on the diagonals.
    """
    try:
        return np.asarray(operation(scaled))
    except np.linalg.LinAlgError:
        return np.asarray(operation(scaled + _RIDGE * np.eye(scaled.shape[-1])))


def misfit_fails(cost: Array, freedom: Array) -> Mask:
    """Say whether whitened sums of squares are more than degrees of freedom allow."""
    from scipy.special import chdtri  # takes a third of the time that `--help` may take

    return np.asarray(cost > chdtri(np.maximum(freedom, 1), FALSE_ALARM))


def with_unit_diagonal(hessian: Array, damping: Array | float) -> tuple[Array, Array]:
    """Return H (..., P, P) scaled to a unit diagonal and damped, and the scale (..., P).

    damping (...): added to the diagonal.
    """
    size = hessian.shape[-1]
    diagonal = hessian.reshape(*hessian.shape[:-2], size * size)[..., :: size + 1]
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    outer = scale[..., :, None] * scale[..., None, :]
    scaled = np.divide(hessian, outer, order='C')  # so that reshaping it makes no copy
    scaled.reshape(*outer.shape[:-2], size * size)[..., :: size + 1] = np.asarray(
        1 + _FLOOR + damping
    )[..., None]
    return scaled, scale


def dense_step(normal: Arrays, damping: Array) -> tuple[Arrays, Array]:
    """`Problem.step` for normal equations (H (A, P, P), g (A, P)) without structure."""
    hessian, gradient = normal
    step = solve_damped(hessian, gradient, damping)
    moved: Array = (step * (hessian @ step[..., None])[..., 0]).sum(axis=-1)
    return (step,), moved


def _take_rows(arrays: Arrays, index: Index) -> Arrays:
    """Return the rows at ascending places; all of them are not copied."""
    if len(index) == len(arrays[0]):
        return arrays
    return tuple(array[index] for array in arrays)


def _with_rows(arrays: Arrays, index: Index, new: Arrays, mask: Mask) -> Arrays:
    """Return arrays with the masked ones of the new rows, which go to `index`."""
    if len(index) == len(arrays[0]):
        return new
    for array, values in zip(arrays, new, strict=True):
        array[index] = values[mask]
    return arrays


class ArrowEquations(NamedTuple):
    """Normal equations of S systems, each H = [[blocks, cross], [cross^T, shared]].

    blocks (S, V, B, B); cross (S, V, B, K); shared (S, K, K); block_gradient (S, V, B);
    shared_gradient (S, K).
    """

    blocks: Array
    cross: Array
    shared: Array
    block_gradient: Array
    shared_gradient: Array


def arrow_of_views(
    cost: Array, hessian: Array, gradient: Array, block: int
) -> tuple[Array, Arrays]:
    """Gather the normal equations of single views, whitened, into arrows.

    cost (S, V); hessian (S, V, B + K, B + K), gradient (S, V, B + K): `block` = B columns of the
    view's own, then those that all views share.  Returns the costs (S,) and the fields of
    ArrowEquations, as `least_squares.LeastSquares.linearize` does.
    """
    equations = ArrowEquations(
        hessian[..., :block, :block],
        hessian[..., :block, block:],
        hessian[..., block:, block:].sum(axis=1),
        gradient[..., :block],
        gradient[..., block:].sum(axis=1),
    )
    return cost.sum(axis=1), tuple(equations)


def arrow_step(normal: Arrays, damping: Array) -> tuple[Arrays, Array]:
    """Solve (H + damping diag H) d = -g: `least_squares.LeastSquares.step`; damping (S,).

    Returns ((block steps (S, V, B), shared steps (S, K)), |J d|^2 (S,)).  A parameter that nothing
    depends on stays where it is.
    """
    equations = ArrowEquations(*normal)
    scaled, block_scale, shared_scale = _scale_arrow(equations, damping)
    eliminated, reduced = _eliminate(scaled)
    right = scaled.shared_gradient - np.einsum(
        'svbk,svb->sk', eliminated[..., :-1], scaled.block_gradient
    )
    shared_step = -(_inverse(reduced) @ right[..., None])[..., 0]
    block_step = (
        -eliminated[..., -1] - (eliminated[..., :-1] @ shared_step[:, None, :, None])[..., 0]
    )
    block_step, shared_step = block_step / block_scale, shared_step / shared_scale
    return (block_step, shared_step), _squared_change(equations, block_step, shared_step)


def arrow_information(normal: Arrays) -> Array:
    """Return the information (S, K, K) about the shared parameters, the blocks being unknown."""
    equations = ArrowEquations(*normal)
    scaled, _, shared_scale = _scale_arrow(equations, np.zeros(len(equations.shared)))
    _, reduced = _eliminate(scaled)
    return np.asarray(reduced * shared_scale[:, :, None] * shared_scale[:, None, :])


def arrow_covariance(normal: Arrays) -> tuple[Array, Array]:
    """Return the covariances of blocks (S, V, B, B) and of shared parameters (S, K, K), whitened.

    A direction that the rows do not determine is left out of it: check `arrow_information` first.
    """
    equations = ArrowEquations(*normal)
    scaled, block_scale, shared_scale = _scale_arrow(equations, np.zeros(len(equations.shared)))
    eliminated, reduced = _eliminate(scaled)
    shared = _inverse(reduced)
    leverage = eliminated[..., :-1]
    blocks = _inverse(scaled.blocks) + leverage @ shared[:, None] @ np.swapaxes(leverage, -1, -2)
    return (
        blocks / (block_scale[..., :, None] * block_scale[..., None, :]),
        shared / (shared_scale[:, :, None] * shared_scale[:, None, :]),
    )


def _scale_arrow(equations: ArrowEquations, damping: Array) -> tuple[ArrowEquations, Array, Array]:
    """Scale to a unit diagonal and damp it; return also the scales (S, V, B) and (S, K)."""
    blocks, block_scale = with_unit_diagonal(equations.blocks, damping[:, None])
    shared, shared_scale = with_unit_diagonal(equations.shared, damping)
    scaled = ArrowEquations(
        blocks,
        equations.cross / (block_scale[..., :, None] * shared_scale[:, None, None, :]),
        shared,
        equations.block_gradient / block_scale,
        equations.shared_gradient / shared_scale,
    )
    return scaled, block_scale, shared_scale


def _eliminate(scaled: ArrowEquations) -> tuple[Array, Array]:
    """Return blocks^-1 [cross, gradient] (S, V, B, K + 1) and the Schur complement (S, K, K)."""
    right = np.concatenate([scaled.cross, scaled.block_gradient[..., None]], axis=-1)
    eliminated = never_singular(lambda h: np.linalg.solve(h, right), scaled.blocks)
    explained = np.einsum('svbk,svbl->skl', scaled.cross, eliminated[..., :-1])
    reduced = scaled.shared - explained
    return eliminated, (reduced + np.swapaxes(reduced, -1, -2)) / 2


def _inverse(matrix: Array) -> Array:
    """Return the inverse of symmetric matrices (..., K, K) without their singular directions."""
    with contextlib.suppress(np.linalg.LinAlgError):
        inverse = np.asarray(np.linalg.inv(matrix), dtype=float)
        # No less than the ratio of the eigenvalues, for a matrix that is no less than singular.
        spread = np.abs(_trace(inverse) * _trace(matrix))
        if (spread < 1 / _SINGULAR).all():
            return inverse
    values, vectors = np.linalg.eigh(matrix)
    kept = values > _SINGULAR * values[..., -1:]
    with np.errstate(divide='ignore'):
        scale = np.where(kept, 1 / values, 0.0)
    return np.asarray((vectors * scale[..., None, :]) @ np.swapaxes(vectors, -1, -2))


def _trace(matrix: Array) -> Array:
    return np.asarray(np.trace(matrix, axis1=-2, axis2=-1))


def _squared_change(equations: ArrowEquations, block_step: Array, shared_step: Array) -> Array:
    inner = equations.blocks @ block_step[..., None] + 2 * (
        equations.cross @ shared_step[:, None, :, None]
    )
    by_blocks = np.einsum('svb,svb->s', block_step, inner[..., 0])
    by_shared = np.einsum('sk,skl,sl->s', shared_step, equations.shared, shared_step)
    return np.asarray(by_blocks + by_shared)
