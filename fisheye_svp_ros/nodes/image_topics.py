"""The images of a camera, raw and compressed, as image_transport has them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from fisheye_svp_ros.io.decoding import read_camera_info
from fisheye_svp_ros.nodes.base import BaseNode
from fisheye_svp_ros.nodes.camera_info import CameraInfos
from fisheye_svp_ros.nodes.quality import INFO_INPUT, SENSOR
from fisheye_svp_ros.nodes.subscriptions import Unread

COMPRESSED_SUFFIX = '/compressed'
_MAX_LEAD = 100  # images of which one topic may be ahead of the other


class ImageTopics:
    """Subscriptions of a node to the images on a topic, and to the camera_info of these.

    decode: what reads an Image and a CompressedImage; take: what gets the stamps and images.
    """

    def __init__(
        self, node: BaseNode, topic: str, decode: tuple[Callable[[Any, str], Any], ...],
        take: Callable[[int, Unread], None], info: str, infos: CameraInfos,
    ) -> None:
        self._taken: deque[tuple[int, str]] = deque(maxlen=_MAX_LEAD)
        compressed = topic + COMPRESSED_SUFFIX
        node.collect(Image, topic, decode[0], take, SENSOR)
        node.collect(CompressedImage, compressed, decode[1], take, SENSOR,
                     name=_compressed_topic(node, topic))
        node.collect(CameraInfo, info, read_camera_info, partial(infos.hear, info), INFO_INPUT,
                     latched=True)

    def remember(self, stamp: int, image: Unread) -> None:
        """Take note of an image that is taken."""
        self._taken.append((stamp, image.topic))

    def is_repeated(self, stamp: int, image: Unread) -> bool:
        """Say whether it was taken from the other topic: image_transport sends it on both."""
        return any(at == stamp and topic != image.topic for at, topic in self._taken)


def _compressed_topic(node: BaseNode, raw: str) -> str:
    """Return the topic of compressed images: beside the raw ones, unless remapped itself."""
    own = str(node.resolve_topic_name(raw + COMPRESSED_SUFFIX))
    if own != node.resolve_topic_name(raw + COMPRESSED_SUFFIX, only_expand=True):
        return own
    return f'{node.resolve_topic_name(raw)}{COMPRESSED_SUFFIX}'
