"""Score tests: what one more effect explains, with everything that is free projected out."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import stats

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.model import (
    Linearised,
    dense_frames,
    flat_rows,
    gather,
    landmark_groups,
    survey_of,
)
from fisheye_svp_ros.effects.landmark_survey import LandmarkSurveyEffect

# A column of which less than this is left once the nuisance is out cannot be told from it.
IDENTIFIABLE = 1e-4


class Score(NamedTuple):
    """A score test: statistic (whitened squares explained), its rank, p-value, estimate (P,).

    inflation: the factor by which dependence of residuals was taken to raise the statistic.
    """

    statistic: float
    rank: int
    p_value: float
    estimate: Array
    inflation: float = 1.0


class Nuisance:
    """The space of what is free: poses, rig, intrinsics, effects already in the model.

    residual (F, M): the whitened residual outside that space; rows, rank: its dimensions.
    """

    def __init__(
        self, linear: Linearised, extra: Array | None = None,
        survey: LandmarkSurveyEffect | None = None,
    ) -> None:
        """Take a linearised state, columns (F, M, P) that are free as well, free landmarks."""
        self.shape = linear.residual.shape
        self.rows = int(linear.rows.used.sum())
        shared = linear.shared_columns
        if extra is not None:
            shared = np.concatenate([shared, extra], axis=-1)
        survey = survey or survey_of(linear.state.terms)
        if survey is None:
            self._group, self._blocks = None, block_basis(linear.frame_columns)
        else:
            free = linear.rows.used & (survey.slots(linear.rows.landmark) >= 0)
            self._group = landmark_groups(linear.rows.landmark, free)
            place = linear.whitened(linear.linear.d_target)
            self._blocks = block_basis(gather(place, self._group))
            shared = np.concatenate([dense_frames(linear.frame_columns), shared], axis=-1)
        self.shared_basis = _in_rows(
            basis(self.outside_blocks(shared), _norms(shared)), self.shape
        )
        blocks = int((np.abs(self._blocks).sum(axis=1) > 0).sum())
        self.rank = blocks + self.shared_basis.shape[-1]
        self.residual = self.outside(linear.residual[..., None])[..., 0]

    @property
    def frame_basis(self) -> Array | None:
        """Basis (F, M, 6) of the poses, frame by frame; None where landmarks are free."""
        return self._blocks if self._group is None else None

    @property
    def freedom(self) -> int:
        """Degrees of freedom of the residual."""
        return int(self.rows - self.rank)

    @property
    def misfit(self) -> float:
        """Sum of the squared residuals, whitened."""
        return float((self.residual**2).sum())

    def outside(self, columns: Array) -> Array:
        """Return columns (F, M, P) less their part inside the nuisance space."""
        flat = flat_rows(self.outside_blocks(columns))
        shared = flat_rows(self.shared_basis)
        flat = flat - shared @ (shared.T @ flat)
        return flat.reshape(columns.shape)

    def leverage(self, first: Index, second: Index) -> Array:
        """Return sums (K,) of the hat matrix over pairs of rows (flat indices)."""
        shared = flat_rows(self.shared_basis)
        inside = np.einsum('kr,kr->k', shared[first], shared[second])
        rows = self.shape[1]
        if self._group is None:
            frame = flat_rows(self._blocks)
            same = first // rows == second // rows
            inside = inside + same * np.einsum('kr,kr->k', frame[first], frame[second])
        return np.asarray(inside)

    def outside_blocks(self, columns: Array) -> Array:
        """Return columns (F, M, P) less what poses (or free landmarks) take up of them."""
        if self._group is None:
            q = self._blocks
            return columns - q @ (np.swapaxes(q, -1, -2) @ columns)
        q, grouped = self._blocks, gather(columns, self._group)
        inside = q @ (np.swapaxes(q, -1, -2) @ grouped)
        flat = flat_rows(columns).copy()
        mine = self._group < len(flat)
        flat[self._group[mine]] -= inside[mine]
        return flat.reshape(columns.shape)


def score(
    nuisance: Nuisance, columns: Array, inflation: Callable[[Array], float] = lambda _: 1.0
) -> Score:
    """Test whether columns (F, M, P) explain part of the residual (F test, noise estimated).

    inflation: of directions (F, M, R), by how much sums along them exceed independent ones.
    Source: score (Lagrange multiplier) test of a nested model, e.g. Seber and Lee, Linear
    Regression Analysis, section 4.3.
    """
    projected = nuisance.outside(columns)
    norms = np.maximum(_norms(columns), 1e-300)
    q = _in_rows(basis(projected, norms), nuisance.shape)
    rank = q.shape[-1]
    if rank == 0:
        return Score(0.0, 0, 1.0, np.zeros(columns.shape[-1]))
    explained = np.einsum('fmr,fm->r', q, nuisance.residual)
    statistic = float((explained**2).sum())
    flat = flat_rows(projected) / norms
    gram = np.linalg.pinv(flat.T @ flat, rcond=IDENTIFIABLE**2, hermitian=True)
    estimate = gram @ (flat.T @ nuisance.residual.ravel()) / norms
    factor = inflation(q)
    return Score(statistic, rank, p_value(nuisance, statistic, rank, factor), estimate, factor)


def p_value(nuisance: Nuisance, statistic: float, rank: int, inflation: float = 1.0) -> float:
    """Return the F test's p-value of a statistic of given rank."""
    left = nuisance.freedom - rank
    if left < 1 or rank == 0:
        return 1.0
    variance = max(nuisance.misfit - statistic, 1e-300) / left
    # An inflation is itself measured, on as many independent sums as there are frames.
    known = left if inflation == 1.0 else max(min(left, nuisance.shape[0] - 1), 1)
    return float(stats.f.sf(statistic / rank / variance / inflation, rank, known))


def basis(columns: Array, norms: Array) -> Array:
    """Return an orthonormal basis (rows, R) of columns (..., P), relative to original norms (P,).

    What has less than IDENTIFIABLE of its norm left is taken as nothing.
    """
    flat = flat_rows(columns) / np.maximum(norms, 1e-300)
    if not flat.shape[1]:
        return flat
    # Eigenvectors of the Gram matrix, twice: as orthonormal as a QR, and the rank shows.
    values, vectors = np.linalg.eigh(flat.T @ flat)
    kept = values > max(IDENTIFIABLE**2, 1e-13 * values[-1])
    q = flat @ (vectors[:, kept] / np.sqrt(values[kept]))
    values, vectors = np.linalg.eigh(q.T @ q)
    return np.asarray(q @ (vectors / np.sqrt(np.maximum(values, 1e-30))))


def _in_rows(flat: Array, shape: tuple[int, ...]) -> Array:
    return flat.reshape(*shape, flat.shape[-1])


def _norms(columns: Array) -> Array:
    return np.asarray(np.sqrt((columns**2).sum(axis=(0, 1))))


def landmark_crossings(
    place: Array, group: Index, frame_basis: Array, shared_basis: Array
) -> tuple[Array, Array]:
    """Return how columns by a landmark's place (L, m, 3) lie along bases (F, M, B), (F, M, K).

    group: the rows (L, m) of each landmark.  Returns (L, 3, F, B), frame by frame, and (L, 3, K).
    """
    frames, height, width = frame_basis.shape
    label, row = np.nonzero(group < frames * height)
    mine = place[label, row][:, :, None] * flat_rows(frame_basis)[group[label, row]][:, None, :]
    by_frame = np.zeros((len(group), frames, 3, width))
    np.add.at(by_frame, (label, group[label, row] // height), mine)
    shared = np.einsum('lma,lmk->lak', place, gather(shared_basis, group))
    return np.swapaxes(by_frame, 1, 2), shared


def landmark_information(
    place: Array, group: Index, frame_basis: Array, shared_basis: Array
) -> Array:
    """Return the information matrix (3 L, 3 L) of all landmarks' places, the bases projected out.

    Arguments as of `landmark_crossings`.
    """
    count = len(group)
    crossings = landmark_crossings(place, group, frame_basis, shared_basis)
    crossed = np.concatenate([part.reshape(3 * count, -1) for part in crossings], axis=-1)
    information = -crossed @ crossed.T
    blocks = information.reshape(count, 3, count, 3)
    blocks[np.arange(count), :, np.arange(count)] += np.swapaxes(place, -1, -2) @ place
    return np.asarray(information)


def block_basis(columns: Array) -> Array:
    """Orthonormal bases (B, M, 6) of each block's columns; zero columns where rank is missing."""
    scale = np.sqrt((columns**2).sum(axis=1, keepdims=True))
    u, s, _ = np.linalg.svd(columns / np.maximum(scale, 1e-300), full_matrices=False)
    return np.asarray(u * (s > 1e-9)[:, None, :])
