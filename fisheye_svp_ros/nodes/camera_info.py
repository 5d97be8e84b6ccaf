"""The lenses that cameras tell of on their `camera_info`."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

from fisheye_svp_ros.errors import FisheyeSvpError, ParameterError
from fisheye_svp_ros.io.decoding import CameraModel
from fisheye_svp_ros.io.lens_formats.ros import lens_of
from fisheye_svp_ros.optics.lens import Lens

CAMERA_INFO = 'camera_info'  # the value of the parameter `lens`, and the topic
_MAX_MESSAGES = 1000  # of each camera, for sets that wait


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
            return self._model(topic, stamp).size
        return None

    def lens(self, topic: str, stamp: int) -> Lens:
        """Return the lens of a set; raise FisheyeSvpError where nobody has told a usable one."""
        known = self._model(topic, stamp)
        lens, worst = lens_of(*known, topic.replace('/', '_'), topic)
        if self._told.get(topic) != known:
            self._told[topic] = known
            off = f', {worst:.2g} px off at worst' if worst else ''
            self._tell(f'{topic}: {known.model} of {lens.width}x{lens.height} px{off}')
        return lens

    def _model(self, topic: str, stamp: int) -> CameraModel:
        heard = self._heard.get(topic)
        if not heard:
            raise ParameterError(f'{topic}: no message received; set the parameter lens')
        key = stamp if stamp in heard else next(reversed(heard))
        if not isinstance(heard[key], CameraModel):
            heard[key] = heard[key].read()
        model: CameraModel = heard[key]
        return model
