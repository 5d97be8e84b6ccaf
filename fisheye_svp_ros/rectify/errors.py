"""What a viewpoint that moves leaves of an error where points are not at the range of the maps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.rectify.cameras import RectifiedCamera
from fisheye_svp_ros.rectify.maps import Rectification, RectifiedPair

_RANGES = (0.3, 0.5, 1.0, 2.0, 5.0, np.inf)  # m, of tables
LIMIT = 0.5  # px
_SAMPLES = 48  # along the longer side of the image
_NEAREST, _STEPS = 0.1, 81  # m; ranges, even in their inverse, at which the limit is looked for


class RangeErrors(NamedTuple):
    """Errors (R, N), px, at rectified pixels (N, 2) of points at ranges (R,), m; NaN: not seen.

    Of a pair: of what both cameras see, at ranges from the middle of the baseline and at pixels of
    the left camera; px: row of the right image minus the left one; depth (R, N): by disparity,
    relative to the true depth.
    """

    ranges: Array
    pixels: Array
    px: Array
    depth: Array | None = None


def image_error(side: Rectification, ranges: Array) -> RangeErrors:
    """Return how far points at other ranges lie from their places in the rectified camera.

    Of a sphere along great circles: near its poles a small angle takes many pixels of azimuth.
    """
    pixels, directions = _sample_pixels(side)
    px = np.full((len(ranges), len(pixels)), np.nan)
    for row, range_m in enumerate(ranges):
        uv, seen = side.image_points(directions, range_m)
        points = side.rectified_points(np.where(seen[:, None], uv, np.nan))
        px[row] = _pixel_distances(side.camera, points, pixels)
    return RangeErrors(ranges, pixels, px)


def pair_error(pair: RectifiedPair, ranges: Array) -> RangeErrors:
    """Return what is left of the difference of rows, and of depths by disparity, at ranges."""
    pixels, directions = _sample_pixels(pair.left)
    row, depth = np.full((2, len(ranges), len(pixels)), np.nan)
    for number, range_m in enumerate(ranges):
        points = pair.left.scene_points(directions, range_m)
        found = []
        for side, local in ((pair.left, points), (pair.right, pair.rig.transform(points))):
            uv, seen = side.project(local)
            found.append(side.rectified_points(np.where(seen[:, None], uv, np.nan)))
        row[number] = found[1][:, 1] - found[0][:, 1]
        if np.isfinite(range_m):
            true = np.hypot(*(points @ pair.left.rotation.T)[:, 1:].T)
            depth[number] = pair.depth(*found) / true - 1
    return RangeErrors(ranges, pixels, row, depth)


def tolerated_ranges(ranges: Array, px: Array, range_m: float, limit: float = LIMIT) -> Array:
    """Return the nearest and furthest range (2,), m, about range_m with errors of up to `limit`.

    ranges (R,), m, sorted; px (R, N): errors there, 0 at range_m.  In the inverse of the range
    the error is nearly straight, and so it is taken for between two ranges.
    """
    worst = quantiles(px)[:, 2]
    inverse = 1 / ranges
    ends = []
    for side in (ranges < range_m, ranges > range_m):
        by_distance = np.argsort(np.abs(inverse[side] - 1 / range_m))
        place = np.concatenate([[1 / range_m], inverse[side][by_distance]])
        error = np.concatenate([[0.0], worst[side][by_distance]])
        beyond = np.flatnonzero(error > limit)
        if not beyond.size:
            ends.append(1 / place[-1] if place[-1] else np.inf)
            continue
        k = beyond[0]
        share = (limit - error[k - 1]) / (error[k] - error[k - 1])
        ends.append(1 / (place[k - 1] + share * (place[k] - place[k - 1])))
    return np.array(ends)


def table_ranges(side: Rectification) -> Array:
    """Return ranges (R,), m, for a table: usual ones that the lens sees, and that of the maps."""
    return np.array(sorted({side.range, *(r for r in _RANGES if r > side.min_range)}))


def search_ranges(side: Rectification) -> Array:
    """Return ranges (R,), m, sorted, up to infinity, among which a limit is looked for."""
    inverse = np.linspace(1 / max(_NEAREST, 1.01 * side.min_range), 0.0, _STEPS)
    return np.concatenate([1 / inverse[:-1], [np.inf]])


def quantiles(errors: Array) -> Array:
    """Return median, 95 % and largest size (R, 3) of errors (R, N); NaN where there is none."""
    rows = (np.abs(row[np.isfinite(row)]) for row in errors)
    return np.array(
        [np.quantile(row, (0.5, 0.95, 1.0)) if row.size else np.full(3, np.nan) for row in rows]
    )


def _pixel_distances(camera: RectifiedCamera, places: Array, pixels: Array) -> Array:
    """Return the distances (N,), px, between pixels (N, 2); NaN where `places` is."""
    straight: Array = np.linalg.norm(places - pixels, axis=-1)
    if camera.projection != 'equirectangular':
        return straight
    chord = np.linalg.norm(camera.directions(*places.T) - camera.directions(*pixels.T), axis=-1)
    along = camera.f * 2 * np.arcsin(np.minimum(chord / 2, 1.0))
    return np.asarray(np.where(np.isfinite(straight), along, np.nan))


def _sample_pixels(side: Rectification) -> tuple[Array, Array]:
    """Return rectified pixels (N, 2) all over what the maps reach, and their directions (N, 3)."""
    camera = side.camera
    step = max(camera.width, camera.height) / _SAMPLES
    u, v = np.meshgrid(
        *(
            np.linspace(0, size - 1, max(round(size / step), 2)).round()
            for size in (camera.width, camera.height)
        )
    )
    reached = side.maps.mask[v.astype(int), u.astype(int)]
    pixels = np.stack([u, v], axis=-1)[reached]
    return pixels, camera.directions(*pixels.T)
