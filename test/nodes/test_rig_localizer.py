"""A rig is localized from all of its cameras at once, as `localize --rig` does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.graph import LATCHED, Graph
from helpers.tag_room import LEFT, LENS, TagRoom, oval

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus  # isort: skip
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped  # isort: skip
from sensor_msgs.msg import Image, PointCloud2  # isort: skip
from visualization_msgs.msg import MarkerArray  # isort: skip

import fisheye_svp_ros as fsvp
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io.decoding import read_key_values, read_pose, stamp_of
from fisheye_svp_ros.io.lens_files import save_lens
from fisheye_svp_ros.io.rig_files import save_rig
from fisheye_svp_ros.io.tag_maps import write_tag_map
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.detector import Detector
from fisheye_svp_ros.nodes.rig_localizer import RigLocalizer
from fisheye_svp_ros.nodes.synthetic_camera import SyntheticCamera
from fisheye_svp_ros.scene.rigs import rig


def test_the_pose_is_that_of_the_first_camera(graph: Callable[..., Graph], tmp_path: Path) -> None:
    save_rig(rig('vergent'), tmp_path / 'rig.yaml')
    g = graph(
        f'rig_localizer:rig:={tmp_path}/rig.yaml',
        'svp:=false',
        'rate:=10.0',
        'style:=vergent',
        'radius:=0.5',
        'poses_file:=calibration',
    )
    poses = g.hear(PoseWithCovarianceStamped, 'rig_localizer/pose')
    true = g.hear(PoseStamped, 'left/true_pose')
    results = g.hear(DiagnosticArray, 'rig_localizer/result')
    node = g.start(RigLocalizer)
    assert node.cameras == ('left/', 'right/')
    g.start(SyntheticCamera)
    g.until(lambda: poses and results)
    pose = poses[0]
    known = next(one for one in true if stamp_of(one) == stamp_of(pose))
    assert read_pose(pose.pose, 'pose').position == pytest.approx(
        read_pose(known, 'pose').position, abs=1e-7
    )
    values = read_key_values(results[0], 'result')
    assert float(values['rms_px']) < 1e-6 and float(values['position_error_m']) < 1e-7
    assert pose.pose.covariance[0] > 0


@pytest.mark.parametrize('given', [(), ('rig:=nothere.yaml',)])
def test_a_rig_is_needed(graph: Callable[..., Graph], given: tuple[str, ...]) -> None:
    with pytest.raises(ParameterError, match='rig'):
        graph(*given).start(RigLocalizer)


CAMERAS, ROOM, SIGMA = ('front', 'side'), TagRoom(16), 0.2


def among_tags(folder: Path, graph: Callable[..., Graph], *more: str) -> Graph:
    """Return a graph for a rig among tags whose map states its errors."""
    information = 4e4 * np.eye(6 * ROOM.count)
    tags = ROOM.tags._replace(covariance=np.linalg.inv(information))
    write_tag_map(tags, folder / 'tags.yaml', information=information)
    save_lens(LENS, folder / 'lens.yaml')
    save_rig(LEFT.inverse(), folder / 'rig.yaml', CAMERAS)
    return graph(
        f'rig_localizer:rig:={folder}/rig.yaml',
        f'rig_localizer:tag_map:={folder}/tags.yaml',
        f'lens:={folder}/lens.yaml',
        f'sigma_px:={SIGMA}',
        'patience:=0.5',
        *more,
    )


def test_node_and_library_pose_a_rig_among_tags_alike(
    graph: Callable[..., Graph], tmp_path: Path
) -> None:
    """To the last digit; the errors of the map are in both."""
    g = among_tags(tmp_path, graph, 'rig_localizer:detections:=image_points')
    poses = g.hear(PoseWithCovarianceStamped, 'rig_localizer/pose')
    results = g.hear(DiagnosticArray, 'rig_localizer/result')
    shown = g.hear(MarkerArray, 'rig_localizer/tag_map', LATCHED)
    g.start(RigLocalizer)
    table, found = ROOM.table(2), []
    topics = [g.tell(PointCloud2, f'{name}/image_points') for name in CAMERAS]
    for frame in range(3):
        seen = table.take(table.frame == frame)
        found.append(
            fsvp.localize_rig(
                replace(seen, sigma=np.full(len(seen), SIGMA)),
                dict.fromkeys(CAMERAS, LENS),
                tmp_path / 'rig.yaml',
                tag_map=tmp_path / 'tags.yaml',
            )
        )
        for camera, topic in enumerate(topics):
            mine = seen.take(seen.camera == camera)
            topic.publish(
                messages.image_points_message(mine.landmark, mine.uv, (1 + frame) * 10**9, 'cam')
            )
        g.until(lambda: len(results) > frame)  # noqa: B023
    assert [one.status[0].level for one in results] == [DiagnosticStatus.OK] * 3
    assert poses[0].header.frame_id == 'map' and shown
    for frame, message in enumerate(poses):
        pose = read_pose(message.pose, 'pose')
        np.testing.assert_array_equal(pose.position, found[frame].pose.position[0])
        covariance = np.reshape(message.pose.covariance, (6, 6))
        np.testing.assert_array_equal(covariance, found[frame].covariance[0])
        off = pose.difference(oval(frame / 4))
        assert off @ np.linalg.solve(covariance, off) < 22.5


def test_a_camera_that_sees_no_tag_is_no_hindrance(
    graph: Callable[..., Graph], tmp_path: Path
) -> None:
    kinds = pytest.importorskip('apriltag_msgs.msg', reason='apriltag_msgs is not installed')
    g = among_tags(tmp_path, graph)
    poses = g.hear(PoseWithCovarianceStamped, 'rig_localizer/pose')
    g.start(RigLocalizer)
    table = ROOM.table()
    front, side = (g.tell(kinds.AprilTagDetectionArray, f'{name}/detections') for name in CAMERAS)
    found = []
    for tag in np.unique(table.landmark[table.frame == 0] // 4).tolist():
        found.append(kinds.AprilTagDetection(family='tag36h11', id=tag))
        uv = table.uv[(table.frame == 0) & (table.landmark // 4 == tag)]
        for corner, (u, v) in zip(found[-1].corners, uv.tolist(), strict=True):
            corner.x, corner.y = u + 0.5, v + 0.5
    header = messages.header(10**9, 'cam')
    front.publish(kinds.AprilTagDetectionArray(header=header, detections=found))
    side.publish(kinds.AprilTagDetectionArray(header=header))
    g.until(lambda: poses)
    off = read_pose(poses[0].pose, 'pose').difference(oval(0.0))
    assert np.linalg.norm(off[:3]) < 0.02


def test_a_detector_that_finds_no_tag_holds_up_no_rig(
    graph: Callable[..., Graph], tmp_path: Path
) -> None:
    """Each camera has a detector of its own; the rig has its landmarks, and no map of tags."""
    write_tag_map(ROOM.tags, tmp_path / 'tags.yaml')
    save_lens(LENS, tmp_path / 'lens.yaml')
    save_rig(LEFT.inverse(), tmp_path / 'rig.yaml', CAMERAS)
    g = graph(
        f'rig_localizer:rig:={tmp_path}/rig.yaml',
        f'board:=tags:{tmp_path}/tags.yaml',
        f'lens:={tmp_path}/lens.yaml',
        f'sigma_px:={SIGMA}',
        'patience:=60.0',
    )
    poses = g.hear(PoseWithCovarianceStamped, 'rig_localizer/pose')
    found = g.hear(PointCloud2, 'side/image_points')
    g.start(RigLocalizer)
    g.start(lambda: Detector(namespace='side'))
    g.tell(PointCloud2, 'landmarks', LATCHED).publish(
        messages.landmarks_message(ROOM.tags.landmarks(), 0, 'map')
    )
    front, images = g.tell(PointCloud2, 'front/image_points'), g.tell(Image, 'side/image')
    seen = ROOM.table()
    seen = seen.take(seen.frame == 0)
    front.publish(messages.image_points_message(seen.landmark, seen.uv, 10**9, 'front'))
    wall = messages.image_message(np.full((120, 160), 128, np.uint8), 10**9, 'side')

    def posed() -> bool:
        images.publish(wall)  # again: one before all are connected is lost
        g.idle(0.3)
        return bool(poses)

    g.until(posed)
    assert stamp_of(found[0]) == 10**9 and found[0].width == 0
    off = read_pose(poses[0].pose, 'pose').difference(oval(0.0))
    assert np.linalg.norm(off[:3]) < 0.02
