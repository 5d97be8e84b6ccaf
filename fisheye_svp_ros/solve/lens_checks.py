"""What there is to say against a lens that was fitted to image points: facts for every command."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.optics.lens import Lens

_POOR, _LOST = 10.0, 5.0  # times the noise of the points, and px, that a lens should not leave
_MAX_CENTER_OFFSET = 0.1  # of the image, by which a principal point is seldom off its center
_MIN_SMALLER_SHARE, _SHARE_TOLERANCE = 0.05, 0.01  # of the image
_MIN_COVERED_RADIUS = 0.7  # of the way to the nearest edge; less is poor coverage
_ANGLE_SLACK = np.radians(2.0)  # past the outermost point of a calibration: as good as there


class ImageCoverage(NamedTuple):
    """Where the image of a lens lies, and how much of it image points cover.

    offset: of the principal point from the center of the image, px; size: of the image, px;
    radius, edge: of the outermost image point and of the nearest edge of the image from the
    principal point, px; farthest: the largest u and v of image points, px.
    """

    offset: tuple[float, float]
    size: tuple[int, int]
    radius: float
    edge: float
    farthest: tuple[float, float]

    @property
    def is_off_center(self) -> bool:
        """Whether the principal point is where few cameras have theirs."""
        shares = [off / size for off, size in zip(self.offset, self.size, strict=True)]
        return max(map(abs, shares)) > _MAX_CENTER_OFFSET or self.smaller_size is not None

    @property
    def smaller_size(self) -> tuple[int, int] | None:
        """The size of an image, smaller by one factor, whose center the principal point is.

        None where points lie beyond it, or the center is off by another share of each side:
        an image that is stated too large leaves both.
        """
        shares = [-off / size for off, size in zip(self.offset, self.size, strict=True)]
        share = sum(shares) / 2
        smaller = tuple(round(size * (1 - 2 * share)) for size in self.size)
        fits = all(far < size for far, size in zip(self.farthest, smaller, strict=True))
        alike = abs(shares[0] - shares[1]) < _SHARE_TOLERANCE
        return (smaller[0], smaller[1]) if share > _MIN_SMALLER_SHARE and alike and fits else None

    @property
    def is_extrapolated(self) -> bool:
        """Whether the curve is a guess in a large part of the image."""
        return self.radius < _MIN_COVERED_RADIUS * self.edge


def image_coverage(lens: Lens, uv: Array) -> ImageCoverage:
    """Return where image points uv (N, 2), px, lie in the image of a lens."""
    off = lens.cx - (lens.width - 1) / 2, lens.cy - (lens.height - 1) / 2
    out = float(np.linalg.norm(uv - (lens.cx, lens.cy), axis=-1).max())
    far = uv.max(axis=0).tolist()
    return ImageCoverage(
        off, (lens.width, lens.height), out, _nearest_edge(lens), (far[0], far[1])
    )


def _nearest_edge(lens: Lens) -> float:
    """Return how far the nearest edge of the image is from the principal point, px."""
    return min(lens.cx, lens.width - lens.cx, lens.cy, lens.height - lens.cy)


def probable_size(lens: Lens) -> tuple[int, int] | None:
    """Return the image size that a principal point far off the center is the center of, px.

    None for one that is not, or whose center is that of no image of the same shape.
    """
    scale = np.array([(2 * lens.cx + 1) / lens.width, (2 * lens.cy + 1) / lens.height])
    if np.abs(scale - 1).max() <= 2 * _MAX_CENTER_OFFSET or scale.min() <= 0:
        return None
    if abs(scale[0] / scale[1] - 1) > _MAX_CENTER_OFFSET:
        return None
    return round(2 * lens.cx + 1), round(2 * lens.cy + 1)


def is_no_fit(rms_px: float, sigma_px: float) -> bool:
    """Whether a lens leaves so much that it is no model of its points; sigma: NaN if unknown."""
    return rms_px > max(_LOST, _POOR * sigma_px if np.isfinite(sigma_px) else 0.0)


def is_known_in_part(lens: Lens) -> bool:
    """Whether a lens was calibrated far within its image, by points or by what its file says."""
    angle = lens.calibrated_angle
    if angle is None or angle >= lens.max_incidence:
        return False
    height = float(lens.image_height.value_and_slope(np.asarray(angle))[0])
    return height * lens.focal < _MIN_COVERED_RADIUS * _nearest_edge(lens)


class ExtrapolatedPoints(NamedTuple):
    """What share of image points lies beyond the angle that a lens is known to.

    farthest: the angle of the outermost; known: that of the calibration; rad.
    """

    share: float
    farthest: float
    known: float


def extrapolated_points(lens: Lens, uv: Array) -> ExtrapolatedPoints | None:
    """Return which of image points uv (N, 2), px, lie where the curve of a lens is a guess.

    None where none does, or where nobody says how far the lens was calibrated.
    """
    angle = lens.calibrated_angle
    if angle is None:
        return None
    height = np.hypot((uv[:, 0] - lens.cx) / lens.fx, (uv[:, 1] - lens.cy) / lens.fy)
    limit, _ = lens.image_height.value_and_slope(np.asarray(angle + _ANGLE_SLACK))
    beyond = height > limit
    if not beyond.any():
        return None
    edge, _ = lens.image_height.value_and_slope(np.asarray(lens.max_incidence))
    farthest = lens.image_height.angle(np.minimum(height[beyond].max(), edge))
    return ExtrapolatedPoints(float(beyond.mean()), float(farthest), angle)
