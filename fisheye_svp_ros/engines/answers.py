"""What engines are asked with and answer with."""

from __future__ import annotations

from typing import NamedTuple

from fisheye_svp_ros.arrays import Array, Index, Mask

# Points (S, N, 3), m; image points (S, N, 2), px; weights (S, N), 1/px
Seen = tuple[Array, Array, Array]


class Poses(NamedTuple):
    """S poses at their minima, the fields of `solve.localization.Localization`.

    solved (S,): whether it was; what was not, `left` of them, is left to the solver.
    """

    rotation: Array
    position: Array
    covariance: Array
    residual: Array
    cost: Array
    solved: Mask
    iterations: Index
    left: int


class Rigs(NamedTuple):
    """S rigs at their minima: state, cost and iterations (S,), normal equations (an arrow)."""

    state: tuple[Array, ...]
    cost: Array
    iterations: Index
    normal: tuple[Array, ...]
