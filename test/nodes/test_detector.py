"""The detector: images in, image points under their stamps out."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.graph import LATCHED, Graph
from helpers.photographs import BOARD, PRINTED, photograph, poses, true_corners
from numpy.typing import NDArray
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CompressedImage, Image, PointCloud2

from fisheye_svp_ros.io.decoding import read_image_points, read_landmarks
from fisheye_svp_ros.nodes.detector import Detector
from fisheye_svp_ros.nodes.messages import header

SENSOR = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)


def raw(pixels: NDArray[np.uint8], stamp: int) -> Any:
    height, width = pixels.shape
    return Image(header=header(stamp, 'camera'), height=height, width=width, encoding='mono8',
                 is_bigendian=0, step=width, data=array('B', pixels.tobytes()))


@pytest.fixture
def graph(ros_domain: int) -> Iterator[Graph]:
    graph = Graph('-p', f'board:={BOARD}')
    graph.start(Detector)
    yield graph
    graph.close()


def test_images_to_points(graph: Graph) -> None:
    landmarks = graph.hear(PointCloud2, 'landmarks', LATCHED)
    graph.until(lambda: landmarks)
    assert read_landmarks(landmarks[0]).landmarks.points == pytest.approx(PRINTED.corners)
    points = graph.hear(PointCloud2, 'image_points')
    where = poses(2, 4)
    images = graph.tell(Image, 'image', SENSOR)
    for i in range(2):
        message = raw(photograph(where.take(i)), 7 + i)
        graph.until(lambda message=message: (
            images.publish(message),
            any(p.header.stamp == message.header.stamp for p in points))[1])
        found = read_image_points(points[-1])
        true = true_corners(where.take(i))[found.landmark]
        assert np.abs(found.uv - true).max() < 0.1
        assert points[-1].header.frame_id == 'camera'


def test_compressed_and_bad_images(graph: Graph) -> None:
    points = graph.hear(PointCloud2, 'image_points')
    image = photograph(poses(1, 4).take(0))
    tell = graph.tell(CompressedImage, 'image/compressed', SENSOR)
    data = array('B', cv2.imencode('.png', image)[1].tobytes())
    good = CompressedImage(header=header(5), format='png', data=data)
    graph.until(lambda: (tell.publish(good), points)[1])
    heard, images = len(points), graph.tell(Image, 'image', SENSOR)
    images.publish(raw(image[:-20], 6))
    short = raw(image, 7)
    short.data = short.data[:100]
    images.publish(short)
    graph.idle(0.5)
    assert not any(p.header.stamp.nanosec in (6, 7) for p in points[heard:])
    graph.until(lambda: (images.publish(raw(image, 8)),
                         any(p.header.stamp.nanosec == 8 for p in points))[1])
