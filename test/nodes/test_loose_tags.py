"""The detector finds loose tags of a map: their corners, and the map as landmarks."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.graph import LATCHED, Graph

from sensor_msgs.msg import Image, PointCloud2  # isort: skip

from fisheye_svp_ros.io.decoding import read_image_points, read_landmarks
from fisheye_svp_ros.io.tag_maps import map_of_size, write_tag_map
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.detector import Detector
from fisheye_svp_ros.pose import identity


@pytest.mark.skipif(not hasattr(cv2, 'aruco'), reason='this OpenCV has no markers')
def test_loose_tags_are_found(graph: Callable[..., Graph], tmp_path: Path) -> None:
    tags = map_of_size(np.array([3, 8]), 0.2, identity(2))
    write_tag_map(tags, tmp_path / 'tags.yaml')
    image = np.full((300, 300), 255, np.uint8)
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    image[60:220, 50:210] = cv2.aruco.generateImageMarker(family, 3, 160)[::-1, ::-1]
    image = cv2.GaussianBlur(image, (0, 0), 0.7)
    g = graph(f'board:=tags:{tmp_path}/tags.yaml', 'longest_search:=30.0')
    points = g.hear(PointCloud2, 'image_points')
    landmarks = g.hear(PointCloud2, 'landmarks', LATCHED)
    g.start(Detector)
    publisher = g.tell(Image, 'image')
    stamp = [10**9]

    def found() -> object:
        stamp[0] += 10**8
        publisher.publish(messages.image_message(image, stamp[0], 'cam'))
        g.idle(0.3)
        return points and landmarks

    g.until(found)
    seen = read_image_points(points[0])
    assert seen.landmark.tolist() == [12, 13, 14, 15]
    expected = [[49.5, 219.5], [209.5, 219.5], [209.5, 59.5], [49.5, 59.5]]
    np.testing.assert_allclose(seen.uv, expected, atol=0.15)
    known = read_landmarks(landmarks[0]).landmarks
    assert {12, 35} <= set(known.ids.tolist())
    # What was found is drawn for whoever looks, and for nobody else.
    drawn = g.hear(Image, 'detector/found')
    g.until(lambda: found() and drawn)
    picture = np.frombuffer(drawn[0].data, np.uint8).reshape(300, 300, 3).astype(int)
    green = picture[..., 1] - picture[..., [0, 2]].max(axis=-1) > 100
    rows, columns = np.nonzero(green)
    assert drawn[0].encoding == 'bgr8' and green.any()
    assert 40 < columns.min() < 60 and 40 < rows.min() < 60
    # No image is made of an empty one, either: it comes without points.
    image[:] = 255
    g.until(lambda: found() and not np.ptp(np.frombuffer(drawn[-1].data, np.uint8)))
