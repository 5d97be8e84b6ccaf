"""The yardstick: the likelihood-ratio test that is told which effect to look for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import optimize, stats

from benchmark.blind_hidden import Hidden
from benchmark.blind_projection import Nuisance, basis
from benchmark.blind_scene import Scene, World
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.diagnosis import SIGNIFICANCE
from fisheye_svp_ros.effects.base import Effect, Untestable
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.effects.target_effects import LandmarkSurveyEffect
from fisheye_svp_ros.optics.lens import intrinsic_names
from fisheye_svp_ros.solve.rig_state import Linearization, RigState, group_by_frame


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

    @staticmethod
    def angles(world: World) -> Array:
        """Incidence angles (S, N), rad, as far as scatter is concerned."""
        places = world.in_camera(world.points, world.times[:, None])
        off_axis = np.linalg.norm(places[..., :2], axis=-1)
        return np.asarray(np.arctan2(off_axis, places[..., 2]))


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
    if hidden.moves:
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


def _f_test(
    linear: LinearScene, name: str, moved: Array, residual: Array, level: float
) -> bool:
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
