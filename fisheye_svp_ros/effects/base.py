"""What an effect is: a small extension of the forward model at one of its stages.

The stages and what a displacement means there (S views of N points, last axis D):
target   D = 3, m: the landmark moves in the target frame
pose     D = 6, m and rad: the camera moves for this one point (`Pose.retract`)
pupil    D = 3, m: the ray starts beside the axis, in the camera frame
ray      D = 2, m and px: viewpoint shift s and image height h change
image    D = 2, px: the optical image moves
detector D = 2, px: the detected point moves
noise    nothing moves; the scatter or the table changes
Nearly all effects are linear in their parameters: displacement = columns @ values.
A model holds them as terms: effects with their values, and where their columns stand.
"""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from math import prod
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, gather_rows, scatter
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.optics.camera import Incidence
from fisheye_svp_ros.optics.curves import IMAGE_HEIGHTS
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.boards import Board, find_boards
from fisheye_svp_ros.scene.observations import Views

DIMENSIONS = {
    'target': 3,
    'pose': 6,
    'pupil': 3,
    'ray': 2,
    'image': 2,
    'detector': 2,
    'noise': 0,
}  # D
_MAX_SPARSER = 2.0  # times as much time between frames: over more a camera need not move evenly
_PAUSE = 4.0  # times the median time between views: over so long no motion is known
_MAX_PLAUSIBLE = 30.0  # times what would be a large value of a parameter


class Untestable(Exception):
    """The data lacks what an effect needs; the text says what."""


class Parameter(NamedTuple):
    """One number of an effect: its name, unit, a size that would be large, whether >= 0."""

    name: str
    unit: str
    large: float
    positive: bool = False


@dataclass
class Scene:
    """All that an effect may look at: views, lens, the camera's poses (S,) and ideal images.

    uv (S, N, 2), px: predicted without detector effects; incidence: where the rays meet the lens,
    None before the ray stage; cameras: of a rig whose lenses differ, the views (rows of all),
    number and scene of each camera.
    """

    views: Views
    lens: Lens
    pose: Pose
    uv: Array
    incidence: Incidence | None = None
    cameras: tuple[tuple[Index, int, Scene], ...] = ()

    @cached_property
    def boards(self) -> list[Board]:
        """The rigid pieces of the target with their own axes."""
        used = self.views.used
        return find_boards(self.views.points[used], self.views.board[used])

    @cached_property
    def theta_max(self) -> float:
        """Largest incidence angle among the observations, rad."""
        if self.incidence is None:
            return self.lens.max_incidence
        theta = self.incidence.theta[self.views.used]
        return float(np.nanmax(theta, initial=1e-3))

    @property
    def theta(self) -> Array:
        """Incidence angles (S, N), rad."""
        assert self.incidence is not None, 'asked before the ray stage'
        return self.incidence.theta

    @cached_property
    def times(self) -> Array:
        """Time of each view (S,), s; NaN where unknown."""
        t = np.where(self.views.used, self.views.t, np.nan)
        timed = np.asarray(np.isfinite(t).any(axis=1))
        return scatter(timed, np.nanmean(t[timed], axis=1))

    @cached_property
    def twist(self) -> Array:
        """Velocity (S, 6) of each view's camera, m/s and rad/s, from its neighbors in time.

        Zero where it is unknown: of a view with pauses before and after it.
        """
        twist = np.zeros((len(self.times), 6))
        for camera in np.unique(self.views.camera):
            views_of_camera = np.flatnonzero(
                (self.views.camera == camera) & np.isfinite(self.times)
            )
            order = views_of_camera[np.argsort(self.times[views_of_camera], kind='stable')]
            if len(order) < 2:
                continue
            step = np.diff(self.times[order])
            pauses = np.flatnonzero(step > _PAUSE * np.median(step)) + 1
            for burst in np.split(order, pauses):
                if len(np.unique(self.times[burst])) > 1:
                    twist[burst] = _velocities(self.pose.take(burst), self.times[burst])
        return twist

    def normalized_uv(self) -> Array:
        """Image points (S, N, 2) relative to the principal point, over the focal length."""
        if self.cameras:
            return gather_rows([(rows, part.normalized_uv()) for rows, _, part in self.cameras])
        center, focal = (self.lens.cx, self.lens.cy), (self.lens.fx, self.lens.fy)
        return np.asarray((self.uv - np.array(center)) / np.array(focal))


@dataclass(frozen=True)
class Effect(ABC):
    """One effect with its structure (the dataclass fields); the values live outside."""

    name: ClassVar[str]
    stage: ClassVar[str]
    of_target: ClassVar[bool] = False  # whether another target would not have it
    rarer_than: ClassVar[str] = ''  # a more common effect with nearly the same residuals
    of_motion: ClassVar[bool] = False  # whether it follows from the motion of the camera
    abrupt: ClassVar[bool] = False  # whether smooth changes are no evidence of it
    asked_after: ClassVar[tuple[str, ...]] = ()  # more common effects whose residuals it includes
    of_frames: ClassVar[bool] = False  # whether its size depends on how each frame was taken
    asked_last: ClassVar[bool] = False  # whether it is tested only beside all other effects
    hides: ClassVar[tuple[str, ...]] = ()  # effects confounded with it where it is present
    hidden_structure: ClassVar[tuple[str, ...]] = ()  # variables on which its residuals depend
    # How a map of the target shows it: 'smooth' over boards, 'single' landmarks, '' not at all
    target_map: ClassVar[str] = ''
    when_untestable: ClassVar[str] = ''  # what to do where frames differ and have no time
    meaning: ClassVar[str] = ''  # what it is, as a sentence
    headline: ClassVar[str] = ''  # the same, shorter, without a stop; '' for the meaning
    signature: ClassVar[str]
    to_separate: ClassVar[str]

    @classmethod
    def budget_stage(cls) -> str:
        """Return its stage in the variance budget: lens, target, frame or noise."""
        if cls.of_frames:
            return 'frame'
        return cls.stage if cls.stage in ('target', 'noise') else 'lens'

    @classmethod
    def summary(cls) -> str:
        """Return what it is, as a sentence: its `meaning`, or the docstring of its module."""
        return cls.meaning or inspect.getdoc(inspect.getmodule(cls)) or cls.name

    @classmethod
    def candidates(cls, scene: Scene) -> Sequence[Effect]:
        """Return the forms of this effect worth testing, simplest first; raise Untestable."""
        return [cls()]

    @property
    @abstractmethod
    def parameters(self) -> tuple[Parameter, ...]:
        """The parameters, in the order of the columns."""

    @abstractmethod
    def columns(self, scene: Scene) -> Array:
        """Derivatives (S, N, D, P) of the displacement at this effect's stage."""

    def displacement(self, scene: Scene, values: Array) -> Array:
        """Displacement (S, N, D) at this effect's stage."""
        return np.asarray(self.columns(scene) @ values)

    def prior_sigma(self, scene: Scene) -> Array:
        """Return standard deviations (P,) of the values about 0 before any data; inf: unknown."""
        return np.full(len(self.parameters), np.inf)

    def is_implausible(self, values: Array, scene: Scene) -> bool:
        """Whether there can be no such values (P,), whatever the data say.

        A scale that poses take up all but entirely would have to be a hundred per cent.
        """
        sizes = zip(values, self.parameters, strict=True)
        return all(abs(value) > _MAX_PLAUSIBLE * parameter.large for value, parameter in sizes)

    def with_curves(self, lens: Lens, values: Array) -> Lens:
        """Return the lens with what this effect adds to its curves; others leave them alone."""
        return lens

    def report_values(self, values: Array) -> Array:
        """Return values (P, ...) without what something else that is free takes up."""
        return values

    @property
    def lens_field(self) -> str:
        """The field of a lens that holds this effect where nothing else in the lens can."""
        return 'target' if self.stage == 'target' or self.of_target else 'corrections'

    def extend(self, lens: Lens, values: Array) -> Lens:
        """Return the lens with this effect in its place, added to what stands there.

        Raises LensError where the lens holds another form of the same effect.
        """
        curved = self.with_curves(lens, values)
        if curved is not lens and IMAGE_HEIGHTS.name_of(type(curved.image_height)):
            return curved
        held: Mapping[str, Any] = getattr(lens, self.lens_field)
        if self.name in held:
            held_form, before = self.from_dict(held[self.name], lens.name)
            if held_form != self:
                raise LensError(
                    f'lens {lens.name!r} already holds {held_form.key} in {self.lens_field}; '
                    f'{self.key} cannot be added'
                )
            values = values + before
        changes: dict[str, Any] = {self.lens_field: {**held, self.name: self.to_dict(values)}}
        return replace(lens, **changes)

    def rescale_values(self, values: Array, ratio: float) -> Array:
        """Return the values that leave the effect what it is when fx and fy grow by a ratio.

        What changes the curves grows with them, what moves image points stays what it is, in px.
        """
        return values

    def resize_values(self, values: Array, scale: float, rows: float) -> Array | None:
        """Return the values for an image whose pixels are scaled; None where there are none.

        scale: of the focal length, px; rows: share of the old image's rows that it has.
        """
        return values * [scale if parameter.unit == 'px' else 1.0 for parameter in self.parameters]

    def merge_with(self, other: Self) -> Effect:
        """Return the form that holds this one and another of the same effect."""
        return other

    def beside_intrinsics(self, scene: Scene) -> Effect:
        """Return the form to ask for where the lens's own intrinsics are fitted, too."""
        return self

    @property
    def of_recording(self) -> bool:
        """Whether it happened to one recording, so that neither lens nor target has it."""
        return False

    def holds_for(self, t: Array, known: Array) -> bool:
        """Whether it says anything of other frames, of times t (s), than those of known times."""
        if not self.of_recording:
            return True
        return bool(np.nanmin(known) <= np.median(t) <= np.nanmax(known))

    def is_refutable_by(self, t: Array, known: Array) -> bool:
        """Whether other frames, of times t (s), can refute it; known: those it was found in.

        Velocities are differences of poses: frames that are far apart may not tell of motion.
        """
        return not (self.of_motion and _time_step(t) > _MAX_SPARSER * _time_step(known))

    @property
    def per_frame(self) -> bool:
        """Whether parameters belong to single frames, so that other frames say nothing of them."""
        return False

    @property
    def kinds(self) -> tuple[str, ...]:
        """What it is, once for each camera of a rig that has it for itself."""
        return (self.name,)

    @property
    def cameras(self) -> tuple[str, ...]:
        """The cameras of a rig that have it, each for itself; none where all have it as one."""
        return ()

    @property
    def form(self) -> Effect:
        """What it is, whichever camera has it."""
        return self

    def forms_of_camera(self, camera: int) -> Iterator[tuple[Effect, Index]]:
        """Yield what acts in the views of a camera, and which of the parameters are its own."""
        yield self, np.arange(len(self.parameters))

    @property
    def key(self) -> str:
        """A short name of this form, unique within a data set."""
        parts = [
            f'{f.name}={_shorten(getattr(self, f.name))}'
            for f in fields(self)
            if f.metadata.get('key', True)
        ]
        return f'{self.name}({", ".join(parts)})' if parts else self.name

    def to_dict(self, values: Array) -> dict[str, Any]:
        """Return structure and values as the lens YAML holds them."""
        names = [parameter.name for parameter in self.parameters]
        numbers = dict(zip(names, map(float, values), strict=True))
        structure = {name: _plain_value(value) for name, value in asdict(self).items()}
        return {**structure, 'parameters': numbers}

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any], where: str) -> tuple[Effect, Array]:
        """Return the effect and its values; raise LensError naming `where` and the field."""
        structure = {name: value for name, value in entry.items() if name != 'parameters'}
        field_names = {field.name for field in fields(cls)}
        if foreign := [name for name in structure if name not in field_names]:
            raise LensError(
                f'{where}: effect {cls.name} has {foreign[0]}, which does not belong '
                'there; its numbers are in a mapping, parameters'
            )
        try:
            effect = cls(**{name: _frozen(value) for name, value in structure.items()})
            names = [parameter.name for parameter in effect.parameters]
            numbers = dict(entry['parameters'])
            values = np.array([float(numbers.pop(name)) for name in names])
        except (KeyError, TypeError, ValueError) as cause:
            raise LensError(f'{where}: effect {cls.name} is incomplete ({cause})') from cause
        if numbers or not np.isfinite(values).all():
            odd = next(iter(numbers), 'a value that is not finite')
            raise LensError(f'{where}: effect {cls.name} has {odd}, which does not belong there')
        return effect, values


class PlaneEffect(Effect):
    """An effect that moves image points in proportion to the focal length."""

    stage: ClassVar[str] = 'image'

    @abstractmethod
    def plane_columns(self, scene: Scene) -> Array:
        """Derivatives (S, N, 2, P) of the displacement over the focal lengths."""

    def columns(self, scene: Scene) -> Array:
        focal = np.array([scene.lens.fx, scene.lens.fy])
        return np.asarray(self.plane_columns(scene) * focal[:, None])

    def rescale_values(self, values: Array, ratio: float) -> Array:
        return values / ratio


class PupilEffect(Effect):
    """An effect that moves the origins of rays, in the camera frame."""

    stage: ClassVar[str] = 'pupil'

    @abstractmethod
    def origin_columns(self, theta: Array) -> Array:
        """Derivatives (..., 3, P) of the origins of rays of angles (...), m."""

    def columns(self, scene: Scene) -> Array:
        return self.origin_columns(scene.theta)


NO_TIME = 'the observations carry no time, or too few instants'


class NoiseEffect(Effect):
    """An effect that moves no prediction: it changes the scatter or the table itself."""

    stage: ClassVar[str] = 'noise'

    def columns(self, scene: Scene) -> Array:
        return np.empty((*scene.uv.shape[:2], 0, len(self.parameters)))

    def noise_scale(self, scene: Scene, values: Array) -> Array | float:
        """Factor (S, N) on the standard deviation of the noise."""
        return 1.0

    def record_points(self, uv: Array, values: Array, rng: np.random.Generator) -> Array:
        """Return noisy image points (S, N, 2), px, NaN for none, as a table would have them."""
        return uv


def require_time(scene: Scene, minimum: int) -> Array:
    """Return the times (S,) of the views; raise Untestable for fewer than `minimum` instants."""
    instants = np.unique(scene.times[np.isfinite(scene.times)])
    if len(instants) < minimum or not np.isfinite(scene.times).all():
        raise Untestable(NO_TIME)
    return scene.times


def require_cameras(scene: Scene) -> None:
    """Raise Untestable where there is no second camera."""
    if not np.any(scene.views.camera > 0):
        raise Untestable('there is one camera only')


def require_motion(scene: Scene) -> Array:
    """Return the velocities (S, 6); raise Untestable where nothing is known to move."""
    require_time(scene, 5)
    twist = scene.twist
    if np.abs(twist).max() < 1e-6:
        raise Untestable('the camera does not move')
    return twist


def _velocities(pose: Pose, t: Array) -> Array:
    """Return velocities (S, 6) by cubic splines through poses at times (S,), s, in order.

    Parabolas through three poses lose a fifth of what a hand does at three poses in two seconds;
    what follows from motion then seems so much larger.  Of two poses by the line through them.
    Source: de Boor, A Practical Guide to Splines (1978), chapter 4.
    """
    times, first = np.unique(t, return_index=True)
    known = pose.take(first)
    if len(times) == 2:
        change = known.take(np.array([1])).difference(known.take(np.array([0])))
        return np.repeat(change / (times[1] - times[0]), len(t), axis=0)
    # Not while nodes start
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    place = CubicSpline(times, known.position)(t, 1)
    rotation = Rotation.from_matrix(known.rotation)
    turn = RotationSpline(times, rotation)(t, 1)  # about the body's axes
    return np.concatenate([place, (pose.rotation @ turn[..., None])[..., 0]], axis=-1)


def _shorten(value: Any) -> str:
    if isinstance(value, tuple):
        shown = ' '.join(_shorten(item) for item in value[:4])
        return shown + (' ...' if len(value) > 4 else '')
    return f'{value:.4g}' if isinstance(value, float) else str(value)


def _plain_value(value: Any) -> Any:
    if isinstance(value, tuple | list):
        return [_plain_value(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value


def _frozen(value: Any) -> Any:
    return tuple(_frozen(item) for item in value) if isinstance(value, list) else value


@dataclass(frozen=True, eq=False)
class ModelTerm:
    """An effect in a model, of one camera, of a pair or of a rig.

    values (P,): of its parameters; columns (P,): theirs among those that all frames share; none
    before the model is linearized.
    """

    effect: Effect
    values: Array
    columns: Index = field(default_factory=lambda: np.empty(0, dtype=np.int64))

    @property
    def name(self) -> str:
        """The name of the effect."""
        return self.effect.name

    def displacement(self, scene: Scene) -> Array:
        """Displacement (S, N, D) at the effect's stage."""
        return self.effect.displacement(scene, self.values)


def _time_step(t: Array) -> float:
    """Return the median time between frames of times t (N,), s; NaN where there are no two."""
    instants = np.unique(t[np.isfinite(t)])
    return float(np.median(np.diff(instants))) if len(instants) > 1 else np.nan


def camera_terms(terms: Iterable[ModelTerm], camera: int) -> tuple[ModelTerm, ...]:
    """Return what acts in the views of one camera, with that camera's values."""
    return tuple(
        ModelTerm(form, np.asarray(term.values)[slots])
        for term in terms
        for form, slots in term.effect.forms_of_camera(camera)
    )


def noise_scale(terms: Sequence[ModelTerm], scene: Scene) -> Array | float:
    """Return the factor (S, N) of noise effects on the standard deviation of the noise."""
    return prod(
        term.effect.noise_scale(scene, term.values)
        for term in terms
        if isinstance(term.effect, NoiseEffect)
    )
