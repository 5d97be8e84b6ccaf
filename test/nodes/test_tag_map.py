"""A localizer with a map of tags: its errors are in the covariances, and nothing replaces it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from helpers.graph import LATCHED, Graph

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus  # isort: skip
from geometry_msgs.msg import PoseWithCovarianceStamped  # isort: skip
from sensor_msgs.msg import PointCloud2  # isort: skip
from visualization_msgs.msg import MarkerArray  # isort: skip

from fisheye_svp_ros.effects.forward import project_corrected
from fisheye_svp_ros.io.decoding import IMAGE_POINTS, read_pose, structured_array
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.io.tag_maps import map_of_size, tag_covariance, write_tag_map
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.localizer import Localizer
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.scene.observations import Landmarks

LENS = load_lens(lens_path('fish180'))
CAMERA = Pose(rotation_from_vector(np.array([0.1, -0.2, 0.3])), np.array([0.05, -0.1, 0.0]))
COUNT, SETS, SIGMA = 5, 40, 0.2


def noisy_map() -> tuple[Pose, np.ndarray]:
    """Return true poses of tags, and the information of a map: 5 mm and 5 mrad a tag."""
    rng = np.random.default_rng(2)
    turn = rotation_from_vector(np.array([3.0, 0, 0]) + rng.normal(0, 0.3, (COUNT, 3)))
    place = rng.uniform([-0.8, -0.8, 1.2], [0.8, 0.8, 1.8], (COUNT, 3))
    return Pose(turn, place), 4e4 * np.eye(6 * COUNT)


def test_the_errors_of_the_map_are_in_the_pose_and_the_test_of_residuals(
    graph: Callable[..., Graph], tmp_path: Path
) -> None:
    true, information = noisy_map()
    stated = map_of_size(np.arange(COUNT), 0.3, true, '', tag_covariance(information))
    write_tag_map(stated, tmp_path / 'tags.yaml', information=information)
    g = graph(
        f'tag_map:={tmp_path}/tags.yaml',
        'detections:=image_points',
        'lens:=fish180',
        f'sigma_px:={SIGMA}',
        'patience:=0.2',
        'gate:=3.0',
    )
    poses = g.hear(PoseWithCovarianceStamped, 'localizer/pose')
    results = g.hear(DiagnosticArray, 'localizer/result')
    g.start(Localizer)
    shapes = g.hear(MarkerArray, 'localizer/tag_map', LATCHED)  # also for those who come later
    g.until(lambda: shapes)
    outlines, errors = shapes[0].markers
    assert len(outlines.points) == 8 * COUNT and outlines.header.frame_id == 'map'
    ends = np.array([[one.x, one.y, one.z] for one in errors.points]).reshape(COUNT, 3, 2, 3)
    np.testing.assert_allclose(np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=-1), 4 * 0.005)
    np.testing.assert_allclose(ends.mean(axis=2), np.tile(true.position[:, None], (1, 3, 1)))
    # A board that another node publishes is not this map.
    other = Landmarks(np.arange(4 * COUNT), np.random.default_rng(0).normal(size=(4 * COUNT, 3)))
    g.probe.create_publisher(PointCloud2, 'landmarks', LATCHED).publish(
        messages.landmarks_message(other, 0, 'board')
    )
    g.idle(0.3)
    points, rng = g.tell(PointCloud2, 'image_points'), np.random.default_rng(3)
    for i in range(SETS):
        moved = true.retract(rng.normal(0, 0.005, (COUNT, 6)))
        corners = map_of_size(np.arange(COUNT), 0.3, moved).corners.reshape(-1, 3)
        uv = project_corrected(LENS, CAMERA.into_body(corners)).uv
        uv += rng.normal(0, SIGMA, uv.shape)
        cloud = structured_array(IMAGE_POINTS, np.arange(4 * COUNT), *uv.T)
        points.publish(messages.cloud_message(cloud, (1 + i) * 10**8, 'camera'))
        g.until(lambda i=i: len(results) > i)
    assert len(poses) == SETS
    assert all(one.status[0].level == DiagnosticStatus.OK for one in results)
    squares = []
    for message in poses:
        error = read_pose(message.pose, 'pose').difference(CAMERA)
        covariance = np.reshape(message.pose.covariance, (6, 6))
        squares.append(float(error @ np.linalg.solve(covariance, error)))
    assert 4.0 < np.mean(squares) < 8.0
    assert poses[0].header.frame_id == 'map'
