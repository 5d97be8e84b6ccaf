"""What the library returns: named arrays, each a table, too."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.io.csv_files import pose_columns
from fisheye_svp_ros.io.result_files import Columns, Result
from fisheye_svp_ros.optics.lens import Lens, parameter_values
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Observations


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
        return Columns({
            'parameter': self.names,
            'value': parameter_values(self.lens, self.names),
            'standard_error': np.sqrt(np.diag(self.covariance)),
        })


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
        return Columns({'frame': self.frame, 'landmark': self.landmark, 'x': x, 'y': y, 'z': z,
                        'gap': self.gap, 'epipolar_px': self.epipolar_px})


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
        return Columns({
            'frame': o.frame, 'camera': [o.cameras[i] for i in o.camera], 'landmark': o.landmark,
            'u': o.uv[:, 0], 'v': o.uv[:, 1], 'x': o.xyz[:, 0], 'y': o.xyz[:, 1],
            'z': o.xyz[:, 2],
        })


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
        return Columns({name: [cause[name] for cause in causes]
                        for name in ('effect', 'p_value', 'gain')})


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
        return Columns({
            'spread': spread.ravel(), 'range': distance.ravel(),
            **{name: np.ravel(values) for name, values in self.error.items()},
            **{f'{name}_noise': np.ravel(values) for name, values in self.noise.items()},
            **{f'{name}_{part}': np.ravel(values) for part, by in self.own.items()
               for name, values in by.items()},
        })
