"""Whether a board is bent or sags: the odds of a bend that stays, where gravity may do the same.

A board that sags by its own weight bends by b (n . g), n its normal and g the direction of
gravity.  Where its normals hardly vary over the frames, that is nearly a bend that stays.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import special

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.effect_tests import CONFOUNDED_P, EffectTests
from fisheye_svp_ros.diagnosis.null_model import NullModel, border_of
from fisheye_svp_ros.diagnosis.random_effects import NAMES, SAG
from fisheye_svp_ros.mixed_model import (
    FactoredEquations,
    eliminate,
    factor_equations,
    integrate_columns,
    make_equations,
)

_SIZES = (3e-5, 1e-4, 3e-4, 1e-3, 3e-3)  # m: standard deviations of a coefficient of a bend


class SagOdds(NamedTuple):
    """A bend that stays, whether the board sags or not, against a sag alone.

    log_odds: twice their logarithm; confounded: whether the bend is not needed beside the sag.
    """

    log_odds: float
    confounded: bool


def bend_over_sag(tests: EffectTests, columns: Index) -> SagOdds | None:
    """Return the odds of a bend to a sag of the same shapes; None where nothing tells of a sag.

    columns: of the border, of the bend in the model.  The coefficients of either are random, of
    whatever size is likeliest; each costs a variance and its prior, as in `EffectTests.log_odds`.
    With true poses gravity is not beside the camera, and a board on a robot need not sag.
    """
    null = tests.null
    if null.linear.data.poses is not None:
        return None
    factored, bend, centered, whole = _factor_with_sag(null, columns)
    rest = np.arange(bend[0])
    count = null.full.rows - null.full.group_rank

    def gain(*parts: Index) -> float:
        every = np.concatenate(parts)
        return -min(
            _cost(factored, rest, every, (null.variances.sigma / size) ** 2, count)
            for size in _SIZES
        )

    alone, sag = gain(bend), gain(whole)
    both = gain(bend, centered)
    confounded = bool(special.chdtrc(1, max(both - sag, 0.0)) > CONFOUNDED_P)
    if not (confounded or null.variances.alive[NAMES.index(SAG)]):
        return None
    both -= tests.parameter_cost + tests.prior_log_odds
    log_odds = float(2 * np.logaddexp(alone / 2, both / 2) - sag)
    return SagOdds(log_odds, confounded)


def _factor_with_sag(
    null: NullModel, columns: Index
) -> tuple[FactoredEquations, Index, Index, Index]:
    """Return the equations without a random sag, and where bends and sags are in their border.

    The border: what is in the model but the bend, the bend, m, a sag of its shapes that is
    centered over the frames, one whose mean counts, and the residual without the bend.
    """
    (term,) = (term for term in null.terms if np.array_equal(term.columns, columns))
    rest = null.fixed.border[..., np.setdiff1d(null.included_columns, columns)]
    bend = null.fixed.border[..., columns] * null.scale[columns]
    sags = [
        (bend[..., None] * normals[..., None, :]).reshape(*bend.shape[:2], -1)
        for normals in _normals(null, bend)
    ]
    border = border_of(null.linear, np.concatenate([rest, bend, *sags], axis=-1))
    border[..., -1] += bend @ term.values
    equations = make_equations(null.random.columns, null.linear.frame_columns, border)
    alive = null.variances.alive & (np.array(NAMES) != SAG)
    factored = factor_equations(equations.select(alive), null.variances.lam, null.variances.weight)
    ends = np.cumsum([rest.shape[-1], bend.shape[-1], *(sag.shape[-1] for sag in sags)])
    _, bends, centered, whole, _ = np.split(np.arange(border.shape[-1]), ends)
    return factored, bends, centered, whole


def _normals(null: NullModel, bend: Array) -> tuple[Array, Array]:
    """Return the normal (F, M, 3) of the board of each row, by the axes of the camera or rig.

    First less its mean over the frames, each by what it shows of a bend (F, M, K); then as it is.
    """
    linear = null.linear
    board_of = linear.data.blocks(linear.data.views.board[..., None] * np.ones(2))
    centered, whole = np.zeros((2, *bend.shape[:2], 3))
    for board in linear.scene.boards:
        mine = board_of == board.id
        normal = board.axes[2] @ linear.state.pose.rotation
        weight = ((bend**2).sum(axis=-1) * mine).sum(axis=1)
        middle = weight @ normal / max(float(weight.sum()), 1e-300)
        whole += mine[..., None] * normal[:, None]
        centered += mine[..., None] * (normal - middle)[:, None]
    return centered, whole


def _cost(
    factored: FactoredEquations, rest: Index, random: Index, ratio: float, count: int
) -> float:
    """Return minus twice the log likelihood with columns random; ratio: of noise to variance."""
    logs, information = integrate_columns(factored, random, ratio)
    return float(logs + count * np.log(eliminate(information, rest)[-1, -1]))
