"""Two cameras as each other's truth: one board has one shape, and a rig stands still.

What each camera alone says of the target is carried over to the other, which took no part in
finding it; and the rig is found view by view, from poses of each camera by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.diagnosis.adjustment import fit
from fisheye_svp_ros.diagnosis.carried import (
    Carried,
    names_of,
    of_landmarks,
    of_target,
    settled,
    target_of,
    with_target,
)
from fisheye_svp_ros.diagnosis.known_truth import Compared, compared
from fisheye_svp_ros.diagnosis.model import Data, Linearised, State, chosen_views
from fisheye_svp_ros.diagnosis.moments import FEWEST, posed_alone
from fisheye_svp_ros.diagnosis.random_effects import NAMES, STAGE_OF
from fisheye_svp_ros.diagnosis.refit import fit_linear, refit
from fisheye_svp_ros.diagnosis.search import Found
from fisheye_svp_ros.diagnosis.target_map import KnownTarget, less_similarity
from fisheye_svp_ros.diagnosis.wanted import Wanted
from fisheye_svp_ros.effects.of_cameras import camera_terms
from fisheye_svp_ros.pose import Pose, identity, vector_from_rotation

_ALIKE = 6  # landmarks, the fewest that two maps are compared by


class Maps(NamedTuple):
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
    target: tuple[Carried, ...]
    maps: Maps | None
    rig: dict[str, Compared]
    withdrawn: tuple[str, ...] = ()
    posed_alone: bool = False

    @property
    def verdict(self) -> str:
        """Whether they agree on the target: agree, contradict, undecided; nothing: no shape."""
        if not self.target:
            return 'nothing'
        apart = bool(self.rig) and not self.posed_alone and all(
            moved.high < 0 for moved in self.rig.values())
        if apart or any(one.worse for one in self.target):
            return 'contradict'
        return 'agree' if all(one.better for one in self.target) else 'undecided'

    def to_dict(self) -> dict[str, Any]:
        """Return what diagnosis.json holds."""
        return {
            'cameras': list(self.cameras), 'verdict': self.verdict,
            'target': [one.to_dict() for one in self.target],
            'maps': self.maps and self.maps._asdict(),
            'rig': {name: value._asdict() for name, value in self.rig.items()},
            'withdrawn': list(self.withdrawn), 'posed_alone': self.posed_alone,
        }


class _Camera(NamedTuple):
    """One camera by itself: its lens before, and its data and state with the causes."""

    name: str
    before: State
    data: Data
    state: State
    free: tuple[str, ...]
    target: Array | None


def agreed(
    found: Found, free: Sequence[str], wanted: Wanted, again: Callable[[Wanted], Found],
    progress: Callable[[str, float], None],
) -> tuple[Found, list[TwoCameras]]:
    """Ask the cameras of a rig whether they agree on the target; give up what they do not.

    again: searches anew for causes.
    """
    if found.evidence.linear.data.cameras < 2:
        return found, []
    progress('asking each camera what it says of the other', 0.78)
    said = two_cameras(found, free)
    gone = tuple(e.name for e, _, _ in found.causes
                 if e.stage == 'target' and e.name not in wanted.included)
    if not gone or all(pair.verdict != 'contradict' for pair in said):
        return found, said
    found = again(replace(wanted, left_out=(*wanted.left_out, *gone)))
    return found, [replace(pair, withdrawn=gone if pair.verdict == 'contradict' else ())
                   for pair in said]


def two_cameras(found: Found, free: Sequence[str]) -> list[TwoCameras]:
    """Return what each two cameras of a rig say of each other, if both saw enough."""
    data = found.evidence.linear.data
    known = KnownTarget.of(data.views)
    cameras = [_alone(found, free, camera, known) for camera in range(data.cameras)
               if (data.camera_of == camera).sum() >= FEWEST]
    alone = posed_alone(data)
    return [replace(_compared(one, other, known), posed_alone=alone)
            for one, other in combinations(cameras, 2)]


def _alone(found: Found, free: Sequence[str], camera: int, known: KnownTarget) -> _Camera:
    """Fit one camera by itself, under the null model of all."""
    evidence, base = found.evidence, found.simulated.state
    data, mine = evidence.linear.data, evidence.linear.data.camera_of == camera
    own = chosen_views(data, mine)
    own = replace(own, camera_of=np.zeros_like(own.camera_of), poses=None)
    pose = found.state.view_poses(data).take(np.flatnonzero(mine))
    at = camera if found.state.others else 0
    names = tuple(found.state.own_names(free)[at])
    state = _single(found.state, pose, at, camera)
    target = None
    if _has_target(found):
        variances = of_landmarks(own, evidence.variances, evidence.design.landmark)
        state = refit(own, state, names, variances)
        target = target_of(fit_linear(Linearised(own, state, names), variances), known)
    return _Camera(data.observations.cameras[camera], _single(base, pose, at, camera), own, state,
                   names, target)


def _single(state: State, pose: Pose, lens: int, camera: int) -> State:
    return State(pose, identity(1), state.lenses[lens], camera_terms(state.terms, camera))


def _has_target(found: Found) -> bool:
    """Whether anything was found that stays with the target."""
    alive = found.evidence.variances.alive
    return any(map(of_target, found.state.terms)) or any(
        STAGE_OF[name] == 'target' for name, there in zip(NAMES, alive, strict=True) if there)


def _compared(one: _Camera, other: _Camera, known: KnownTarget) -> TwoCameras:
    carried, poses = [], []
    for mine, source in ((one, other), (other, one)):
        data, state = mine.data, mine.state.without(names_of(
            [term for term in mine.state.terms if of_target(term)]))
        if source.target is None:
            after = fit(data, state, mine.free)
        else:
            _, without = settled(data, state, mine.free)
            data = with_target(data, known, less_similarity(known.points, source.target))
            after, there = settled(data, state, mine.free)
            carried.append(Carried.of(source.name, mine.name, without, there))
        poses.append((fit(mine.data, mine.before, mine.free).pose, after.pose))
    return TwoCameras((one.name, other.name), tuple(carried), _maps(one, other, known),
                      _scatter((one.data, other.data), poses))


def _maps(one: _Camera, other: _Camera, known: KnownTarget) -> Maps | None:
    """Compare what two cameras found of the target, by the landmarks that both saw."""
    if one.target is None or other.target is None:
        return None
    seen = [np.isin(known.landmark, mine.data.views.landmark[mine.data.views.used])
            for mine in (one, other)]
    both = seen[0] & seen[1]
    if both.sum() < _ALIKE:
        return None
    shared = KnownTarget(known.landmark[both], known.board[both], known.points[both])
    off, along = (
        [np.concatenate([getattr(board, name).ravel() for board in shared.maps(moved[both])])
         for moved in (one.target, other.target)] for name in ('height', 'slide')
    )
    return Maps(int(both.sum()), _correlation(*off), _correlation(*along),
                (float(np.sqrt((off[0]**2).mean())), float(np.sqrt((off[1]**2).mean()))))


def _correlation(one: Array, other: Array) -> float:
    size = np.sqrt((one**2).sum() * (other**2).sum())
    return float((one * other).sum() / size) if size > 0 else 0.0


def _scatter(
    data: tuple[Data, Data], poses: Sequence[tuple[Pose, Pose]]
) -> dict[str, Compared]:
    """Compare how the rig scatters that each frame gives, before and after."""
    shared, first, second = np.intersect1d(
        data[0].views.frame, data[1].views.frame, return_indices=True)
    if len(shared) < FEWEST:
        return {}
    before, after = (
        deviations(one.take(first).inverse().compose(other.take(second)))
        for one, other in zip(*poses, strict=True)
    )
    names = ('translation_m', 'rotation_rad')
    return {name: compared(b, a) for name, b, a in zip(names, before, after, strict=True)}


def deviations(rig: Pose) -> tuple[Array, Array]:
    """Return how far (F,), m and rad, each rig is from the middle of all."""
    turn = vector_from_rotation(np.swapaxes(rig.rotation[:1], -1, -2) @ rig.rotation)
    place, angle = (
        np.linalg.norm(part - np.median(part, axis=0), axis=-1) for part in (rig.position, turn))
    return place, angle
