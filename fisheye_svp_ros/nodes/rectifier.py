"""Rectifies the images of a camera or of a stereo pair, for consumers of image_rect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import cv2
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image

from fisheye_svp_ros.detect.image_messages import color_image
from fisheye_svp_ros.detect.photographs import decode_image
from fisheye_svp_ros.errors import ObservationError, ParameterError
from fisheye_svp_ros.io.lens_files import cameras_in, load_lens
from fisheye_svp_ros.io.parameters import parameter
from fisheye_svp_ros.io.rig_files import load_pair, pair_of_lenses
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.base import BaseNode
from fisheye_svp_ros.nodes.camera_info import (
    CAMERA_INFO,
    COMPRESSED_SUFFIX,
    CameraInfos,
    ImageTopics,
    info_topic,
)
from fisheye_svp_ros.nodes.quality import SENSOR
from fisheye_svp_ros.nodes.subscriptions import Unread
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.rectify.cameras import camera_for
from fisheye_svp_ros.rectify.maps import RANGE, Rectification, rectify_pair
from fisheye_svp_ros.reporting.wording.inputs import points_extrapolated
from fisheye_svp_ros.scene.observations import STEREO
from fisheye_svp_ros.study.settings import Settings

_INFO = f'image/{CAMERA_INFO}'  # of the raw images; `camera_info` is that of the rectified ones


@dataclass(frozen=True)
class RectifierSettings(Settings):
    """Parameters of the rectifier."""

    lens: str = parameter(
        CAMERA_INFO,
        'Lens: a file, or a name in config/lenses. For a rig: a file or folder with both. '
        '`camera_info`: from that topic next to the images',
        file=True,
    )
    stereo: bool = parameter(
        False, 'Rectify a stereo pair, the cameras in the namespaces left and right', fixed=True
    )
    rig: str = parameter(
        '',
        'Rig of the stereo pair: `rig.yaml` or its folder, a file of Kalibr, Basalt, or '
        'OpenCV, or a URDF. Empty: that of the lenses',
        file=True,
    )
    field_of_view: float = parameter(
        1.5708, 'Horizontal field of view of the rectified images', 'rad', (0.01, 3.05)
    )
    width: int = parameter(
        0, 'Width of the rectified images. 0: that of the images', 'px', (0, 8192)
    )
    height: int = parameter(
        0, 'Height of the rectified images. 0: that of the images', 'px', (0, 8192)
    )
    range: float = parameter(
        RANGE,
        'Range at which images of a lens with a moving viewpoint are exact. For a pair, it is '
        'measured from the middle of the baseline',
        'm',
        (0.01, 1e6),
    )


class _Setup(NamedTuple):
    """Settings, the rig of a pair, and rectifications by camera, as far as lenses are known."""

    settings: RectifierSettings
    rig: Pose | None
    sides: dict[str, Rectification]


class Rectifier(BaseNode):
    """Publishes rectified images and their camera_info under the stamp and frame of the image.

    It works only while somebody listens.  Maps are computed once, for each lens.
    """

    NAME = 'rectifier'
    SETTINGS = RectifierSettings
    settings: RectifierSettings

    def __init__(self, node_name: str | None = None, **options: Any) -> None:
        super().__init__(node_name, **options)
        cv2.setNumThreads(1)  # other nodes want the other cores
        self._cameras = tuple(f'{name}/' for name in STEREO) if self.settings.stereo else ('',)
        self._infos = CameraInfos(self.get_logger().info)
        self._setup: _Setup
        self._lenses: tuple[Lens, ...] = ()
        self._outputs: dict[str, tuple[Any, Any]] = {}
        self._images: dict[str, ImageTopics] = {}
        for camera in self._cameras:
            self._connect(camera)
        self.start()

    def _connect(self, camera: str) -> None:
        """Create the topics of a camera, given by its namespace with a slash."""
        own = str(self.resolve_topic_name(f'{camera}{CAMERA_INFO}'))
        raw = info_topic(self, f'{camera}image', f'{camera}{_INFO}', own)
        if own == raw:
            raise ParameterError(
                f'the node would subscribe to its own output {raw}; choose another namespace, for '
                'example -r __ns:=/rectified'
            )
        self._outputs[camera] = (
            self.announce(Image, f'{camera}image_rect', SENSOR, wait=True),
            self.announce(CameraInfo, f'{camera}{CAMERA_INFO}', SENSOR),
        )
        self._images[camera] = ImageTopics(
            self,
            f'{camera}image',
            (_read_raw, _read_compressed),
            partial(self._take, camera),
            f'{camera}{_INFO}',
            self._infos,
            raw,
        )

    def needed_inputs(self) -> Sequence[Sequence[str]]:
        """Return the topics without which there is nothing to rectify."""
        images = [(f'{c}image', f'{c}image{COMPRESSED_SUFFIX}') for c in self._cameras]
        infos = [(f'{c}{_INFO}',) for c in self._cameras]
        return [*images, *(infos if self.settings.lens == CAMERA_INFO else [])]

    def prepare(self, settings: RectifierSettings) -> _Setup:
        """Load lens and rig, compute the maps; refuse what cannot be used."""
        rig = self._rig(settings)
        if settings.lens == CAMERA_INFO:
            return _Setup(settings, rig, {})
        path = lens_path(settings.lens)
        names = cameras_in(path) if rig is not None else ()
        lenses = tuple(load_lens(f'{path}#{name}') for name in names[:2]) or tuple(
            load_lens(path) for _ in self._cameras
        )
        sides = self._rectifications(settings, rig, lenses)
        for side in sides.values():
            _ = side.maps
        return _Setup(settings, rig, sides)

    def configure(self, setup: _Setup) -> None:
        """Rectify otherwise from now on."""
        self._setup, self._lenses = setup, ()

    def _rig(self, settings: RectifierSettings) -> Pose | None:
        """Return the rig of a pair, None for one camera; raise FisheyeSvpError where it lacks."""
        if not settings.stereo:
            if settings.rig:
                raise ParameterError(
                    f'rig is {settings.rig!r}, but stereo is false; start the '
                    'node with stereo:=true, or leave rig empty'
                )
            return None
        path = None if settings.lens == CAMERA_INFO else lens_path(settings.lens)
        names = cameras_in(path) if path else ()
        if settings.rig:
            return load_pair(settings.rig, names[:2] or STEREO)
        if len(names) > 2:
            raise ParameterError(
                f'lens {settings.lens!r} holds {len(names)} cameras, '
                f'{", ".join(names)}; give a file or folder of two'
            )
        rig = pair_of_lenses(path, names) if path else None
        if rig is None:
            raise ParameterError(
                f'rig is empty, and lens {settings.lens!r} holds none; name the file of the rig'
            )
        return rig

    def _rectifications(
        self, settings: RectifierSettings, rig: Pose | None, lenses: tuple[Lens, ...]
    ) -> dict[str, Rectification]:
        """Return the rectification of each camera."""
        size = settings.width or lenses[0].width, settings.height or lenses[0].height
        camera = camera_for(lenses, 'pinhole', size, settings.field_of_view, rig is not None)
        if rig is None:
            return {'': Rectification(lenses[0], camera, settings.range)}
        pair = rectify_pair(lenses[0], lenses[1], rig, camera, settings.range)
        return dict(zip(self._cameras, (pair.left, pair.right), strict=True))

    def report(self) -> tuple[Mapping[str, object], str]:
        """Return what is wrong with the rectified images."""
        sides = self._setup.sides.items()
        return {}, '; '.join(
            points_extrapolated(f'{camera}image_rect', side.extrapolated_points)
            for camera, side in sides
            if side.extrapolated_points
        )

    def _take(self, camera: str, stamp: int, image: Unread) -> None:
        """Rectify an image, if somebody listens."""
        rectified, info = self._outputs[camera]
        if not self.has_listeners() or not (
            rectified.get_subscription_count() or info.get_subscription_count()
        ):
            return
        if self._images[camera].is_repeated(stamp, image):
            return
        frame, pixels, encoding = image.read()
        side = self._side(camera, stamp)
        height, width = pixels.shape[:2]
        if (width, height) != (side.lens.width, side.lens.height):
            raise ObservationError(
                f'{image.topic}: {width}x{height} px, but the lens is for '
                f'{side.lens.width}x{side.lens.height} px; give the lens of these images'
            )
        self._images[camera].remember(stamp, image)
        if rectified.get_subscription_count():
            rectified.publish(messages.image_message(side.remap(pixels), stamp, frame, encoding))
        info.publish(messages.rectified_info_message(side, stamp, frame))

    def _side(self, camera: str, stamp: int) -> Rectification:
        """Return the rectification of a camera; raise FisheyeSvpError where no lens is known."""
        setup = self._setup
        if setup.settings.lens != CAMERA_INFO:
            return setup.sides[camera]
        lenses = tuple(self._infos.lens(f'{one}{_INFO}', stamp) for one in self._cameras)
        if lenses != self._lenses:
            sides = self._rectifications(setup.settings, setup.rig, lenses)
            self._setup, self._lenses = setup._replace(sides=sides), lenses
        return self._setup.sides[camera]


def _read_raw(message: Any, topic: str) -> tuple[str, NDArray[Any], str]:
    return (message.header.frame_id, *color_image(message, topic))


def _read_compressed(message: Any, topic: str) -> tuple[str, NDArray[Any], str]:
    pixels = decode_image(bytes(message.data), topic, color=True)
    depth = 8 * pixels.dtype.itemsize
    return message.header.frame_id, pixels, f'{"mono" if pixels.ndim == 2 else "bgr"}{depth}'
