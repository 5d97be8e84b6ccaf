"""The detector's guide: the wanted view over the live image, photographs taken by themselves."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from geometry_msgs.msg import PoseStamped
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image
from std_msgs.msg import Float64

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.detect.patterns import Pattern
from fisheye_svp_ros.detect.photographs import Pixels
from fisheye_svp_ros.detect.points import Points
from fisheye_svp_ros.detect.workers import BoundedCalls, TimedOut
from fisheye_svp_ros.errors import FisheyeSvpError, ObservationError, OutputError, ParameterError
from fisheye_svp_ros.io.csv_files import write_observations
from fisheye_svp_ros.io.files import replacing
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.paths import visible_paths
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.base import BaseNode
from fisheye_svp_ros.nodes.camera_info import CAMERA_INFO, CameraInfos
from fisheye_svp_ros.nodes.quality import LATCHED
from fisheye_svp_ros.optics.curves import kannala_brandt_equivalent
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.planning.guide import (
    DetectedBoard,
    Guide,
    SessionState,
    evaluate_session,
    observations_of,
    start_session,
)
from fisheye_svp_ros.planning.plan import nominal_lens
from fisheye_svp_ros.reporting.shot_plots import draw_guide
from fisheye_svp_ros.reporting.wording.shots import guide_words

_PLANNING_TIMEOUT = 60.0  # s, to choose the next photograph
_PICTURES = QoSProfile(depth=2)
_NS = 1e9
_FAST = (cv2.IMWRITE_PNG_COMPRESSION, 1)


class Guiding:
    """Follows the board for a detector, which looks at one image after the other.

    What is wanted next is chosen in a process of its own, which is ended where it takes too long.
    """

    def __init__(
        self, node: BaseNode, settings: Any, pattern: Pattern, infos: CameraInfos
    ) -> None:
        """Announce the topics; raise ParameterError for a lens or folder that cannot be used."""
        self._node, self._settings, self._pattern = node, settings, pattern
        self._folder = Path(settings.guide_output).absolute()
        with suppress(OSError):
            self._folder.mkdir(parents=True, exist_ok=True)
        if not (self._folder.is_dir() and os.access(self._folder, os.W_OK)) or visible_paths(
            self._folder.iterdir()
        ):
            raise ParameterError(
                f'guide_output: {self._folder} is not an empty, writable folder; '
                'choose another one'
            )
        self._infos = infos
        self._lens: Lens | None = None
        if settings.lens not in ('', CAMERA_INFO):
            self._lens = load_lens(lens_path(settings.lens))
        self._pictures = node.announce(Image, '~/guide', _PICTURES)
        self._wanted = node.announce(PoseStamped, '~/wanted', LATCHED)
        self._metrics = {
            name: node.announce(Float64, f'~/metrics/{name}')
            for name in ('score', 'photographs', 'stderr')
        }
        self._guide: Guide | None = None
        self._calls: BoundedCalls | None = None
        self._considering = False  # beyond the call that warms the process up
        self._told: Array | None = None
        self._frame, self._failures, self._trouble = '', 0, ''

    def heard(self) -> bool:
        """Say whether somebody looks at the picture."""
        return bool(self._pictures.get_subscription_count())

    def stop(self) -> None:
        """End the process."""
        if self._calls is not None:
            self._calls.stop()

    def report(self) -> tuple[dict[str, object], str]:
        """Return how far it is, for /diagnostics, and what is wrong."""
        if self._guide is None:
            return {'guide': 'waiting for the first image'}, self._trouble
        do, where, known = guide_words(self._guide)
        return {
            'guide': f'{do}; {where}',
            'guide: taken': known,
            'guide: unreachable views': len(self._guide.session.room.taken),
            'guide: failures': self._failures,
        }, self._trouble

    def look(self, stamp: int, frame: str, pixels: Pixels, result: Any) -> None:
        """Take note of an image and of what was found in it; publish the picture.

        Raises FisheyeSvpError for an image or a lens that cannot be used.
        """
        if self._guide is None:
            self._begin(stamp, pixels)
        assert self._guide is not None
        guide, seen = self._guide, None
        if isinstance(result, Points):
            seen = DetectedBoard(stamp / _NS, result.ids, result.uv, result.sigma)
        self._frame = frame
        if guide.look(stamp / _NS, seen):
            self._save(pixels)
        self._publish_metric('score', guide.score)
        self._publish_next_board(guide)
        if self.heard():
            self._pictures.publish(
                messages.image_message(draw_guide(pixels, guide, seen), stamp, frame)
            )

    def work(self) -> None:
        """Take up what has been considered; have the next considered."""
        guide, calls = self._guide, self._calls
        if guide is None or calls is None:
            return
        result = calls.result()
        if result is not None and self._considering:
            self._considering = False
            if isinstance(result, SessionState):
                self._adopt(guide, result)
            else:
                self._fail(guide, result)
        if guide.thinking and not calls.busy and self._calls is not None:
            self._considering = True
            calls.start(guide.session, _PLANNING_TIMEOUT)

    def _begin(self, stamp: int, pixels: Pixels) -> None:
        height, width = pixels.shape
        lens, settings = self._lens, self._settings
        if settings.lens == CAMERA_INFO:
            lens = self._infos.lens(CAMERA_INFO, stamp)
        if lens is None:
            lens = nominal_lens((width, height), settings.field_of_view)
        if (lens.width, lens.height) != (width, height):
            raise ObservationError(
                f'image: {width}x{height} px, but lens {lens.name!r} is for '
                f'{lens.width}x{lens.height}'
            )
        session = start_session(
            kannala_brandt_equivalent(lens),
            self._pattern.points,
            (settings.near, settings.far),
            settings.guide,
            settings.goal,
        )
        orders = np.stack([turn.source for turn in self._pattern.symmetries])
        self._guide = Guide(session, orders)
        # Which loads all and fails: a warm process
        self._calls = BoundedCalls(evaluate_session, None)

    def _adopt(self, guide: Guide, stand: SessionState) -> None:
        guide.adopt(stand)
        self._trouble = ''
        self._publish_metric('photographs', len(guide.session.taken))
        if stand.stderr is not None:
            self._publish_metric('stderr', stand.stderr)
        self._node.get_logger().info('guide: ' + '; '.join(filter(None, guide_words(guide))))

    def _fail(self, guide: Guide, result: Any) -> None:
        """Go on without the last photograph; without any there is nothing to go on with."""
        self._failures += 1
        late = isinstance(result, TimedOut)
        self._trouble = f'guide: {f"no plan within {_PLANNING_TIMEOUT:g} s" if late else result}'
        if not (late or isinstance(result, FisheyeSvpError)):
            self._node.unforeseen(result)
        self._node.get_logger().warning(self._trouble, throttle_duration_sec=1.0)
        if not guide.session.taken:
            self.stop()
            self._calls = None
        guide.fail()

    def _publish_next_board(self, guide: Guide) -> None:
        """Publish where the board is wanted, in the camera's frame, once it is another place."""
        outline = guide.outline
        if outline is None or guide.stand is None or outline is self._told:
            return
        self._told = outline
        board = guide.stand.wanted.shots.camera.take(guide.place).inverse()
        self._wanted.publish(messages.pose_message(board, 0, self._frame))

    def _save(self, pixels: Pixels) -> None:
        """Write the photograph taken last, and the observations of all."""
        assert self._guide is not None
        taken = self._guide.session.taken
        with replacing(self._folder / 'photographs' / f'{len(taken) - 1:03d}.png') as path:
            if not cv2.imwrite(str(path), pixels, _FAST):
                raise OutputError(f'{self._folder}: the photograph cannot be written')
        write_observations(
            self._folder / 'observations.csv', observations_of(taken, self._pattern.points)
        )

    def _publish_metric(self, name: str, value: float) -> None:
        self._metrics[name].publish(messages.number_message(value))
