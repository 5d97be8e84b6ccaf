"""Levenberg-Marquardt on many independent systems at once."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.optics.engines.stopping import (
    MAX_ITERATIONS,
    NOISE,
    ROUNDING,
    STEP_TOLERANCE,
    STUCK,
)

Arrays = tuple[Array, ...]

_LEAST = 1e-300  # what is divided by in place of 0
_FLOOR = 1e-15  # keeps an exactly singular system solvable; far below any data's weight


class Problem(Protocol):
    """S independent least-squares systems; `index` (A,) says which of them are asked for.

    States, normal equations and steps are tuples of arrays whose leading axis is the system.
    """

    def linearise(self, state: Arrays, index: Index) -> tuple[Array, Arrays]:
        """Return the costs (A,), inf outside the domain, and the normal equations."""

    def step(self, normal: Arrays, damping: Array) -> tuple[Arrays, Array]:
        """Solve (H + damping diag H) d = -g; return d and |J d|^2, (A,)."""

    def retract(self, state: Arrays, step: Arrays) -> Arrays:
        """Apply a step to the states."""


class Solved(NamedTuple):
    """state; cost (S,): sum of squared whitened residuals; converged (S,); iterations (S,).

    normal: the normal equations there, as of the last step but one.
    """

    state: Arrays
    cost: Array
    converged: Mask
    iterations: Index
    normal: Arrays


def levenberg_marquardt(
    problem: Problem, start: Arrays, max_iterations: int = MAX_ITERATIONS
) -> Solved:
    """Minimise every system from its own start, with a damping of its own.

    Source: Marquardt's scaling with Nielsen's damping (IMM-REP-1999-05, section 3).  A step that
    leaves the domain of the lens costs infinity and is refused; one too small to matter, or after
    which the next would be, is taken without another look, and is the last.
    """
    systems = start[0].shape[0]
    state = tuple(array.copy() for array in start)
    active: Index = np.arange(systems)
    total, normal = problem.linearise(state, active)
    damping, growth = np.full(systems, 1e-4), np.full(systems, 2.0)
    converged, moved_before = np.zeros(systems, dtype=bool), np.zeros(systems)
    iterations = np.zeros(systems, dtype=np.int64)
    active = active[np.isfinite(total)]
    for _ in range(max_iterations):
        if not active.size:
            break
        iterations[active] += 1
        step, moved = problem.step(_take(normal, active), damping[active])
        trial = problem.retract(_take(state, active), step)
        before = total[active]
        done = moved <= STEP_TOLERANCE**2 + ROUNDING * before
        done |= moved * moved <= STEP_TOLERANCE**2 * (1 + before) * moved_before[active]
        done &= damping[active] < 1
        if done.any():
            last, on = active[done], ~done
            converged[last] = True
            total[last] = np.maximum(before - moved, 0.0)[done]
            state = _put(state, last, trial, done)
            active, before, moved = active[on], before[on], moved[on]
            trial = tuple(array[on] for array in trial)
            if not active.size:
                break
        cost, fresh = problem.linearise(trial, active)
        better = cost <= before * (1 + ROUNDING) + NOISE * np.sqrt(before)
        ratio = np.where(better, before - cost, 0.0) / np.fmax(moved, _LEAST)
        accepted = active[better]
        total[accepted], moved_before[accepted] = cost[better], moved[better]
        state = _put(state, accepted, trial, better)
        normal = _put(normal, accepted, fresh, better)
        damping[active], growth[active] = _adjusted(
            damping[active], growth[active], better, ratio
        )
        active = active[damping[active] < STUCK]
    return Solved(state, total, converged, iterations, normal)


def solve_damped(hessian: Array, gradient: Array, damping: Array) -> Array:
    """Solve (H + damping diag H) d = -g for H (..., P, P), g (..., P), damping (...).

    A parameter that nothing depends on stays where it is.
    """
    scaled, scale = with_unit_diagonal(hessian, damping)
    step: Array = -np.linalg.solve(scaled, (gradient / scale)[..., None])[..., 0] / scale
    return step


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


def _adjusted(damping: Array, growth: Array, better: Mask, ratio: Array) -> tuple[Array, Array]:
    shrunk = np.maximum(damping * np.clip(1 - (2 * ratio - 1) ** 3, 0.1, 2.0), 1e-15)
    raised = np.maximum(damping, 1e-9) * growth
    return np.where(better, shrunk, raised), np.where(better, 2.0, 2 * growth)


def _take(arrays: Arrays, index: Index) -> Arrays:
    if len(index) == len(arrays[0]):
        return arrays
    return tuple(array[index] for array in arrays)


def _put(arrays: Arrays, index: Index, new: Arrays, mask: Mask) -> Arrays:
    """Return arrays with the masked ones of the new rows, which go to `index`."""
    if len(index) == len(arrays[0]):
        return new
    for array, values in zip(arrays, new, strict=True):
        array[index] = values[mask]
    return arrays
