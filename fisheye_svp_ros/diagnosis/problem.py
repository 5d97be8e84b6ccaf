"""First stage, the problem: inputs checked, outliers rejected, the simulation fitted as it is."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fisheye_svp_ros.effects.base import Effect
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.effects.detection_effects import QuantisationEffect
from fisheye_svp_ros.effects.extension import LANDMARKS, landmark_rows, on_boards
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.boards import is_flat
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.scene.table_checks import (
    check_cameras,
    check_distinct,
    order_cameras,
    put_right_camera_first,
    quantization_step,
    remove_copies,
    thin_out,
)
from fisheye_svp_ros.solve.bundle_adjustment import adjust
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.measured_poses import rig_lenses
from fisheye_svp_ros.solve.outliers import Outliers, find_outliers
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
    rms_px,
)

Progress = Callable[[str, float], None]

_STEP_OVER_NOISE = 0.1  # a step this small beside the noise is how numbers are written


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
                raise ParameterError(f'effect {name!r} is unknown; known are {known}')
        for name in self.included:
            if not can_be_included(name):
                raise ParameterError(f'effect {name} cannot be fitted without a test; leave it '
                                     'out of --with')


@dataclass(frozen=True)
class Inputs:
    """What a diagnosis is asked about, checked.

    observations; lenses: as given, by camera, '' where one is that of all; free: intrinsics that
    are fitted; poses: those given, by frame; held_out: other frames of the same cameras.
    """

    observations: Observations
    lenses: Mapping[str, Lens]
    free: tuple[str, ...]
    options: DiagnosisOptions
    poses: dict[int, Pose] | None = None
    held_out: Observations | None = None

    @classmethod
    def check(
        cls, observations: Observations, lens: Lens | Mapping[str, Lens],
        options: DiagnosisOptions, *, free_intrinsics: bool | None = None,
        poses: dict[int, Pose] | None = None, held_out: Observations | None = None,
    ) -> Inputs:
        """Return checked inputs, as `diagnose` takes them; raise ObservationError otherwise."""
        observations, _ = remove_copies(observations)
        observations.landmarks()  # each is in one place
        if poses is not None:
            observations = put_right_camera_first(observations)
        check_cameras(observations)
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
    multiples, px, 0 for none; options: without effects that these data cannot be asked for.
    """

    inputs: Inputs
    table: RigViews
    data: RigViews
    outliers: Outliers
    base: RigState
    free: tuple[str, ...]
    options: DiagnosisOptions
    step: float

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
        data, outliers = find_outliers(table, simulated)
        base = adjust(data, initial_state(data, lenses[0], lenses[1:]), inputs.free)
        if has_few_shared_frames(data) or rig_is_inconsistent(data, lenses, base, inputs.free):
            data = unpair_cameras(data)
            base = adjust(data, initial_state(data, lenses[0], lenses[1:]), inputs.free)
        step, options = quantization_step(inputs.observations.uv), inputs.options
        rms = rms_px(Linearization(data, base, inputs.free))
        if step / np.sqrt(6) > _STEP_OVER_NOISE * rms:
            options = options.leave_out(*QuantisationEffect.hides)
        else:
            step = 0.0
        return cls(inputs, table, data, outliers, base, inputs.free, options, step)

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
        return tuple(effect for effect, _ in self.base.terms)
