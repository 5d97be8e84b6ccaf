"""Tags that another node found: messages of apriltag_msgs and vision_msgs to image points."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from fisheye_svp_ros.errors import ObservationError, ParameterError
from fisheye_svp_ros.io.decoding import ImagePoints
from fisheye_svp_ros.io.tag_maps import CENTER_OFFSET, CORNERS, check_family, tags_of
from fisheye_svp_ros.reporting.wording import inputs as wording

_LAST_NUMBER = re.compile(r'(\d{1,6})\D*$')  # of an id such as tag36h11:5


class TagLimits(NamedTuple):
    """Which tags of a detector are used, and the family of the map, '' where it is not known."""

    max_hamming: int = 1
    min_decision_margin: float = 10.0
    family: str = ''

    def pass_tag(self, tag: Any) -> bool:
        """Say whether a detection is sure enough; a margin of 0 is one that is not stated."""
        margin = float(tag.decision_margin)
        return tag.hamming <= self.max_hamming and not 0 < margin < self.min_decision_margin


DEFAULT_LIMITS = TagLimits()


def detections_reader(
    package: str, limits: TagLimits, may_be_empty: bool = False
) -> tuple[Any, Callable[[Any, str], ImagePoints]]:
    """Return the message class of detections, and what decodes one.

    package: apriltag_msgs or vision_msgs; may_be_empty: a message without a tag is a set, too.
    Raises ParameterError where the package is not installed.
    """
    tags = partial(read_apriltags, limits=limits, may_be_empty=may_be_empty)
    middles = partial(read_detections, may_be_empty=may_be_empty)
    kinds: dict[str, tuple[str, Callable[[Any, str], ImagePoints]]] = {
        'apriltag_msgs': ('AprilTagDetectionArray', tags),
        'vision_msgs': ('Detection2DArray', middles),
    }
    name, read = kinds[package]
    try:
        return getattr(import_module(f'{package}.msg'), name), read
    except ImportError as cause:
        raise ParameterError(
            f'detections: {package} is not installed; apt install '
            f'ros-jazzy-{package.replace("_", "-")}'
        ) from cause


def read_apriltags(
    message: Any,
    topic: str = 'detections',
    limits: TagLimits = DEFAULT_LIMITS,
    may_be_empty: bool = False,
) -> ImagePoints:
    """Return the corners of tags; libapriltag puts pixel centers at a half.

    Raises ObservationError for tags of another family than those of the map.
    """
    for family in {str(tag.family) for tag in message.detections}:
        check_family(family, limits.family, topic)
    counts = Counter(int(tag.id) for tag in message.detections)
    tags = [tag for tag in message.detections if limits.pass_tag(tag) and counts[tag.id] == 1]
    ids = [CORNERS * int(tag.id) + corner for tag in tags for corner in range(CORNERS)]
    uv = [(corner.x - 0.5, corner.y - 0.5) for tag in tags for corner in tag.corners]
    doubtful = len(message.detections) - len(tags)
    if doubtful and not (tags or may_be_empty):
        raise ObservationError(f'{topic}: {wording.doubtful_tags(doubtful, doubtful)}')
    found = _image_points(ids, uv, message, topic, may_be_empty)
    return found._replace(doubtful_tags=doubtful)


def read_detections(
    message: Any, topic: str = 'detections', may_be_empty: bool = False
) -> ImagePoints:
    """Return the middles of tags; those whose id has no number are left out."""
    ids, uv = [], []
    for detection in message.detections:
        names = [detection.id, *(result.hypothesis.class_id for result in detection.results)]
        number = next((match[1] for name in names if (match := _LAST_NUMBER.search(name))), None)
        if number is not None:
            ids.append(CENTER_OFFSET + int(number))
            center = getattr(detection.bbox.center, 'position', detection.bbox.center)
            uv.append((center.x, center.y))
    return _image_points(ids, uv, message, topic, may_be_empty)


def _image_points(
    ids: list[int],
    uv: list[tuple[float, float]],
    message: Any,
    topic: str,
    may_be_empty: bool,
) -> ImagePoints:
    if not (ids or may_be_empty):
        raise ObservationError(f'{topic}: it holds no tag')
    points, landmark = np.array(uv, dtype=float).reshape(-1, 2), np.array(ids, dtype=np.int64)
    usable = np.isfinite(points).all(axis=1)
    if not (usable.any() or may_be_empty):
        raise ObservationError(f'{topic}: no image point is a finite number')
    rejected = int((~usable).sum())
    return ImagePoints(
        landmark[usable],
        points[usable],
        str(message.header.frame_id),
        rejected,
        f'{topic}: {rejected} points are no finite numbers' if rejected else '',
        tags_of(landmark[usable]),
    )
