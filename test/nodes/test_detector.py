"""The detector: images in, image points under their stamps out."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.graph import LATCHED, Graph
from helpers.photographs import BOARD, LENS, PRINTED, photograph, poses, true_corners
from numpy.typing import NDArray
from rclpy.qos import QoSProfile, ReliabilityPolicy
from scipy.stats import chi2

from diagnostic_msgs.msg import DiagnosticArray  # isort: skip
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped  # isort: skip
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2  # isort: skip

from fisheye_svp_ros.errors import ObservationError, ParameterError
from fisheye_svp_ros.io.decoding import (
    read_image_points,
    read_key_values,
    read_landmarks,
    read_pose,
    stamp_of,
)
from fisheye_svp_ros.io.lens_files import save_lens
from fisheye_svp_ros.nodes.detector import Detector
from fisheye_svp_ros.nodes.localizer import Localizer
from fisheye_svp_ros.nodes.messages import header, image_message
from fisheye_svp_ros.nodes.synthetic_camera import SyntheticCamera
from fisheye_svp_ros.pose import quaternion_from_rotation

SENSOR = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)


def raw(pixels: NDArray[np.uint8], stamp: int) -> Any:
    return image_message(pixels, stamp, 'camera')


@pytest.fixture
def detecting(graph: Callable[..., Graph]) -> Graph:
    detecting = graph(f'board:={BOARD}')
    detecting.detector = detecting.start(Detector)
    return detecting


def test_images_to_points(detecting: Graph) -> None:
    landmarks = detecting.hear(PointCloud2, 'landmarks', LATCHED)
    detecting.until(lambda: landmarks)
    assert read_landmarks(landmarks[0]).landmarks.points == pytest.approx(PRINTED.corners)
    points = detecting.hear(PointCloud2, 'image_points')
    where = poses(2, 4)
    images = detecting.tell(Image, 'image', SENSOR)
    for i in range(2):
        message = raw(photograph(where.take(i)), 7 + i)
        detecting.until(
            lambda message=message: (
                images.publish(message),
                any(p.header.stamp == message.header.stamp for p in points),
            )[1]
        )
        found = read_image_points(points[-1])
        true = true_corners(where.take(i))[found.landmark]
        assert np.abs(found.uv - true).max() < 0.1
        assert points[-1].header.frame_id == 'camera'


def test_it_rests_between_images(detecting: Graph) -> None:
    points = detecting.hear(PointCloud2, 'image_points')
    images = detecting.tell(Image, 'image', SENSOR)
    for stamp in (7, 8):
        message = raw(photograph(poses(1, 4).take(0)), stamp)
        detecting.until(
            lambda message=message: (
                images.publish(message),
                any(p.header.stamp == message.header.stamp for p in points),
            )[1]
        )
        detecting.until(detecting.detector._look.is_canceled)


def test_compressed_and_bad_images(detecting: Graph) -> None:
    points = detecting.hear(PointCloud2, 'image_points')
    image = photograph(poses(1, 4).take(0))
    tell = detecting.tell(CompressedImage, 'image/compressed', SENSOR)
    data = array('B', cv2.imencode('.png', image)[1].tobytes())
    good = CompressedImage(header=header(5), format='png', data=data)
    images = detecting.tell(Image, 'image', SENSOR)
    # What has no board says nothing of the camera: its size is not taken for the camera's.
    detecting.until(
        lambda: (
            images.publish(raw(np.zeros((7, 9), np.uint8), 4)),
            detecting.detector._counts['images without board'],
        )[1]
    )
    detecting.until(lambda: (tell.publish(good), points)[1])
    heard = len(points)
    images.publish(raw(image[:-20], 6))
    short = raw(image, 7)
    short.data = short.data[:100]
    images.publish(short)
    detecting.idle(0.5)
    assert not any(p.header.stamp.nanosec in (6, 7) for p in points[heard:])
    detecting.until(
        lambda: (images.publish(raw(image, 8)), any(p.header.stamp.nanosec == 8 for p in points))[
            1
        ]
    )


def test_a_camera_info_of_another_size_is_told_of(detecting: Graph) -> None:
    image = photograph(poses(1, 4).take(0))
    detecting.hear(PointCloud2, 'image_points')
    reports = detecting.hear(DiagnosticArray, '/diagnostics')
    images, told = (
        detecting.tell(Image, 'image', SENSOR),
        detecting.tell(CameraInfo, 'camera_info', SENSOR),
    )

    other = 'image: 424x400 px, but camera_info is for 848x400 px'

    def says(width: int, told_of: bool) -> None:
        """Publish until a report has the other size, or has it no more."""
        message = CameraInfo(width=width, height=image.shape[0], distortion_model='equidistant')
        message.k, message.d = [300.0, 0.0, 9.0, 0.0, 300.0, 9.0, 0.0, 0.0, 1.0], [0.0] * 4
        detecting.until(
            lambda: (
                told.publish(message),
                images.publish(raw(image, 5)),
                [m for m in reports if (other in m.status[0].message) == told_of],
            )[-1]
        )
        reports.clear()

    says(848, True)
    says(424, False)


def test_an_image_that_comes_raw_and_compressed_is_searched_once(detecting: Graph) -> None:
    points = detecting.hear(PointCloud2, 'image_points')
    image = photograph(poses(1, 4).take(0))
    images = detecting.tell(Image, 'image', SENSOR)
    tell = detecting.tell(CompressedImage, 'image/compressed', SENSOR)
    data = array('B', cv2.imencode('.png', image)[1].tobytes())
    detecting.until(lambda: (images.publish(raw(image, 5)), points)[1])
    detecting.idle(0.5)
    detecting.until(detecting.detector._look.is_canceled)
    detecting.idle(0.2)
    heard = len(points)
    detecting.until(
        lambda: (
            tell.publish(CompressedImage(header=header(5), format='png', data=data)),
            detecting.detector._inputs['image/compressed'].count.received > 2,
        )[1]
    )
    detecting.until(lambda: (images.publish(raw(image, 6)), stamp_of(points[-1]) == 6)[1])
    assert [stamp_of(one) for one in points[heard:]].count(5) == 0


def test_a_search_is_bounded_and_the_next_image_is_searched(graph: Callable[..., Graph]) -> None:
    """Noise of this size takes seconds, as everything in it may be a square."""
    g = graph(f'board:={BOARD}', 'longest_search:=0.5')
    points, diagnostics = (
        g.hear(PointCloud2, 'image_points'),
        g.hear(DiagnosticArray, '/diagnostics'),
    )
    node = g.start(Detector)
    images = g.tell(Image, 'image', SENSOR)
    good = photograph(poses(1, 4).take(0))
    g.until(lambda: (images.publish(raw(good, 5)), points)[1])
    noise = np.random.default_rng(0).integers(0, 256, good.shape, dtype=np.uint8)
    noise = np.kron(noise, np.ones((3, 3), np.uint8))
    # Nothing else is held up meanwhile: that the executor goes round shows it.
    g.until(
        lambda: (
            setattr(node, '_size', None),
            images.publish(raw(noise, 6)),
            node._counts['searches ended'],
        )[2]
    )
    g.until(
        lambda: (images.publish(raw(good, 7)), any(p.header.stamp.nanosec == 7 for p in points))[1]
    )
    g.until(
        lambda: any(
            pair.key == 'searches ended' and int(pair.value)
            for m in diagnostics
            for pair in m.status[0].values
        )
    )


def test_from_rendered_images_to_the_true_pose(
    graph: Callable[..., Graph], tmp_path: Path
) -> None:
    """Camera, detector and localizer as a user starts them; the error within its covariance."""
    lens = tmp_path / 'small.yaml'
    save_lens(LENS, lens)
    where = poses(2, 4)
    listed = [
        float(value)
        for i in range(2)
        for value in (*where.take(i).position, *quaternion_from_rotation(where.take(i).rotation))
    ]
    g = graph(
        f'board:={BOARD}',
        f'photograph:={BOARD}',
        f'lens:={lens}',
        f'poses:={listed}',
        'rate:=2.0',
        'sigma_px:=0.04',
        'board_frame:=world',
    )
    images, estimated = (
        g.hear(Image, 'image', SENSOR),
        g.hear(PoseWithCovarianceStamped, 'localizer/pose'),
    )
    results = g.hear(DiagnosticArray, 'localizer/result')
    for kind in (Detector, Localizer, SyntheticCamera):
        g.start(kind)

    def known() -> dict[int, dict[str, float]]:
        read = {stamp_of(m): read_key_values(m) for m in results}
        return {
            stamp: {k: float(v) for k, v in values.items()}
            for stamp, values in read.items()
            if 'position_error_m' in values
        }

    g.until(lambda: len(known()) > 2)
    assert images[0].encoding == 'mono8' and (images[0].width, images[0].height) == (424, 400)
    assert not g.probe.count_publishers('/synthetic_camera/image_points')
    for message in estimated:
        metrics = known().get(stamp_of(message))
        if metrics is None:
            continue
        pose = read_pose(message.pose)
        truth = min(
            (where.take(i) for i in range(2)),
            key=lambda one: float(np.linalg.norm(one.position - pose.position)),
        )
        error = pose.difference(truth)
        covariance = np.reshape(message.pose.covariance, (6, 6))
        assert error @ np.linalg.solve(covariance, error) < chi2.isf(1e-4, 6)
        assert metrics['position_error_m'] == pytest.approx(np.linalg.norm(error[:3]))


def test_a_camera_that_photographs_waits_for_who_compares_with_its_truth(
    graph: Callable[..., Graph],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr('fisheye_svp_ros.nodes.camera.LIMIT', 0.0)
    lens = tmp_path / 'small.yaml'
    save_lens(LENS, lens)
    g = graph(f'photograph:={BOARD}', f'lens:={lens}', 'rate:=20.0', 'wait_for_subscribers:=1')
    images = g.hear(Image, 'image', SENSOR)
    camera = g.start(SyntheticCamera)
    g.until(lambda: not camera.camera('').unwatched_topic)
    assert not camera.has_listeners() and not images
    g.idle(0.3)
    assert capfd.readouterr().err.count('too few listen to /true_pose') == 1
    g.hear(PoseStamped, 'true_pose')
    g.until(lambda: images)


@pytest.mark.parametrize(
    ('parameters', 'reason'),
    [
        ((f'board:={BOARD}', 'detections:=true'), 'must be an aprilgrid'),
        (('detections:=true',), 'apriltag_msgs is not installed'),
    ],
)
def test_tags_of_others_need_their_messages_and_a_grid(
    graph: Callable[..., Graph],
    parameters: tuple[str, ...],
    reason: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr('fisheye_svp_ros.nodes.detector.find_spec', lambda name: None)
    if 'grid' in reason:
        monkeypatch.setattr('fisheye_svp_ros.nodes.detector._tag_array', lambda: DiagnosticArray)
    g = graph(*parameters)
    with pytest.raises(ParameterError, match=reason):
        g.start(Detector)


def test_tags_that_others_found(graph: Callable[..., Graph], tmp_path: Path) -> None:
    grid = tmp_path / 'grid.yaml'
    grid.write_text(
        "target_type: 'aprilgrid'\ntagCols: 3\ntagRows: 2\ntagSize: 0.05\ntagSpacing: 0.3\n"
    )
    g = graph(f'board:=aprilgrid:{grid}')
    node = g.start(Detector)
    corners = [SimpleNamespace(x=10.0 + i, y=20.0) for i in range(4)]
    tags = [SimpleNamespace(id=number, corners=corners) for number in (0, 2, 99)]
    message = SimpleNamespace(detections=tags, header=SimpleNamespace(frame_id='camera'))
    frame, ids, uv = node._read_tags(message, 'detections')
    assert frame == 'camera' and ids.tolist() == [0, 1, 2, 3, 8, 9, 10, 11]
    assert uv.tolist() == [[9.5 + i, 19.5] for i in range(4)] * 2
    with pytest.raises(ObservationError, match='none of 1 tags belongs'):
        message.detections = tags[2:]
        node._read_tags(message, 'detections')
