"""First stage, the problem: inputs checked, outliers rejected, the simulation fitted as it is."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np

from fisheye_svp_ros.arrays import Index
from fisheye_svp_ros.diagnosis.effect_forms import with_effect
from fisheye_svp_ros.diagnosis.fitted_model import rms_px
from fisheye_svp_ros.diagnosis.outliers import (
    Outliers,
    cross_camera_offsets,
    find_outliers,
    quantization_step,
)
from fisheye_svp_ros.effects.base import Effect, Untestable
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.effects.quantisation import QuantisationEffect
from fisheye_svp_ros.effects.rig_flex import RigFlexEffect
from fisheye_svp_ros.effects.stereo_time_offset import StereoTimeOffsetEffect
from fisheye_svp_ros.effects.target import LANDMARKS, landmark_rows, on_boards
from fisheye_svp_ros.errors import ObservationError, ParameterError
from fisheye_svp_ros.optics.lens import Lens, intrinsic_names
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Observations, rig_cameras
from fisheye_svp_ros.solve.bundle_adjustment import adjust
from fisheye_svp_ros.solve.initial_rig import initial_state, localize_cameras, localize_frames
from fisheye_svp_ros.solve.measured_poses import posable_views
from fisheye_svp_ros.solve.rig_state import Linearization, RigState, RigViews, group_by_frame

Progress = Callable[[str, float], None]

ROUNDING = 1e-7  # px: what is simulated without noise scatters by less, nothing measured does
MIN_SHARED_FRAMES = 5  # of two cameras: of fewer, others hardly predict one by the rig
MAX_RIG_RATIO = 2.0  # times the rms that each camera has by itself: they do not stand still
_OUTSIDE_SHARE = 0.02  # of the points of a camera: more than single outliers
_COPIED_SHARE = 0.5  # of the image points: no two photographs have so many alike
_PLACE_TOLERANCE = 1e-3  # of a target's extent: more than places that are written less exactly
_MANY_POINTS, _MIN_POINTS = 1500, 24  # of a thinned table, and of a view that stays whole
_STEP_OVER_NOISE = 0.1  # a step this small beside the noise is how numbers are written
_UNRELATED_SHARE = 0.05  # of the image, by which half of the views contradict a rig: none is there
_EXPLAINED_RATIO = 1.1  # times that rms, if an effect of a rig is all that moves them


def can_be_included(name: str) -> bool:
    """Whether an effect can be fitted without a test: not those of noise, or single landmarks."""
    kind = CATALOGUE[name]
    return kind.stage != 'noise' and not kind.asked_last


@dataclass(frozen=True)
class DiagnosisOptions:
    """Effects to include without a test, effects to leave out, whether time matters most.

    Raises ParameterError for a name that is in no catalogue, or that cannot be included.
    """

    included: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    quick: bool = False

    def leave_out(self, *names: str) -> DiagnosisOptions:
        """Return the options with more effects left out."""
        return replace(self, left_out=(*self.left_out, *names))

    def __post_init__(self) -> None:
        for name in (*self.included, *self.left_out):
            if name not in CATALOGUE:
                known = ', '.join(CATALOGUE)
                raise ParameterError(f'effect {name!r} is unknown; known are {known}')
        for name in self.included:
            if not can_be_included(name):
                raise ParameterError(f'effect {name} cannot be included without a test; leave it '
                                     'to the diagnosis')


@dataclass(frozen=True)
class Inputs:
    """What a diagnosis is asked about, checked.

    observations; lenses: as given, by camera, '' where one is that of all; free: intrinsics that
    are fitted; poses: true poses by frame; held_out: other frames of the same cameras.
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
    def given_effects(self) -> tuple[Effect, ...]:
        """The effects that the lens came with."""
        return tuple(effect for effect, _ in self.base.terms)


def rig_lenses(observations: Observations, lens: Lens | Mapping[str, Lens]) -> dict[str, Lens]:
    """Return the lens of each camera by name, or the one of all under ''.

    Raises ObservationError for a camera of the observations without a lens.
    """
    if isinstance(lens, Lens):
        return {'': lens}
    missing = [name for name in observations.cameras if name not in lens]
    if missing:
        raise ObservationError(f'{observations.source}: camera {missing[0]!r} has no lens')
    return {name: lens[name] for name in observations.cameras}


def order_cameras(table: Observations, cameras: tuple[str, ...]) -> Observations:
    """Return other observations of a rig with its cameras in the order of these.

    Raises ObservationError where they are of other cameras.
    """
    if len(cameras) == 1:
        return table
    if set(table.cameras) != set(cameras):
        held = ', '.join(filter(None, table.cameras)) or 'one without a name'
        raise ObservationError(f'{table.source}: its cameras ({held}) are not those of the rig, '
                               + ', '.join(cameras))
    order = np.array([cameras.index(name) for name in table.cameras])
    return replace(table, cameras=cameras, camera=order[table.camera])


def put_right_camera_first(table: Observations) -> Observations:
    """Return observations of a rig with its right camera first: true poses are of that one."""
    names = rig_cameras(table.cameras)
    if names is None or len(np.unique(table.camera)) < 2:
        return table
    return order_cameras(table, (names[1], *(name for name in table.cameras if name != names[1])))


def check_distinct(observations: Observations, other: Observations) -> None:
    """Raise ObservationError where most of other observations are these once more."""
    seen, again = (set(zip(table.landmark.tolist(), *table.uv.T.tolist(), strict=True))
                   for table in (observations, other))
    if len(seen & again) > _COPIED_SHARE * len(again):
        raise ObservationError(f'{other.source}: these image points are those of '
                               f'{observations.source}; other photographs are needed')


def is_another_target(observations: Observations, other: Observations) -> bool:
    """Whether landmarks of one number stand in different places of two tables."""
    one, there = observations.landmarks(), other.landmarks()
    _, mine, theirs = np.intersect1d(one.ids, there.ids, return_indices=True)
    apart = np.abs(one.points[mine] - there.points[theirs])
    return bool(apart.max(initial=0.0) > _PLACE_TOLERANCE * np.ptp(one.points, axis=0).max())


def dither(table: Observations) -> Observations:
    """Return observations with noise that nobody can measure, the same every time.

    Where nothing else is left over, as of simulated points without noise, rounding is: it depends
    on place and frame, and would be taken for a cause.
    """
    noise = 10 * ROUNDING * np.random.default_rng(0).standard_normal(table.uv.shape)
    return replace(table, uv=table.uv + noise)


def remove_copies(observations: Observations) -> tuple[Observations, tuple[int, ...]]:
    """Return the frames whose image points no earlier one has, to the last digit, and the others.

    A copy knows nothing new, and what is noise in it seems to come again.
    """
    table = observations
    order = np.lexsort((table.landmark, table.camera, table.frame))
    rows = np.column_stack([table.camera, table.landmark, table.uv])[order]
    seen: set[bytes] = set()
    again = []
    for part in np.split(np.arange(len(order)), np.flatnonzero(np.diff(table.frame[order])) + 1):
        points = rows[part].tobytes()
        if points in seen:
            again.append(int(table.frame[order[part[0]]]))
        seen.add(points)
    return table.take(~np.isin(table.frame, again)), tuple(again)


def check_cameras(observations: Observations) -> None:
    """Raise ObservationError where two cameras of a rig hold the same image points."""
    tables = [replace(observations.take(observations.camera == camera),
                      source=f'{observations.source}, camera {name}')
              for camera, name in enumerate(observations.cameras)]
    for one, other in combinations(tables, 2):
        check_distinct(one, other)


def free_parameters(lenses: Mapping[str, Lens], free: bool | None = None) -> tuple[str, ...]:
    """Return the intrinsics that are fitted, those of a rig with the camera's name before them.

    free: of all lenses or of none; None asks each lens whether a calibration made it.
    """
    return tuple(
        f'{camera}.{name}' if camera else name for camera, lens in lenses.items()
        if (lens.calibration is not None if free is None else free)
        for name in intrinsic_names(lens)
    )


def posable_observations(
    observations: Observations, lens: Lens | Mapping[str, Lens]
) -> tuple[Observations, tuple[int, ...]]:
    """Return the views that fix a pose, and the frames that have others.

    Raises GeometryError where a camera has no view left, ObservationError where image points lie
    outside the images that its lens is of.
    """
    lenses = list(rig_lenses(observations, lens).values())
    models = [ForwardModel(one) for one in lenses]
    kept = np.ones(len(observations), dtype=bool)
    left_out: set[int] = set()
    for camera in np.unique(observations.camera):
        mine = observations.camera == camera
        which = int(camera) if len(models) > 1 else 0
        _check_inside(observations.take(mine), lenses[which])
        _, frames = posable_views(observations.take(mine), models[which])
        kept[mine & np.isin(observations.frame, frames)] = False
        left_out.update(frames)
    return observations.take(kept), tuple(sorted(left_out))


def _check_inside(observations: Observations, lens: Lens) -> None:
    outside = (observations.uv < 0) | (observations.uv > (lens.width, lens.height))
    if outside.any(axis=1).mean() > _OUTSIDE_SHARE:
        raise ObservationError(
            f'{observations.source}: image points lie outside the {lens.width}x{lens.height} px '
            f'of lens {lens.name!r}; is it the lens of this camera?')


def thin_out(observations: Observations) -> Observations:
    """Return about _MANY_POINTS points of more: every second landmark, every third ...

    A view that would be left with less than _MIN_POINTS stays whole.
    """
    step = max(len(observations) // _MANY_POINTS, 1)
    views = np.stack([observations.frame, observations.camera])
    _, view, points = np.unique(views, axis=1, return_inverse=True, return_counts=True)
    place = np.unique(observations.landmark, return_inverse=True)[1].reshape(-1)
    whole = points[view.reshape(-1)] < _MIN_POINTS * step
    return observations.take(whole | (place % step == 0))


def poses_by_frame(
    observations: Observations, frame: Index, pose: Pose, source: str
) -> dict[int, Pose]:
    """Return the true pose of each frame of a table, of poses (P,) of the frames (P,).

    Raises ObservationError, naming the source, for a frame without one.
    """
    known = {number: pose.take(i) for i, number in enumerate(frame.tolist())}
    for number in observations.frames.tolist():
        if number not in known:
            raise ObservationError(
                f'{source}: frame {number} of {observations.source} has no pose in it; add it, or '
                'leave the poses out'
            )
    return known


def unpair_cameras(data: RigViews) -> RigViews:
    """Return the data with a pose for every view, whatever rig the cameras are said to be."""
    return replace(data, frame_of=np.arange(len(data.frame_of)))


def is_unpaired(data: RigViews) -> bool:
    """Whether there are frames of several cameras that `unpair_cameras` has taken apart."""
    views = len(data.views.frame)
    return data.frames == views > len(np.unique(data.views.frame))


def has_no_rig(data: RigViews) -> bool:
    """Whether no frame has several views, so that nothing says how the cameras stand."""
    return data.frames == len(data.views.frame)


def has_few_shared_frames(data: RigViews) -> bool:
    """Whether several cameras saw so few frames that what they say of a rig is no measure."""
    shared = int((np.bincount(data.frame_of) > 1).sum())
    return data.cameras > 1 and data.poses is None and shared < MIN_SHARED_FRAMES


def rig_differs(test: RigViews, state: RigState) -> bool:
    """Whether the cameras do not stand as in a state fitted to other frames."""
    if has_no_rig(test):
        return False
    alone = unpair_cameras(test)
    together, own = (rms_px(Linearization(data, localize_frames(data, state), ()))
                     for data in (test, alone))
    return together > MAX_RIG_RATIO * own


def is_unrelated(data: RigViews, state: RigState) -> bool:
    """Whether no rig explains where the cameras stand in most frames that several of them saw."""
    if data.cameras < 2 or data.poses is not None:
        return False
    misfit, _ = cross_camera_offsets(data, state, localize_cameras(state.model, data.views))
    several = np.isfinite(misfit)
    extent = float(np.ptp(data.views.uv[data.views.used], axis=0).max())
    return bool(several.any() and
                np.quantile(misfit[several], 0.5, method='higher') > _UNRELATED_SHARE * extent)


def rig_is_inconsistent(
    data: RigViews, lenses: Sequence[Lens], base: RigState, free: Sequence[str]
) -> bool:
    """Whether the cameras do not keep their places, beyond what any effect of a rig allows.

    lenses: as they were given; base: the fit of the data as a rig's.
    """
    if data.poses is not None or has_no_rig(data):
        return False
    alone = unpair_cameras(data)

    def misfits(free: Sequence[str], together: RigState) -> tuple[float, float]:
        posed = adjust(alone, initial_state(alone, lenses[0], lenses[1:]), free)
        return rms_px(Linearization(data, together, ())), rms_px(Linearization(alone, posed, ()))

    whole, own = misfits(free, base)
    if whole < MAX_RIG_RATIO * own:
        return False
    # Lenses that are wrong look like a rig that moves: they get what they want first.
    every = free_parameters(dict(zip(base.labels, lenses, strict=True)), True)
    base = adjust(data, base, every)
    whole, own = misfits(every, base)
    if whole < MAX_RIG_RATIO * own:
        return False
    scene = Linearization(data, base, ()).scene
    for kind in (RigFlexEffect, StereoTimeOffsetEffect):
        try:
            effect = kind.candidates(scene)[-1]
        except Untestable:
            continue
        base = with_effect(base, effect, np.zeros(len(effect.parameters)))
    return rms_px(Linearization(data, adjust(data, base, every), ())) > _EXPLAINED_RATIO * own
