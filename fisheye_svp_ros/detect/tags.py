"""Loose tags in images: AprilTags 36h11 by id, wherever they hang."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.detect.finders import Grey, detect_markers, need_markers
from fisheye_svp_ros.detect.patterns import LENGTH_UNITS, LOOSE_TAGS, Pattern
from fisheye_svp_ros.detect.photographs import Photograph, Pixels
from fisheye_svp_ros.detect.points import Points, eight_bit
from fisheye_svp_ros.detect.tag_edges import fit_quads
from fisheye_svp_ros.errors import ObservationError, ParameterError
from fisheye_svp_ros.io.tag_maps import CORNERS, TagMap, check_family, read_tag_map

FAMILY = '36h11'
# libapriltag goes round a tag from its lower left, against the clock; OpenCV's print of a tag is
# that of libapriltag turned by half.
_ORDER = [1, 0, 3, 2]
_MIN_SIDE = 12.0  # px; the corners of a smaller tag run into its code
_TAGS, _MAX_NAMES = 587, 5  # tags of the family, ids in a sentence
_LENGTH = re.compile(r'[0-9.]+ *(mm|cm|m)', re.IGNORECASE)
_SPEC = re.compile(r'tags:(?:36h11:)?([0-9.]+) *(mm|cm|m)', re.IGNORECASE)


class TagViews(NamedTuple):
    """Tags in F images: frames by name; rows (R,): which image, which id; uv (R, 4, 2), px."""

    names: tuple[str, ...]
    image: Index
    ids: Index
    uv: Array
    size: tuple[int, int]


def tag_size(spec: str) -> float:
    """Return the side of loose tags, m, from `tags:36h11:160mm`; raise ParameterError."""
    need_markers(spec)
    match = _SPEC.fullmatch(spec)
    size = float(match[1]) * LENGTH_UNITS[match[2].lower()] if match else 0.0
    if not 0 < size < 10:
        raise ParameterError(
            f'board {spec!r}: loose tags are given as tags:36h11:160mm (side of the black square)'
        )
    return size


def find_tags(image: Grey) -> tuple[Index, Array]:
    """Return ids (T,) and corners (T, 4, 2), px, of the tags in a grey image, each id once."""
    ids, corners = detect_markers(image, cv2.aruco.DICT_APRILTAG_36h11, 1)
    side = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).min(axis=1)
    once = np.array([(ids == one).sum() == 1 for one in ids], dtype=bool)
    keep = once & (side > _MIN_SIDE)
    return ids[keep], fit_quads(image, corners[keep][:, _ORDER])


def tag_pattern(spec: str, tags: TagMap) -> Pattern:
    """Return what a detector looks for where loose tags hang as a map says.

    Its points are by landmark, NaN for those of other tags.
    Raises ParameterError where OpenCV has no markers.
    """
    need_markers(spec)
    points = np.full((CORNERS * _TAGS, 3), np.nan)
    known = tags.ids < _TAGS
    points.reshape(_TAGS, CORNERS, 3)[tags.ids[known]] = tags.corners[known]
    none, side = np.zeros((len(points), 2)), float(tags.sizes.max())
    return Pattern(
        LOOSE_TAGS, spec, 0, 0, points, 0.0, none, none[:, 0], side, side, note=tags.note
    )


def read_tag_pattern(spec: str, words: Sequence[str]) -> Pattern:
    """Return the pattern of tags:tags.yaml, also with family and side before the file.

    Raises ParameterError where the map is missing, or says otherwise.
    """
    return tag_pattern(spec, tags_of_board(spec, words))


def tags_of_board(spec: str, words: Sequence[str]) -> TagMap:
    """Return the map of tags that a board names."""
    left, size = list(words), None
    if left and left[0].lower() == FAMILY:
        left.pop(0)
    if left and _LENGTH.fullmatch(left[0]):
        size = tag_size(f'{LOOSE_TAGS}:{left.pop(0)}')
    if not left:
        raise ParameterError(
            f'board {spec!r}: loose tags need a map; add its file, as in tags:tags.yaml, or '
            '--tag-map tags.yaml'
        )
    try:
        tags = read_tag_map(':'.join(left), size)
        check_family(FAMILY, tags.family, spec)
    except ObservationError as error:
        raise ParameterError(str(error)) from error
    return tags


def known_points(points: Points, pattern: Pattern) -> Points | str:
    """Return the points of tags that the map has, or why there are none."""
    keep = np.isfinite(pattern.points[points.ids]).all(axis=1)
    if not keep.any():
        seen = ', '.join(map(str, np.unique(points.ids // CORNERS)[:_MAX_NAMES]))
        return f'no tag of the map; there are {seen}'
    return points._replace(
        ids=points.ids[keep],
        uv=points.uv[keep],
        sigma=points.sigma[keep],
        reach=points.reach[keep],
    )


def find_tag_points(pixels: Pixels) -> Points | str:
    """Return the corners of loose tags as points, or why there are none."""
    ids, corners = find_tags(eight_bit(pixels))
    if not len(ids):
        return 'no tag found'
    side = np.linalg.norm(corners[:, 1] - corners[:, 0], axis=-1)
    numbers = (CORNERS * ids[:, None] + np.arange(CORNERS)).ravel()
    unknown = np.full(len(numbers), np.nan)
    return Points(numbers, corners.reshape(-1, 2), unknown, np.nan, np.repeat(side / 8, CORNERS))


def find_tag_views(photographs: Iterable[Photograph]) -> TagViews:
    """Search photographs for loose tags; raise ObservationError where none shows any."""
    names, image, ids, uv, size = list[str](), list[int](), list[Index](), list[Array](), (0, 0)
    for number, photograph in enumerate(photographs):
        pixels = eight_bit(photograph.pixels())
        size = pixels.shape[1], pixels.shape[0]
        found, corners = find_tags(pixels)
        names.append(photograph.name)
        image += [number] * len(found)
        ids.append(found)
        uv.append(corners)
    if not image:
        raise ObservationError(f'no tag 36h11 in {len(names)} images; check family and sharpness')
    return TagViews(
        tuple(names),
        np.array(image, dtype=np.int64),
        np.concatenate(ids),
        np.concatenate(uv),
        size,
    )
