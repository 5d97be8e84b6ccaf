"""Plain least squares beside what is free: the yardstick's own algebra."""

from __future__ import annotations

import numpy as np

from fisheye_svp_ros.arrays import Array, flat_rows
from fisheye_svp_ros.mixed_model import group_basis
from fisheye_svp_ros.solve.rig_state import Linearization

IDENTIFIABLE = 1e-4  # of a column's norm: what is left less cannot be told from what is free


class Nuisance:
    """The space of what is free: poses, rig, intrinsics.

    residual (F, M): the whitened residual outside that space; rows, rank: its dimensions.
    """

    def __init__(self, linear: Linearization) -> None:
        self.shape = linear.residual.shape
        self.rows = int(linear.row_mask.sum())
        self._blocks = group_basis(linear.frame_columns)
        norms = np.sqrt((linear.shared_columns**2).sum(axis=(0, 1)))
        self._shared = basis(self.outside_blocks(linear.shared_columns), norms)
        blocks = int((np.abs(self._blocks).sum(axis=1) > 0).sum())
        self.rank = blocks + self._shared.shape[-1]
        self.residual = self.outside(linear.residual[..., None])[..., 0]

    @property
    def freedom(self) -> int:
        """Degrees of freedom of the residual."""
        return self.rows - self.rank

    def outside(self, columns: Array) -> Array:
        """Return columns (F, M, P) less their part inside the space."""
        flat = flat_rows(self.outside_blocks(columns))
        return (flat - self._shared @ (self._shared.T @ flat)).reshape(columns.shape)

    def outside_blocks(self, columns: Array) -> Array:
        """Return columns (F, M, P) less what poses take up of them."""
        return columns - self._blocks @ (np.swapaxes(self._blocks, -1, -2) @ columns)


def basis(columns: Array, norms: Array) -> Array:
    """Return an orthonormal basis (rows, R) of columns (F, M, P), relative to norms (P,)."""
    flat = flat_rows(columns) / np.maximum(norms, 1e-300)
    u, s, _ = np.linalg.svd(flat, full_matrices=False)
    return np.asarray(u[:, s > IDENTIFIABLE])
