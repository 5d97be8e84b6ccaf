"""Boards that were numbered from another end in some photographs.

A board that looks the same when it is turned is fitted as well in either order of its landmarks:
the pose takes up the turn.  What its landmarks are off by tells: in the other order a view shows
the offsets of the opposite landmarks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.fitted_model import FittedModel
from fisheye_svp_ros.diagnosis.null_model import NullModel
from fisheye_svp_ros.diagnosis.problem import Problem
from fisheye_svp_ros.diagnosis.random_effects import MILLIMETRE, NAMES
from fisheye_svp_ros.effects.target_map import KnownTarget
from fisheye_svp_ros.scene.boards import BoardTurn, board_turns
from fisheye_svp_ros.scene.observations import Landmarks, Observations, frame_name
from fisheye_svp_ros.solve.initial_rig import localize_cameras
from fisheye_svp_ros.solve.outliers import FRAME, cross_camera_offsets
from fisheye_svp_ros.solve.rig_checks import is_unpaired
from fisheye_svp_ros.solve.rig_state import RigViews, group_by_frame

_PRIOR = 0.01  # how probable it is, before any data, that a photograph is numbered otherwise
SUSPECT_ODDS, CERTAIN_ODDS = 20.0, 1000.0
_MAX_LOG_ODDS = 27.6  # odds beyond 1e12 rest on the tails of no data
_MIN_FRAMES, _MIN_POINTS = 4, 6
_START_MM, _EM_STEPS = 0.3, 8
_CONSISTENT_RATIO = 3.0  # times the median offset between cameras: within it they agree
_MEDIAN_OF_NORMAL = 0.6745  # of the absolute value, in standard deviations


@dataclass(frozen=True)
class TurnedFrame:
    """A frame whose board is numbered from another end than in the others.

    camera: of a single view, '' for the whole frame; photograph: what it is called; odds: that
    it is so; corrected: whether it is diagnosed in the order of the others.
    """

    frame: int
    camera: str
    photograph: str
    degrees: int
    odds: float
    corrected: bool

    @property
    def has_photograph(self) -> bool:
        """Whether it is called by a photograph, not by its number."""
        return not self.photograph.startswith(f'frame {self.frame}')


class _Frames(NamedTuple):
    """What F frames of up to N points say of the L landmarks of one board, in its axes.

    rows (F, N, 2): whitened residuals with everything predicted but where landmarks are; place
    (F, N, 2, 3): their derivatives by that, per mm; slot (F, N): of L, -1 for none; fixed
    (F, N, 2, K): columns that a frame fits for itself; known (L, 3), mm: where landmarks are said
    to be, with all effects; partner (T, L), matrix (T, 3, 3): every order, the first as it is.
    """

    rows: Array
    place: Array
    slot: Index
    fixed: Array
    known: Array
    partner: Index
    matrix: Array

    def order(self, turn: Index) -> tuple[Index, Array, Array]:
        """Return slots (F, N), derivatives and residuals by offsets, in an order (F,) of each."""
        slot = np.where(self.slot < 0, 0, self.partner[turn[:, None], self.slot])
        back = np.swapaxes(self.matrix[turn], -1, -2)[:, None]
        there = self.slot >= 0
        moved = (back @ self.known[slot][..., None])[..., 0] - self.known[self.slot]
        rows = self.rows - (self.place @ moved[..., None])[..., 0]
        return (
            slot,
            np.where(there[..., None, None], self.place @ back, 0.0),
            np.where(there[..., None], rows, 0.0),
        )

    def products(self, turn: Index) -> tuple[Array, Array]:
        """Return what each frame says of landmarks: products (F, L, 3, 3) and (F, L, 3)."""
        slot, place, rows = self.order(turn)
        shape = len(slot), self.known.shape[0], 3
        square, product = np.zeros((*shape, 3)), np.zeros(shape)
        at = np.arange(len(slot))[:, None], slot
        np.add.at(square, at, np.swapaxes(place, -1, -2) @ place)
        np.add.at(product, at, (np.swapaxes(place, -1, -2) @ rows[..., None])[..., 0])
        return square, product

    def compare_orders(self, turn: Index, noise: float, spread: Array) -> tuple[Array, Array]:
        """Return the log likelihood ratios (T, F) of every order to the first, by the others.

        And by how many standard errors (T, F) each frame shows the difference of the two orders:
        the ratio is half of its square where the order is right, less that where it is wrong.
        noise: variance of rows; spread (3,): variances of offsets.
        """
        square, product = self.products(turn)
        square, product = square.sum(axis=0) - square, product.sum(axis=0) - product
        covariance = np.linalg.inv(square / noise + np.diag(1 / spread))
        mean = (covariance @ product[..., None])[..., 0] / noise
        likelihood, distance, left = [], [], []
        for i in range(len(self.partner)):
            slot, place, rows = self.order(np.full(len(turn), i))
            at = np.arange(len(slot))[:, None], slot
            left.append(rows - (place @ mean[at][..., None])[..., 0])
            inside = noise * np.eye(2) + place @ covariance[at] @ np.swapaxes(place, -1, -2)
            likelihood.append(_restricted_likelihood(left[-1], inside, self.fixed)[0])
            distance.append(_restricted_likelihood(left[-1] - left[0], inside, self.fixed)[1])
        return np.array(likelihood) - likelihood[0], np.sqrt(np.maximum(distance, 0.0))

    def offset_variances(self, turn: Index, noise: float) -> Array:
        """Return variances (3,) of offsets along the axes, mm^2 (EM)."""
        square, product = (part.sum(axis=0) for part in self.products(turn))
        spread = np.full(3, _START_MM**2)
        for _ in range(_EM_STEPS):
            covariance = np.linalg.inv(square / noise + np.diag(1 / spread))
            mean = (covariance @ product[..., None])[..., 0] / noise
            spread = (mean**2 + np.diagonal(covariance, axis1=1, axis2=2)).mean(axis=0)
        return np.asarray(spread)


def _restricted_likelihood(rows: Array, covariance: Array, fixed: Array) -> tuple[Array, Array]:
    """Return restricted log likelihoods (F,) of rows (F, N, 2), and their squares (F,).

    covariance (F, N, 2, 2): of each point; fixed (F, N, 2, K): columns that rows fit.
    """
    inverse = np.linalg.inv(covariance)
    weighted = inverse @ fixed
    normal = np.einsum('fnik,fnil->fkl', fixed, weighted)
    ridge = 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(fixed.shape[-1])
    normal = normal + ridge
    pull = np.einsum('fnik,fni->fk', weighted, rows)
    taken = np.einsum('fk,fk->f', pull, np.linalg.solve(normal, pull[..., None])[..., 0])
    square = np.einsum('fni,fnij,fnj->f', rows, inverse, rows) - taken
    logs = np.log(np.linalg.det(covariance)).sum(axis=1) + np.linalg.slogdet(normal)[1]
    return -(logs + square) / 2, square


def find_turned_views(problem: Problem) -> list[tuple[TurnedFrame, BoardTurn]]:
    """Return the views that contradict the other cameras of their frame, but do not when turned.

    Of two views either may be the one, and both are named; `find_turned_frames` tests the whole
    frame afterwards.
    """
    table, outliers = problem.observations, problem.outliers
    rows = outliers.rows[[why == FRAME for why in outliers.why]]
    if not len(rows) or is_unpaired(problem.data):
        return []
    torn = np.unique(table.frame[rows])
    agreed = _cross_camera_misfits(problem, problem.data).values()
    usual = float(np.median([misfit for misfit in agreed if np.isfinite(misfit)] or [np.inf]))
    target = KnownTarget.from_views(problem.table.views)
    trials = []
    for turn in board_turns(Landmarks(target.landmark, target.points), target.board):
        for camera in range(len(table.cameras)):
            data = group_by_frame(
                turn.apply(table, np.isin(table.frame, torn) & (table.camera == camera))
            )
            data = data.select(np.isin(data.views.frame, torn))
            trials.append((camera, turn, _cross_camera_misfits(problem, data)))
    before, found = _cross_camera_misfits(problem, problem.table), []
    for frame in torn.tolist() if trials else ():
        camera, turn, misfits = min(trials, key=lambda trial: trial[2][frame])
        if misfits[frame] > _CONSISTENT_RATIO * usual:
            continue
        gain = (before[frame] ** 2 - misfits[frame] ** 2) / (2 * usual**2) + np.log(_PRIOR)
        name, views = table.cameras[camera], int((problem.table.views.frame == frame).sum())
        found.append(
            (
                TurnedFrame(
                    frame,
                    name,
                    frame_name(table, frame, name if views > 2 else None),
                    turn.degrees,
                    float(np.exp(min(gain, _MAX_LOG_ODDS))),
                    bool(gain > np.log(CERTAIN_ODDS)),
                ),
                turn,
            )
        )
    return found


def _cross_camera_misfits(problem: Problem, data: RigViews) -> dict[int, float]:
    """Return how far off, px, a view of each frame is at most from where the rig has it."""
    alone = localize_cameras(problem.base.model, data.views)
    misfit = cross_camera_offsets(data, problem.base, alone)[0]
    return {
        frame: float(misfit[data.views.frame == frame].max())
        for frame in np.unique(data.views.frame).tolist()
    }


def find_turned_frames(
    null: NullModel, fitted: FittedModel
) -> list[tuple[TurnedFrame, BoardTurn]]:
    """Return the frames whose board is likely to be numbered from another end, with the turns."""
    views, table = null.linear.data.views, null.linear.data.observations
    target = KnownTarget.from_views(views)
    turns = board_turns(Landmarks(target.landmark, target.points), target.board)
    first = null.linear.data.first_views
    alone = is_unpaired(null.linear.data)
    found = []
    for number in dict.fromkeys(turn.board.id for turn in turns):
        own = [turn for turn in turns if turn.board.id == number]
        at, frames = _gather(fitted, target, own)
        if len(at) < _MIN_FRAMES:
            continue
        for i, turn, odds in _resolve(frames, null.variances.sigma**2):
            view = first[at[i]]
            frame = int(views.frame[view])
            camera = table.cameras[views.camera[view]] if alone else ''
            found.append(
                (
                    TurnedFrame(
                        frame,
                        camera,
                        frame_name(table, frame, camera or None),
                        own[turn - 1].degrees,
                        odds,
                        odds > CERTAIN_ODDS,
                    ),
                    own[turn - 1],
                )
            )
    return found


def turn_frames(
    table: Observations, found: Sequence[tuple[TurnedFrame, BoardTurn]]
) -> Observations:
    """Return the table with the frames that are certain in the order of the others."""
    for one, turn in found:
        if one.corrected:
            rows = table.frame == one.frame
            if one.camera:
                rows &= table.camera == table.cameras.index(one.camera)
            table = turn.apply(table, rows)
    return table


def _resolve(frames: _Frames, noise: float) -> list[tuple[int, int, float]]:
    """Return frame, turn and odds of those that are likelier in another order.

    The likeliest is turned first: what the others show is clearer then.
    """
    turn = np.zeros(len(frames.slot), dtype=np.int64)
    each = np.arange(len(turn))
    for _ in range(len(turn) // 2 + 1):
        spread = np.maximum(frames.offset_variances(turn, noise), 1e-12)
        gain, distance = frames.compare_orders(turn, noise, spread)
        scatter = _scatter(gain, distance)
        better = (gain - gain[turn, each]) / scatter
        frame = int(better.max(axis=0).argmax())
        if better[:, frame].max() < 1.0:
            break
        turn[frame] = better[:, frame].argmax()
    odds = gain[turn, each] / scatter + np.log(_PRIOR)
    return [
        (int(i), int(turn[i]), float(np.exp(min(odds[i], _MAX_LOG_ODDS))))
        for i in np.flatnonzero(turn)
        if odds[i] > np.log(SUSPECT_ODDS)
    ]


def _scatter(gain: Array, distance: Array) -> float:
    """Return the variance of what frames show of a turn over what it should be, 1 at least.

    gain, distance (T, F): as `compare_orders` returns them.  A frame shows none of the turn or all
    of it.
    """
    gain, distance = gain[1:], np.maximum(distance[1:], 1e-9)
    part = gain / distance**2 + 0.5
    off = np.where(part > 0.5, part - 1, part) * distance
    return max(float(np.median(np.abs(off)) / _MEDIAN_OF_NORMAL) ** 2, 1.0)


def _gather(
    fitted: FittedModel, target: KnownTarget, turns: Sequence[BoardTurn]
) -> tuple[Index, _Frames]:
    """Return what the frames that show one board alone say of it, and which frames these are."""
    linear, columns = fitted.linear, fitted.random.columns
    board, ids = turns[0].board, turns[0].landmark
    count = len(linear.residual)
    used = linear.row_mask.reshape(count, -1, 2)[..., 0]
    alone = np.isin(fitted.random.landmark, turns[0].alone)[columns.unit] & used
    shown = np.isin(fitted.random.landmark, ids)[columns.unit] & used
    at = np.flatnonzero(((shown | alone) == used).all(axis=1) & (shown.sum(axis=1) >= _MIN_POINTS))
    # Fields of the image stay in: they take up what a frame in the wrong order errs by.
    rows = fitted.residuals(of_frames=True).reshape(count, -1, 2)[at]
    bumps = columns.group_label == NAMES.index('frame_bumps')
    fixed = np.concatenate([linear.frame_columns[at], columns.group[at][..., ~bumps]], axis=-1)
    fixed = np.where(shown[at][..., None, None], fixed.reshape(*rows.shape, fixed.shape[-1]), 0.0)
    fixed = fixed / np.maximum(np.sqrt((fixed**2).sum(axis=(1, 2), keepdims=True)), 1e-12)
    own = np.isin(target.landmark, ids)
    where = target.points[own] + target.displacements(linear.state.terms, linear.state.lens)[own]
    slot = np.where(shown[at], np.searchsorted(ids, target.landmark[columns.unit[at]]), -1)
    partner = [np.arange(len(ids)), *(np.searchsorted(ids, turn.partner) for turn in turns)]
    frames = _Frames(
        np.where((slot >= 0)[..., None], rows, 0.0),
        np.where((slot >= 0)[..., None, None], columns.offset[at], 0.0),
        slot,
        fixed,
        (where - board.center) @ board.axes.T / MILLIMETRE,
        np.array(partner),
        np.array([np.eye(3), *(turn.matrix for turn in turns)]),
    )
    return at, frames
