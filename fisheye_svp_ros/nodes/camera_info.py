"""What cameras tell: their images, raw and compressed, and their lenses on `camera_info`."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from fisheye_svp_ros.errors import FisheyeSvpError, ObservationError, ParameterError
from fisheye_svp_ros.io.decoding import (
    CameraModel,
    FramedCamera,
    are_different_frames,
    read_framed_camera,
)
from fisheye_svp_ros.io.lens_formats.ros import distortion_lens
from fisheye_svp_ros.nodes.base import BaseNode
from fisheye_svp_ros.nodes.quality import INFO_INPUT, SENSOR
from fisheye_svp_ros.nodes.subscriptions import Unread
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.reporting.wording import inputs as wording

CAMERA_INFO = 'camera_info'  # the value of the parameter `lens`, and the topic
_MAX_MESSAGES = 1000  # of each camera, for sets that wait
COMPRESSED_SUFFIX = '/compressed'
_MAX_LEAD = 100  # images of which one topic may be ahead of the other


class CameraInfos:
    """What came on `camera_info`, by topic and stamp.

    A set is solved with the camera_info of its stamp, or with the latest: lenses seldom change.
    """

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell = tell
        self._heard: dict[str, dict[int, Any]] = {}
        self._told: dict[str, CameraModel] = {}

    def hear(self, topic: str, stamp: int, unread: Any) -> None:
        """Keep a message until a set needs it."""
        heard = self._heard.setdefault(topic, {})
        heard.pop(stamp, None)
        heard[stamp] = unread
        if len(heard) > _MAX_MESSAGES:
            del heard[next(iter(heard))]

    def size(self, topic: str, stamp: int) -> tuple[int, int] | None:
        """Return width and height, px, of the images, where somebody has told of them."""
        with suppress(FisheyeSvpError):
            return self._camera(topic, stamp).model.size
        return None

    def lens(self, topic: str, stamp: int, frame: str = '') -> Lens:
        """Return the lens of a set; raise FisheyeSvpError where nobody has told a usable one.

        frame: that the camera_info must be of, where it is known.
        """
        known, own = self._camera(topic, stamp)
        if are_different_frames(own, frame):
            raise ObservationError(wording.camera_info_of_another(topic, own, frame))
        lens = distortion_lens(*known, topic.replace('/', '_'), topic)
        if self._told.get(topic) != known:
            self._told[topic] = known
            self._tell(f'{topic}: {known.model or "pinhole"} of {lens.width}x{lens.height} px')
        return lens

    def _camera(self, topic: str, stamp: int) -> FramedCamera:
        heard = self._heard.get(topic)
        if not heard:
            raise ParameterError(wording.no_camera_info(topic))
        key = stamp if stamp in heard else next(reversed(heard))
        if not isinstance(heard[key], FramedCamera):
            heard[key] = heard[key].read()
        camera: FramedCamera = heard[key]
        return camera


class ImageTopics:
    """Subscriptions of a node to the images on a topic, and to the camera_info of these.

    decode: what reads an Image and a CompressedImage; take: what gets the stamps and images.
    info: the topic of camera_info, as the node calls it; info_name: what that is, if not itself.
    """

    def __init__(
        self,
        node: BaseNode,
        topic: str,
        decode: tuple[Callable[[Any, str], Any], ...],
        take: Callable[[int, Unread], None],
        info: str,
        infos: CameraInfos,
        info_name: str = '',
    ) -> None:
        self._taken: deque[tuple[int, str]] = deque(maxlen=_MAX_LEAD)
        compressed = topic + COMPRESSED_SUFFIX
        node.collect(Image, topic, decode[0], take, SENSOR)
        node.collect(
            CompressedImage,
            compressed,
            decode[1],
            take,
            SENSOR,
            name=_compressed_topic(node, topic),
        )
        node.collect(
            CameraInfo,
            info,
            read_framed_camera,
            partial(infos.hear, info),
            INFO_INPUT,
            latched=True,
            name=info_name,
        )

    def remember(self, stamp: int, image: Unread) -> None:
        """Take note of an image that is taken."""
        self._taken.append((stamp, image.topic))

    def is_repeated(self, stamp: int, image: Unread) -> bool:
        """Say whether it was taken from the other topic: image_transport sends it on both."""
        return any(at == stamp and topic != image.topic for at, topic in self._taken)


def info_topic(node: BaseNode, raw: str, info: str, own: str) -> str:
    """Return the topic of camera_info: beside the images, as image_transport has it.

    raw, info: as the node calls them.  It is `info` itself where that is remapped, or where what
    is beside the images is the node's own output.
    """
    named = str(node.resolve_topic_name(info))
    beside = f'{node.resolve_topic_name(raw).rpartition("/")[0]}/{CAMERA_INFO}'
    remapped = named != node.resolve_topic_name(info, only_expand=True)
    return named if remapped or beside == own else beside


def _compressed_topic(node: BaseNode, raw: str) -> str:
    """Return the topic of compressed images: beside the raw ones, unless remapped itself."""
    own = str(node.resolve_topic_name(raw + COMPRESSED_SUFFIX))
    if own != node.resolve_topic_name(raw + COMPRESSED_SUFFIX, only_expand=True):
        return own
    return f'{node.resolve_topic_name(raw)}{COMPRESSED_SUFFIX}'
