"""Finders: where the points of a pattern are, roughly, in a grey 8-bit image.

A finder returns None, or which points it found (M,) and where, (M, 2), px.  OpenCV's own; its
aruco module changed its interface in 4.7.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.detect.grids import find_circles, find_squares
from fisheye_svp_ros.detect.patterns import LocatedPoints, Pattern
from fisheye_svp_ros.detect.tag_grids import GridReading, GridSize, TagLayout, read_grid
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.registry import Registry

Grey = NDArray[np.uint8]
Finder = Callable[[Grey, Pattern], LocatedPoints | None]

_ARUCO: Any = getattr(cv2, 'aruco', None)  # of opencv-contrib alone before 4.7
_SEARCH_SIZE = 1600  # px; larger images are searched smaller first
_MIN_SHARE = 0.5  # of all points
_SHARPENING_BLUR = 2.0  # px of blur, which makes squares and cells of tags run into one another
_CLASSIC = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
_SB = cv2.CALIB_CB_ACCURACY
_SB_HARD = _SB | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE


def _at_small_scale(find: Finder) -> Finder:
    """Return a finder that searches large images at a smaller scale."""

    def search(image: Grey, pattern: Pattern) -> LocatedPoints | None:
        scale = _SEARCH_SIZE / max(image.shape)
        if scale >= 1:
            return find(image, pattern)
        small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        found = find(small, pattern)
        return None if found is None else found._replace(uv=(found.uv + 0.5) / scale - 0.5)

    return search


def _search_scaled(find: Finder) -> Finder:
    """Return a finder that searches large images at a smaller scale first."""

    def search(image: Grey, pattern: Pattern) -> LocatedPoints | None:
        found = _at_small_scale(find)(image, pattern)
        return find(image, pattern) if found is None and max(image.shape) > _SEARCH_SIZE else found

    return search


def invert_image(find: Finder) -> Finder:
    """Return a finder that searches the inverted image."""
    return lambda image, pattern: find(np.asarray(255 - image, np.uint8), pattern)


def _sharper(find: Finder) -> Finder:
    """Return a finder that looks again, at the sharpened image, where it finds few points."""

    def search(image: Grey, pattern: Pattern) -> LocatedPoints | None:
        found = find(image, pattern)
        if found is not None and len(found.ids) >= _MIN_SHARE * len(pattern.points):
            return found
        soft = cv2.GaussianBlur(image, (0, 0), _SHARPENING_BLUR)
        more = find(np.asarray(cv2.addWeighted(image, 3.0, soft, -2.0, 0.0), np.uint8), pattern)
        return max(found, more, key=lambda one: 0 if one is None else len(one.ids))

    return search


def _either_color(find: Finder) -> Finder:
    """Return a finder that searches the inverted image where it finds nothing."""
    return lambda image, pattern: find(image, pattern) or invert_image(find)(image, pattern)


def classic(image: Grey, pattern: Pattern) -> LocatedPoints | None:
    """cv2.findChessboardCorners."""
    ok, corners = cv2.findChessboardCorners(image, (pattern.columns, pattern.rows), flags=_CLASSIC)
    return _all_corners(ok, corners)


def sector_based(image: Grey, pattern: Pattern) -> LocatedPoints | None:
    """cv2.findChessboardCornersSB (Duda and Frese, BMVC 2018), thoroughly where need be."""
    for flags in (_SB, _SB_HARD):
        ok, corners = cv2.findChessboardCornersSB(
            image, (pattern.columns, pattern.rows), flags=flags
        )
        if ok:
            return _all_corners(ok, corners)
    return None


def classic_subpixel(image: Grey, pattern: Pattern) -> LocatedPoints | None:
    """cv2.findChessboardCorners and cv2.cornerSubPix, as most programs do it."""
    found = classic(image, pattern)
    if found is None:
        return None
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
    corners = found.uv.astype(np.float32).reshape(-1, 1, 2)
    refined = cv2.cornerSubPix(image, corners, (5, 5), (-1, -1), criteria)
    return _all_corners(True, refined)


def chessboard(image: Grey, pattern: Pattern) -> LocatedPoints | None:
    """The classic search, which is fast, and where it fails the sector-based one."""
    return _sharper(classic)(image, pattern) or sector_based(image, pattern)


def charuco(image: Grey, pattern: Pattern) -> LocatedPoints | None:
    """Chessboard corners between ArUco markers, by cv2.aruco; parts of a board as well."""
    dictionary = dictionary_of(pattern)
    size = (pattern.columns, pattern.rows)
    if hasattr(_ARUCO, 'CharucoDetector'):
        ids = np.arange(pattern.first, pattern.first + pattern.tag_count, dtype=np.int32)
        board = _ARUCO.CharucoBoard(size, pattern.size, pattern.marker, dictionary, ids)
        corners, ids, tags, tag_ids = _ARUCO.CharucoDetector(board).detectBoard(image)
        turned = pattern.rows % 2 == 0 and hasattr(board, 'setLegacyPattern')
        if ids is None and tag_ids is not None and turned:
            # Before OpenCV 4.6 boards of an even number of rows had their colors the other way.
            board.setLegacyPattern(True)
            corners, ids, _, _ = _ARUCO.CharucoDetector(board).detectBoard(
                image, markerCorners=tags, markerIds=tag_ids
            )
    else:
        board = _ARUCO.CharucoBoard_create(*size, pattern.size, pattern.marker, dictionary)
        if pattern.first:
            board.setIds((board.ids + pattern.first).astype(np.int32))
        tags, tag_ids, _ = _ARUCO.detectMarkers(image, dictionary)
        if tag_ids is None:
            return None
        _, corners, ids = _ARUCO.interpolateCornersCharuco(tags, tag_ids, image, board)
    if ids is None or len(ids) < 4:
        return None
    return LocatedPoints(ids.ravel().astype(np.int64), corners.reshape(-1, 2).astype(float))


def aprilgrid(image: Grey, pattern: Pattern) -> LocatedPoints | None:
    """An AprilGrid of tags 36h11, printed as Kalibr does it or otherwise, by cv2.aruco."""
    grid = _read_aprilgrid(image, pattern)
    return LocatedPoints(grid.ids, grid.uv, grid) if len(grid.ids) else None


def _read_aprilgrid(image: Grey, pattern: Pattern) -> GridReading:
    """Return what the tags in an image say: with Kalibr's border of two cells, or else of one."""
    size = GridSize(pattern.columns, pattern.rows, pattern.gap)
    layout = pattern.layout
    borders = (2, 1) if layout is None else (layout.border,)
    readings = []
    for border in borders:
        ids, corners = _tags(image, pattern, border)
        reading = read_grid(ids, corners, border, size, layout)
        readings.append((len(reading.ids), len(ids), border, reading))
        if len(reading.ids) > 4:
            break  # by chance a tag is read with the other border, but no grid of them
    return max(readings, key=lambda one: one[:3])[3]


def explain_failure(image: Grey, pattern: Pattern) -> str:
    """Return why a board was not found, as far as the image tells."""
    if pattern.kind != 'aprilgrid':
        return 'no board found'
    return _read_aprilgrid(image, pattern).reason or 'no board found'


def _tags(image: Grey, pattern: Pattern, border: int) -> tuple[Index, Array]:
    """Return ids (T,) and corners (T, 4, 2), px, of tags of the dictionary of a pattern.

    border: cells around their code.
    """
    return _detect(image, dictionary_of(pattern), border)


def detect_markers(image: Grey, name: int, border: int) -> tuple[Index, Array]:
    """Return ids (T,) and corners (T, 4, 2), px, of tags of one of OpenCV's dictionaries."""
    return _detect(image, _ARUCO.getPredefinedDictionary(name), border)


def _detect(image: Grey, dictionary: Any, border: int) -> tuple[Index, Array]:
    modern = hasattr(_ARUCO, 'ArucoDetector')
    parameters = (_ARUCO.DetectorParameters if modern else _ARUCO.DetectorParameters_create)()
    parameters.markerBorderBits = border
    if modern:
        tags, ids, _ = _ARUCO.ArucoDetector(dictionary, parameters).detectMarkers(image)
    else:
        tags, ids, _ = _ARUCO.detectMarkers(image, dictionary, parameters=parameters)
    if ids is None:
        return np.empty(0, np.int64), np.empty((0, 4, 2))
    return ids.ravel().astype(np.int64), np.asarray(tags, dtype=float).reshape(-1, 4, 2)


class TagReport(NamedTuple):
    """How many tags are in an image, how many the pattern does not have; layouts that fit them."""

    seen: int = 0
    beyond: int = 0
    layouts: frozenset[TagLayout] = frozenset()


NO_TAGS = TagReport()


def report_tags(image: Grey, pattern: Pattern, grid: GridReading | None) -> TagReport:
    """Return what the tags in an image say besides its points; grid: as it was read."""
    if not pattern.tag_count:
        return NO_TAGS
    layouts: frozenset[TagLayout] = frozenset()
    border, first = 1, pattern.first
    if pattern.kind == 'aprilgrid':
        grid = grid or _read_aprilgrid(image, pattern)
        layouts = grid.layouts
        layout = grid.layout or next(iter(layouts), TagLayout(2, 0, False, 0))
        border, first = layout.border, layout.first
    ids, _ = _tags(image, pattern, border)
    beyond = (ids < first) | (ids >= first + pattern.tag_count)
    return TagReport(len(ids), int(beyond.sum()), layouts)


# Which patterns a detector is for, and its finder
DETECTORS = Registry[tuple[tuple[str, ...], Finder]](
    'detectors',
    {
        'saddle': (('chessboard',), _search_scaled(chessboard)),
        'quick': (('chessboard',), _search_scaled(classic)),
        'sb': (('chessboard',), sector_based),
        'classic': (('chessboard',), classic_subpixel),
        'charuco': (('charuco',), _either_color(_sharper(charuco))),
        'aprilgrid': (('aprilgrid',), _either_color(_sharper(aprilgrid))),
        'circles': (('circles', 'asymmetric_circles'), _search_scaled(find_circles)),
        'squares': (('squares',), find_squares),
    },
    tuple,
)
# What a detector does first, alone
FIRST_LOOKS: dict[str, Finder] = {'saddle': _at_small_scale(classic)}
UNFITTED_DETECTORS = ('sb', 'classic')  # keep their own points; the others are fitted


def default_detector(pattern: Pattern) -> str:
    """Return the name of the detector that a pattern is searched with; '' for loose tags."""
    return next((name for name, (kinds, _) in DETECTORS.items() if pattern.kind in kinds), '')


def _all_corners(ok: bool, corners: Any) -> LocatedPoints | None:
    if not ok:
        return None
    uv = np.asarray(corners, dtype=float).reshape(-1, 2)
    return LocatedPoints(np.arange(len(uv)), uv)


def need_markers(spec: str) -> None:
    """Raise ParameterError where OpenCV has no markers, which a board is made of."""
    if _ARUCO is None:
        raise ParameterError(
            f'board {spec!r}: OpenCV {cv2.__version__} has no markers; '
            'install 4.7 or newer, or opencv-contrib'
        )


def dictionary_of(pattern: Pattern) -> Any:
    """Return the ArUco dictionary of a pattern."""
    need_markers(pattern.spec)
    named = [name for name in dir(_ARUCO) if name.upper() == pattern.dictionary]
    if not named:
        raise ParameterError(
            f'board {pattern.spec!r}: OpenCV {cv2.__version__} has no dictionary '
            f'{pattern.dictionary}'
        )
    number = getattr(_ARUCO, named[0])
    if hasattr(_ARUCO, 'getPredefinedDictionary'):
        return _ARUCO.getPredefinedDictionary(number)
    return _ARUCO.Dictionary_get(number)
