"""Whether data are adequate, before any decision: what remains beside noise, what they reach.

Frames of different cameras, or of a camera that changes from frame to frame, fit no lens; points
amid the image say nothing of its edge.  Facts only; `reporting.wording.adequacy` has the words.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from scipy import special

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.causes import Cause
from fisheye_svp_ros.diagnosis.decision import MIN_FRAMES, Decision, PhotographsAnswer
from fisheye_svp_ros.diagnosis.evaluation import Evaluation
from fisheye_svp_ros.diagnosis.findings import MAX_SHIFT, Finding, Flaw, FlawKind, Reason
from fisheye_svp_ros.diagnosis.frame_changes import FrameChanges, find_frame_changes
from fisheye_svp_ros.diagnosis.variance_budget import Component
from fisheye_svp_ros.scene.boards import is_flat
from fisheye_svp_ros.scene.observations import frame_names
from fisheye_svp_ros.scene.table_checks import MAX_TARGET_SIZE, target_size
from fisheye_svp_ros.solve.frame_groups import MIN_GROUP, find_frame_groups
from fisheye_svp_ros.solve.lens_checks import image_coverage, is_no_fit
from fisheye_svp_ros.solve.mirrored_points import Mirror, find_mirror
from fisheye_svp_ros.solve.ray_errors import MAX_RAY_ERROR, RANGES, RayError

_MAX_SPREAD = 0.05  # of the variance between frames: more within groups, and they are none
_MAX_GROUPS = 3
_MAX_NOISE = 1.0  # px: detectors of corners leave .02 to .3, those of blurred tags .5
_MIN_SINE = 0.1  # of the angle between a line of sight and a board, to tell its sides apart
_NEAR_RANGE = RANGES.index(1.0)
_SURE = 1.96  # standard errors: 97.5 % of a normal distribution on one side


@dataclass(frozen=True)
class Adequacy:
    """What is wrong with the data, the worst first.

    reached: the angle of the points, rad; frames_error: rms angle, rad, by which rays of a single
    frame differ from those of the lens.
    """

    flaws: tuple[Flaw, ...]
    reached: float
    frames_error: float = 0.0

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
    rays: Mapping[str, Sequence[RayError]],
    candidates: Sequence[Finding],
) -> Adequacy:
    """Return what is wrong with the data of an evaluation.

    rays: expected errors of the lens that is to be used, by camera; candidates: not confirmed.
    """
    linear = evaluation.simulation
    reached = float(np.nanmax(linear.scene.theta[linear.data.views.used]))
    changes = find_frame_changes(evaluation, causes, components)
    flaws = [*_mirrors(evaluation), *_impossible_lengths(evaluation, candidates)]
    flaws += _misfits(evaluation, changes, components, are_rays_known(rays))
    flaws += _differing_sides(evaluation)
    if evaluation.noise_px > _MAX_NOISE:
        flaws.append(Flaw(FlawKind.NOISE_TOO_LARGE, evaluation.noise_px, _MAX_NOISE))
    if evaluation.free and evaluation.medium is None:
        if evaluation.frames < MIN_FRAMES:
            flaws.append(Flaw(FlawKind.FEW_FRAMES, evaluation.frames, MIN_FRAMES))
        flaws += _coverage(evaluation)
        if not any(flaw.kind.is_misfit for flaw in flaws):
            flaws += _unknown_rays(rays, changes.ray_error)
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
        tuple(replace(flaw, names=one) for flaw, one in zip(flaws, names, strict=True)),
        reached,
        changes.ray_error,
    )


def _mirrors(evaluation: Evaluation) -> Iterator[Flaw]:
    """Yield cameras whose points are mirror images of what they saw."""
    table, state = evaluation.problem.observations, evaluation.simulation.state
    for camera in np.unique(table.camera).tolist():  # some of a table's may have seen nothing
        lens = state.lenses[camera if len(state.lenses) > 1 else 0]
        mirror = find_mirror(table.take(table.camera == camera), lens)
        if mirror and mirror != Mirror.Y_UPWARDS:
            name = table.cameras[camera]
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
            shift = next(iter(candidate.parameters.values()))
            # One that only stands against another effect may be anything.
            if abs(shift['value']) - _SURE * shift['stderr'] > MAX_SHIFT:
                yield Flaw(FlawKind.SHIFT_TOO_LARGE, abs(shift['value']), MAX_SHIFT)


def _differing_sides(evaluation: Evaluation) -> Iterator[Flaw]:
    """Yield that frames see a flat board from its two sides, which a printed one has not.

    Corners that are numbered in mirrored order fit as well as others, from behind.
    """
    table, linear = evaluation.problem.observations, evaluation.simulation
    if not is_flat(table.xyz):
        return
    middle = table.xyz.mean(axis=0)
    normal = np.linalg.svd(table.xyz - middle, full_matrices=False)[2][-1]
    away = linear.state.pose.position - middle
    sine = away @ normal / np.linalg.norm(away, axis=1)
    front, back = sine > _MIN_SINE, sine < -_MIN_SINE
    if front.any() and back.any():
        fewer = min(front, back, key=np.count_nonzero)
        frames = tuple(linear.data.frame_numbers[fewer].tolist())
        yield Flaw(FlawKind.SIDES_DIFFER, len(frames), len(sine), (frames,))


def _misfits(
    evaluation: Evaluation, changes: FrameChanges, components: Sequence[Component], known: bool
) -> Iterator[Flaw]:
    """Yield what no one lens is meant by: frames of several cameras, or of one that changes.

    A board that bends from frame to frame is no reason: what it costs the lens is in its errors.
    known: whether these are small; then fields that frames have of their own are no reason either.
    """
    focal = next(iter(evaluation.problem.inputs.lenses.values())).fx
    frames = float(np.hypot.reduce([p.sd_px for p in components if p.stage == 'frame'] or [0.0]))
    left, scatter = evaluation.figures.named.rms_px, evaluation.scatter_px
    differ = max(changes.warp_error, changes.shapeless_error) > MAX_RAY_ERROR
    if differ or frames > MAX_RAY_ERROR * focal:
        groups = _camera_groups(evaluation, scatter)
        if groups:
            yield Flaw(FlawKind.CAMERAS_MIXED, left, scatter, groups)
            return
    least = _least_share(len(changes.focal))
    if least * max(changes.focal_error, changes.center_error) > MAX_RAY_ERROR:
        yield _changing_intrinsics(evaluation, changes)
    elif differ and not known:
        yield Flaw(FlawKind.FRAMES_DIFFER, left, scatter, _worst_frames(evaluation))
    elif is_no_fit(left, scatter):
        yield Flaw(FlawKind.NO_FIT, left, scatter)


def _least_share(frames: int) -> float:
    """Return what share of a standard deviation over some frames is sure (95 %), by chi-square."""
    dof = max(frames - 1, 1)
    return float(np.sqrt(dof / special.chdtri(dof, 0.05)))


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


def _changing_intrinsics(evaluation: Evaluation, changes: FrameChanges) -> Flaw:
    """Return which of the intrinsics change more, by how much, and in which frames."""
    numbers = evaluation.null.linear.data.frame_numbers
    focal, center = changes.focal, changes.center
    lens = evaluation.null.linear.state.lens
    values = np.column_stack([focal * min(lens.width, lens.height) / 2, center])
    groups = tuple(tuple(numbers[group].tolist()) for group in _clusters(values))
    if changes.center_error > changes.focal_error:
        kind = FlawKind.CAMERAS_MIXED if groups else FlawKind.CENTER_VARIES
        if groups:
            named = evaluation.figures.named.rms_px
            return Flaw(kind, named, evaluation.noise_px, groups)
        shift = float(np.sqrt(center.var(axis=0).sum()))
        far = np.linalg.norm(center, axis=1)
        farthest = tuple(numbers[np.argsort(-far)].tolist())
        return Flaw(kind, shift, changes.center_error, (farthest,))
    order = np.argsort(focal)
    third = max(len(order) // 3, 1)
    ends = (tuple(sorted(numbers[order[:third]])), tuple(sorted(numbers[order[-third:]])))
    plain = tuple(tuple(int(n) for n in end) for end in ends)
    return Flaw(FlawKind.FOCAL_VARIES, float(np.ptp(focal)), changes.focal_error, groups or plain)


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


def _unknown_rays(rays: Mapping[str, Sequence[RayError]], frames_error: float) -> Iterator[Flaw]:
    """Yield cameras whose rays may be off by too much even where there are points.

    That they are off by less than MAX_RAY_ERROR is sure to 97.5 %: it is the user's loss, in what
    a single frame is solved with, that decides, however large the noise is.
    """
    for name, errors in rays.items():
        bound = errors[_NEAR_RANGE].in_quadrature(frames_error).high
        if bound > MAX_RAY_ERROR:
            yield Flaw(FlawKind.LENS_UNKNOWN, bound, MAX_RAY_ERROR, camera=name)


def are_rays_known(rays: Mapping[str, Sequence[RayError]]) -> bool:
    """Say whether the rays of all cameras are known to be off by less than MAX_RAY_ERROR."""
    return bool(rays) and not any(_unknown_rays(rays, 0.0))
