"""Whether data are adequate, before any decision: what remains beside noise, what they reach.

Frames of different cameras, or of a camera that changes from frame to frame, fit no lens; points
amid the image say nothing of its edge.  Facts only; `reporting.wording.adequacy` has the words.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.causes import Cause
from fisheye_svp_ros.diagnosis.decision import Decision, PhotographsAnswer
from fisheye_svp_ros.diagnosis.effect_tests import SIGNIFICANCE
from fisheye_svp_ros.diagnosis.evaluation import Evaluation
from fisheye_svp_ros.diagnosis.findings import MAX_SHIFT, Finding, Flaw, FlawKind, Reason
from fisheye_svp_ros.diagnosis.random_effects import NAMES, SAG
from fisheye_svp_ros.diagnosis.variance_budget import Component
from fisheye_svp_ros.effects.recording_effects import FocalDriftEffect, SessionStepEffect
from fisheye_svp_ros.scene.boards import is_flat
from fisheye_svp_ros.scene.observations import frame_names
from fisheye_svp_ros.scene.table_checks import MAX_TARGET_SIZE, target_size
from fisheye_svp_ros.solve.frame_groups import MIN_GROUP, find_frame_groups
from fisheye_svp_ros.solve.lens_checks import image_coverage, is_no_fit
from fisheye_svp_ros.solve.mirrored_points import find_mirror
from fisheye_svp_ros.solve.ray_errors import RANGES, RayError

_FOCAL, _CENTER = 'frame_focal', 'frame_centre'
_MAX_FRAMES_RATIO = 3.0  # times noise and scatter: what frames may have of their own, of any form
_MAX_RAY_RATIO = 6.0  # times the noise of a point: how far off a ray may be within the data
_MIN_SIGMAS = 2.0
_MAX_SPREAD = 0.05  # of the variance between frames: more within groups, and they are none
_MAX_GROUPS = 3
_NEAR_RANGE = RANGES.index(1.0)


@dataclass(frozen=True)
class Adequacy:
    """What is wrong with the data, the worst first; reached: the angle of the points, rad."""

    flaws: tuple[Flaw, ...]
    reached: float

    @property
    def is_misfit(self) -> bool:
        """Whether more than noise is left, so that nothing is certain."""
        return any(flaw.kind.is_misfit for flaw in self.flaws)

    def revise(self, decisions: Mapping[str, Decision]) -> dict[str, Decision]:
        """Return decisions that reassure nobody where the data are not adequate."""
        if not self.flaws:
            return dict(decisions)
        again: PhotographsAnswer = 'retake' if self.is_misfit else 'more'
        revised = {
            name: replace(one, confidence=None, bound=[], flaws=self.flaws)
            for name, one in decisions.items()
        }
        for name in ('lens', 'target'):
            if self.is_misfit or revised[name].say == 'keep':
                revised[name] = replace(revised[name], say='undecided')
        if self.is_misfit or revised['photographs'].say == 'enough':
            revised['photographs'] = replace(revised['photographs'], say=again)
        return revised


def judge_data(
    evaluation: Evaluation,
    causes: Sequence[Cause],
    components: Sequence[Component],
    ray_errors: Mapping[str, Mapping[str, Sequence[RayError]]],
    candidates: Sequence[Finding],
) -> Adequacy:
    """Return what is wrong with the data of an evaluation; candidates: not confirmed."""
    linear = evaluation.simulation
    reached = float(np.nanmax(linear.scene.theta[linear.data.views.used]))
    flaws = [*_mirrors(evaluation), *_impossible_lengths(evaluation, candidates)]
    flaws += _misfits(evaluation, causes, components)
    if evaluation.free and evaluation.medium is None:
        flaws += _coverage(evaluation)
        if not any(flaw.kind.is_misfit for flaw in flaws):
            flaws += _unknown_rays(evaluation, ray_errors)
    flaws.sort(key=lambda flaw: flaw.kind.value)
    table = evaluation.problem.observations
    known = {frame for frame, _, _ in table.photographs}
    names = [
        tuple(
            tuple(name for frame in group if frame in known for name in frame_names(table, frame))
            for group in flaw.groups
        )
        for flaw in flaws
    ]
    return Adequacy(
        tuple(replace(flaw, names=one) for flaw, one in zip(flaws, names, strict=True)), reached
    )


def _mirrors(evaluation: Evaluation) -> Iterator[Flaw]:
    """Yield cameras whose points are mirror images of what they saw."""
    table, state = evaluation.problem.observations, evaluation.simulation.state
    for camera, name in enumerate(table.cameras):
        lens = state.lenses[camera if len(state.lenses) > 1 else 0]
        if mirror := find_mirror(table.take(table.camera == camera), lens):
            yield Flaw(FlawKind.MIRRORED, 0.0, 0.0, camera=name, mirror=mirror)


def _impossible_lengths(evaluation: Evaluation, candidates: Sequence[Finding]) -> Iterator[Flaw]:
    """Yield lengths that no board and no lens has.

    Landmarks that are no flat board may be those of a hall.
    """
    table = evaluation.problem.observations
    across = target_size(table)
    if across > MAX_TARGET_SIZE and is_flat(table.xyz):
        yield Flaw(FlawKind.TARGET_TOO_LARGE, across, MAX_TARGET_SIZE)
    for candidate in candidates:
        if candidate.reason is Reason.IMPLAUSIBLE:
            shift = next(abs(entry['value']) for entry in candidate.parameters.values())
            yield Flaw(FlawKind.SHIFT_TOO_LARGE, shift, MAX_SHIFT)


def _misfits(
    evaluation: Evaluation, causes: Sequence[Cause], components: Sequence[Component]
) -> Iterator[Flaw]:
    """Yield what no lens explains: more than noise is left, and it differs between frames."""
    scatter = evaluation.scatter_px
    frames = {
        part.name: part.sd_px / scatter
        for part in components
        if part.stage == 'frame'
        and part.name in NAMES
        and part.name != SAG
        and part.p_value * len(NAMES) < SIGNIFICANCE
    }
    total = float(np.hypot.reduce(list(frames.values()) or [0.0]))
    left = evaluation.figures.named.rms_px
    other = {name: of for name, of in frames.items() if name not in (_FOCAL, _CENTER)}
    shapeless = float(np.hypot.reduce(list(other.values()) or [0.0]))
    if shapeless > _MAX_FRAMES_RATIO:
        groups = _camera_groups(evaluation, scatter)
        kind = FlawKind.CAMERAS_MIXED if groups else FlawKind.FRAMES_DIFFER
        yield Flaw(kind, left, scatter, groups or _worst_frames(evaluation))
        return
    changes = _intrinsics_by_frame(evaluation, causes, frames)
    if changes is not None:
        yield _changing_intrinsics(evaluation, *changes, total)
    elif is_no_fit(left, scatter):
        yield Flaw(FlawKind.NO_FIT, left, scatter)


def _camera_groups(evaluation: Evaluation, noise: float) -> tuple[tuple[int, ...], ...]:
    """Return frames by the camera that they fit, none where no few cameras fit them."""
    data = evaluation.null.linear.data
    if data.cameras > 1:
        return ()
    views, lens = data.views, evaluation.simulation.state.lens
    places = np.nanmean(np.where(views.used[..., None], views.uv, np.nan), axis=1)
    found = find_frame_groups(views, (lens.width, lens.height), noise, [*places.T])
    return tuple(sorted(tuple(sorted(views.frame[group].tolist())) for group in found))


def _worst_frames(evaluation: Evaluation) -> tuple[tuple[int, ...], ...]:
    """Return the half of the frames that leaves more."""
    linear = evaluation.cause_fit
    squares = (linear.residual**2).sum(axis=1) / np.maximum(linear.row_mask.sum(axis=1), 1)
    worst = np.argsort(-squares)[: max(len(squares) // 2, 1)]
    return (tuple(evaluation.null.linear.data.frame_numbers[worst].tolist()),)


def _intrinsics_by_frame(
    evaluation: Evaluation, causes: Sequence[Cause], frames: Mapping[str, float]
) -> tuple[Array, Array] | None:
    """Return relative focal lengths (F,) and centers (F, 2), px; None where they are alike.

    By random effects that are larger than noise, and by named changes that are larger than those
    of a camera at rest (`Parameter.large`).
    """
    focal, center = _named_changes(evaluation, causes)
    if any(frames.get(name, 0.0) > 1.0 for name in (_FOCAL, _CENTER)):
        own = _own_coefficients(evaluation)
        focal = focal + own[_FOCAL].sum(axis=1) / _radius(evaluation)
        center = center + own[_CENTER].reshape(len(center), -1, 2).sum(axis=1)
    return (focal, center) if focal.any() or center.any() else None


def _own_coefficients(evaluation: Evaluation) -> dict[str, Array]:
    """Return what frames are predicted to have of their own (F, B), px, by component."""
    fitted = evaluation.fitted
    group = fitted.factored.equations.split(fitted.solution.e, fitted.solution.r)[0]
    label = fitted.random.columns.group_label  # after the columns of the pose
    own = group[:, group.shape[1] - len(label) :]
    return {name: own[:, label == NAMES.index(name)] for name in (_FOCAL, _CENTER)}


def _radius(evaluation: Evaluation) -> float:
    """Return half the larger extent of the points, px: the unit of `random_effects`."""
    views = evaluation.null.linear.data.views
    return float(np.ptp(views.uv[views.used], axis=0).max()) / 2


def _named_changes(evaluation: Evaluation, causes: Sequence[Cause]) -> tuple[Array, Array]:
    """Return what large named changes add to focal lengths (F,) and centers (F, 2), px."""
    linear = evaluation.null.linear
    count = linear.data.frames
    focal, center = np.zeros(count), np.zeros((count, 2))
    named = {cause.effect for cause in causes}
    first = linear.data.first_views
    for term in linear.state.terms:
        effect, values = term.effect, term.values
        if effect.name not in named:
            continue
        if isinstance(effect, SessionStepEffect):
            steps = values.reshape(-1, 3)
            if _is_large(effect, values, evaluation):
                after = effect.step_design(linear.scene)[first]
                focal, center = focal + after @ steps[:, 0], center + after @ steps[:, 1:]
        elif isinstance(effect, FocalDriftEffect) and _is_large(effect, values, evaluation):
            focal = focal + effect.relative_change(linear.scene)[first] @ values
    return focal, center


def _is_large(
    effect: FocalDriftEffect | SessionStepEffect, values: Array, evaluation: Evaluation
) -> bool:
    """Whether a change is larger than any of a camera at rest, beyond its error."""
    columns = next(term.columns for term in evaluation.null.terms if term.name == effect.name)
    large = np.array([parameter.large for parameter in effect.parameters])
    least = np.abs(values) - _MIN_SIGMAS * evaluation.errors[columns]
    return bool((least > large).any())


def _changing_intrinsics(
    evaluation: Evaluation, focal: Array, center: Array, ratio: float
) -> Flaw:
    """Return which of the intrinsics change more, by how much, and in which frames."""
    numbers, radius = evaluation.null.linear.data.frame_numbers, _radius(evaluation)
    shift = float(np.sqrt(center.var(axis=0).sum()))
    values = np.column_stack([focal * radius, center])
    groups = tuple(tuple(numbers[group].tolist()) for group in _clusters(values))
    if shift > float(focal.std()) * radius:
        kind = FlawKind.CAMERAS_MIXED if groups else FlawKind.CENTER_VARIES
        if groups:
            named = evaluation.figures.named.rms_px
            return Flaw(kind, named, evaluation.noise_px, groups)
        far = np.linalg.norm(center - center.mean(axis=0), axis=1)
        return Flaw(kind, shift, ratio, (tuple(numbers[np.argsort(-far)].tolist()),))
    order = np.argsort(focal)
    third = max(len(order) // 3, 1)
    ends = (tuple(sorted(numbers[order[:third]])), tuple(sorted(numbers[order[-third:]])))
    plain = tuple(tuple(int(n) for n in end) for end in ends)
    return Flaw(FlawKind.FOCAL_VARIES, float(np.ptp(focal)), ratio, groups or plain)


def _clusters(values: Array) -> list[Index]:
    """Return few groups (of MIN_GROUP and more) that hold nearly all variance of values (F, 3)."""
    total = float(((values - values.mean(axis=0)) ** 2).sum())
    for count in range(2, _MAX_GROUPS + 1):
        if len(values) < count * MIN_GROUP:
            break
        middles, label = scipy.cluster.vq.kmeans2(values, count, minit='++', seed=0, iter=30)
        within = float(((values - middles[label]) ** 2).sum())
        groups = [np.flatnonzero(label == cluster) for cluster in range(count)]
        if within < _MAX_SPREAD * total and min(map(len, groups)) >= MIN_GROUP:
            return sorted(groups, key=lambda group: int(group[0]))
    return []


def _coverage(evaluation: Evaluation) -> Iterator[Flaw]:
    """Yield what calibrate says of the image of each camera, too."""
    linear = evaluation.simulation
    data, views, state = linear.data, linear.data.views, linear.state
    for camera, lens in enumerate(state.lenses):
        mine = views.used & ((data.camera_of == camera) | (len(state.lenses) == 1))[:, None]
        image, name = image_coverage(lens, views.uv[mine]), state.labels[camera]
        if image.is_extrapolated:
            reached = float(np.nanmax(linear.scene.theta[mine]))
            yield Flaw(FlawKind.ANGLE_SHORT, reached, lens.max_incidence, camera=name)
        if image.is_off_center:
            yield Flaw(FlawKind.OFF_CENTER, *image.offset, camera=name)


def _unknown_rays(
    evaluation: Evaluation, ray_errors: Mapping[str, Mapping[str, Sequence[RayError]]]
) -> Iterator[Flaw]:
    """Yield cameras whose rays are unknown even where there are points."""
    lenses = evaluation.problem.inputs.lenses
    for name, sides in ray_errors.items():
        error = sides['extended'][_NEAR_RANGE].value
        point = evaluation.scatter_px / lenses[name].fx
        if error > _MAX_RAY_RATIO * point:
            yield Flaw(FlawKind.LENS_UNKNOWN, error, point, camera=name)
