"""Arrow-shaped least squares: V small blocks and K shared parameters a system, S systems at once.

A row of a system depends on one block (the pose of its view) and on what all views share (a lens,
a rig).  Eliminating the blocks leaves K equations (Schur complement; Triggs et al., Bundle
Adjustment - A Modern Synthesis, 2000, section 6.1).  No sparse solver is needed.
"""

from __future__ import annotations

import contextlib
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.solve.least_squares import Arrays, never_singular, with_unit_diagonal

_SINGULAR = 1e-14  # relative eigenvalue below which shared parameters are left where they are


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


class ArrowCovariance(NamedTuple):
    """Covariance of the blocks (S, V, B, B) and of the shared parameters (S, K, K)."""

    blocks: Array
    shared: Array


def arrow_of_views(
    cost: Array, hessian: Array, gradient: Array, block: int
) -> tuple[Array, Arrays]:
    """Gather the normal equations of single views, whitened, into arrows.

    cost (S, V); hessian (S, V, B + K, B + K), gradient (S, V, B + K): `block` = B columns of the
    view's own, then those that all views share.  Returns the costs (S,) and the fields of
    ArrowEquations, as `least_squares.LeastSquares.linearise` does.
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
    scaled, block_scale, shared_scale = _scale(equations, damping)
    eliminated, reduced = _eliminate(scaled)
    right = scaled.shared_gradient - np.einsum(
        'svbk,svb->sk', eliminated[..., :-1], scaled.block_gradient
    )
    shared_step = -(_inverse(reduced) @ right[..., None])[..., 0]
    block_step = -eliminated[..., -1] - (
        eliminated[..., :-1] @ shared_step[:, None, :, None]
    )[..., 0]
    block_step, shared_step = block_step / block_scale, shared_step / shared_scale
    return (block_step, shared_step), _squared_change(equations, block_step, shared_step)


def arrow_information(normal: Arrays) -> Array:
    """Return the information (S, K, K) about the shared parameters, the blocks being unknown."""
    equations = ArrowEquations(*normal)
    scaled, _, shared_scale = _scale(equations, np.zeros(len(equations.shared)))
    _, reduced = _eliminate(scaled)
    information: Array = reduced * shared_scale[:, :, None] * shared_scale[:, None, :]
    return information


def arrow_covariance(normal: Arrays) -> ArrowCovariance:
    """Return the covariance of every block and of the shared parameters, whitened rows assumed.

    A direction that the rows do not determine is left out of it: check `arrow_information` first.
    """
    equations = ArrowEquations(*normal)
    scaled, block_scale, shared_scale = _scale(equations, np.zeros(len(equations.shared)))
    eliminated, reduced = _eliminate(scaled)
    shared = _inverse(reduced)
    leverage = eliminated[..., :-1]
    blocks = _inverse(scaled.blocks) + leverage @ shared[:, None] @ np.swapaxes(leverage, -1, -2)
    return ArrowCovariance(
        blocks / (block_scale[..., :, None] * block_scale[..., None, :]),
        shared / (shared_scale[:, :, None] * shared_scale[:, None, :]),
    )


def _scale(equations: ArrowEquations, damping: Array) -> tuple[ArrowEquations, Array, Array]:
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
    known = np.einsum('svbk,svbl->skl', scaled.cross, eliminated[..., :-1])
    reduced = scaled.shared - known
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
    trace: Array = np.trace(matrix, axis1=-2, axis2=-1)
    return trace


def _squared_change(equations: ArrowEquations, block_step: Array, shared_step: Array) -> Array:
    inner = equations.blocks @ block_step[..., None] + 2 * (
        equations.cross @ shared_step[:, None, :, None]
    )
    by_blocks = np.einsum('svb,svb->s', block_step, inner[..., 0])
    moved: Array = by_blocks + np.einsum(
        'sk,skl,sl->s', shared_step, equations.shared, shared_step
    )
    return moved
