"""Finds a board in the images of a camera: image points, and the board as landmarks."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from sensor_msgs.msg import CompressedImage, Image, PointCloud2

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.detect.finders import default_detector
from fisheye_svp_ros.detect.patterns import Pattern, parse_pattern
from fisheye_svp_ros.detect.photographs import Pixels, message_pixels
from fisheye_svp_ros.detect.points import find_points
from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.io.parameters import parameter
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.access import allowed
from fisheye_svp_ros.nodes.base import LATCHED, SENSOR_INPUT, BaseNode, Unread, run
from fisheye_svp_ros.scene.landmarks import Landmarks
from fisheye_svp_ros.study.settings import Settings

_QUICK = {'saddle': 'quick'}  # a live camera has another image soon
_LOOK = 0.002  # s, how often a waiting image is looked for


@dataclass(frozen=True)
class DetectorSettings(Settings):
    """Parameters of the detector."""

    board: str = parameter(
        'chessboard:9x6:25mm', 'The board: chessboard:COLUMNSxROWS:SIZE (inner corners), '
        'charuco:..., aprilgrid:FILE, circles:..., squares:..., as for `fisheye-svp detect`'
    )
    board_frame: str = parameter('board', 'Frame id of the landmarks')


class Detector(BaseNode):
    """Publishes the image points of a board under the stamp of their image.

    Only the newest image counts: older ones that wait are dropped and counted.
    """

    NAME = 'detector'
    SETTINGS = DetectorSettings
    settings: DetectorSettings

    def __init__(self) -> None:
        super().__init__()
        self._points = self.announce(PointCloud2, 'image_points', wait=True)
        self._landmarks = self.announce(PointCloud2, 'landmarks', LATCHED)
        self._pattern: Pattern
        self._near: Array | None = None
        self._size: tuple[int, ...] | None = None
        self._waiting: tuple[int, Unread] | None = None
        self._counts = {'images overtaken': 0, 'images without board': 0}
        for kind, topic in ((Image, 'image'), (CompressedImage, 'image/compressed')):
            self.collect(kind, topic, partial(_read, kind), self._take, SENSOR_INPUT)
        self.every(_LOOK, self._work)
        self.start()

    def prepare(self, settings: DetectorSettings) -> Pattern:
        """Return the pattern; raise ParameterError where the text names none."""
        kind, _, file = settings.board.partition(':')
        if kind == 'aprilgrid' and settings is not self.settings:
            allowed(file, self.settings.folder, 'board')
        return parse_pattern(settings.board)

    def configure(self, pattern: Pattern) -> None:
        """Look for another board from now on."""
        self._pattern, self._near, self._size = pattern, None, None
        board = Landmarks(np.arange(len(pattern.points)), pattern.points)
        self._landmarks.publish(messages.landmarks_message(board, 0, self.settings.board_frame))

    def report(self) -> tuple[dict[str, object], str]:
        """Return how many images were overtaken, and how many showed no board."""
        return dict(self._counts), ''

    def _take(self, stamp: int, image: Unread) -> None:
        """Keep the newest image, if anybody wants to know what is in it."""
        if not self._points.get_subscription_count() or not self.has_listeners():
            return
        if self._waiting is not None:
            self._counts['images overtaken'] += 1
            if self._waiting[0] > stamp:
                return
        self._waiting = stamp, image

    def _work(self) -> None:
        if self._waiting is None:
            return
        (stamp, image), self._waiting = self._waiting, None
        try:
            frame, pixels = image.read()
            self._check_size(pixels)
        except ObservationError as error:
            self.drop(image.topic, error)
            return
        detector = default_detector(self._pattern)
        found = find_points(pixels, self._pattern, _QUICK.get(detector, detector), self._near)
        if isinstance(found, str):
            self._near = None
            self._counts['images without board'] += 1
            return
        self._near = found.uv
        self._points.publish(
            messages.image_points_message(found.ids, found.uv, stamp, frame))

    def _check_size(self, pixels: Pixels) -> None:
        """Raise ObservationError where images change their size: no lens would fit both."""
        if self._size is None:
            self._size = pixels.shape
        if pixels.shape != self._size:
            raise ObservationError(
                f'image: {pixels.shape[1]}x{pixels.shape[0]} px, but it was '
                f'{self._size[1]}x{self._size[0]}; start the node anew for another camera')


def _read(kind: Any, message: Any, topic: str) -> tuple[str, Pixels]:
    return message.header.frame_id, message_pixels(message, kind.__name__, topic)


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(Detector, args)
