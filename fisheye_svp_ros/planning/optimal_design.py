"""Which photographs to take next: views of a board that tell most of what is in doubt.

Every view that a person can arrange adds information about all that is shared (lens, causes and
their confounded effects), its own pose eliminated. Views are added greedily and then exchanged,
so that the doubt shrinks most: the error of some numbers with all others unknown (D_s-optimal
design), or how far a named cause is from whatever it may be mistaken for. Sources: Atkinson,
Donev and Tobias, Optimum Experimental Designs, 2007, sections 10.3 and 12; Federov's exchange.
Landmarks' own random errors are left out of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import special
from scipy.spatial import KDTree

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.diagnosis import CONFOUNDED_P
from fisheye_svp_ros.effects.base import Effect, Untestable
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import GeometryError, ParameterError
from fisheye_svp_ros.mixed_model import project_out
from fisheye_svp_ros.optics.lens import INTRINSICS, Lens
from fisheye_svp_ros.pose import Pose, identity, rotation_from_vector
from fisheye_svp_ros.scene.boards import is_flat, spacing
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.simulate.simulation import blank_views
from fisheye_svp_ros.solve.rig_state import Linearization, RigState, RigViews

CANDIDATES = 600
_TRIES = 12_000
_EDGE, _SPACING = 8.0, 9.0  # px from the edge of the image and between points, to be detected
_NEIGHBORS = 4
_SLANT = np.cos(np.radians(70.0))  # of a board to the ray, beyond which corners are not found
_EXCHANGES = 4  # rounds
# What a person can set: steps of angles, rad, and distances between near and far
_STEP, _QUARTER, _TILTS = np.radians(5.0), np.radians(45.0), np.radians([0, 15, 30, 45, 60])
_DISTANCES = 9
_EXCLUSION_RADIUS = 0.25  # of the distance
_ANGLE_MARGIN = np.radians(10.0)  # what has been seen, where the image of a lens may have ended
# Prior standard deviations of intrinsics that nothing is known of, over the focal length
_PRIOR_SIGMAS = {'fx': 0.1, 'fy': 0.1, 'cx': 0.1, 'cy': 0.1}


class ViewLimits(NamedTuple):
    """Where the board can be: nearest and furthest, m, at which it is sharp; largest tilt, rad.

    field: furthest from the axis, rad; taken (P, 3): places of its middle before the camera, m,
    where it cannot be, nor near them.
    """

    near: float
    far: float
    tilt: float = float(np.radians(60.0))
    field: float = float(np.pi)
    taken: Array = np.zeros((0, 3))


class Shots(NamedTuple):
    """P views of a board.

    camera (P,): in the target frame; distance (P,), m, to the board's middle; angle, azimuth (P,):
    where in the field that is, azimuth from right over down; tilt (P,) of the board from facing
    the camera; tilt_axis (P,): about which line, from right over down; roll (P,), rad.
    """

    camera: Pose
    distance: Array
    angle: Array
    azimuth: Array
    tilt: Array
    tilt_axis: Array
    roll: Array

    def take(self, index: Index) -> Shots:
        """Return some of the views."""
        return Shots(self.camera.take(index), *(part[index] for part in self[1:]))


@dataclass(frozen=True)
class FlatBoard:
    """A flat board: landmark numbers (N,), points (N, 3), m, board numbers (N,), facing (3, 3).

    The last is the turn that shows it squarely to a camera before it.
    """

    landmark: Index
    points: Array
    board: Index
    facing: Array

    @property
    def rim(self) -> Array:
        """The points (N, 3), m, moved outwards by their spacing: squares end beyond corners."""
        middle = self.points.mean(axis=0)
        local = (self.points - middle) @ self.facing.T
        half = np.abs(local[:, :2]).max(axis=0)
        return np.asarray(middle + local * [*(1 + spacing(self.points) / half), 1.0] @ self.facing)

    @property
    def corners(self) -> Index:
        """Which of the points are its corners."""
        x, y, _ = (self.points @ self.facing.T).T
        return np.array([np.argmin(x + y), np.argmax(x + y), np.argmin(x - y), np.argmax(x - y)])

    @classmethod
    def from_observations(cls, observations: Observations, pose: Pose) -> FlatBoard:
        """Return the board of a table, its front the side that cameras (S,) saw.

        Raises GeometryError for a target that is not flat.
        """
        landmark, first = np.unique(observations.landmark, return_index=True)
        points = observations.xyz[first]
        middle = points.mean(axis=0)
        if not is_flat(points):
            raise GeometryError(
                f'{observations.source}: the target is not one flat board; the next photographs '
                'can be planned only for one'
            )
        axes = np.linalg.svd(points - middle, full_matrices=False)[2]
        normal = axes[2] * np.sign(((middle - pose.position) @ axes[2]).sum() or 1.0)
        across = np.eye(3)[0] - normal[0] * normal
        if np.linalg.norm(across) < 0.5:
            across = np.eye(3)[1] - normal[1] * normal
        across /= np.linalg.norm(across)
        facing = np.stack([across, np.cross(normal, across), normal])
        return cls(landmark, points, observations.board[first], facing)


@dataclass(frozen=True)
class Criterion:
    """What is in doubt: columns of the information.

    interest (P,): the numbers; value (P,): of a cause that may be mistaken, None where their
    errors are to be small; others: columns of each effect that it may be mistaken for; nuisance:
    of all else that is unknown.
    """

    interest: Index
    nuisance: Index
    value: Array | None = None
    others: tuple[Index, ...] = ()

    def merit(self, information: Array) -> Array:
        """Return how well each information (B, K, K) answers; more is better."""
        if self.value is None:
            remaining = _marginal_information(information, self.interest, self.nuisance)
            return np.asarray(np.linalg.slogdet(remaining)[1]) / len(self.interest)
        merits = []
        for nuisance in self.others or (self.nuisance[:0],):
            unknown = np.concatenate([self.nuisance, nuisance])
            remaining = _marginal_information(information, self.interest, unknown)
            merits.append(np.einsum('i,bij,j->b', self.value, remaining, self.value))
        return np.asarray(np.min(merits, axis=0))

    def answer(self, information: Array) -> float:
        """Return the standard error (the geometric mean of several), or how sure a name is.

        The latter: with which probability it proves needed beside each of its confounded effects.
        """
        merit = float(self.merit(information[None])[0])
        if self.value is None:
            return float(np.exp(-merit / 2))
        rank = len(self.interest)
        return float(1 - special.chndtr(special.chdtri(rank, CONFOUNDED_P), rank, merit))


class Design:
    """What is known, and what every candidate view would add.

    names, units: of the columns, lens parameters and then EFFECT.PARAMETER; values: what they are;
    known (K, K): information; added (P, K, K): of each of the shots.
    """

    def __init__(
        self,
        linear: Linearization,
        effects: Sequence[Effect],
        board: FlatBoard,
        shots: Shots,
        noise: float,
        known: bool = True,
    ) -> None:
        """Take a fit, and effects that are not in it but may be there; noise: of u and v, px.

        known: whether the views of the fit have been taken, or are there to say what is shared.
        """
        state, lens, free = linear.state, linear.state.lens, linear.free
        terms = [t for t in state.terms if t.effect.stage != 'noise']
        parameters = [
            (term.name, p, v)
            for term in terms
            for p, v in zip(term.effect.parameters, term.values, strict=True)
        ]
        parameters += [(e.name, p, 0.0) for e in effects for p in e.parameters]
        self.names = (*free, *(f'{name}.{p.name}' for name, p, _ in parameters))
        self.units = (*(_unit(name) for name in free), *(p.unit for _, p, _ in parameters))
        self.values = np.array(
            [lens.parameters[name] for name in free] + [value for _, _, value in parameters]
        )
        wide = [
            lens.focal * _PRIOR_SIGMAS[name] if name in _PRIOR_SIGMAS else 1.0 for name in free
        ]
        wide += [p.large for _, p, _ in parameters]
        self.shots, self.board, self.known_views = shots, board, known
        self.known: Array = np.diag(1 / np.square(wide))
        if known:
            used = linear.row_weight
            mean = float(np.sqrt(np.mean(used[used > 0] ** 2)))
            self.known = (
                self.known + information(linear, effects).sum(axis=0) / (mean * noise) ** 2
            )
        views = blank_views(board.landmark, board.points, len(shots.distance), board=board.board)
        data = RigViews.of_one_camera(views)
        posed = replace(state, pose=shots.camera, rig=identity(1), terms=tuple(terms))
        self.added = information(Linearization(data, posed, free), effects) / noise**2

    def columns(self, name: str) -> Index:
        """Return the columns of an effect, or of one number, by its name or its last part.

        Raises ParameterError for one that is not among the names.
        """
        parts = [
            (full_name, full_name.partition('.')[0], full_name.rpartition('.')[2])
            for full_name in self.names
        ]
        matches = [i for i, names in enumerate(parts) if name in names]
        if matches:
            return np.array(matches)
        raise ParameterError(
            f'{name!r} is not a parameter of this lens and its causes; choose from '
            + ', '.join(self.names)
        )

    def question(self, name: str, others: Sequence[str] = ()) -> Criterion:
        """Ask for the error of a number, or whether an effect is not one of some others."""
        interest = self.columns(name)
        groups = tuple(self.columns(name) for name in others)
        nuisance = np.setdiff1d(np.arange(len(self.names)), np.concatenate([interest, *groups]))
        return Criterion(interest, nuisance, self.values[interest] if others else None, groups)

    def choose(self, question: Criterion, count: int) -> tuple[Index, list[float]]:
        """Return places of chosen shots, best first, and the answer with each one more.

        Where fewer than `count` are possible, all of them.
        """
        count = min(count, len(self.added))
        chosen = self._add_views(question, range(len(self.added)), count)
        for _ in range(_EXCHANGES):
            before = list(chosen)
            for i in range(count):
                chosen[i] = self._best_view(
                    question, range(len(self.added)), chosen[:i] + chosen[i + 1 :]
                )
            if chosen == before:
                break
        ordered = self._add_views(question, chosen, count)
        return np.array(ordered), [
            question.answer(self._information_with(ordered[:i])) for i in range(count + 1)
        ]

    def _add_views(self, question: Criterion, among: Sequence[int], count: int) -> list[int]:
        """Return some of the views, each the best beside those before it."""
        chosen: list[int] = []
        for _ in range(count):
            chosen.append(self._best_view(question, among, chosen))
        return chosen

    def _best_view(self, question: Criterion, among: Sequence[int], taken: Sequence[int]) -> int:
        left = [i for i in among if i not in taken]
        merit = question.merit(self._information_with(taken) + self.added[left])
        return left[int(np.argmax(merit))]

    def _information_with(self, taken: Sequence[int]) -> Array:
        return np.asarray(self.known + self.added[list(taken)].sum(axis=0))


def richest_forms(linear: Linearization, names: Sequence[str]) -> list[Effect]:
    """Return the richest forms of effects of lens or target that are not in a fit."""
    there = {term.name for term in linear.state.terms}
    effects = []
    for name in names:
        if name in there or CATALOGUE[name].budget_stage() not in ('lens', 'target'):
            continue
        try:
            forms = CATALOGUE[name].candidates(linear.scene)
        except Untestable:
            continue
        effects.append(max(forms, key=lambda form: len(form.parameters)))
    return effects


def max_view_angle(lens: Lens, reached: float) -> float:
    """Return out to which angle a lens may well see that did so up to `reached`, rad.

    The image of most fills it to the nearest edge, and of many ends there.
    """
    u = min(lens.cx, lens.width - lens.cx) / lens.fx
    v = min(lens.cy, lens.height - lens.cy) / lens.fy
    edge = lens.image_height.angle(np.asarray(max(min(u, v), 0.0)))
    return max(reached + float(_ANGLE_MARGIN), min(float(edge), lens.max_incidence))


def candidate_shots(
    state: RigState, board: FlatBoard, room: ViewLimits, rng: np.random.Generator
) -> Shots:
    """Return up to CANDIDATES views that can be taken: the board whole, sharp, detectable.

    Raises GeometryError where there is none.
    """
    lens, count = state.lens, _TRIES
    top = int(lens.max_incidence / _STEP)
    angle = _STEP * np.minimum(
        np.arccos(rng.uniform(np.cos(lens.max_incidence), 1, count)) / _STEP + 0.5, top
    ).astype(int)
    azimuth, axis, roll = (
        step * rng.integers(0, round(2 * np.pi / step), count)
        for step in (np.radians(30.0), _QUARTER, _QUARTER)
    )
    distance = rng.choice(np.geomspace(room.near, room.far, _DISTANCES), count)
    tilt = rng.choice(_TILTS[room.tilt + 1e-9 >= _TILTS], count)
    sight = np.stack(
        [np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)], axis=-1
    )
    zero = np.zeros(count)
    towards = rotation_from_vector(
        angle[:, None] * np.stack([-np.sin(azimuth), np.cos(azimuth), zero], axis=-1)
    )
    tilted = rotation_from_vector(
        tilt[:, None] * np.stack([np.cos(axis), np.sin(axis), zero], axis=-1)
    )
    rolled = rotation_from_vector(roll[:, None] * np.array([0.0, 0.0, 1.0]))
    turn = towards @ tilted @ rolled @ board.facing
    middle = distance[:, None] * sight
    place = middle - turn @ board.points.mean(axis=0)
    shots = Shots(Pose(turn, place).inverse(), distance, angle, azimuth, tilt, axis, roll)
    away = (
        np.linalg.norm(middle[:, None] - room.taken, axis=-1)
        > _EXCLUSION_RADIUS * distance[:, None]
    )
    allowed = away.all(axis=1) & _detectable(state, board, shots, room.field)
    possible = np.flatnonzero(allowed)[:CANDIDATES]
    if not possible.size:
        raise GeometryError(
            f'lens {lens.name!r} does not see the whole board from {room.near:g} to '
            f'{room.far:g} m; choose other distances (--room NEAR FAR) or a smaller board'
        )
    return shots.take(possible)


def _detectable(state: RigState, board: FlatBoard, shots: Shots, field: float) -> Mask:
    """Whether boards are in image and field as a whole, their points far enough apart (P,)."""
    model, feasible = (
        ForwardModel(state.lens, state.terms),
        np.ones(len(shots.distance), dtype=bool),
    )
    size, rim = np.array([state.lens.width, state.lens.height]), board.rim
    # Most boards do not fit by their corners, for which there is no need to look at all of them.
    for indices in (board.corners, np.arange(len(rim))):
        left = np.flatnonzero(feasible)
        if not left.size:
            return feasible
        camera = shots.camera.take(left)
        views = blank_views(
            board.landmark[indices], rim[indices], left.size, board=board.board[indices]
        )
        edge, outer = model.predict(camera, views), camera.into_body(views.points)
        seen = outer[..., 2] > np.cos(field) * np.linalg.norm(outer, axis=-1)
        with np.errstate(invalid='ignore'):
            inside = ((edge.uv > _EDGE) & (edge.uv < size - _EDGE)).all(axis=-1)
        feasible[left] = (edge.valid & seen & inside).all(axis=1)
    left = np.flatnonzero(feasible)
    feasible[left] = _resolvable(model, board, shots.camera.take(left))
    return feasible


def _resolvable(model: ForwardModel, board: FlatBoard, camera: Pose) -> Mask:
    """Whether the points of boards are far enough apart in the image, and not too slanted (P,)."""
    views = blank_views(board.landmark, board.points, len(camera.position), board=board.board)
    image, local = model.predict(camera, views), camera.into_body(views.points)
    normal = np.swapaxes(camera.rotation, -1, -2) @ board.facing[2]
    slant = (local @ normal[..., None])[..., 0] / np.linalg.norm(local, axis=-1)
    many = min(_NEIGHBORS, len(board.points) - 1)
    near = np.asarray(KDTree(board.points).query(board.points, many + 1)[1])[:, 1:]
    with np.errstate(invalid='ignore'):
        apart = np.linalg.norm(image.uv[:, near] - image.uv[:, :, None], axis=-1)
        told = (apart > _SPACING).all(axis=(1, 2)) & (slant > _SLANT).all(axis=1)
        return np.asarray(told & image.valid.all(axis=1))


def _unit(name: str) -> str:
    if name in INTRINSICS:
        return 'px'
    return 'rad' if 'tilt' in name else 'm' if name.startswith('port_') else '1'


def information(linear: Linearization, effects: Sequence[Effect]) -> Array:
    """Return what each frame tells of all that is shared (F, K, K), its pose taken out."""
    columns = np.concatenate(
        [linear.shared_columns, *(linear.effect_columns(effect) for effect in effects)], axis=-1
    )
    clean = project_out(columns, linear.frame_columns)
    return np.asarray(np.swapaxes(clean, -1, -2) @ clean)


def _marginal_information(information: Array, interest: Index, unknown: Index) -> Array:
    """Return the information (B, P, P) of some columns with others unknown."""
    block = information[:, interest[:, None], interest]
    if not len(unknown):
        return np.asarray(block)
    mixed = information[:, unknown[:, None], interest]
    nuisance = information[:, unknown[:, None], unknown]
    return np.asarray(block - np.swapaxes(mixed, -1, -2) @ np.linalg.solve(nuisance, mixed))
