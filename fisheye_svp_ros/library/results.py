"""What the library returns: named arrays, each a table, too, that are kept as JSON."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, get_args, get_origin, get_type_hints

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.io.csv_files import pose_columns
from fisheye_svp_ros.io.files import read_json, write_json
from fisheye_svp_ros.io.lens_files import lens_from_dict, lens_to_dict
from fisheye_svp_ros.optics.lens import Lens, parameter_values
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.solve.measured_poses import rms_px

if TYPE_CHECKING:
    from pandas import DataFrame

    from fisheye_svp_ros.solve.solved_poses import SolvedPoses

_BAND = np.radians(10.0)
_BRIEF = 60  # characters of a value in a repr
_KIND_KEY = 'result'


class Columns(dict[str, list[Any]]):
    """Rows by column, of plain Python values, None where nothing is known."""

    def __init__(self, columns: Mapping[str, Any]) -> None:
        super().__init__(
            {
                name: np.asarray(values).tolist()
                if isinstance(values, np.ndarray)
                else list(values)
                for name, values in columns.items()
            }
        )

    def rows(self) -> Iterator[tuple[Any, ...]]:
        """Yield the rows."""
        return zip(*self.values(), strict=True)

    def save(self, path: str | Path) -> list[Path]:
        """Write PATH.csv and PATH.parquet; return both."""
        from fisheye_svp_ros.io.columns import write_table

        return write_table(Path(path), self.to_dataframe())

    def to_dataframe(self) -> DataFrame:
        """Return the rows as a pandas.DataFrame."""
        from fisheye_svp_ros.io.columns import make_table

        return make_table(self)

    def __str__(self) -> str:
        cells = [
            list(self),
            *(
                [f'{cell:.6g}' if isinstance(cell, float) else str(cell) for cell in row]
                for row in self.rows()
            ),
        ]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        return '\n'.join(
            '  '.join(cell.rjust(width) for cell, width in zip(row, widths, strict=True))
            for row in cells
        )


def _brief(value: Any) -> str:
    """Return an array's shape, a mapping's or list's length, a lens's name, a number as it is."""
    shape = getattr(value, 'shape', None)
    if shape:
        return f'array{shape}'
    if isinstance(value, Mapping | list | tuple) and not hasattr(value, '_fields'):
        return f'{type(value).__name__} of {len(value)}'
    name = getattr(value, 'name', None)
    text = f'{type(value).__name__} {name!r}' if name else repr(value)
    return text if len(text) <= _BRIEF else f'{text[:_BRIEF].splitlines()[0]} ...'


class Result(ABC):
    """A dataclass of arrays, poses, lenses, tables and plain values that is kept as JSON."""

    def __init_subclass__(cls) -> None:
        # Before the dataclass has its own, which prints whole arrays.
        cls.__repr__ = Result.__repr__  # type: ignore[method-assign]

    def __repr__(self) -> str:
        parts = (f'{name}={_brief(value)}' for name, value in vars(self).items())
        return f'{type(self).__name__}({", ".join(parts)})'

    @abstractmethod
    def table(self) -> Columns:
        """Return the rows that a person would look at."""

    def save(self, path: str | Path) -> None:
        """Write a JSON file that `load` reads back; raise OutputError where it cannot."""
        write_json(path, {_KIND_KEY: type(self).__name__, **_to_json(self)})

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read what `save` wrote; raise ObservationError, naming the file, for anything else."""
        document = read_json(path, ObservationError)
        try:
            if document.pop(_KIND_KEY) != cls.__name__:
                raise ValueError(f'it holds another result than {cls.__name__}')
            found: Self = _from_json(document, cls)
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as cause:
            raise ObservationError(f'{path}: not a saved {cls.__name__} ({cause})') from cause
        return found


def _to_json(value: Any) -> Any:
    if isinstance(value, Lens):
        return lens_to_dict(value)
    if isinstance(value, Pose):
        return {name: _to_json(part) for name, part in value._asdict().items()}
    if is_dataclass(value):
        return {field.name: _to_json(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {key: _to_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_to_json(item) for item in value]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def _from_json(value: Any, hint: Any) -> Any:
    """Return what `_to_json` made plain, as the annotation of its field has it."""
    kinds = [kind for kind in get_args(hint) if kind is not type(None)]
    if hint in (Array, Index):
        return np.array(value, dtype=float if hint == Array else np.int64)
    if value is None or hint is Any:
        return value
    if hint is Lens:
        return lens_from_dict(value)
    if hint is Pose:
        return Pose(*(np.array(value[name], dtype=float) for name in Pose._fields))
    if isinstance(hint, type) and is_dataclass(hint):
        hints = get_type_hints(hint)
        return hint(
            **{
                field.name: _from_json(value[field.name], hints[field.name])
                for field in fields(hint)
            }
        )
    if get_origin(hint) is dict:
        return {key: _from_json(item, kinds[1]) for key, item in value.items()}
    if get_origin(hint) is tuple:
        return tuple(value)
    if len(kinds) == 1 and get_origin(hint) is not list:
        return _from_json(value, kinds[0])
    return value


@dataclass(frozen=True)
class Localized(Result):
    """A pose a frame: frame (F,), pose (F,) of the camera in the world, rms_px (F,).

    covariance (F, 6, 6), m and rad, of the change in `Pose.retract`; residual (N, 2), px: measured
    minus predicted, in the order of the observations, NaN where not used; sigma_px: noise of u and
    v, estimated, None where the observations bring their own; left_out: frames whose points do
    not fix a pose; reasons (F,): why a pose should not be relied on, '' where nothing speaks
    against it: its misfit, or outliers, which are not used.
    """

    frame: Index
    pose: Pose
    covariance: Array
    rms_px: Array
    residual: Array
    sigma_px: float | None
    left_out: tuple[int, ...]
    reasons: tuple[str, ...]

    @classmethod
    def from_solved(cls, solved: SolvedPoses, rows: int) -> Localized:
        """Return what was solved of a table of so many rows."""
        used = solved.views.used
        residual = np.full((rows, 2), np.nan)
        residual[solved.views.row[used]] = solved.residual[used]
        return cls(
            solved.frame,
            solved.pose,
            solved.covariance,
            np.array([*map(rms_px, solved.residual)]),
            residual,
            solved.sigma,
            solved.left_out,
            solved.reasons,
        )

    def table(self) -> Columns:
        """Return one row a frame, as poses.csv has it, with the rms."""
        return Columns(pose_columns(self.frame, self.pose) | {'rms_px': self.rms_px})


@dataclass(frozen=True)
class Calibrated(Result):
    """A fitted lens: names (K,) of what was fitted, covariance (K, K), with any target.

    sigma_px, left_out: as in `Localized`; converged: whether the adjustment came to its end.
    """

    lens: Lens
    names: tuple[str, ...]
    covariance: Array
    sigma_px: float | None
    left_out: tuple[int, ...]
    converged: bool

    def table(self) -> Columns:
        """Return one row a parameter that was fitted."""
        return Columns(
            {
                'parameter': self.names,
                'value': parameter_values(self.lens, self.names),
                'standard_error': np.sqrt(np.diag(self.covariance)),
            }
        )


@dataclass(frozen=True)
class CalibratedRig(Result):
    """A rig: the left camera in the right one.

    covariance (6, 6), m and rad, for the noise as in `Localized`; frame (V,); pose (V,) of the
    right camera in the world; rms_px over both cameras.
    """

    rig: Pose
    covariance: Array
    frame: Index
    pose: Pose
    rms_px: float
    converged: bool

    def table(self) -> Columns:
        """Return one row a frame: the right camera in the world."""
        return Columns(pose_columns(self.frame, self.pose))


@dataclass(frozen=True)
class StereoDepth(Result):
    """Points (N, 3), m, in the right camera, of what both cameras see; frame, landmark (N,).

    gap (N,), m: distance of the two rays; epipolar_px (N,): of the left point from the epipolar
    curve of the right one (Error2 is its mean); covariance (N, 3, 3), m^2, where the lenses' own
    errors were asked for.  NaN where the rays do not meet.
    """

    frame: Index
    landmark: Index
    points: Array
    gap: Array
    epipolar_px: Array
    covariance: Array | None = None

    def table(self) -> Columns:
        """Return one row a point."""
        x, y, z = self.points.T
        return Columns(
            {
                'frame': self.frame,
                'landmark': self.landmark,
                'x': x,
                'y': y,
                'z': z,
                'gap': self.gap,
                'epipolar_px': self.epipolar_px,
            }
        )


@dataclass(frozen=True)
class Simulated(Result):
    """What cameras see: observations, one frame a pose.

    pose (F,) of the camera in the world, of the right one of a rig; rig: the left camera in the
    right one, None for one camera.
    """

    lens: Lens
    observations: Observations
    pose: Pose
    rig: Pose | None

    def table(self) -> Columns:
        """Return one row an image point."""
        o = self.observations
        return Columns(
            {
                'frame': o.frame,
                'camera': [o.cameras[i] for i in o.camera],
                'landmark': o.landmark,
                'u': o.uv[:, 0],
                'v': o.uv[:, 1],
                'x': o.xyz[:, 0],
                'y': o.xyz[:, 1],
                'z': o.xyz[:, 2],
            }
        )


@dataclass(frozen=True)
class Swept(Result):
    """The rows of a sweep, one a set of image points, by column; None where nothing is known."""

    columns: dict[str, list[Any]]

    def table(self) -> Columns:
        """Return the rows."""
        return Columns(self.columns)


@dataclass(frozen=True)
class Diagnosed(Result):
    """verdict; document: the mapping of diagnosis.json; lens: extended by what was found."""

    verdict: str
    document: dict[str, Any]
    lens: Lens

    def table(self) -> Columns:
        """Return one row a cause."""
        causes = self.document['causes']
        return Columns(
            {name: [cause[name] for cause in causes] for name in ('effect', 'p_value', 'gain')}
        )


@dataclass(frozen=True)
class Budgeted(Result):
    """SVP errors and what noise causes, by quantity: arrays (A, R), SI and px.

    spreads (A,), rad; ranges (R,), m; own: by part what is wrong with a lens that knows its own
    errors; see `study.budget.Budget`.
    """

    spreads: Array
    ranges: Array
    error: dict[str, Array]
    noise: dict[str, Array]
    own: dict[str, dict[str, Array]]

    def table(self) -> Columns:
        """Return one row a spread and range."""
        spread, distance = np.meshgrid(self.spreads, self.ranges, indexing='ij')
        return Columns(
            {
                'spread': spread.ravel(),
                'range': distance.ravel(),
                **{name: np.ravel(values) for name, values in self.error.items()},
                **{f'{name}_noise': np.ravel(values) for name, values in self.noise.items()},
                **{
                    f'{name}_{part}': np.ravel(values)
                    for part, by in self.own.items()
                    for name, values in by.items()
                },
            }
        )


@dataclass(frozen=True)
class Compared(Result):
    """How far two lenses disagree: angle (R, G), rad, between what they see at an image point.

    ranges (R,), m; uv (G, 2), px, all over the image; theta (G,), rad, the incidence angle in the
    first lens; rms, largest (R,), rad, over the image.  motion: the camera frame of the second
    lens in that of the first, by which both fit best; it is taken out.
    """

    one: Lens
    other: Lens
    ranges: Array
    uv: Array
    theta: Array
    angle: Array
    motion: Pose

    @property
    def rms(self) -> Array:
        """Root mean square (R,), rad, over the image."""
        return np.asarray(np.sqrt((self.angle**2).mean(axis=1)))

    @property
    def largest(self) -> Array:
        """The largest angle (R,), rad, over the image."""
        return np.asarray(self.angle.max(axis=1))

    def table(self) -> Columns:
        """Return one row a band of 10 degrees: from, to, rad; points; rms at each range, rad."""
        band = (self.theta / _BAND).astype(int)
        there, points = np.unique(band, return_counts=True)
        return Columns(
            {
                'from': _BAND * there,
                'to': _BAND * (there + 1),
                'points': points,
                **{
                    f'rms_{range_m:g}m': np.sqrt(np.bincount(band, angle**2)[there] / points)
                    for range_m, angle in zip(self.ranges, self.angle, strict=True)
                },
            }
        )
