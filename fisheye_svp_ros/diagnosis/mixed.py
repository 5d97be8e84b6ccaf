"""Henderson's mixed-model equations of a linearised state, solved block by block.

Rows are whitened; all matrices are in units of the noise variance, so the prior precision of a
coefficient is lambda = sigma^2 / tau^2.  Poses (fixed) and what single frames have of their own
make one block a frame, the offsets of a landmark one block of three; the larger of the two sets is
eliminated in a batch, the rest is one dense matrix.
Source: Henderson, Best linear unbiased estimation and prediction under a selection model,
Biometrics 31 (1975); Searle, Casella, McCulloch, Variance Components (1992), chapter 7.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from scipy import linalg

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.diagnosis.products import Blocks, arranged, multiplied
from fisheye_svp_ros.diagnosis.random_effects import NAMES, Design

FIXED, ABSENT = -1, -2  # labels: without a prior; not there
_RIDGE = 1e-10  # of a pose's normalised columns: known poses have none
_NEVER = 1e12
_UNTOLD = 1e-5  # of a column's own information, where rounding has made the whole indefinite


def solve_lower(root: Array, right: Array, trans: Literal[0, 1] = 0) -> Array:
    """Solve triangular equations; where there are none, LAPACK of an older SciPy refuses them."""
    if not len(root):
        return right
    return np.asarray(
        linalg.solve_triangular(root, right, lower=True, trans=trans, check_finite=False))


@dataclass(frozen=True)
class Equations:
    """The mixed-model equations before any variance is known.

    by_frame: whether frames are the eliminated blocks; rows: numbers in the residual; poses: fixed
    coefficients of the frames; pose_scale (F, 6): norms that pose columns were divided by; width:
    coefficients of one frame; landmarks: those that have offsets.
    """

    blocks: Blocks
    by_frame: bool
    rows: int
    poses: int
    pose_scale: Array
    width: int
    landmarks: Index

    def bordered(self, basis: Array) -> Equations:
        """Return the equations with combinations (X - 1, m) of the fixed columns as border."""
        full = linalg.block_diag(basis, np.eye(1))
        b = self.blocks
        parts = b._replace(ex=b.ex @ full, rx=b.rx @ full, xx=full.T @ b.xx @ full)
        return replace(self, blocks=parts)

    def kept(self, alive: Mask) -> tuple[Mask, Mask, Mask]:
        """Return which blocks (E,), columns of them (k,) and of the rest (R,) are there.

        alive: the components that are; a landmark keeps its three places if it has any.
        """
        b, known = self.blocks, np.concatenate([alive, [False, True]])
        rest = known[b.r_label]
        if not self.by_frame:
            return np.asarray(known[b.e_label].any(axis=1)), np.ones(3, dtype=bool), rest
        own = rest[len(rest) - 3 * len(self.landmarks) :].reshape(-1, 3).any(axis=1)
        rest[len(rest) - 3 * len(self.landmarks) :] = np.repeat(own, 3)
        return np.ones(len(b.ee), dtype=bool), known[b.e_label[0]], rest

    def trimmed(self, alive: Mask) -> Equations:
        """Return the equations without the coefficients of some components."""
        b, known = self.blocks, np.concatenate([alive, [False, True]])
        blocks, e, r = self.kept(alive)
        if all(part.all() for part in (known[b.e_label], known[b.r_label])):
            return self
        if self.by_frame:
            width = int(e.sum())
            left = r[len(r) - 3 * len(self.landmarks) :].reshape(-1, 3).any(axis=1)
        else:
            width = int(r[: len(self.pose_scale) * self.width].sum()) // len(self.pose_scale)
            left = blocks
        parts = Blocks(
            b.ee[np.ix_(blocks, e, e)], b.er[np.ix_(blocks, e, r)], b.rr[np.ix_(r, r)],
            b.ex[np.ix_(blocks, e)], b.rx[r], b.xx,
            np.where(known[b.e_label], b.e_label, ABSENT)[np.ix_(blocks, e)],
            np.where(known[b.r_label], b.r_label, ABSENT)[r],
        )
        return replace(self, blocks=parts, width=width, landmarks=self.landmarks[left])

    def at_the_border(self, kind: int) -> Equations:
        """Return the equations with a component of the rest in front of the border, no prior."""
        b, mine = self.blocks, self.blocks.r_label == kind
        parts = Blocks(
            b.ee, b.er[..., ~mine], b.rr[np.ix_(~mine, ~mine)],
            np.concatenate([b.er[..., mine], b.ex], axis=-1),
            np.concatenate([b.rr[np.ix_(~mine, mine)], b.rx[~mine]], axis=-1),
            np.block([[b.rr[np.ix_(mine, mine)], b.rx[mine]], [b.rx[mine].T, b.xx]]),
            b.e_label, b.r_label[~mine],
        )
        return replace(self, blocks=parts)

    def times(self, e: Array, r: Array) -> tuple[Array, Array, Array]:
        """Multiply coefficients (E, k, C), (R, C): products with blocks, rest and border."""
        b = self.blocks
        flat = e.reshape(-1, e.shape[-1])
        return (
            b.ee @ e + b.er @ r,
            b.er.reshape(len(flat), len(r)).T @ flat + b.rr @ r,
            b.ex.reshape(len(flat), len(b.xx)).T @ flat + b.rx.T @ r,
        )

    def placed(self, frame: Array, landmark: Array, shared: Array) -> tuple[Array, Array]:
        """Put what belongs to coefficients where they stand: e (E, k), r (R,); see `sorted`.

        frame (F, b), landmark (L, 3) of all landmarks, shared (Q,).
        """
        landmark = landmark[self.landmarks]
        if self.by_frame:
            return frame, np.concatenate([shared, landmark.ravel()])
        return landmark, np.concatenate([frame.ravel(), shared])

    def sorted(self, e: Array, r: Array) -> tuple[Array, Array, Array]:
        """Sort coefficients (E, k, ...), (R, ...): by frame (F, b, ...), by landmark, shared."""
        if self.by_frame:
            count = len(r) - 3 * len(self.landmarks)
            return e, r[count:].reshape(len(self.landmarks), 3, *r.shape[1:]), r[:count]
        count = len(self.pose_scale) * self.width
        return r[:count].reshape(len(self.pose_scale), self.width, *r.shape[1:]), e, r[count:]


def equations(design: Design, pose: Array, border: Array) -> Equations:
    """Multiply out the columns of a design, of poses (F, M, 6) and of a border (F, M, X)."""
    scale = np.sqrt((pose**2).sum(axis=1))
    scale = np.where(scale < 1e-9, np.inf, scale)
    products = multiplied(design, pose / scale[:, None], border)
    width, six = products.ff.shape[-1], np.arange(6)
    products.ff[:, six, six] += np.where(np.isfinite(scale), _RIDGE, 1.0)
    l_label = np.where(design.landmark_label < 0, ABSENT, design.landmark_label)
    # Bumps of single frames are many, and seldom there.
    seldom = int((design.frame_label == NAMES.index('frame_bumps')).sum())
    by_frame = len(pose) * (width - seldom) >= l_label.size
    f_label = np.concatenate([np.full(6, FIXED), design.frame_label])
    blocks = arranged(
        products, np.broadcast_to(f_label, (len(pose), width)), l_label, design.shared_label,
        by_frame,
    )
    rows = int((np.abs(pose).sum(axis=-1) + np.abs(border).sum(axis=-1) > 0).sum())
    poses = int(np.isfinite(scale).sum())
    return Equations(blocks, by_frame, rows, poses, scale, width, np.arange(len(l_label)))


@dataclass(frozen=True)
class Factored:
    """The equations with given variances, factored.

    inverse (E, k, k): of the blocks' Cholesky factors; coupled (E, k, R), block_border (E, k, X),
    border (R, X): right-hand sides after their forward substitution; factor (R, R), lower;
    information (X, X): of the border, everything else eliminated.
    """

    equations: Equations
    precision: tuple[Array, Array]
    inverse: Array
    coupled: Array
    block_border: Array
    factor: Array
    border: Array
    information: Array

    @property
    def freedom(self) -> int:
        """Numbers in the residual less fixed coefficients, the border's and those of poses."""
        return self.equations.rows - self.equations.poses - len(self.information) + 1

    @cached_property
    def root(self) -> Array:
        """Lower root of the information of the fixed columns.

        What random parts have all but taken up stays where it is.
        """
        info = self.information[:-1, :-1]
        try:
            return np.asarray(np.linalg.cholesky(info))
        except np.linalg.LinAlgError:
            return np.asarray(np.linalg.cholesky(info + _UNTOLD * np.diag(np.diag(info))))

    @cached_property
    def log_determinant(self) -> float:
        """Of the covariance of the numbers over the noise variance, poses projected out."""
        e, r = self.precision
        priors = np.concatenate([e.ravel(), r])
        logs = log_square(self.factor) - log_square(self.inverse)
        return float(logs - np.log(priors[priors > 0]).sum())

    def coefficients(self, way: Array) -> tuple[Array, Array]:
        """Return the coefficients (E, k), (R,) that follow a combination (X,) of the border."""
        r = solve_upper(self.factor, self.border @ way)
        right = self.block_border @ way - self.coupled @ r
        return (np.swapaxes(self.inverse, -1, -2) @ right[..., None])[..., 0], r

    def solved(self, e: Array, r: Array, x: Array) -> tuple[Array, Array, Array]:
        """Return the coefficients (E, k, C), (R, C), (X, C) of vectors with such products."""
        first = self.inverse @ e
        flat = first.reshape(-1, first.shape[-1])
        second = r - self.coupled.reshape(len(flat), len(r)).T @ flat
        if len(second):
            second = solve_lower(self.factor, second)
        bent = self.block_border.reshape(len(flat), len(x) + 1)[:, :-1]
        third = x - bent.T @ flat - self.border[:, :-1].T @ second
        values = linalg.solve(self.information[:-1, :-1], third, assume_a='pos')
        rest = solve_upper(self.factor, second - self.border[:, :-1] @ values)
        right = first - self.block_border[..., :-1] @ values - self.coupled @ rest
        return np.swapaxes(self.inverse, -1, -2) @ right, rest, values

    def shares(self, e: Array, r: Array) -> Array:
        """Return the squares of coefficients over their prior variances, by component."""
        label = self.equations.blocks.label
        squares = np.concatenate([(self.precision[0] * e**2).ravel(), self.precision[1] * r**2])
        mine = label >= 0
        return np.asarray(
            np.bincount(label[mine], weights=squares[mine], minlength=len(NAMES)), dtype=float
        )

    def taken(self, e: Array, r: Array, x: Array | None) -> Array:
        """Return v' A (A' A + D)^-1 A' v (C, C) of vectors v.

        e (E, k, C), r (R, C): their products with the columns A; x (X, C): those with the border's
        fixed ones, None to leave these out.
        """
        first = self.inverse @ e
        flat = first.reshape(-1, first.shape[-1])
        second = r - self.coupled.reshape(len(flat), len(r)).T @ flat
        if len(second):
            second = solve_lower(self.factor, second)
        found = flat.T @ flat + second.T @ second
        if x is None:
            return np.asarray(found)
        bent = self.block_border.reshape(len(flat), len(x) + 1)[:, :-1]
        third = x - bent.T @ flat - self.border[:, :-1].T @ second
        last = linalg.solve(self.information[:-1, :-1], third, assume_a='pos')
        return np.asarray(found + third.T @ last)


def precisions(eq: Equations, lam: Array, weight: Array) -> tuple[Array, Array]:
    """Return prior precisions (E, k), (R,); weight (L,): factors of each landmark's."""
    table = np.concatenate([lam, [_NEVER, 0.0]])  # by label: ..., ABSENT (-2), FIXED (-1)
    e, r = table[eq.blocks.e_label], table[eq.blocks.r_label]
    if len(eq.landmarks):
        if eq.by_frame:
            r[-3 * len(eq.landmarks) :] *= np.repeat(weight[eq.landmarks], 3)
        else:
            e *= weight[eq.landmarks, None]
    return e, r


def factored(eq: Equations, lam: Array, weight: Array) -> Factored:
    """Factor the equations; lam (components,): sigma^2 / tau^2 of each."""
    b = eq.blocks
    e, r = precisions(eq, lam, weight)
    diagonal = np.arange(b.ee.shape[1])
    ee = b.ee.copy()
    ee[:, diagonal, diagonal] += e
    count, cut = e.size, len(e) // 2
    inverse, coupled, block_border = np.empty_like(ee), np.empty_like(b.er), np.empty_like(b.ex)

    def eliminated(part: slice) -> tuple[Array, Array]:
        inverse[part] = np.linalg.inv(np.linalg.cholesky(ee[part]))
        np.matmul(inverse[part], b.er[part], out=coupled[part])
        np.matmul(inverse[part], b.ex[part], out=block_border[part])
        flat = coupled[part].reshape(e[part].size, len(b.rr))
        return flat.T @ flat, flat.T @ block_border[part].reshape(len(flat), len(b.xx))

    # Two threads: most of the time goes here, and NumPy lets go of the interpreter.
    with ThreadPoolExecutor(2) as pool:
        first, second = pool.map(eliminated, (slice(cut), slice(cut, None)))
    rr, bent = b.rr - first[0] - second[0], block_border.reshape(count, len(b.xx))
    rr[np.diag_indices_from(rr)] += r
    if len(rr):
        factor = linalg.cholesky(rr, lower=True, overwrite_a=True, check_finite=False)
        border = solve_lower(factor, b.rx - first[1] - second[1])
    else:
        factor, border = rr, b.rx
    information = b.xx - bent.T @ bent - border.T @ border
    return Factored(eq, (e, r), inverse, coupled, block_border, factor, border, information)


def solve_upper(factor: Array, right: Array) -> Array:
    """Solve the equations of the transpose of a lower triangle."""
    if not len(factor):
        return right
    return solve_lower(factor, right, trans=1)


def log_square(root: Array) -> float:
    """Return the logarithm of the square of the determinant of triangular matrices."""
    diagonal = np.abs(np.diagonal(root, axis1=-2, axis2=-1))
    return 2 * float(np.log(np.maximum(diagonal, 1e-300)).sum())
