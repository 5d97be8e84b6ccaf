"""Screening: every effect of the catalogue, in all its forms, by score test."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.correlation import Correlation
from fisheye_svp_ros.diagnosis.model import Linearised, gather, landmark_groups
from fisheye_svp_ros.diagnosis.projection import (
    IDENTIFIABLE,
    Nuisance,
    Score,
    landmark_crossings,
    landmark_information,
    p_value,
    score,
)
from fisheye_svp_ros.effects.base import Effect, Untestable
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.effects.landmark_survey import MIN_VIEWS, LandmarkSurveyEffect
from fisheye_svp_ros.effects.session_step import SessionStepEffect


@dataclass(frozen=True)
class Candidate:
    """One form of one effect with its test.

    corrected: the p-value times the number of effects and of this effect's forms; merit: how much
    better the data are described, less what that many parameters do by chance (BIC).
    """

    effect: Effect
    score: Score
    corrected: float
    merit: float


@dataclass(frozen=True)
class Screening:
    """All candidates, best merit first; effects that cannot be tested, with the reason."""

    candidates: tuple[Candidate, ...]
    untestable: dict[str, str]

    def eligible(self, significance: float) -> list[Candidate]:
        """Return the candidates whose corrected p-value is below the significance."""
        return [c for c in self.candidates if c.corrected < significance]

    def best(self, name: str) -> Candidate | None:
        """Return the form of an effect with the best merit."""
        return next((c for c in self.candidates if c.effect.name == name), None)


def screen(
    linear: Linearised, nuisance: Nuisance, correlation: Correlation,
    names: Sequence[str] | None = None,
) -> Screening:
    """Test every effect that moves predictions (or only those named) on top of a state."""
    forms: dict[str, Sequence[Effect]] = {}
    untestable: dict[str, str] = {}
    for name, kind in CATALOGUE.items():
        if kind.stage == 'noise' or (names is not None and name not in names):
            continue
        try:
            forms[name] = kind.candidates(linear.scene)
        except Untestable as why:
            untestable[name] = str(why)
    effects = len(CATALOGUE) - len(untestable) if names is None else len(names)
    found: list[Candidate] = []
    for name, several in forms.items():
        if name == SessionStepEffect.name and _is_quick(nuisance, correlation):
            tested = single_steps(linear, nuisance, several)
        else:
            tested = [
                (effect, _test(linear, nuisance, correlation, effect), len(several))
                for effect in several
            ]
        if name == LandmarkSurveyEffect.name and nuisance.frame_basis is not None:
            tested = [(effect, result, 2) for effect, result, _ in tested]
            tested += single_landmarks(linear, nuisance)
            if linear.data.displaced:
                together = LandmarkSurveyEffect(linear.data.displaced)
                tested.append((together, _test(linear, nuisance, correlation, together), 2))
        if all(result.rank == 0 for _, result, _ in tested):
            untestable[name] = 'what it would do is taken up by what is free already'
        for effect, result, count in tested:
            corrected = min(1.0, result.p_value * effects * count)
            found.append(Candidate(effect, result, corrected, merit(nuisance, result)))
    found.sort(key=lambda candidate: -candidate.merit)
    return Screening(tuple(found), untestable)


def merit(nuisance: Nuisance, result: Score) -> float:
    """Return twice the gain in log likelihood less the charge of the Bayesian criterion."""
    left = max(nuisance.misfit - result.statistic, 1e-12 * nuisance.misfit)
    gain = nuisance.freedom * np.log(nuisance.misfit / left)
    return float(gain - result.rank * np.log(nuisance.rows))


def _test(
    linear: Linearised, nuisance: Nuisance, correlation: Correlation, effect: Effect
) -> Score:
    if isinstance(effect, LandmarkSurveyEffect) and effect.everywhere:
        return _all_landmarks(linear, nuisance, effect)
    columns = linear.effect_columns(effect)
    result = score(nuisance, columns, correlation.inflation)
    bounded = [
        value < 0 for value, parameter in zip(result.estimate, effect.parameters, strict=True)
        if parameter.positive
    ]
    # A size that comes out negative where only a positive one has a meaning explains nothing.
    return result._replace(p_value=1.0, statistic=0.0) if any(bounded) else result


def _all_landmarks(
    linear: Linearised, nuisance: Nuisance, effect: LandmarkSurveyEffect
) -> Score:
    nothing = np.zeros(len(effect.parameters))
    if nuisance.frame_basis is None or nuisance.freedom < 1.5 * len(nothing):
        return Score(0.0, 0, 1.0, nothing, 1.0)
    group, mine = _places(linear)
    information = landmark_information(
        mine, group, nuisance.frame_basis, nuisance.shared_basis
    )
    scale = np.sqrt(np.maximum((mine**2).sum(axis=1).ravel(), 1e-300))
    values, vectors = np.linalg.eigh(information / scale / scale[:, None])
    kept = values > IDENTIFIABLE**2
    gradient = _gradient(nuisance, group, mine).ravel() / scale
    statistic = float(((vectors[:, kept].T @ gradient) ** 2 / values[kept]).sum())
    rank = int(kept.sum())
    return Score(statistic, rank, p_value(nuisance, statistic, rank), nothing)


def _is_quick(nuisance: Nuisance, correlation: Correlation) -> bool:
    """Whether sums over single frames are enough for a test."""
    return nuisance.frame_basis is not None and not correlation.dependent


def single_steps(
    linear: Linearised, nuisance: Nuisance, steps: Sequence[Effect]
) -> list[tuple[Effect, Score, int]]:
    """Test a step of the intrinsics at each instant by itself, all at once.

    What a step explains is a matter of sums over the frames after it.
    """
    poses = nuisance.frame_basis
    assert poses is not None
    starts = np.array([step.starts[0] for step in steps if isinstance(step, SessionStepEffect)])
    first = replace(steps[0], starts=(-np.inf,))  # type: ignore[call-arg]
    place = linear.effect_columns(first)
    clean = place - poses @ (np.swapaxes(poses, -1, -2) @ place)
    across = np.swapaxes(clean, -1, -2)
    views = linear.data.views
    instant = linear.scene.times if np.isfinite(linear.scene.times).all() else views.frame
    instant = instant[np.unique(linear.data.frame_of, return_index=True)[1]]
    # (A, F): which frames come after a step; sums over them of what is outside the nuisance.
    after = (instant >= starts[:, None]).astype(float)
    shared = np.tensordot(after, across @ nuisance.shared_basis, 1)
    own = np.tensordot(after, across @ clean, 1) - shared @ np.swapaxes(shared, -1, -2)
    gradient = np.tensordot(after, (across @ nuisance.residual[..., None])[..., 0], 1)
    norms = np.sqrt(np.maximum(after @ (place**2).sum(axis=1), 1e-300))
    values, vectors = np.linalg.eigh(own / norms[:, None] / norms[..., None])
    inverse = np.where(values > IDENTIFIABLE**2, 1 / np.maximum(values, IDENTIFIABLE**2), 0.0)
    along = (gradient / norms)[:, None] @ vectors
    statistic = (along[:, 0] ** 2 * inverse).sum(axis=1)
    estimate = (vectors @ (along[:, 0] * inverse)[..., None])[..., 0] / norms
    return [
        (
            step,
            Score(float(size), int(rank), p_value(nuisance, float(size), int(rank)), values_),
            len(steps),
        )
        for step, size, rank, values_ in zip(
            steps, statistic, (inverse > 0).sum(axis=1), estimate, strict=True
        )
    ]


def single_landmarks(
    linear: Linearised, nuisance: Nuisance
) -> list[tuple[Effect, Score, int]]:
    """Test the displacement of each landmark by itself, all at once.

    Every score needs only the rows of its own landmark: the nuisance enters through its basis.
    Each frame shows a landmark once, so what a frame's residuals share does not add up here.
    """
    assert nuisance.frame_basis is not None
    rows = linear.rows
    group, mine = _places(linear)
    taken = landmark_crossings(mine, group, nuisance.frame_basis, nuisance.shared_basis)
    own = np.swapaxes(mine, -1, -2) @ mine
    for part in taken:
        flat = part.reshape(len(group), 3, -1)
        own -= flat @ np.swapaxes(flat, -1, -2)
    gradient = _gradient(nuisance, group, mine)
    estimate = (np.linalg.pinv(own, rcond=1e-6, hermitian=True) @ gradient[..., None])[..., 0]
    statistic = np.einsum('la,la->l', estimate, gradient)
    ids = rows.landmark.ravel()[group[:, 0]]
    frame = np.where(group < rows.landmark.size, group // rows.landmark.shape[1], -1)
    views = np.array([len(np.unique(mine[mine >= 0])) for mine in frame])
    return [
        (
            LandmarkSurveyEffect((int(ids[i]),)),
            Score(
                float(statistic[i]), 3, p_value(nuisance, float(statistic[i]), 3), estimate[i]
            ),
            2 * len(group),
        )
        for i in np.flatnonzero(views >= MIN_VIEWS)
    ]


def _places(linear: Linearised) -> tuple[Index, Array]:
    """Return the rows (L, m) of each landmark and their columns (L, m, 3) by its place."""
    group = landmark_groups(linear.rows.landmark, linear.rows.used)
    return group, gather(linear.whitened(linear.linear.d_target), group)


def _gradient(nuisance: Nuisance, group: Index, place: Array) -> Array:
    """Return how residuals pull at each landmark's place (L, 3)."""
    residual = gather(nuisance.residual[..., None], group)
    return np.asarray(np.swapaxes(place, -1, -2) @ residual)[..., 0]


def transferred(old: Effect, values: Array, new: Effect) -> Array:
    """Return start values of a form of an effect from another form's, by parameter name."""
    known = dict(zip((p.name for p in old.parameters), values, strict=True))
    return np.array([known.get(parameter.name, 0.0) for parameter in new.parameters])
