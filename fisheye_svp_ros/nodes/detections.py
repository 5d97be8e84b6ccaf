"""Tags that another node found: messages of apriltag_msgs and vision_msgs to image points."""

from __future__ import annotations

import re
from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np

from fisheye_svp_ros.errors import ObservationError, ParameterError
from fisheye_svp_ros.io.decoding import ImagePoints
from fisheye_svp_ros.io.tag_maps import CENTER_OFFSET, CORNERS

_LAST_NUMBER = re.compile(r'(\d{1,6})\D*$')  # of an id such as tag36h11:5


def detections_reader(package: str) -> tuple[Any, Callable[[Any, str], ImagePoints]]:
    """Return the message class of detections, and what decodes one.

    package: apriltag_msgs or vision_msgs.  Raises ParameterError where it is not installed.
    """
    name, read = {
        'apriltag_msgs': ('AprilTagDetectionArray', read_apriltags),
        'vision_msgs': ('Detection2DArray', read_detections),
    }[package]
    try:
        return getattr(import_module(f'{package}.msg'), name), read
    except ImportError as cause:
        raise ParameterError(
            f'detections: {package} is not installed; apt install '
            f'ros-jazzy-{package.replace("_", "-")}'
        ) from cause


def read_apriltags(message: Any, topic: str = 'detections') -> ImagePoints:
    """Return the corners of tags; libapriltag puts pixel centers at a half."""
    tags = message.detections
    ids = [CORNERS * int(tag.id) + corner for tag in tags for corner in range(CORNERS)]
    uv = [(corner.x - 0.5, corner.y - 0.5) for tag in tags for corner in tag.corners]
    return _image_points(ids, uv, message, topic)


def read_detections(message: Any, topic: str = 'detections') -> ImagePoints:
    """Return the middles of tags; those whose id has no number are left out."""
    ids, uv = [], []
    for detection in message.detections:
        names = [detection.id, *(result.hypothesis.class_id for result in detection.results)]
        number = next((match[1] for name in names if (match := _LAST_NUMBER.search(name))), None)
        if number is not None:
            ids.append(CENTER_OFFSET + int(number))
            center = getattr(detection.bbox.center, 'position', detection.bbox.center)
            uv.append((center.x, center.y))
    return _image_points(ids, uv, message, topic)


def _image_points(
    ids: list[int], uv: list[tuple[float, float]], message: Any, topic: str
) -> ImagePoints:
    if not ids:
        raise ObservationError(f'{topic}: it holds no tag')
    points = np.array(uv, dtype=float)
    usable = np.isfinite(points).all(axis=1)
    if not usable.any():
        raise ObservationError(f'{topic}: no image point is a finite number')
    rejected = int((~usable).sum())
    return ImagePoints(
        np.array(ids, dtype=np.int64)[usable],
        points[usable],
        str(message.header.frame_id),
        rejected,
        f'{topic}: {rejected} points are no finite numbers' if rejected else '',
    )
