"""Levenberg-Marquardt on many independent systems at once."""

from __future__ import annotations

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

_RIDGE = 2e-14  # beyond rounding, and less than what counts as determined
_FLOOR = 1e-15  # keeps an exactly singular system solvable; far below any data's weight
# Of the cost: what a step promises where derivatives that are not exact end
_STALL_TOLERANCE = 1e-6


class LeastSquares(Protocol):
    """S independent least-squares systems; `index` (A,) says which of them are asked for.

    States, normal equations and steps are tuples of arrays whose leading axis is the system.
    """

    def linearise(self, state: Arrays, index: Index) -> tuple[Array, Arrays]:
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
    total, normal = problem.linearise(start, active)
    found = Minimum(
        tuple(array.copy() for array in start), total, np.zeros(systems, dtype=np.bool_),
        np.zeros(systems, dtype=np.int64), normal,
    )
    damping, growth = np.full(systems, FIRST_DAMPING), np.full(systems, FIRST_GROWTH)
    moved_before = np.zeros(systems)
    active = active[np.isfinite(total)]
    for _ in range(max_iterations):
        if not active.size:
            break
        found.iterations[active] += 1
        step, moved = problem.step(_rows(found.normal, active), damping[active])
        trial = problem.retract(_rows(found.state, active), step)
        before = total[active]
        done = is_last(moved, moved_before[active], before, damping[active])
        if done.any():
            last, on = active[done], ~done
            found.converged[last] = True
            total[last] = np.maximum(before - moved, 0.0)[done]
            found = found._replace(state=_with_rows(found.state, last, trial, done))
            active, before, moved = active[on], before[on], moved[on]
            trial = tuple(array[on] for array in trial)
            if not active.size:
                break
        cost, fresh = problem.linearise(trial, active)
        better = is_better(cost, before)
        accepted = active[better]
        total[accepted], moved_before[accepted] = cost[better], moved[better]
        found = found._replace(
            state=_with_rows(found.state, accepted, trial, better),
            normal=_with_rows(found.normal, accepted, fresh, better),
        )
        damping[active], growth[active] = update_damping(
            damping[active], growth[active], better, before - cost, moved
        )
        active = active[damping[active] < STUCK]
    rest = np.flatnonzero(~found.converged & np.isfinite(total))
    if rest.size:
        # Some effects have derivatives that are not exact: no step keeps what it promises.
        _, moved = problem.step(_rows(found.normal, rest), np.zeros(len(rest)))
        found.converged[rest] = moved <= _STALL_TOLERANCE * total[rest]
    return found


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


def with_unit_diagonal(hessian: Array, damping: Array | float) -> tuple[Array, Array]:
    """Return H (..., P, P) scaled to a unit diagonal and damped, and the scale (..., P).

    damping (...): added to the diagonal.
    """
    diagonal = np.diagonal(hessian, axis1=-2, axis2=-1)
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    scaled = hessian / (scale[..., :, None] * scale[..., None, :])
    np.einsum('...ii->...i', scaled)[...] = np.asarray(1 + _FLOOR + damping)[..., None]
    return scaled, scale


def dense_step(normal: Arrays, damping: Array) -> tuple[Arrays, Array]:
    """`Problem.step` for normal equations (H (A, P, P), g (A, P)) without structure."""
    hessian, gradient = normal
    step = solve_damped(hessian, gradient, damping)
    moved: Array = (step * (hessian @ step[..., None])[..., 0]).sum(axis=-1)
    return (step,), moved


def _rows(arrays: Arrays, index: Index) -> Arrays:
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
