"""Cross-camera validation: one board has one shape, and a rig stands still.

What each camera alone says of the target is carried over to the other, which took no part in
finding it; and the rig is found view by view, from poses of each camera by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.diagnosis.cross_validation import (
    Comparison,
    HeldOut,
    compare_errors,
    cross_validate,
    rms_reduction,
)
from fisheye_svp_ros.diagnosis.fitted_model import FittedModel, refit
from fisheye_svp_ros.diagnosis.null_model import NullModel
from fisheye_svp_ros.diagnosis.problem import Progress
from fisheye_svp_ros.diagnosis.random_effects import NAMES, STAGE_OF
from fisheye_svp_ros.diagnosis.selection import Selection, select_causes
from fisheye_svp_ros.effects.base import ModelTerm, camera_terms
from fisheye_svp_ros.effects.target_map import KnownTarget, at_landmarks, less_similarity
from fisheye_svp_ros.pose import Pose, identity, vector_from_rotation
from fisheye_svp_ros.solve.bundle_adjustment import adjust
from fisheye_svp_ros.solve.rig_checks import MIN_SHARED_FRAMES, is_unpaired
from fisheye_svp_ros.solve.rig_state import Linearization, RigState, RigViews

_MIN_DISPLACEMENT = 1e-9  # m
_MIN_COMMON_LANDMARKS = 6  # landmarks, the fewest that two maps are compared by


@dataclass(frozen=True)
class Transfer:
    """Frames of `to`, each left out one by one, without and with what was found in `source`.

    without_px, with_px: rms of the 2-D residual; less_px: by how much it is less, and its 95 %
    interval over frames.
    """

    source: str
    to: str
    without_px: float
    with_px: float
    less_px: Comparison

    @classmethod
    def compare(cls, source: str, to: str, without: HeldOut, carried: HeldOut) -> Transfer:
        """Compare two predictions of the same frames, those that the others can predict."""
        rows = without.is_predictable | carried.is_predictable
        without, carried = without.take(rows), carried.take(rows)
        return cls(source, to, without.rms, carried.rms, rms_reduction(without, carried))

    def to_dict(self) -> dict[str, Any]:
        """Return what diagnosis.json holds."""
        return asdict(self) | {'less_px': self.less_px.interval}

    @property
    def improves(self) -> bool:
        """Whether it predicts better beyond chance."""
        return self.less_px.low > 0

    @property
    def worsens(self) -> bool:
        """Whether it predicts worse beyond chance."""
        return self.less_px.high < 0


def moves_with_lens(term: ModelTerm) -> bool:
    """Whether an effect moves with the lens, from one recording and target to the next."""
    effect = term.effect
    return effect.budget_stage() == 'lens' and not effect.of_recording


def displaces_landmarks(term: ModelTerm) -> bool:
    """Whether an effect displaces landmarks."""
    return term.effect.stage == 'target'


def without_terms(state: RigState, which: Callable[[ModelTerm], bool]) -> RigState:
    """Return the state without some of its effects."""
    return state.without_effects([term.name for term in state.terms if which(term)])


def fit_and_predict(
    data: RigViews, state: RigState, free: Sequence[str], held: Collection[str] = ()
) -> tuple[RigState, HeldOut]:
    """Fit by least squares, and predict frames left out one by one; held: effects kept fixed.

    Nothing random: what was carried over is tried as whoever uses it would.
    """
    fitted = adjust(data, state, free, held=held)
    return fitted, cross_validate(NullModel.with_variances(data, fitted, free), held=held)


def fitted_target(fitted: FittedModel, known: KnownTarget) -> Array:
    """Return where a fit has the landmarks of a target, displacements (L, 3), m.

    Effects of the target and predicted offsets; those of landmarks it did not see are zero.
    """
    offsets = fitted.predicted_offsets()
    moved = known.displacements(fitted.state.terms, fitted.state.lens)
    moved[np.searchsorted(known.landmark, offsets.landmark)] += offsets.offset
    return moved


def displace_target(data: RigViews, known: KnownTarget, moved: Array) -> RigViews:
    """Return data with displaced landmarks."""
    points = data.views.points + at_landmarks(data.views, known.landmark, moved)
    return replace(data, views=data.views._replace(points=points))


class TargetMaps(NamedTuple):
    """Two maps of one target.

    landmarks: how many are in both; correlation, correlation_along: of the displacements off their
    boards and along them; rms_m: of those off the boards, by each camera.
    """

    landmarks: int
    correlation: float
    correlation_along: float
    rms_m: tuple[float, float]


@dataclass(frozen=True)
class TwoCameras:
    """What two cameras of a rig say of each other.

    target: its shape found by one, tried on the other; rig: translation_m and rotation_rad, mean
    distance of a frame's rig from the middle of all, before and after; withdrawn: the causes that
    were given up because the two contradict each other; posed_alone: whether each view was posed
    by itself, since the two did not keep their places, were not photographed together, or saw
    too few frames together.
    """

    cameras: tuple[str, str]
    target: tuple[Transfer, ...]
    maps: TargetMaps | None
    rig: dict[str, Comparison]
    withdrawn: tuple[str, ...] = ()
    posed_alone: bool = False

    @property
    def verdict(self) -> str:
        """Whether they agree on the target: agree, contradict, undecided; nothing: no shape."""
        if not self.target:
            return 'nothing'
        apart = (
            bool(self.rig)
            and not self.posed_alone
            and all(moved.high < 0 for moved in self.rig.values())
        )
        if apart or any(transfer.worsens for transfer in self.target):
            return 'contradict'
        return 'agree' if all(transfer.improves for transfer in self.target) else 'undecided'

    def to_dict(self) -> dict[str, Any]:
        """Return what diagnosis.json holds."""
        return {
            'cameras': list(self.cameras),
            'verdict': self.verdict,
            'target': [transfer.to_dict() for transfer in self.target],
            'maps': self.maps and self.maps._asdict(),
            'rig': {name: value.to_dict() for name, value in self.rig.items()},
            'withdrawn': list(self.withdrawn),
            'posed_alone': self.posed_alone,
        }


class _Camera(NamedTuple):
    """One camera by itself: its lens before, and its data and state with the causes."""

    name: str
    before: RigState
    data: RigViews
    state: RigState
    free: tuple[str, ...]
    target: Array | None


def agree_on_target(
    selection: Selection, progress: Progress
) -> tuple[Selection, list[TwoCameras]]:
    """Ask the cameras of a rig whether they agree on the target; give up what they do not."""
    if selection.null.linear.data.cameras < 2:
        return selection, []
    progress('cross-camera validation', 0.78)
    pairs, problem = compare_cameras(selection), selection.problem
    gone = tuple(
        cause.name
        for cause in selection.causes
        if displaces_landmarks(cause) and cause.name not in problem.options.included
    )
    if not gone or all(pair.verdict != 'contradict' for pair in pairs):
        return selection, pairs
    selection = select_causes(
        replace(problem, options=problem.options.leave_out(*gone)),
        lambda stage, _: progress(stage, 0.79),
    )
    return selection, [
        replace(pair, withdrawn=gone if pair.verdict == 'contradict' else ()) for pair in pairs
    ]


def compare_cameras(selection: Selection) -> list[TwoCameras]:
    """Return what each two cameras of a rig say of each other, if both saw enough."""
    data = selection.null.linear.data
    known = KnownTarget.from_views(data.views)
    cameras = [
        _fit_camera(selection, camera, known)
        for camera in range(data.cameras)
        if (data.camera_of == camera).sum() >= MIN_SHARED_FRAMES
    ]
    alone = is_unpaired(data)
    return [
        replace(_compare(camera, other, known), posed_alone=alone)
        for camera, other in combinations(cameras, 2)
    ]


def _fit_camera(selection: Selection, camera: int, known: KnownTarget) -> _Camera:
    """Fit one camera by itself, under the null model of all."""
    null, base = selection.null, selection.problem.base
    data, mine = null.linear.data, null.linear.data.camera_of == camera
    own = data.select(mine)
    own = replace(own, camera_of=np.zeros_like(own.camera_of), poses=None)
    whole = null.linear.state
    pose = whole.view_poses(data).take(np.flatnonzero(mine))
    at = camera if whole.others else 0
    names = tuple(whole.lens_names(selection.problem.free)[at])
    state = _single_camera(whole, pose, at, camera)
    target = None
    # Whether anything was found that stays with the target.
    stages = {STAGE_OF[name] for name in np.array(NAMES)[null.variances.alive]}
    if 'target' in stages or any(map(displaces_landmarks, whole.terms)):
        seen = np.unique(own.views.landmark[own.views.used])
        variances = replace(
            null.variances,
            weight=null.variances.weight[np.searchsorted(null.random.landmark, seen)],
        )
        state = refit(own, state, names, variances)
        target = fitted_target(
            FittedModel.of_state(Linearization(own, state, names), variances), known
        )
    return _Camera(
        data.observations.cameras[camera],
        _single_camera(base, pose, at, camera),
        own,
        state,
        names,
        target,
    )


def _single_camera(state: RigState, pose: Pose, lens: int, camera: int) -> RigState:
    return RigState(pose, identity(1), state.lenses[lens], camera_terms(state.terms, camera))


def _compare(camera: _Camera, other: _Camera, known: KnownTarget) -> TwoCameras:
    carried, poses = [], []
    for mine, source in ((camera, other), (other, camera)):
        data, state = mine.data, without_terms(mine.state, displaces_landmarks)
        if source.target is None:
            after = adjust(data, state, mine.free)
        else:
            _, without = fit_and_predict(data, state, mine.free)
            data = displace_target(data, known, less_similarity(known.points, source.target))
            after, there = fit_and_predict(data, state, mine.free)
            carried.append(Transfer.compare(source.name, mine.name, without, there))
        poses.append((adjust(mine.data, mine.before, mine.free).pose, after.pose))
    return TwoCameras(
        (camera.name, other.name),
        tuple(carried),
        _maps(camera, other, known),
        _scatter((camera.data, other.data), poses),
    )


def _maps(camera: _Camera, other: _Camera, known: KnownTarget) -> TargetMaps | None:
    """Compare what two cameras found of the target, by the landmarks that both saw."""
    if camera.target is None or other.target is None:
        return None
    seen = [
        np.isin(known.landmark, mine.data.views.landmark[mine.data.views.used])
        for mine in (camera, other)
    ]
    both = seen[0] & seen[1]
    if both.sum() < _MIN_COMMON_LANDMARKS:
        return None
    shared = KnownTarget(known.landmark[both], known.board[both], known.points[both])
    off, along = (
        [
            np.concatenate([getattr(board, name).ravel() for board in shared.maps(moved[both])])
            for moved in (camera.target, other.target)
        ]
        for name in ('height', 'slide')
    )
    return TargetMaps(
        int(both.sum()),
        _correlation(*off),
        _correlation(*along),
        (float(np.sqrt((off[0] ** 2).mean())), float(np.sqrt((off[1] ** 2).mean()))),
    )


def _correlation(mine: Array, other: Array) -> float:
    """Return how alike two displacements are, m; those of rounding are no displacements."""
    size = np.sqrt((mine**2).sum() * (other**2).sum())
    return float((mine * other).sum() / size) if size > _MIN_DISPLACEMENT**2 else 0.0


def _scatter(
    data: tuple[RigViews, RigViews], poses: Sequence[tuple[Pose, Pose]]
) -> dict[str, Comparison]:
    """Compare how the rig scatters that each frame gives, before and after."""
    shared, first, second = np.intersect1d(
        data[0].views.frame, data[1].views.frame, return_indices=True
    )
    if len(shared) < MIN_SHARED_FRAMES:
        return {}
    before, after = (
        deviations(pose.take(first).inverse().compose(other.take(second)))
        for pose, other in zip(*poses, strict=True)
    )
    names = ('translation_m', 'rotation_rad')
    return {name: compare_errors(b, a) for name, b, a in zip(names, before, after, strict=True)}


def deviations(rig: Pose) -> tuple[Array, Array]:
    """Return how far (F,), m and rad, each rig is from the middle of all."""
    turn = vector_from_rotation(np.swapaxes(rig.rotation[:1], -1, -2) @ rig.rotation)
    place, angle = (
        np.linalg.norm(part - np.median(part, axis=0), axis=-1) for part in (rig.position, turn)
    )
    return place, angle
