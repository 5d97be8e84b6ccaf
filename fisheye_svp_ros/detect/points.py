"""The points of a pattern in one image: found, brought into the pattern's order, fitted."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial import cKDTree

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.detect.circle_fit import fit_circles, imaging
from fisheye_svp_ros.detect.corner_fit import Corners, edge_clearance, fit_corners
from fisheye_svp_ros.detect.finders import (
    DETECTORS,
    UNFITTED_DETECTORS,
    Finder,
    Grey,
    explain_failure,
)
from fisheye_svp_ros.detect.patterns import LOOSE_TAGS, LocatedPoints, Pattern, local_axes
from fisheye_svp_ros.detect.photographs import Pixels
from fisheye_svp_ros.detect.tag_grids import GridReading
from fisheye_svp_ros.detect.windows import halve_image

SATURATED_SHARE = 0.02  # of a board's pixels at the end of the scale
_MIN_SHARE = 0.5  # of the points found must turn out to be what the pattern says
_MARGIN = 0.3  # of its size, around the place where a board was last
_GLANCE = 350  # px, of these surroundings; without a board larger ones take up to half a second
_SHORTEST, _LONGEST = 24, 32_766  # px, of an image that OpenCV searches
_MIN_POINTS = 4
_OUTLIER_SIGMAS = 6.0  # times the median sigma
_MAX_CLEARANCE = 30.0  # px to the next edge, three times the largest window
_NARROW, _NARROWEST = 0.6, 9.0  # of the way to the next edge, which rough points tell badly; px
_ROUNDS, _STILL = 2, 0.3  # px that a corner may be from the middle of its window
_STEP = 1.05  # of the size of a tag or square, to points that are looked for next
_REFIT_GROWTH = 1.5  # times as many points, and the lens that says where they are is fitted anew
_FREE = ('f', 'k1')  # of that lens
_SOFT_BLUR = 2.0  # px of blur; the window must reach well beyond it
# By three corners of a line, how far a parabola gets one and a half squares before the first
_EXTRAPOLATION = np.array([35.0, -42.0, 15.0]) / 8
_CONTRAST_TOLERANCE = 0.35  # of the step from dark to bright
_MIN_MATCH_SHARE = 0.8  # of the squares of a side
_MIN_SQUARES = 3
_SMOOTHING = 1.0  # px


class Points(NamedTuple):
    """Points (M,) of a pattern: which; uv (M, 2) and sigma (M,), px; blur and reach, px.

    reach (M,): distance to the next edge of the print in the image; grid: what tags say about an
    AprilGrid.
    """

    ids: Index
    uv: Array
    sigma: Array
    blur: float
    reach: Array
    grid: GridReading | None = None


def find_points(
    pixels: Pixels,
    pattern: Pattern,
    detector: str,
    near: Array | None = None,
    finder: Finder | None = None,
) -> Points | str:
    """Return the points of a pattern in a grey image, or why there are none.

    near (M, 2): image points of the board in the image before; its surroundings are searched
    first, and the rest only where the board is not there any more.  finder: in place of the
    detector's own.
    """
    if pattern.kind == LOOSE_TAGS:
        from fisheye_svp_ros.detect.tags import find_tag_points  # which needs this module

        return find_tag_points(pixels)
    height, width = pixels.shape
    if not _SHORTEST <= min(height, width) <= max(height, width) <= _LONGEST:
        return f'no board found: the image is {width} x {height} px'
    try:
        return _search(pixels, pattern, detector, near, finder or DETECTORS[detector][1])
    except cv2.error as cause:
        return f'no board found: {cause.err}'


def _search(
    pixels: Pixels, pattern: Pattern, detector: str, near: Array | None, finder: Finder
) -> Points | str:
    grey = eight_bit(pixels)
    located = _search_near(grey, pattern, finder, near) if near is not None else None
    located = located or finder(grey, pattern)
    if located is None:
        return explain_failure(grey, pattern)
    index, uv, grid = located
    if grid is not None and grid.layout is not None:
        pattern = pattern.with_layout(grid.layout)
    if len(index) < _MIN_POINTS:
        return f'{len(index)} points found; {_MIN_POINTS} are needed'
    if pattern.marker:
        # Where the board was a moment ago time counts.
        if near is None or len(index) < _MIN_SHARE * len(pattern.points):
            index, uv = _complete_tags(pixels, index, uv, pattern)
    elif len(index) == len(pattern.points):
        uv = _fix_handedness(uv, pattern)
    measured = _measure(pixels, index, uv, pattern, detector, censored=True)
    if isinstance(measured, str) and full_scale_share(pixels, uv) > SATURATED_SHARE:
        # Where little light is left within the scale, only its end tells where an edge is: too far
        # on the dark side, but on both sides of a corner, or all around a circle, alike.
        again = _measure(pixels, index, uv, pattern, detector, censored=False)
        measured = measured if isinstance(again, str) else again
    if isinstance(measured, str) and pattern.kind == 'aprilgrid':
        # Other programs than Kalibr print no squares beyond the corners of tags.
        again = _measure(pixels, index, uv, pattern.without_squares(), detector, censored=True)
        measured = measured if isinstance(again, str) else again
    return measured if isinstance(measured, str) else measured._replace(grid=grid)


def full_scale_share(pixels: Pixels, uv: Array) -> float:
    """Return the share of pixels around image points (M, 2), px, at the end of the scale."""
    mask = np.zeros(pixels.shape, np.uint8)
    hull = cv2.convexHull(np.round(uv).astype(np.int32).reshape(-1, 1, 2))
    cv2.fillConvexPoly(mask, hull, 1)
    board = pixels[mask > 0]
    return float((board >= np.iinfo(pixels.dtype).max).mean()) if board.size else 0.0


def _measure(
    pixels: Pixels, index: Index, uv: Array, pattern: Pattern, detector: str, censored: bool
) -> Points | str:
    """Fit the points found at uv (M, 2), px; censored: see `corner_fit.fit_corners`."""
    if detector == 'circles':
        circles = fit_circles(pixels, uv, pattern.points[index], censored)
        return _order_points(index, circles, pattern, _surroundings(index, uv, pattern)[1])
    corners, reach = _fit_corners(pixels, index, uv, pattern, detector == 'quick', censored)
    if detector in UNFITTED_DETECTORS:
        corners = corners._replace(uv=uv)
    return _order_points(index, corners, pattern, reach)


def search(task: tuple[Pixels, Pattern, str, Array | None]) -> Points | str | Exception:
    """Do what `find_points` does for its arguments; return what it raises."""
    try:
        return find_points(*task)
    except Exception as error:
        return error


def _surroundings(index: Index, uv: Array, pattern: Pattern) -> tuple[Array, Array]:
    """Return the directions (M, 2, 2) of a corner's edges, px/m, and px to the next edge (M,)."""
    axes = local_axes(pattern.points[index, :2], uv)
    if pattern.kind == 'chessboard' and len(index) == len(pattern.points):
        reach = _least_square(uv, pattern)
    else:
        reach = pattern.clearance * _height(axes)
    square = np.any(pattern.inward)
    return axes * (pattern.inward[index, :, None] if square else 1.0), reach


def _complete_tags(
    pixels: Pixels, index: Index, uv: Array, pattern: Pattern
) -> tuple[Index, Array]:
    """Return the points that a finder of tags found, and those of tags that it missed.

    Tags that are small, or bent through a fisheye, are not decoded.  A lens fitted to the points
    of this photograph says where the next ones are; corners of the right colors are there.
    """
    points, (height, width) = pattern.points, pixels.shape
    fitted, where = index[:0], uv[:0]
    new, start, agreed = index, uv, 0.0
    missing = np.ones(len(points), dtype=bool)
    image_of, known = None, 0
    while len(new):
        axes, reach = _surroundings(np.append(fitted, new), np.vstack([where, start]), pattern)
        narrow = np.minimum(_NARROW * reach, _NARROWEST)[len(fitted) :]
        corners = fit_corners(pixels, start, axes[len(fitted) :], narrow)
        tint = np.sign(corners.contrast) * pattern.tint[new]
        agreed = agreed or np.sign(tint[corners.ok].sum())
        ok = corners.ok & (tint == agreed)
        fitted, where = np.append(fitted, new[ok]), np.vstack([where, corners.uv[ok]])
        missing[fitted] = False
        far, _ = cKDTree(points[fitted]).query(points)
        new = np.flatnonzero(missing & (far < _STEP * pattern.size))
        missing[new] = False
        if len(new) and len(fitted) > _REFIT_GROWTH * known:
            image_of, known = imaging(points[fitted], where, pixels.shape, _FREE), len(fitted)
        if image_of is None:
            break
        start = image_of(points[new])
        inside = ((start > 0) & (start < (width, height))).all(axis=1)
        new, start = new[inside], start[inside]
    if len(fitted) < len(index):
        return index, uv
    order = np.argsort(fitted)
    return fitted[order], where[order]


def _fit_corners(
    pixels: Pixels, index: Index, start: Array, pattern: Pattern, live: bool, censored: bool
) -> tuple[Corners, Array]:
    """Fit corners, and again where the first fit puts them; return how far (M,) is left, px.

    About points that are off by a pixel or two a window leans to one side, and may reach into the
    next edge, so that it is narrow at first.  Those too soft for their window are fitted at half
    the size, if there is room.
    live: time counts, so that windows are whole from the first, and only corners whose window
    stood wrong are fitted again.
    """
    square = bool(np.any(pattern.inward))
    axes, reach = _surroundings(index, start, pattern)
    first = reach if live else np.minimum(_NARROW * reach, _NARROWEST)
    corners = fit_corners(pixels, start, axes, first, square, censored)
    wrong = _off_center(corners, start) if live else np.ones(len(start), dtype=bool)
    for _ in range(_ROUNDS):
        if not wrong.any():
            break
        start = np.where(corners.ok[:, None], corners.uv, start)
        axes, reach = _surroundings(index, start, pattern)
        # The next edge has its blur, too.
        free = np.where(corners.ok, np.minimum(reach, edge_clearance(reach, corners.blur)), reach)
        off = np.flatnonzero(wrong) if live else np.arange(len(start))
        again = fit_corners(pixels, start[off], axes[off], free[off], square, censored)
        for whole, part in zip(corners, again, strict=True):
            whole[off] = part
        wrong = _off_center(corners, start)
    soft = np.flatnonzero((~corners.ok | (corners.blur > _SOFT_BLUR)) & (reach > _MAX_CLEARANCE))
    if not len(soft):
        return corners, reach
    again = fit_corners(
        halve_image(pixels),
        (start[soft] + 0.5) / 2 - 0.5,
        axes[soft] / 2,
        reach[soft] / 2,
        square,
        censored,
    )
    refitted = soft[again.ok]
    size = {'uv': 2 * again.uv + 0.5, 'sigma': 2 * again.sigma, 'blur': 2 * again.blur}
    for name, whole, part in zip(Corners._fields, corners, again, strict=True):
        whole[refitted] = size.get(name, part)[again.ok]
    return corners, reach


def _off_center(corners: Corners, start: Array) -> Mask:
    """Return which corners (M,) are not in the middle of their window."""
    return np.asarray(corners.ok & (np.linalg.norm(corners.uv - start, axis=1) >= _STILL))


def _height(axes: Array) -> Array:
    """Distance, px, of neighboring parallel lines a metre apart on the board."""
    longer = np.linalg.norm(axes, axis=-1).max(axis=-1)
    return np.asarray(np.abs(np.linalg.det(axes)) / np.maximum(longer, 1e-9))


def _least_square(uv: Array, pattern: Pattern) -> Array:
    """Return the height (M,), px, of the least square at each point of a whole grid.

    Beyond the outer points squares are taken to go on shrinking as they do up to there.
    """
    grid = uv.reshape(pattern.rows, pattern.columns, 2)
    right, down = np.diff(grid, axis=1), np.diff(grid, axis=0)
    sides = np.stack([right[1:] + right[:-1], down[:, 1:] + down[:, :-1]], axis=-2) / 2
    height = _height(sides)
    for _ in range(2):
        first, last = height[:1], height[-1:]
        height = np.concatenate(
            [
                first * np.minimum(first / height[1:2], 1),
                height,
                last * np.minimum(last / height[-2:-1], 1),
            ]
        ).T
    return np.asarray(
        np.minimum.reduce(
            [height[:-1, :-1], height[1:, :-1], height[:-1, 1:], height[1:, 1:]]
        ).ravel()
    )


def _search_near(
    grey: Grey, pattern: Pattern, finder: Finder, near: Array
) -> LocatedPoints | None:
    low, high = near.min(axis=0), near.max(axis=0)
    margin = _MARGIN * float((high - low).max()) + 10
    height, width = grey.shape
    left, top = np.clip(low - margin, 0, (width, height)).astype(int)
    right, bottom = np.clip(high + margin, 0, (width, height)).astype(int)
    if min(right - left, bottom - top) < 10:
        return None
    glance = _GLANCE / max(right - left, bottom - top)
    scale = min(glance, 1.0) if pattern.kind == 'chessboard' else 1.0
    crop = cv2.resize(
        grey[top:bottom, left:right], None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA
    )
    located = finder(crop, pattern)
    return located and located._replace(uv=(located.uv + 0.5) / scale - 0.5 + (left, top))


def _fix_handedness(uv: Array, pattern: Pattern) -> Array:
    """Return image points of a whole grid, mirrored where its columns run the wrong way."""
    if np.median(np.linalg.det(local_axes(pattern.points[:, :2], uv))) > 0:
        return uv
    if pattern.kind == 'squares':
        grid = uv.reshape(pattern.rows, pattern.columns, 4, 2)[:, ::-1]
        return grid[:, :, [1, 0, 3, 2]].reshape(-1, 2)
    return uv.reshape(pattern.rows, pattern.columns, 2)[:, ::-1].reshape(-1, 2)


def _order_points(index: Index, corners: Corners, pattern: Pattern, reach: Array) -> Points | str:
    """Turn the points into the pattern's order; leave out those that are not what they must be."""
    ok, tint = corners.ok, np.sign(corners.contrast) * pattern.tint[index]
    if ok.sum() < max(_MIN_POINTS, _MIN_SHARE * len(ok)):
        return f'{int(ok.sum())} of {len(ok)} points can be fitted as corners'
    if np.isfinite(corners.sigma).all():
        # One by the edge of the field, or half hidden, is not as its neighbors.
        ok &= corners.sigma < _OUTLIER_SIGMAS * np.median(corners.sigma[ok])
    if pattern.kind == 'chessboard' or pattern.marker:
        agreed = np.sign(tint[ok].sum())
        ok &= tint == agreed
        if ok.sum() < max(_MIN_POINTS, _MIN_SHARE * len(ok)):
            return 'bright and dark squares do not alternate; check the size of the board'
    if not pattern.marker and len(index) == len(pattern.points):
        grid = ok.reshape(-1, pattern.columns)
        sides = grid[0], grid[-1], grid[:, 0], grid[:, -1]
        if pattern.kind == 'chessboard' and not all(side.any() for side in sides):
            return 'the grid may be shifted by one square: one of its sides has no corners'
        keep = pattern.kind != 'chessboard' or agreed > 0
        turns = [turn for turn in pattern.turns if turn.same == keep] or list(pattern.symmetries)
        # Of turns that look the same, the one that begins at the upper left of the image.
        best = min(turns, key=lambda turn: float(corners.uv[turn.source[0]].sum()))
        order = best.source
        corners = Corners._make(array[order] for array in corners)
        ok, reach = ok[order], reach[order]
    blur = float(np.median(corners.blur[ok]))
    return Points(index[ok], corners.uv[ok], corners.sigma[ok], blur, reach[ok])


def eight_bit(pixels: Pixels) -> Grey:
    """Return a grey image in 8 bits."""
    if pixels.dtype == np.uint8:
        return pixels
    top = max(float(np.percentile(pixels[::4, ::4], 99.8)), 1.0)
    return np.asarray(cv2.convertScaleAbs(pixels, alpha=255 / top))


def goes_on(pixels: Pixels, points: Points, pattern: Pattern) -> bool:
    """Return whether a further row of squares lies beyond a side of a chessboard's grid.

    Outside the inner corners is one row, of the board's edge.  The next has the colors of the
    row inside, where there is one.
    """
    corners = np.full((len(pattern.points), 2), np.nan)
    corners[points.ids] = points.uv
    grid = corners.reshape(pattern.rows, pattern.columns, 2)
    smooth = cv2.GaussianBlur(pixels.astype(np.float32), (0, 0), _SMOOTHING)
    sides = (grid, grid[::-1], grid.swapaxes(0, 1), grid.swapaxes(0, 1)[::-1])
    return any(_side_goes_on(smooth, side) for side in sides)


def _side_goes_on(image: Array, grid: Array) -> bool:
    """Do so for the side of the first row of a grid (R, C, 2), px."""
    middles = (grid[:, 1:] + grid[:, :-1]) / 2
    inside = (middles[0] + middles[1]) / 2
    beyond = np.tensordot(_EXTRAPOLATION, middles[:3], axes=1)
    own, next_ones = _light(image, inside), _light(image, beyond)
    known = np.isfinite(own) & np.isfinite(next_ones)
    if known.sum() < _MIN_SQUARES:
        return False
    own, next_ones = own[known], next_ones[known]
    step = np.ptp(own)
    return bool((np.abs(next_ones - own) < _CONTRAST_TOLERANCE * step).mean() >= _MIN_MATCH_SHARE)


def _light(image: Array, uv: Array) -> Array:
    """Return the image (H, W) at places (N, 2), px; NaN outside."""
    height, width = image.shape
    there: Mask = np.asarray(np.isfinite(uv).all(axis=1))
    column, row = np.round(np.where(there[:, None], uv, -1)).astype(int).T
    there &= (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return np.where(there, image[np.where(there, row, 0), np.where(there, column, 0)], np.nan)
