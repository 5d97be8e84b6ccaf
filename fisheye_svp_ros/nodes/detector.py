"""Finds a board in the images of a camera: image points, and the board as landmarks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np
from sensor_msgs.msg import CompressedImage, Image, PointCloud2

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.detect.drawing import draw_points
from fisheye_svp_ros.detect.finders import default_detector
from fisheye_svp_ros.detect.patterns import LOOSE_TAGS, Pattern, check_of_board, parse_pattern
from fisheye_svp_ros.detect.photographs import Pixels, message_pixels
from fisheye_svp_ros.detect.points import Points, search
from fisheye_svp_ros.detect.tags import tag_pattern
from fisheye_svp_ros.detect.workers import BoundedCalls, TimedOut
from fisheye_svp_ros.errors import FisheyeSvpError, ObservationError, ParameterError
from fisheye_svp_ros.io.parameters import parameter
from fisheye_svp_ros.io.tag_maps import read_tag_map
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.base import BaseNode
from fisheye_svp_ros.nodes.camera_info import (
    CAMERA_INFO,
    COMPRESSED_SUFFIX,
    CameraInfos,
    ImageTopics,
)
from fisheye_svp_ros.nodes.declaration import check_access
from fisheye_svp_ros.nodes.quality import LATCHED
from fisheye_svp_ros.nodes.subscriptions import Unread
from fisheye_svp_ros.optics.lens import INTRINSICS
from fisheye_svp_ros.scene.observations import Landmarks
from fisheye_svp_ros.study.settings import Settings

if TYPE_CHECKING:
    from fisheye_svp_ros.nodes.guiding import Guiding

_RAW, _COMPRESSED = 'image', f'image{COMPRESSED_SUFFIX}'
_LIVE_DETECTORS = {'saddle': 'quick'}  # a live camera has another image soon
_MIN_FAILURES = 20  # images without a board before the first with one: it may be another board
_NOTHING = np.zeros(0, dtype=np.int64), np.zeros((0, 2))  # ids and image points
_LOOK = 0.005  # s, how often what a search found is looked for
_GUIDE_PARAMETERS = ('e0', *INTRINSICS, 'k1', 'k2', 'k3', 'k4')  # that a guide can determine


@dataclass(frozen=True)
class DetectorSettings(Settings):
    """Parameters of the detector."""

    board: str = parameter(
        'chessboard:9x6:25mm',
        'The board, as for `fisheye-svp detect`: chessboard:COLUMNSxROWS:SIZE (inner corners), '
        'charuco:..., aprilgrid:FILE, circles:..., squares:... tags:FILE: loose tags of a tag '
        'map, whose corners are the landmarks',
    )
    board_frame: str = parameter('board', 'Frame id of the landmarks', frame=True)
    longest_search: float = parameter(
        1.0,
        'Longest search in one image. After that, the image counts as one without a board',
        's',
        (0.05, 60.0),
    )
    detections: bool = parameter(
        False,
        'Instead of images, use AprilTags that another node found in raw (not rectified) '
        'images, from the topic `detections`. Needs apriltag_msgs',
        fixed=True,
    )
    guide: str = parameter(
        '',
        'Parameter of the lens that the live guide determines (e0: the viewpoint shift). '
        'Empty: no guide',
        choices=('', *_GUIDE_PARAMETERS),
        fixed=True,
    )
    goal: float = parameter(
        0.0002,
        'Standard error at which the guide stops, m for e0, px for fx, fy, cx, and cy',
        span=(1e-9, 1e3),
        fixed=True,
    )
    lens: str = parameter(
        '',
        'Initial lens of the guide: a file, or a name in config/lenses. `camera_info`: from '
        'that topic. Empty: a lens with the parameter `field_of_view`',
        fixed=True,
        file=True,
    )
    field_of_view: float = parameter(
        3.1,
        'Horizontal field of view, from the data sheet',
        'rad',
        (0.3, 6.0),
        fixed=True,
    )
    near: float = parameter(
        0.15, 'Nearest distance at which the board is sharp', 'm', (1e-3, 1e3), fixed=True
    )
    far: float = parameter(
        0.8, 'Farthest distance at which the board can be held', 'm', (1e-3, 1e3), fixed=True
    )
    guide_output: str = parameter(
        'guided',
        'Folder for observations.csv and the photographs that the guide takes. It must be empty',
        fixed=True,
    )


class Detector(BaseNode):
    """Publishes the image points of a board under the stamp of their image.

    Only the newest image counts: older ones that wait are dropped and counted.
    """

    NAME = 'detector'
    SETTINGS = DetectorSettings
    settings: DetectorSettings
    # Looked at by destroy_node, also where a signal came while this was being built
    _searches: BoundedCalls | None = None
    _guiding: Guiding | None = None

    def __init__(self, node_name: str | None = None, **options: Any) -> None:
        super().__init__(node_name, **options)
        self._points = self.announce(PointCloud2, 'image_points', wait=True)
        self._landmarks = self.announce(PointCloud2, 'landmarks', LATCHED)
        self._drawn = self.announce(Image, '~/found')
        self._pattern: Pattern
        self._near: Array | None = None
        self._size: tuple[int, ...] | None = None
        self._waiting: tuple[int, Unread] | None = None
        self._searched: tuple[int, str, Pixels] | None = None
        self._infos = CameraInfos(self.get_logger().info)
        self._misfit = ''
        self._failures_at_first = 0  # images before the first with a board
        self._counts = {'images overtaken': 0, 'images without board': 0, 'searches ended': 0}
        if self.settings.detections:
            self.listen(_tag_array(), 'detections', self._read_tags, self._publish_tags)
            self.start()
            return
        decode = partial(_read, Image), partial(_read, CompressedImage)
        self._images = ImageTopics(self, _RAW, decode, self._take, CAMERA_INFO, self._infos)
        self.start()
        if self.settings.guide:
            # The diagnosis and the plots behind it take half a second to import.
            from fisheye_svp_ros.nodes.guiding import Guiding

            self._guiding = Guiding(self, self.settings, self._pattern, self._infos)
        # A search may take long, and nothing but the end of its process breaks it off.
        blank = np.zeros((16, 16), np.uint8), self._pattern, self._detector, None
        self._searches = BoundedCalls(search, blank)
        self._look = self.start_timer(_LOOK, self._work)

    def needed_inputs(self) -> Sequence[Sequence[str]]:
        """Return the topics without which there is nothing to detect."""
        if self.settings.detections:
            return [('detections',)]
        told = self.settings.guide and self.settings.lens == CAMERA_INFO
        return [(_RAW, _COMPRESSED), *([(CAMERA_INFO,)] if told else [])]

    def destroy_node(self) -> None:
        """End the search, too."""
        if self._searches is not None:
            self._searches.stop()
        if self._guiding is not None:
            self._guiding.stop()
        super().destroy_node()

    def prepare(self, settings: DetectorSettings) -> Pattern:
        """Return the pattern; raise ParameterError where the text names none."""
        kind, _, file = settings.board.partition(':')
        if kind == 'aprilgrid' and settings is not self.settings:
            check_access(file, self.settings.folder, 'board')
        if settings.detections and kind != 'aprilgrid':
            raise ParameterError(
                f'board is {settings.board!r}; with detections it must be an aprilgrid'
            )
        if settings.guide and settings.detections:
            raise ParameterError('guide needs images; it cannot be used with detections')
        if settings.guide and settings.board != self.settings.board:
            raise ParameterError('board cannot be changed while the guide runs')
        if settings.near >= settings.far:
            raise ParameterError('near must be below far')
        if kind == LOOSE_TAGS:
            if settings.guide:
                raise ParameterError('guide needs a board; it cannot be used with loose tags')
            if settings is not self.settings:
                check_access(file, self.settings.folder, 'board')
            return tag_pattern(settings.board, read_tag_map(file))
        return parse_pattern(settings.board)

    def configure(self, pattern: Pattern) -> None:
        """Look for another board from now on."""
        self._pattern, self._near, self._size = pattern, None, None
        self._failures_at_first = 0
        board = Landmarks(np.arange(len(pattern.points)), pattern.points)
        if pattern.kind == LOOSE_TAGS:
            tags = read_tag_map(pattern.spec.partition(':')[2])
            board = tags.landmarks()
            if tags.note:
                self.get_logger().warning(tags.note)
        self._landmarks.publish(messages.landmarks_message(board, 0, self.settings.board_frame))

    def report(self) -> tuple[dict[str, object], str]:
        """Return how many images were overtaken, and how many showed no board."""
        trouble = self._misfit or self._missing_board()
        if self._guiding is None:
            return dict(self._counts), trouble
        guide, more = self._guiding.report()
        return {**self._counts, **guide}, trouble or more

    def _missing_board(self) -> str:
        if self._size is not None or self._failures_at_first < _MIN_FAILURES:
            return ''
        return (
            f'image: no {self.settings.board} in the first {self._failures_at_first} images; '
            + check_of_board(self._pattern)
        )

    def _take(self, stamp: int, image: Unread) -> None:
        """Keep the newest image, if anybody wants to know what is in it."""
        looked_at = self._guiding is not None and self._guiding.heard()
        outputs = self._points, self._drawn
        heard = looked_at or any(one.get_subscription_count() for one in outputs)
        if not heard or not self.has_listeners():
            return
        if self._images.is_repeated(stamp, image):
            return
        self._images.remember(stamp, image)
        if self._waiting is not None:
            self._counts['images overtaken'] += 1
            if self._waiting[0] > stamp:
                return
        self._waiting = stamp, image
        self._work()

    @property
    def _detector(self) -> str:
        if self._pattern.kind == LOOSE_TAGS:
            return ''
        name = default_detector(self._pattern)
        return _LIVE_DETECTORS.get(name, name)

    def _work(self) -> None:
        """Publish what a search found; start the next one; look again while it is under way."""
        assert self._searches is not None
        if self._guiding is not None:
            self._guiding.work()
        found = self._searches.result()
        if found is not None and self._searched is not None:
            searched, self._searched = self._searched, None
            self._finish(found, *searched)
        if self._waiting is not None and not self._searches.busy:
            (stamp, image), self._waiting = self._waiting, None
            self._search(stamp, image)
        if self._searches.busy or self._guiding is not None:
            self._look.reset()
        else:
            self._look.cancel()

    def _search(self, stamp: int, image: Unread) -> None:
        assert self._searches is not None
        try:
            frame, pixels = image.read()
            self._check_size(pixels)
        except ObservationError as error:
            self.drop(image.topic, error)
            return
        self._compare(self._infos.size(CAMERA_INFO, stamp), pixels)
        self._searched = stamp, frame, pixels
        task = pixels, self._pattern, self._detector, self._near
        self._searches.start(task, self.settings.longest_search)

    def _finish(self, result: Any, stamp: int, frame: str, pixels: Pixels) -> None:
        ids, uv = (result.ids, result.uv) if isinstance(result, Points) else _NOTHING
        # Where one camera of a rig sees no tag, the set of the others waits for it.
        if isinstance(result, Points) or self._pattern.kind == LOOSE_TAGS:
            self._points.publish(messages.image_points_message(ids, uv, stamp, frame))
        if isinstance(result, Points):
            self._near, self._size = result.uv, pixels.shape
        else:
            self._near = None
            self._counts['images without board'] += 1
            self._failures_at_first += self._size is None
            if self._failures_at_first == _MIN_FAILURES and self._size is None:
                self.get_logger().warning(self._missing_board())
            self._counts['searches ended'] += isinstance(result, TimedOut)
            if isinstance(result, Exception):
                self.unforeseen(result)
        if self._drawn.get_subscription_count():
            drawn = draw_points(pixels, ids, uv)
            self._drawn.publish(messages.image_message(drawn, stamp, frame))
        if self._guiding is not None:
            try:
                self._guiding.look(stamp, frame, pixels, result)
            except FisheyeSvpError as error:
                self.drop('image', error)

    def _read_tags(self, message: Any, topic: str) -> tuple[str, Index, Array]:
        """Return the points of tags; libapriltag puts pixel centers at a half."""
        tags = [
            tag
            for tag in message.detections
            if 0 <= tag.id < self._pattern.columns * self._pattern.rows
        ]
        if not tags:
            raise ObservationError(
                f'{topic}: none of {len(message.detections)} tags belongs to the board'
            )
        # Both go round a tag from its lower left, against the clock.
        ids = np.concatenate([4 * tag.id + np.arange(4) for tag in tags])
        uv = np.array([[corner.x, corner.y] for tag in tags for corner in tag.corners]) - 0.5
        if not np.isfinite(uv).all():
            raise ObservationError(f'{topic}: a corner is not a finite number')
        return str(message.header.frame_id), ids, uv

    def _publish_tags(self, stamp: int, tags: tuple[str, Index, Array]) -> None:
        frame, ids, uv = tags
        self._points.publish(messages.image_points_message(ids, uv, stamp, frame))

    def _check_size(self, pixels: Pixels) -> None:
        """Raise ObservationError where images change their size: no lens would fit both."""
        if self._size is not None and pixels.shape != self._size:
            raise ObservationError(
                f'image: {pixels.shape[1]}x{pixels.shape[0]} px, but it was '
                f'{self._size[1]}x{self._size[0]}; restart the node for another camera'
            )

    def _compare(self, told: tuple[int, int] | None, pixels: Pixels) -> None:
        """Take note where the camera_info is not of these images: the solvers cannot know."""
        height, width = pixels.shape
        self._misfit = (
            ''
            if told in (None, (width, height))
            else (
                f'image: {width}x{height} px, but {CAMERA_INFO} is for '
                f'{told[0]}x{told[1]} px; have '
                'the driver send the calibration of its images'
            )
        )
        if self._misfit:
            self.get_logger().warning(self._misfit, throttle_duration_sec=10.0)


def _read(kind: Any, message: Any, topic: str) -> tuple[str, Pixels]:
    return message.header.frame_id, message_pixels(message, kind.__name__, topic)


def _tag_array() -> Any:
    if find_spec('apriltag_msgs') is None:
        raise ParameterError(
            'detections is true, but apriltag_msgs is not installed: '
            'apt install ros-jazzy-apriltag-msgs'
        )
    return import_module('apriltag_msgs.msg').AprilTagDetectionArray
