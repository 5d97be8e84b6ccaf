"""The yardstick: the likelihood-ratio test that is told which effect to look for.

Its algebra is its own: plain least squares beside what is free.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import optimize, stats

from benchmark.studies.blind_scene import Hidden, Scene
from fisheye_svp_ros.arrays import Array, flat_rows
from fisheye_svp_ros.diagnosis import SIGNIFICANCE
from fisheye_svp_ros.effects.base import Effect, Untestable
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.effects.target_effects import LandmarkSurveyEffect
from fisheye_svp_ros.mixed_model import group_basis
from fisheye_svp_ros.optics.lens import intrinsic_names
from fisheye_svp_ros.solve.rig_state import Linearization, RigState, group_by_frame

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


class LinearScene:
    """A scene linearised at the truth: what poses, rig and free intrinsics leave of image points.

    ideal (S, N, 2): image points without the hidden effects, px.
    """

    def __init__(self, scene: Scene, ideal: Array, held_out: bool = False) -> None:
        self.scene, self.ideal = scene, ideal
        self._chosen = scene.seen & (scene.held_out[scene.frame] == held_out)[:, None]
        data = group_by_frame(scene.table(ideal, held_out))
        frames = np.flatnonzero(scene.held_out == held_out)
        state = RigState(scene.trajectory.at(scene.times[frames]), scene.rig, scene.lens, ())
        free = intrinsic_names(scene.lens) if scene.free else ()
        self.linear = Linearization(data, state, free)
        self.nuisance = Nuisance(self.linear)

    def rows(self, moved: Array) -> Array:
        """Gather displacements (S, N, 2) of image points, px, as rows (F, M) over the noise."""
        views = self.linear.data.views
        values = np.where(views.used[..., None], moved[self._chosen][views.row], 0.0)
        return self.linear.data.blocks(values / self.scene.noise)

    def rms(self, moved: Array, outside: bool = False) -> float:
        """RMS of displacements, px; outside: of what the nuisance leaves of them."""
        rows = self.rows(moved)
        if outside:
            rows = self.nuisance.outside(rows[..., None])
        return float(np.sqrt((rows**2).sum() / self.nuisance.rows)) * self.scene.noise

    def pose_rms(self, seen: Array) -> float:
        """RMS of the 2-D residual of image points (S, N, 2), px, once the poses are fitted."""
        rows = self.nuisance.outside_blocks(self.rows(seen - self.ideal)[..., None])
        return float(np.sqrt(2 * (rows**2).sum() / self.nuisance.rows)) * self.scene.noise


def oracle_finds(
    linear: LinearScene, name: str, hidden: Hidden, amount: float, given: Array
) -> bool:
    """Whether the oracle finds an effect in the image points as they are handed over.

    It knows the effect and takes the form with the greatest power against what was hidden; its
    significance is divided by the numbers of effects and of forms, as that of the diagnosis is.
    """
    rows = linear.rows(given - linear.ideal)
    residual = linear.nuisance.outside(rows[..., None])[..., 0]
    level = SIGNIFICANCE / _testable(linear)
    if hidden.world:
        moved = hidden.world(linear.scene.world(), amount).image() - linear.ideal
        return _f_test(linear, name, linear.rows(moved), residual, level)
    if name == 'noise_vs_angle':
        return _growth_p_value(linear, residual) < level
    if name == 'wrong_ids':
        size = np.median(np.abs(residual[linear.linear.row_mask])) / 0.6745
        p = 2 * stats.norm.sf(np.abs(residual).max() / size) * linear.nuisance.rows
        return bool(p < level)
    return True  # rounded numbers show without a test


def _testable(linear: LinearScene) -> int:
    missing = 0
    for kind in CATALOGUE.values():
        try:
            kind.candidates(linear.linear.scene)
        except Untestable:
            missing += 1
    return len(CATALOGUE) - missing


def _forms(linear: LinearScene, name: str) -> tuple[Sequence[Effect], int]:
    """Return the forms of an effect and their number."""
    forms = CATALOGUE[name].candidates(linear.linear.scene)
    if name != LandmarkSurveyEffect.name:
        return forms, len(forms)
    often = forms[0].landmarks if isinstance(forms[0], LandmarkSurveyEffect) else ()
    return [LandmarkSurveyEffect((number,)) for number in often], 2 * len(often)


def _f_test(linear: LinearScene, name: str, moved: Array, residual: Array, level: float) -> bool:
    """F test of the form that has most power against displacements (F, M), over the noise."""
    nuisance = linear.nuisance
    forms, count = _forms(linear, name)
    signal = nuisance.outside(moved[..., None])[..., 0].ravel()
    best = (-1.0, False)
    for form in forms:
        columns = linear.linear.effect_columns(form) / linear.scene.noise
        q = basis(nuisance.outside(columns), np.sqrt((columns**2).sum(axis=(0, 1))))
        rank = q.shape[1]
        left = nuisance.freedom - rank
        limit = stats.f.isf(level / count, rank, left)
        power = float(stats.ncf.sf(limit, rank, left, ((q.T @ signal) ** 2).sum()))
        if power > best[0]:
            explained = ((q.T @ residual.ravel()) ** 2).sum()
            rest = (residual**2).sum() - explained
            best = power, bool(explained / rank > limit * rest / left)
    return best[1]


def _growth_p_value(linear: LinearScene, residual: Array) -> float:
    """Likelihood-ratio test of sigma(theta) = sigma0 exp(growth theta^2)."""
    used = linear.linear.row_mask
    theta = linear.linear.data.blocks(linear.linear.scene.theta[..., None] * np.ones(2))[used]
    z = theta**2 - np.mean(theta**2)
    e2 = residual[used] ** 2

    def deviance(growth: float) -> float:
        return float(len(z) * np.log(np.mean(e2 * np.exp(-2 * growth * z))))

    best = optimize.minimize_scalar(deviance, bounds=(-3.0, 3.0), method='bounded')
    return float(stats.chi2.sf(max(deviance(0.0) - float(best.fun), 0.0), 1))
