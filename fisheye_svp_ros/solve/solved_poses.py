"""What comes of sets of image points: poses, how far off they may be, and what speaks against."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Views
from fisheye_svp_ros.solve.localization import Localization

if TYPE_CHECKING:
    from fisheye_svp_ros.effects.forward import ForwardModel
    from fisheye_svp_ros.solve.outliers import Outliers, WrongLandmark

NO_POSE = 'image_points: they do not determine a pose (all near one line, or of another lens?)'


class SolvedPoses(NamedTuple):
    """Poses of S sets of image points, of a camera or of the first camera of a rig.

    model: what they were solved with; views: the sets; result: poses, whose covariances are for
    what the residuals show where that is more than sigma; outliers (S, N): points that are
    rejected; reasons (S,): why a pose should not be relied on, '' for a reliable one; sigma: noise
    of u and of v, px, estimated, None where weights are known; excess (S,): factor by which
    residuals are more than that, whose square is in the covariance; suspects (S,): where boards
    are tags and sigma is known, those that may have moved, see `tag_units.suspect_tags`.
    Of a table: left_out: frames whose points fix no pose; landmarks: that are not where they are
    said to be, their points among the outliers.  Of a rig, rejected: outliers that its cameras
    show together; contradicted: whether these do not stand as the rig says.
    """

    model: ForwardModel
    views: Views
    result: Localization
    outliers: Mask
    reasons: tuple[str, ...]
    sigma: float | None
    excess: Array
    suspects: tuple[Mapping[int, float], ...] = ()
    left_out: tuple[int, ...] = ()
    landmarks: tuple[WrongLandmark, ...] = ()
    rejected: Outliers | None = None
    contradicted: bool = False

    @property
    def frame(self) -> Index:
        """The frame (S,) of each set."""
        return self.views.frame

    @property
    def pose(self) -> Pose:
        """The poses (S,) in the world."""
        return self.result.pose

    @property
    def covariance(self) -> Array:
        """Covariances (S, 6, 6), m and rad, of the change in `Pose.retract`."""
        return self.result.covariance

    @property
    def cautious_covariance(self) -> Array:
        """Covariances (S, 6, 6) whose 99.9 % ellipsoids hold, also in weak geometry.

        There errors are not normal, and large ones are less rare than `covariance` states.
        """
        return self.covariance * self.result.tail[:, None, None]

    @property
    def residual(self) -> Array:
        """Residuals (S, N, 2), px, measured minus predicted, NaN for outliers and padding."""
        return np.where(self.outliers[..., None], np.nan, self.result.residual)

    @property
    def sigmas(self) -> Array:
        """Root mean square (S,), by degrees of freedom, of the whitened residuals."""
        points = np.isfinite(self.residual).all(axis=-1).sum(axis=-1)
        return np.asarray(np.sqrt(self.result.cost / np.maximum(2.0 * points - 6, 1)))

    def passes(self, gate: float) -> Mask:
        """Say of which sets (S,) the residuals are no more than `gate` sigmas; 0: of all."""
        return np.asarray(self.sigmas <= gate) if gate else np.ones(len(self.sigmas), dtype=bool)

    def require(self, gate: float = 0.0) -> SolvedPoses:
        """Return it as it is; raise GeometryError where a set has no pose.

        gate: nor where its residuals are above this many sigmas; 0: no limit.
        """
        if not self.result.converged.all():
            raise GeometryError(NO_POSE)
        if not self.passes(gate).all():
            raise GeometryError(gate_reason(gate, float(self.sigmas.max())))
        return self

    def select(self, kept: Mask) -> SolvedPoses:
        """Return some of the sets (S,)."""
        return self._replace(
            views=self.views.take(kept),
            result=self.result.take(kept),
            outliers=self.outliers[kept],
            reasons=tuple(np.array(self.reasons, dtype=object)[kept]),
            excess=self.excess[kept],
            suspects=tuple(one for one, keep in zip(self.suspects, kept, strict=False) if keep),
        )


def gate_reason(gate: float, sigmas: float | None = None) -> str:
    """Say why a set that was solved has no pose; sigmas: its residuals, left out in tables."""
    size = '' if sigmas is None else f'{sigmas:.3g} sigma_px, '
    return f'image_points: their residuals are {size}above the gate ({gate:g} sigma_px): no pose'
