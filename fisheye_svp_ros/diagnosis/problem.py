"""First stage, the problem: inputs checked, outliers rejected, the simulation fitted as it is.

Known poses of the camera are held: they show what free poses hide.  Those of a robot's flange, or
poses with noise of their own, are not, and what holds them would be blamed on the lens.  So they
are held only if the whole catalogue, fitted beside them, explains the images as well as free
poses do; else the hand-eye transform and the noise of the robot are fitted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from fisheye_svp_ros.diagnosis.null_model import NullModel
from fisheye_svp_ros.effects.base import Effect, camera_terms
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.effects.detection_effects import QuantisationEffect
from fisheye_svp_ros.effects.extension import (
    LANDMARKS,
    extend_lens,
    landmark_rows,
    on_boards,
)
from fisheye_svp_ros.effects.target_effects import LandmarkSurveyEffect
from fisheye_svp_ros.errors import GeometryError, ObservationError, ParameterError
from fisheye_svp_ros.mixed_model import eliminate
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.boards import is_flat
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.scene.table_checks import (
    check_cameras,
    check_distinct,
    check_rigid,
    order_cameras,
    put_right_camera_first,
    quantization_step,
    thin_out,
)
from fisheye_svp_ros.solve.bundle_adjustment import adjust
from fisheye_svp_ros.solve.hand_eye import HandEye, fit_hand_eye, flange_poses
from fisheye_svp_ros.solve.initial_rig import initial_state, localize_frames
from fisheye_svp_ros.solve.measured_poses import posable_observations, rig_lenses
from fisheye_svp_ros.solve.outliers import NO_OUTLIERS, Outliers, find_outliers, without_points
from fisheye_svp_ros.solve.rig_checks import (
    has_few_shared_frames,
    is_unrelated,
    rig_is_inconsistent,
    unpair_cameras,
)
from fisheye_svp_ros.solve.rig_state import (
    Linearization,
    RigState,
    RigViews,
    free_parameters,
    group_by_frame,
    with_effect,
)
from fisheye_svp_ros.solve.wrong_landmarks import find_wrong_landmarks

Progress = Callable[[str, float], None]
Provisional = Callable[[tuple[str, ...]], None]  # told the names of causes

_STEP_OVER_NOISE = 0.1  # a step this small beside the noise is how numbers are written
# F ratio of what known poses leave and free ones do not.  With poses of the camera: about 1, 1 to
# 2 beside local errors of board and image that imitate motions; with those of robots: 30 and more.
_MAX_RATIO = 4.0


def ignore_progress(names: tuple[str, ...]) -> None:
    """Keep what a diagnosis has found so far from everybody."""


def can_be_included(name: str) -> bool:
    """Whether an effect can be fitted without a test: not those of noise, or single landmarks."""
    kind = CATALOGUE[name]
    return kind.stage != 'noise' and not kind.asked_last


@dataclass(frozen=True)
class DiagnosisOptions:
    """Effects to include without a test, effects to leave out, whether time matters most.

    range_m: where ray errors are asked for, m, beside those at 0.3, 1 and 5 m; stated: forms of
    effects that are known to be there, which are included as well.
    Raises ParameterError for a name that is in no catalogue, or that cannot be included, and for
    a range that is none.
    """

    included: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    quick: bool = False
    range_m: float | None = None
    stated: tuple[Effect, ...] = ()

    def leave_out(self, *names: str) -> DiagnosisOptions:
        """Return the options with more effects left out."""
        return replace(self, left_out=(*self.left_out, *names))

    def __post_init__(self) -> None:
        if self.range_m is not None and not 0 < self.range_m < np.inf:
            raise ParameterError(f'range {self.range_m:g}: a distance in m, above 0, is needed')
        names = (*self.included, *(effect.name for effect in self.stated))
        object.__setattr__(self, 'included', tuple(dict.fromkeys(names)))
        for name in (*self.included, *self.left_out):
            if name not in CATALOGUE:
                known = ', '.join(CATALOGUE)
                raise ParameterError(f'effect {name!r} is unknown; choose from {known}')
        for name in self.included:
            if not can_be_included(name):
                raise ParameterError(
                    f'effect {name} cannot be fitted without a test; leave it out of --with'
                )


@dataclass(frozen=True)
class Inputs:
    """What a diagnosis is asked about, checked.

    observations; lenses: as given, by camera, '' where one is that of all; free: intrinsics that
    are fitted; poses: those given, by frame; held_out: other frames of the same cameras;
    provisional: told the causes that the first round finds.
    """

    observations: Observations
    lenses: Mapping[str, Lens]
    free: tuple[str, ...]
    options: DiagnosisOptions
    poses: dict[int, Pose] | None = None
    held_out: Observations | None = None
    provisional: Provisional = ignore_progress

    @classmethod
    def check(
        cls,
        observations: Observations,
        lens: Lens | Mapping[str, Lens],
        options: DiagnosisOptions,
        *,
        free_intrinsics: bool | None = None,
        poses: dict[int, Pose] | None = None,
        held_out: Observations | None = None,
    ) -> Inputs:
        """Return checked inputs, as `diagnose` takes them; raise ObservationError otherwise.

        observations, held_out: as `usable_observations` returns them.
        """
        observations.landmarks()  # each is in one place
        if poses is not None:
            observations = put_right_camera_first(observations)
        check_cameras(observations)
        check_rigid(observations)
        lenses = rig_lenses(observations, lens)
        free = free_parameters(lenses, free_intrinsics)
        observations = on_boards(observations, next(iter(lenses.values())).target.get(LANDMARKS))
        if held_out is not None:
            held_out = order_cameras(held_out, observations.cameras)
            held_out = on_boards(held_out, landmark_rows(observations))
            check_distinct(observations, held_out)
        if options.quick:
            observations = thin_out(observations)
        return cls(observations, lenses, free, options, poses, held_out)


@dataclass(frozen=True)
class Problem:
    """Data without outliers, and the simulation as it was fitted to them.

    table: all points; base: the fit, with `free` intrinsics; step: of which all coordinates are
    multiples, px, 0 for none; options: without effects that these data cannot be asked for;
    start: the fit that causes are sought from, with landmarks displaced that are clearly not where
    they are said to be; else the base.
    """

    inputs: Inputs
    table: RigViews
    data: RigViews
    outliers: Outliers
    base: RigState
    free: tuple[str, ...]
    options: DiagnosisOptions
    step: float
    start: RigState

    @classmethod
    def prepare(cls, inputs: Inputs) -> Problem:
        """Localize, reject outliers, and fit the simulation.

        Cameras that no rig explains are posed each by itself.
        Raises GeometryError where a view cannot be posed at all.
        """
        lenses = tuple(inputs.lenses.values())
        table = group_by_frame(inputs.observations, inputs.poses)
        simulated = initial_state(table, lenses[0], lenses[1:])
        if is_unrelated(table, simulated):
            table = unpair_cameras(table)
            simulated = initial_state(table, lenses[0], lenses[1:])
        table, believed, rejected = _displace_landmarks(table, simulated, inputs)
        data, outliers = find_outliers(table, believed)
        outliers = outliers.join(rejected)
        base = adjust(data, initial_state(data, lenses[0], lenses[1:]), inputs.free)
        if has_few_shared_frames(data) or rig_is_inconsistent(data, lenses, base, inputs.free):
            data = unpair_cameras(data)
            base = adjust(data, initial_state(data, lenses[0], lenses[1:]), inputs.free)
        step, options = quantization_step(inputs.observations.uv), inputs.options
        rms = Linearization(data, base, inputs.free).rms_px
        if step / np.sqrt(6) > _STEP_OVER_NOISE * rms:
            options = options.leave_out(*QuantisationEffect.hides)
        else:
            step = 0.0
        start = base
        if believed is not simulated:
            start = localize_frames(data, replace(base, terms=believed.terms, **_lenses(believed)))
            start = adjust(data, start, inputs.free)
        return cls(inputs, table, data, outliers, base, inputs.free, options, step, start)

    @cached_property
    def linear(self) -> Linearization:
        """The simulation as it was fitted, linearized."""
        return Linearization(self.data, self.base, self.free)

    @property
    def observations(self) -> Observations:
        """The table as it is diagnosed."""
        return self.inputs.observations

    @property
    def plannable(self) -> bool:
        """Whether the next photographs can be planned: of one camera, and one flat board."""
        first = np.unique(self.observations.landmark, return_index=True)[1]
        return len(self.observations.cameras) == 1 and is_flat(self.observations.xyz[first])

    @property
    def given_effects(self) -> tuple[Effect, ...]:
        """The effects that the lens came with."""
        return tuple(term.effect for term in self.base.terms)


def _lenses(state: RigState) -> dict[str, Any]:
    return {'lens': state.lens, 'others': state.others}


def _displace_landmarks(
    table: RigViews, simulated: RigState, inputs: Inputs
) -> tuple[RigViews, RigState, Outliers]:
    """Find landmarks that are clearly not where they are said to be.

    Returns the data without those that no place explains, the state with the others displaced,
    and the outliers.
    """
    lenses, state = tuple(inputs.lenses.values()), simulated

    def fit_state(rows: Observations) -> RigState:
        data = group_by_frame(posable_observations(rows, inputs.lenses.get('', inputs.lenses))[0])
        return adjust(data, initial_state(data, lenses[0], lenses[1:]), inputs.free)

    observations = table.observations
    wrong = find_wrong_landmarks(
        observations,
        simulated.model,
        lambda rows: fit_state(rows).model if inputs.free else simulated.model,
    )
    lost = [landmark for landmark in wrong if not landmark.is_displaced]
    rejected = NO_OUTLIERS.append_landmarks(observations, lost)
    moved = [landmark for landmark in wrong if landmark.is_displaced]
    effect = LandmarkSurveyEffect(tuple(landmark.number for landmark in moved))
    if wrong and inputs.free:
        numbers = [landmark.number for landmark in wrong]
        state = replace(
            state,
            **_lenses(fit_state(observations.take(~np.isin(observations.landmark, numbers)))),
        )
    if moved and effect.name not in inputs.options.left_out:
        state = with_effect(state, effect, np.concatenate([landmark.offset for landmark in moved]))
    if wrong:
        table = without_points(table, np.isin(table.views.row, rejected.rows))
        state = localize_frames(table, state)
    return table, state, rejected


def prepare_problem(inputs: Inputs) -> tuple[Problem, bool]:
    """Return the problem, its poses free where the given ones are not the camera's, and if so.

    Raises ObservationError where they are not those of a robot's flange either.
    """
    if inputs.poses is None:
        return Problem.prepare(inputs), False
    free = Problem.prepare(replace(inputs, poses=None))
    if _misfit_ratio(free, inputs.poses) <= _MAX_RATIO:
        return Problem.prepare(inputs), False
    find_hand_eye(free.linear, inputs.poses)
    return free, True


def find_hand_eye(linear: Linearization, poses: dict[int, Pose]) -> HandEye:
    """Return the hand-eye calibration of a fitted model, from poses of the flange by frame.

    Raises ObservationError where the poses do not determine it, or no transform explains them.
    """
    data = linear.data
    try:
        return fit_hand_eye(data, linear.state, linear.free, *flange_poses(data, poses))[1]
    except GeometryError as cause:
        raise ObservationError(
            f'{data.observations.source}: the given poses are neither those of the camera nor '
            f'those of a flange that carries the camera or the target ({cause}). Correct the '
            'poses, or leave them out'
        ) from cause


def _misfit_ratio(problem: Problem, poses: dict[int, Pose]) -> float:
    """Return the F ratio of known poses against free ones, all effects of the catalogue free.

    problem: with free poses.  Infinite where the camera could not see from the known poses what
    it did.
    """
    data, left_out = problem.data, problem.options.left_out
    known, _ = flange_poses(data, poses)
    held, state = replace(data, poses=known), replace(problem.base, pose=known)
    if not np.isfinite(Linearization(held, state, problem.free).residual).all():
        return np.inf
    free = NullModel.estimate(data, problem.base, problem.free, left_out=left_out)
    fixed = NullModel.linearize(held, state, problem.free, free.variances, left_out, False)
    before, after = (
        float(
            eliminate(
                model.information,
                np.concatenate(
                    [model.included_columns, model.fixed.own + model.fixed.forms.generic]
                ),
            )[-1, -1]
        )
        for model in (fixed, free)
    )
    unknown = free.full.group_rank
    return max(before - after, 0.0) / unknown / (after / (free.full.rows - unknown))


def extended_lenses(
    lenses: Mapping[str, Lens], state: RigState, observations: Observations
) -> dict[str, Lens]:
    """Return the lenses that were fitted, with their effects, for every command and node."""
    # What happened to one recording is no part of the lens.
    lasting = [term for term in state.terms if not term.effect.of_recording]
    extended = {}
    for camera, (name, fitted) in enumerate(zip(lenses, state.lenses, strict=True)):
        # A fitted height curve may turn a little earlier than the one the lens came with.
        limit = min(lenses[name].max_incidence, fitted.image_height.limit * (1 - 1e-6))
        own = replace(fitted, calibration=lenses[name].calibration, max_incidence=limit)
        extended[name] = extend_lens(own, camera_terms(lasting, camera), observations)
    return extended
