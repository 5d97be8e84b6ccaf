"""A live guide: which view of the board is wanted now, whether it is there, when enough is known.

`Guide` follows the board from image to image, which takes no time; `evaluate_session` solves what
the photographs so far tell, and which one is wanted next, which takes a second: from the data
sheet of the lens (`planning.plan`), then with the lens as fitted so far, then with a diagnosis.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis import DiagnosisOptions, diagnose
from fisheye_svp_ros.effects.base import ModelTerm
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.effects.ray_effects import ViewpointShiftEffect
from fisheye_svp_ros.errors import FisheyeSvpError
from fisheye_svp_ros.optics.lens import Lens, field_of_view, intrinsic_names
from fisheye_svp_ros.planning.optimal_design import ViewLimits
from fisheye_svp_ros.planning.plan import NextViews, next_photographs, plan
from fisheye_svp_ros.scene.observations import Observations, make_observations
from fisheye_svp_ros.simulate.simulation import blank_views
from fisheye_svp_ros.solve.bundle_adjustment import Prior, adjust
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.measured_poses import usable_observations
from fisheye_svp_ros.solve.rig_state import Linearization, group_by_frame

MAX_PHOTOGRAPHS = 40  # photographs; with so many what is still open stays open
MIN_SCORE = 0.8  # score of a view that is taken
_VIEWS_AHEAD = 4  # views chosen together
_MIN_DIAGNOSED = 6  # photographs before the first diagnosis
_MAX_MOTION, _STANDSTILL = 0.003, 0.5  # of the image's width, and s
_MAX_IMAGES = 200  # images
_VIEW_TIMEOUT = 20.0  # s; then a view is one that cannot be had
_DEFAULT_NOISE = 0.1  # px, noise where the detector does not say
MIN_PROBABILITY = 0.3  # that a few more photographs tell two causes apart, below which none will
# photographs; what they have not told apart, more will not
_MAX_UNDECIDED = _MIN_DIAGNOSED + _VIEWS_AHEAD
_EFFECT = ViewpointShiftEffect(1)


class DetectedBoard(NamedTuple):
    """A board in an image: time, s; points (M,) of the pattern, uv (M, 2) and sigma (M,), px."""

    t: float
    ids: Index
    uv: Array
    sigma: Array


@dataclass(frozen=True)
class Session:
    """What a guide is for, and what it has.

    lens: as the data sheet has it, of Kannala-Brandt's form; points (N, 3), m, of a flat board;
    number: whose standard error is to come down to `goal`, in its unit: e0, an intrinsic
    or a coefficient k1 to k4; latest: lens and e0 as fitted last.
    """

    lens: Lens
    points: Array
    room: ViewLimits
    number: str
    goal: float
    taken: tuple[DetectedBoard, ...] = ()
    latest: tuple[Lens, float] | None = None


class SessionState(NamedTuple):
    """Where matters stand.

    wanted: views, best first; outline: of each, its points (N, 2), px, NaN outside the field;
    value, stderr: of the number, None as long as it is not measured; named: causes, by a
    diagnosis; alike: what the cause of the number may be as well; settled: no doubt is left that
    photographs could take away; latest: lens and e0, for the next session.
    """

    wanted: NextViews
    outline: tuple[Array, ...]
    value: float | None
    stderr: float | None
    named: tuple[str, ...]
    alike: tuple[str, ...]
    settled: bool
    latest: tuple[Lens, float] | None


def evaluate_session(session: Session) -> SessionState | Exception:
    """Return what the photographs tell and which is wanted next; errors are returned, too."""
    try:
        return _evaluate_photographs(session)
    except Exception as error:
        return error


def _evaluate_photographs(session: Session) -> SessionState:
    number, room = session.number, session.room
    if not session.taken:
        planned = plan(session.lens, session.points, room, _VIEWS_AHEAD, number, _DEFAULT_NOISE)
        return _session_state(session, ForwardModel(session.lens), planned.wanted)
    table = observations_of(session.taken, session.points)
    linear = _refit_lens(session, table)
    lens, shift = linear.state.lens, linear.state.terms[0].values
    session = replace(session, latest=(lens, float(shift[0])))
    if len(session.taken) >= _MIN_DIAGNOSED:
        with suppress(FisheyeSvpError):  # the next photograph may mend it
            return _diagnose_session(session, usable_observations(table, lens).observations, lens)
    wanted = next_photographs(linear, (), _noise_of_fit(linear), _VIEWS_AHEAD, number, room)
    return _session_state(
        session, _board_model(linear), wanted, _number_value(linear, number), wanted.answers[0]
    )


def _diagnose_session(session: Session, table: Observations, lens: Lens) -> SessionState:
    """Return where matters stand by a diagnosis.

    Settled once the number is known and what it belongs to is told from all else, or cannot be.
    """
    number, room = session.number, session.room
    diagnosis = diagnose(table, lens, free_intrinsics=True)
    alike: tuple[str, ...] = ()
    for cause in diagnosis.causes if number == _EFFECT.parameters[0].name else ():
        names = cause.effect, *cause.indistinguishable_from
        if len(names) == 1 or _EFFECT.name not in names:
            continue
        wanted = next_photographs(
            diagnosis.evaluation.fixed_model, (cause,), diagnosis.noise_px, _VIEWS_AHEAD, room=room
        )
        if wanted.answers[-1] > MIN_PROBABILITY and len(session.taken) < _MAX_UNDECIDED:
            return _session_state(
                session,
                _board_model(diagnosis.evaluation.fixed_model),
                wanted,
                named=(cause.effect,),
                alike=names[1:],
            )
        # No photograph will tell: what is it, if it is what is asked for?
        alike = tuple(name for name in names if name != _EFFECT.name)
        diagnosis = diagnose(
            table, lens, free_intrinsics=True, options=DiagnosisOptions(left_out=alike)
        )
        break
    wanted = next_photographs(
        diagnosis.evaluation.fixed_model,
        diagnosis.causes,
        diagnosis.noise_px,
        _VIEWS_AHEAD,
        number,
        room,
    )
    value, stderr = _number_value(diagnosis.evaluation.fixed_model, number), wanted.answers[0]
    for cause in diagnosis.causes:
        if number in cause.parameters:
            value = cause.parameters[number]['value']
            stderr = max(stderr, cause.parameters[number]['stderr'])
    return _session_state(
        session,
        _board_model(diagnosis.evaluation.fixed_model),
        wanted,
        value,
        stderr,
        tuple(cause.effect for cause in diagnosis.causes),
        alike,
        stderr <= session.goal,
    )


def _board_model(linear: Linearization) -> ForwardModel:
    """Return how the lens images a board that is as it should be."""
    terms = [
        term
        for term in linear.state.terms
        if term.effect.stage in ('pupil', 'ray', 'image') and not term.effect.of_target
    ]
    return ForwardModel(linear.state.lens, terms)


def _session_state(
    session: Session,
    model: ForwardModel,
    wanted: NextViews,
    value: float | None = None,
    stderr: float | None = None,
    named: tuple[str, ...] = (),
    alike: tuple[str, ...] = (),
    settled: bool = False,
) -> SessionState:
    count = len(session.points)
    views = blank_views(np.arange(count), session.points, len(wanted.shots.distance))
    outline = model.predict(wanted.shots.camera, views).uv
    return SessionState(
        wanted, tuple(outline), value, stderr, named, alike, settled, session.latest
    )


def _number_value(linear: Linearization, number: str) -> float:
    """Return a number of lens or effects; 0 where there is none of it."""
    values = dict(linear.state.parameters)
    for term in linear.state.terms:
        numbers = zip(term.effect.parameters, term.values, strict=True)
        values |= {parameter.name: float(value) for parameter, value in numbers}
    return values.get(number, 0.0)


def _refit_lens(session: Session, table: Observations) -> Linearization:
    """Return lens and e0 as far as the photographs tell them; the data sheet says the rest."""
    lens, shift = session.latest or (session.lens, 0.0)
    data, free = group_by_frame(table), intrinsic_names(lens)
    state = initial_state(data, lens)
    state = replace(state, terms=(ModelTerm(_EFFECT, np.array([shift])),))
    state = adjust(data, state, free, _prior(session.lens, free))
    return Linearization(data, state, free)


def _prior(lens: Lens, free: Sequence[str]) -> Prior:
    """Return what a data sheet tells: a lens to some per cent, a shift of millimetres."""
    edge = lens.max_incidence
    loose = {'fx': 0.1 * lens.fx, 'fy': 0.1 * lens.fy, 'cx': 0.05 * lens.fx, 'cy': 0.05 * lens.fy}
    loose |= {f'k{i}': 0.2 / edge ** (2 * i) for i in range(1, 5)}
    return Prior(
        np.array([*(lens.parameters[name] for name in free), 0.0]),
        np.diag([*(1 / loose[name] for name in free), 1 / _EFFECT.parameters[0].large]),
    )


def _noise_of_fit(linear: Linearization) -> float:
    """Return the noise of u and of v, px, from what the fit leaves, no less than is stated."""
    weight = linear.row_weight
    px = linear.residual[weight > 0] / weight[weight > 0]
    unknown = linear.frame_columns.shape[-1] * len(linear.residual)
    stated = 1 / float(weight.max())
    return max(stated, float(np.sqrt(px @ px / max(px.size - unknown, 1))))


def observations_of(taken: Sequence[DetectedBoard], points: Array) -> Observations:
    """Return photographs of a board with points (N, 3), m, as a table; frames count from 0."""
    count = [len(seen.ids) for seen in taken]
    ids = np.concatenate([seen.ids for seen in taken])
    sigma = np.concatenate([seen.sigma for seen in taken])
    return make_observations(
        np.repeat(np.arange(len(taken)), count),
        ids,
        np.concatenate([s.uv for s in taken]),
        points[ids],
        t=np.repeat([seen.t for seen in taken], count),
        sigma=np.where(np.isfinite(sigma), sigma, _DEFAULT_NOISE),
        source='guide',
    )


@dataclass
class Guide:
    """Follows a board: how near the wanted view is, and whether it stands still there.

    orders (T, N): the orders of points that the board's print does not tell apart.
    score: from 0 to 1, of the last image; thinking: a photograph is taken and not considered yet.
    """

    session: Session
    orders: Index
    stand: SessionState | None = None
    score: float = 0.0
    thinking: bool = True
    place: int = 0
    _since: float | None = None
    _last: deque[DetectedBoard] = field(default_factory=lambda: deque(maxlen=_MAX_IMAGES))

    @property
    def outline(self) -> Array | None:
        """The points of the wanted view (N, 2), px; None while there is none."""
        if self.stand is None or self.thinking or self.is_finished:
            return None
        return self.stand.outline[self.place]

    @property
    def is_finished(self) -> bool:
        """Whether no further photograph is wanted."""
        return self.stand is not None and (
            self.stand.settled or len(self.session.taken) >= MAX_PHOTOGRAPHS
        )

    def adopt(self, stand: SessionState) -> None:
        """Go on with what has been considered."""
        self.session = replace(self.session, latest=stand.latest)
        self.stand, self.thinking, self.place, self._since = stand, False, 0, None
        self.score = 0.0

    def look(self, t: float, seen: DetectedBoard | None) -> bool:
        """Take note of an image at a time, s; return whether it is taken as a photograph."""
        outline = self.outline
        if outline is None:
            self._last.clear()
            return False
        if self._since is None or t < self._since:
            self._since = t
            self._last.clear()
        self.score = 0.0 if seen is None else self._likeness(seen, outline)
        if seen is not None and self._is_still(seen) and self.score >= MIN_SCORE:
            self.session = replace(self.session, taken=(*self.session.taken, seen))
            self.thinking = True
            return True
        if t - self._since > _VIEW_TIMEOUT:
            self._skip_view()
        return False

    def _likeness(self, seen: DetectedBoard, outline: Array) -> float:
        """Return 1 / (1 + d / r): d apart, r the size of the wanted view, root mean squares."""
        size = np.nanvar(outline, axis=0).sum()
        apart = [
            np.nanmean(((outline[order[seen.ids]] - seen.uv) ** 2).sum(axis=1))
            for order in self.orders
        ]
        return float(1 / (1 + np.sqrt(min(apart) / size)))

    def _is_still(self, seen: DetectedBoard) -> bool:
        """Whether the board has stood still long enough."""
        last = self._last
        last.append(seen)
        while len(last) > 2 and seen.t - last[1].t >= _STANDSTILL < seen.t - last[0].t:
            last.popleft()
        if seen.t - last[0].t < _STANDSTILL:
            return False
        most = _MAX_MOTION * self.session.lens.width
        for view in last:
            _, rows, theirs = np.intersect1d(seen.ids, view.ids, return_indices=True)
            moved = np.abs(seen.uv[rows] - view.uv[theirs])
            if not moved.size or moved.max() > most:
                return False
        return True

    def fail(self) -> None:
        """Go on without the last photograph, which cannot be used with the others, and think."""
        room = self.session.room._replace(taken=np.zeros((0, 3)))
        self.session = replace(self.session, taken=self.session.taken[:-1], room=room, latest=None)
        self.thinking = True

    def _skip_view(self) -> None:
        """Ask for another view; where the board would have been it cannot be."""
        assert self.stand is not None
        wanted, session, self._since = self.stand.wanted, self.session, None
        middle = wanted.shots.camera.take(self.place).into_body(wanted.board.points).mean(axis=0)
        room = session.room._replace(taken=np.vstack([session.room.taken, middle]))
        self.session, self.place = replace(session, room=room), self.place + 1
        self.thinking = self.place == len(self.stand.outline)


def start_session(
    lens: Lens, points: Array, room: tuple[float, float], number: str, goal: float
) -> Session:
    """Return a session without photographs.

    lens: of Kannala-Brandt's form; views are wanted within its field alone; room: nearest and
    furthest distance of the board, m.
    """
    open_lens = replace(lens, max_incidence=field_of_view(lens))
    return Session(open_lens, points, ViewLimits(*room, field=lens.max_incidence), number, goal)
