"""Which photographs to take: all of them, of a lens known by its type, or those that come next.

The next ones settle what a cause is confounded with, or minimize the standard error of a number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis import Cause
from fisheye_svp_ros.effects.base import Effect, Untestable
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.effects.ray_effects import ViewpointShiftEffect
from fisheye_svp_ros.errors import GeometryError, ParameterError
from fisheye_svp_ros.optics.curves import KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens, field_of_view, intrinsic_names
from fisheye_svp_ros.planning.optimal_design import (
    Criterion,
    Design,
    FlatBoard,
    Shots,
    ViewLimits,
    candidate_shots,
    max_view_angle,
    richest_forms,
)
from fisheye_svp_ros.pose import identity, quaternion_from_rotation
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.scene.table_checks import check_noise
from fisheye_svp_ros.simulate.simulation import blank_views
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.rig_state import Linearization, RigState, RigViews, group_by_frame

# Over those of the photographs that there are: still sharp, still in reach
_MIN_DISTANCE_RATIO, _MAX_DISTANCE_RATIO = 0.7, 1.5


class NextViews(NamedTuple):
    """Wanted photographs, most telling first.

    asked: a number, a cause, or `lens`; others: what the cause may be mistaken for; unit: of the
    number, '' where certainty or a share is told; answers (N + 1,): before, and with each view
    more: the number's standard error, the probability that the cause proves needed beside any of
    the others, or the mean standard error of several numbers over what it is now (over what the
    first photograph leaves, where there is none yet).
    """

    asked: str
    others: tuple[str, ...]
    unit: str
    answers: tuple[float, ...]
    shots: Shots
    board: FlatBoard

    def to_list(self) -> list[dict[str, Any]]:
        """Return what diagnosis.json holds: a mapping a photograph, SI units."""
        shots, kind = (
            self.shots,
            'certainty' if self.others else ('stderr' if self.unit else 'relative_stderr'),
        )
        return [
            {
                'asked': self.asked,
                'others': list(self.others),
                **{
                    f'{name}_{"m" if name == "distance" else "rad"}': float(
                        getattr(shots, name)[i]
                    )
                    for name in Shots._fields[1:]
                },
                'position': shots.camera.position[i].tolist(),
                'quaternion': quaternion_from_rotation(shots.camera.rotation[i]).tolist(),
                f'{kind}_before': self.answers[i],
                f'{kind}_after': self.answers[i + 1],
            }
            for i in range(len(shots.distance))
        ]


def next_photographs(
    after: Linearization,
    causes: Sequence[Cause],
    noise: float,
    count: int,
    number: str | None = None,
    room: ViewLimits | None = None,
) -> NextViews:
    """Choose `count` photographs beside those of a fit, of the same board by the same camera.

    number: whose error is to shrink; by default what the causes may be mistaken for, then what
    the first of them measures, then the lens.  noise: of u and v, px.
    Raises GeometryError for several cameras and targets that are not one flat board, and
    ParameterError for an unknown number.
    """
    if after.data.cameras > 1:
        raise GeometryError('the next photographs can be planned for one camera only')
    pose = after.state.view_poses(after.data)
    board = FlatBoard.from_observations(after.data.observations, pose)
    if room is None:
        away = np.linalg.norm(board.points.mean(axis=0) - pose.position, axis=-1)
        room = ViewLimits(
            _MIN_DISTANCE_RATIO * float(away.min()), _MAX_DISTANCE_RATIO * float(away.max())
        )
    views = after.data.views
    seen = pose.into_body(views.points)[views.used]
    reached = float(np.arccos((seen[:, 2] / np.linalg.norm(seen, axis=-1)).min()))
    room = room._replace(field=min(room.field, max_view_angle(after.state.lens, reached)))
    asked, rivals, effects = _choose_question(after, causes, number)
    shots = candidate_shots(after.state, board, room, np.random.default_rng(0))
    design = Design(after, effects, board, shots, noise)
    rivals = tuple(o for o in rivals if any(o == n.partition('.')[0] for n in design.names))
    question = lens_criterion(design) if asked == 'lens' else design.question(asked, rivals)
    chosen, answers = design.choose(question, count)
    return next_views(design, asked, rivals, question, chosen, answers)


def next_views(
    design: Design,
    asked: str,
    others: tuple[str, ...],
    question: Criterion,
    chosen: Index,
    answers: Sequence[float],
) -> NextViews:
    """Return chosen views with their answers, in the unit that they are told in."""
    unit = design.units[question.interest[0]] if len(question.interest) == 1 else ''
    if not (unit or others):
        # Before the first photograph of all nothing is known to compare with.
        first = answers[0 if design.known_views else 1]
        answers = [answer / first for answer in answers]
    return NextViews(asked, others, unit, tuple(answers), design.shots.take(chosen), design.board)


def lens_criterion(design: Design) -> Criterion:
    """Ask for all numbers of the lens itself, causes and what looks like them left open."""
    interest = np.flatnonzero(['.' not in name for name in design.names])
    return Criterion(interest, np.setdiff1d(np.arange(len(design.names)), interest))


def _choose_question(
    after: Linearization, causes: Sequence[Cause], number: str | None
) -> tuple[str, tuple[str, ...], list[Effect]]:
    """Return what is asked for, what it may be mistaken for, and effects to take in."""
    if number is not None:
        return number, (), _effects_with(number, after)
    fitted = {term.name for term in after.state.terms}
    fitted_causes = [c for c in causes if c.effect in fitted and c.stage in ('lens', 'target')]
    for cause in fitted_causes:
        # How a board sags, no photograph that is planned can tell.
        alike = tuple(name for name in cause.indistinguishable_from if name in CATALOGUE)
        if alike:
            return cause.effect, alike, richest_forms(after, alike)
    if fitted_causes:
        return fitted_causes[0].effect, (), []
    if after.free:
        return 'lens', (), []
    return 'e0', (), [ViewpointShiftEffect(1)]


def check_parameter_name(
    number: str, observations: Observations, lens: Lens, free: Sequence[str]
) -> None:
    """Raise ParameterError for a number that no diagnosis of a table determines.

    How many parts an effect has, and their names (NAME.PART), only the diagnosis tells.
    """
    if number not in free and '.' not in number:
        data = group_by_frame(observations)
        _effects_with(number, Linearization(data, initial_state(data, lens), tuple(free)))


def _effects_with(number: str, after: Linearization) -> list[Effect]:
    """Return the simplest form of an effect that has a number by this name, or this name itself.

    None where the fit has it.  Raises ParameterError where no effect does.
    """
    names = list(after.free)
    if number in {*after.free, *(name for t in after.state.terms for name in _names_of(t.effect))}:
        return []
    for name, kind in CATALOGUE.items():
        if kind.stage == 'noise':
            continue
        try:
            forms = kind.candidates(after.scene)
        except Untestable:
            continue
        for form in forms:
            if number in _names_of(form):
                return [form]
        parts = [parameter.name for form in forms for parameter in form.parameters]
        names += (
            [name]
            if '.' in ''.join(parts)
            else [f'{name}.{part}' for part in dict.fromkeys(parts)]
        )
    if number in intrinsic_names(after.state.lens):
        raise ParameterError(f'--for {number}: {number} is fixed; add --free intrinsics')
    raise ParameterError(
        f'--for {number}: not a parameter of this lens or of an effect; choose '
        f'from {", ".join(names)}'
    )


def _names_of(effect: Effect) -> set[str]:
    """Return the names of an effect and of its parameters, these with and without its own."""
    parts = {parameter.name for parameter in effect.parameters}
    return {effect.name, *parts, *(f'{effect.name}.{part}' for part in parts)}


class PhotographPlan(NamedTuple):
    """Wanted photographs, and the standard errors of the lens to expect from them, by name."""

    wanted: NextViews
    stderr: dict[str, float]

    def __repr__(self) -> str:
        errors = ', '.join(f'{name} {error:.2g}' for name, error in self.stderr.items())
        return f'PhotographPlan({len(self.wanted.shots.camera.position)} views; {errors})'


def plan(
    lens: Lens, points: Array, room: ViewLimits, count: int, number: str | None, noise: float
) -> PhotographPlan:
    """Choose photographs of a board with points (N, 3), m, z into the board.

    number: whose error is to be small, the whole lens by default; a viewpoint shift is left open.
    Raises GeometryError where the lens does not see the board, ParameterError for a number that
    it does not have and for impossible noise.
    """
    check_noise(noise)
    board = FlatBoard(np.arange(len(points)), points, np.zeros(len(points), int), np.eye(3))
    state = RigState(identity(1), identity(1), lens, ())
    if lens.calibrated_angle is not None:
        room = room._replace(field=max_view_angle(lens, lens.calibrated_angle))
    shots = candidate_shots(state, board, room, np.random.default_rng(0))
    views = blank_views(board.landmark, points, len(shots.distance))
    data = RigViews.of_one_camera(views)
    posed = RigState(shots.camera, identity(1), lens, ())
    linear = Linearization(data, posed, intrinsic_names(lens))
    design = Design(linear, [ViewpointShiftEffect(1)], board, shots, noise, known=False)
    question = lens_criterion(design) if number is None else design.question(number)
    chosen, answers = design.choose(question, count)
    information = design.known + design.added[chosen].sum(axis=0)
    errors = np.sqrt(np.diag(np.linalg.inv(information)))
    return PhotographPlan(
        next_views(design, number or 'lens', (), question, chosen, answers),
        {
            name.rpartition('.')[2]: float(error)
            for name, error in zip(design.names, errors, strict=True)
        },
    )


def nominal_lens(image_size: tuple[int, int], field: float) -> Lens:
    """Return an equidistant lens of a type: its field over the width of the image, rad.

    Where its image is a circle, corners beyond that hold nothing.
    """
    width, height = image_size
    lens = Lens(
        'lens',
        width,
        height,
        width / field,
        width / field,
        (width - 1) / 2,
        (height - 1) / 2,
        KannalaBrandt(),
        1.0,
    )
    return replace(lens, max_incidence=min(field / 2, field_of_view(lens)))
