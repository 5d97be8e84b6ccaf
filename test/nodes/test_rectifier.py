"""The rectifier: what consumers of image_proc and stereo_image_proc take, they get."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from helpers.graph import LATCHED, Graph, set_parameter
from helpers.nodes import ROOT
from helpers.photographs import LENS, PRINTED, photograph, poses
from numpy.typing import NDArray
from rclpy.qos import QoSProfile, ReliabilityPolicy

from sensor_msgs.msg import CameraInfo, CompressedImage, Image  # isort: skip

import fisheye_svp_ros as fsvp
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io.lens_files import save_lens
from fisheye_svp_ros.io.rig_files import save_rig
from fisheye_svp_ros.nodes.messages import (
    camera_info_message,
    header,
    image_message,
)
from fisheye_svp_ros.nodes.rectifier import Rectifier
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.simulate.render import Exposure, render

SENSOR = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
RIG = Pose(rotation_from_vector(np.array([0.02, 0.05, -0.03])), np.array([-0.06, 0.003, 0.004]))
RIGHT = replace(LENS, name='other', fx=144.0, fy=144.0)
FIELD = 1.6


def contract(info: Any, image: Any, raw: Any) -> None:
    """Assert what image_geometry, stereo_image_proc and apriltag_ros rely on."""
    for message in (info, image):
        assert message.header.stamp == raw.header.stamp
        assert message.header.frame_id == raw.header.frame_id
    assert (info.width, info.height) == (image.width, image.height)
    k, p = np.reshape(info.k, (3, 3)), np.reshape(info.p, (3, 4))
    np.testing.assert_array_equal(p[:, :3], k)
    np.testing.assert_array_equal(np.reshape(info.r, (3, 3)), np.eye(3))
    assert k[0, 0] == k[1, 1] > 0 and k[0, 1] == 0 and (k[2] == [0, 0, 1]).all()
    assert info.distortion_model == 'plumb_bob' and list(info.d) == [0.0] * 5
    assert info.binning_x == info.binning_y == 0
    roi = info.roi
    assert (roi.x_offset, roi.y_offset, roi.width, roi.height) == (0, 0, 0, 0)
    assert not roi.do_rectify  # it is the whole image


def pixels_of(image: Any) -> NDArray[np.uint8]:
    data = np.frombuffer(bytes(image.data), np.uint8).reshape(image.height, image.step)
    shape = (image.height, image.width, -1) if image.encoding != 'mono8' else data.shape
    return data.reshape(shape)


@pytest.fixture
def lens(tmp_path: Path) -> Path:
    path = tmp_path / 'lens.yaml'
    save_lens(LENS, path)
    return path


def test_one_camera_with_a_lens_file(graph: Callable[..., Graph], lens: Path) -> None:
    g = graph(f'lens:={lens}', f'field_of_view:={FIELD}', 'range:=0.3', 'width:=300')
    g.start(Rectifier)
    images, infos = g.hear(Image, 'image_rect', SENSOR), g.hear(CameraInfo, 'camera_info', SENSOR)
    tell = g.tell(Image, 'image', SENSOR)
    grey = photograph(poses(1, 4).take(0))
    raw = image_message(grey, 7, 'optical')
    g.until(lambda: (tell.publish(raw), images and infos)[1])
    contract(infos[-1], images[-1], raw)
    side = fsvp.undistort_maps(LENS, size=(300, 400), field_of_view=FIELD, range_m=0.3)
    np.testing.assert_array_equal(pixels_of(images[-1]), side.remap(grey))
    np.testing.assert_allclose(np.reshape(infos[-1].p, (3, 4)), side.p)


@pytest.mark.parametrize(
    ('encoding', 'sent'),
    [
        ('rgb8', 'rgb8'),
        ('bgra8', 'bgra8'),
        ('mono16', 'mono16'),
        ('bayer_rggb8', 'bgr8'),
        ('yuv422_yuy2', 'bgr8'),
        ('nv12', 'mono8'),
        ('8UC3', '8UC3'),
    ],
)
def test_encodings_stay_where_pixels_have_colors(
    graph: Callable[..., Graph], lens: Path, encoding: str, sent: str
) -> None:
    g = graph(f'lens:={lens}')
    g.start(Rectifier)
    images = g.hear(Image, 'image_rect', SENSOR)
    tell = g.tell(Image, 'image', SENSOR)
    channels = {'rgb8': 3, '8UC3': 3, 'bgra8': 4, 'yuv422_yuy2': 2, 'mono16': 2}.get(encoding, 1)
    height = LENS.height * 3 // 2 if encoding == 'nv12' else LENS.height
    data = np.full((height, LENS.width * channels), 128, np.uint8)
    raw = Image(
        header=header(7, 'optical'),
        height=LENS.height,
        width=LENS.width,
        encoding=encoding,
        step=data.shape[1],
        data=array('B', data.tobytes()),
    )
    g.until(lambda: (tell.publish(raw), images)[1])
    assert images[-1].encoding == sent
    assert (np.abs(pixels_of(images[-1])[200, 200].astype(int) - 128) <= 4).all()


def test_compressed_images_come_out_once(graph: Callable[..., Graph], lens: Path) -> None:
    g = graph(f'lens:={lens}')
    node = g.start(Rectifier)
    images = g.hear(Image, 'image_rect', SENSOR)
    tell = g.tell(Image, 'image', SENSOR)
    packed = g.tell(CompressedImage, 'image/compressed', SENSOR)
    grey = photograph(poses(1, 4).take(0))
    data = array('B', cv2.imencode('.png', np.stack([grey] * 3, axis=-1))[1].tobytes())
    small = CompressedImage(header=header(5, 'optical'), format='png', data=data)
    g.until(lambda: (packed.publish(small), images)[1])
    assert images[-1].encoding == 'bgr8' and images[-1].header.frame_id == 'optical'
    before = node._inputs['image'].count.received
    heard = len(images)
    g.until(
        lambda: (
            tell.publish(image_message(grey, 5, 'optical')),
            node._inputs['image'].count.received > before + 1,
        )[1]
    )
    g.idle(0.2)
    assert all(one.encoding == 'bgr8' for one in images[heard:])


def test_nothing_is_done_while_nobody_listens(graph: Callable[..., Graph], lens: Path) -> None:
    g = graph(f'lens:={lens}')
    node = g.start(Rectifier)
    tell = g.tell(Image, 'image', SENSOR)
    raw = image_message(photograph(poses(1, 4).take(0)), 7, 'optical')
    g.until(lambda: (tell.publish(raw), node._inputs['image'].count.received > 2)[1])
    assert node._inputs['image'].count.read == 0
    infos = g.hear(CameraInfo, 'camera_info', SENSOR)
    g.until(lambda: (tell.publish(raw), infos)[1])


def test_one_camera_with_a_camera_info(graph: Callable[..., Graph]) -> None:
    g = graph()
    node = g.start(Rectifier)
    images, infos = g.hear(Image, 'image_rect', SENSOR), g.hear(CameraInfo, 'camera_info', SENSOR)
    tell = g.tell(Image, 'image', SENSOR)
    grey = photograph(poses(1, 4).take(0))
    raw = image_message(grey, 7, 'optical')
    # No lens is known yet.
    g.until(lambda: (tell.publish(raw), node._inputs['image'].count.dropped)[1])
    info = g.tell(CameraInfo, 'image/camera_info', LATCHED)
    info.publish(camera_info_message(LENS, 7, 'optical'))
    g.until(lambda: (tell.publish(raw), images and infos)[1])
    contract(infos[-1], images[-1], raw)
    side = fsvp.undistort_maps(LENS.svp(), field_of_view=1.5708)
    np.testing.assert_array_equal(pixels_of(images[-1]), side.remap(grey))
    # Another size than that of the lens is refused, and the next image comes through.
    dropped, heard = node._inputs['image'].count.dropped, len(images)
    g.until(
        lambda: (
            tell.publish(image_message(grey[:-1], 9, 'optical')),
            node._inputs['image'].count.dropped > dropped,
        )[1]
    )
    g.until(lambda: (tell.publish(raw), len(images) > heard)[1])
    kept = node._side('', 7)
    assert node._side('', 8) is kept  # maps are computed once


def test_the_camera_info_beside_the_images_is_read(ros_domain: int) -> None:
    """As image_transport has it: /camera/image_raw and /camera/camera_info."""
    g = Graph('-r', '__ns:=/rect', '-r', 'image:=/camera/image_raw')
    try:
        g.start(Rectifier)
        infos = g.hear(CameraInfo, '/rect/camera_info', SENSOR)
        tell = g.tell(Image, '/camera/image_raw', SENSOR)
        info = g.tell(CameraInfo, '/camera/camera_info', LATCHED)
        info.publish(camera_info_message(LENS, 7, 'optical'))
        raw = image_message(photograph(poses(1, 4).take(0)), 7, 'optical')
        g.until(lambda: (tell.publish(raw), infos)[1])
    finally:
        g.close()


@pytest.fixture
def lenses(tmp_path: Path) -> Path:
    folder = tmp_path / 'lenses'
    for name, one in (('left', LENS), ('right', RIGHT)):
        save_lens(one, folder / f'{name}.yaml')
    save_rig(RIG, folder / 'rig.yaml')
    return folder


@pytest.mark.parametrize('source', ['file', 'camera_info', 'folder'])
def test_a_stereo_pair(graph: Callable[..., Graph], lenses: Path, source: str) -> None:
    given = (
        [f'lens:={lenses}/']
        if source == 'file'
        else [f'rig:={lenses}/' + 'rig.yaml' * (source != 'folder')]
    )
    g = graph('stereo:=true', f'field_of_view:={FIELD}', 'range:=0.2', *given)
    g.start(Rectifier)
    known = (LENS, RIGHT) if source == 'file' else (LENS.svp(), RIGHT.svp())
    pair = fsvp.rectify_maps(*known, RIG, field_of_view=FIELD, range_m=0.2)
    camera, sides = poses(1, 4).take(0), {}
    told = []
    for name, one, pose in (
        ('left', LENS, camera),
        ('right', RIGHT, camera.compose(RIG.inverse())),
    ):
        grey = render(one, PRINTED, pose, Exposure(), np.random.default_rng(0))
        sides[name] = (
            grey,
            image_message(grey, 7, f'{name}_optical'),
            g.hear(Image, f'{name}/image_rect', SENSOR),
            g.hear(CameraInfo, f'{name}/camera_info', SENSOR),
        )
        told.append((g.tell(Image, f'{name}/image', SENSOR), sides[name][1]))
        info = g.tell(CameraInfo, f'{name}/image/camera_info', LATCHED)
        info.publish(camera_info_message(one, 7, f'{name}_optical'))
    g.until(
        lambda: (
            [tell.publish(raw) for tell, raw in told],
            all(images and infos for *_, images, infos in sides.values()),
        )[1]
    )
    for side, (grey, raw, images, infos) in zip(
        (pair.left, pair.right), sides.values(), strict=True
    ):
        contract(infos[-1], images[-1], raw)
        np.testing.assert_array_equal(pixels_of(images[-1]), side.remap(grey))
    # stereo_image_proc: same K and size; Tx = -fx * baseline in the right P alone.
    left, right = (infos[-1] for *_, infos in sides.values())
    assert left.p[3] == 0.0 and list(left.k) == list(right.k)
    assert right.p[3] == pytest.approx(-right.p[0] * float(np.linalg.norm(RIG.position)))


def test_what_cannot_be_rectified_is_refused(graph: Callable[..., Graph], lens: Path) -> None:
    g = graph(f'lens:={lens}', f'folder:={lens.parent}')
    node = g.start(Rectifier)
    result = set_parameter(node, 'range', 0.011)
    assert result.successful
    (lens.parent / 'broken.yaml').write_text('name: x')
    result = set_parameter(node, 'lens', str(lens.parent / 'broken.yaml'))
    assert not result.successful and 'not a lens file: it has no projection' in result.reason
    assert node.settings.lens == str(lens)


def test_a_pair_without_a_rig_does_not_start(graph: Callable[..., Graph], lens: Path) -> None:
    g = graph('stereo:=true', f'lens:={lens}')
    with pytest.raises(ParameterError, match=r'rig is empty, and lens .* holds none'):
        g.start(Rectifier)


def test_a_rig_of_three_is_no_pair(graph: Callable[..., Graph], lenses: Path) -> None:
    save_lens(LENS, lenses / 'top.yaml')
    save_rig([RIG, RIG], lenses / 'rig.yaml', ('left', 'right', 'top'))
    g = graph('stereo:=true', f'lens:={lenses}/')
    with pytest.raises(ParameterError, match=r'holds 3 cameras, left, right, top; give a file'):
        g.start(Rectifier)


def test_a_topic_that_would_be_heard_and_published_is_refused(ros_domain: int) -> None:
    g = Graph('-r', 'image/camera_info:=/camera_info')
    try:
        with pytest.raises(ParameterError, match=r'its own output .*/camera_info'):
            g.start(Rectifier)
    finally:
        g.close()


def test_shared_memory_holds_images() -> None:
    """As docs/reference/nodes.md tells to use it: several color images of 1280 x 800 px."""
    profile = ElementTree.parse(ROOT / 'config' / 'fastdds' / 'images.xml')
    sizes = {
        name: int(profile.findtext(f'.//{{*}}{name}') or 0)
        for name in ('segment_size', 'maxMessageSize')
    }
    image = 3 * 1280 * 800
    assert sizes['segment_size'] > 10 * image and sizes['maxMessageSize'] > image
