"""What RViz and Foxglove draw of a rig: epipolar curves on the left image."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.graph import LATCHED, Graph

from geometry_msgs.msg import TransformStamped  # isort: skip
from visualization_msgs.msg import MarkerArray  # isort: skip

from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.messages import camera_shape, rays_shape
from fisheye_svp_ros.nodes.stereo_depth import StereoDepth, _shapes
from fisheye_svp_ros.nodes.synthetic_camera import SyntheticCamera
from fisheye_svp_ros.optics.curves import Equidistant
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, identity, rotation_from_vector
from fisheye_svp_ros.scene.rigs import rig

_PIXEL = 0.08 / 1536  # m, on the base of a camera


FRAMES = 'right_camera_optical_frame', 'left_camera_optical_frame'


@pytest.mark.parametrize(
    ('words', 'frame'),
    [
        ((), 'world'),
        (('-r', 'stereo_depth:left/true_pose:=nowhere'), 'left_camera_optical_frame'),
    ],
)
def test_epipolar_curves_run_through_the_image_points(
    ros_domain: int, words: tuple[str, ...], frame: str
) -> None:
    g = Graph(
        '-p',
        'svp:=false',
        '-p',
        'style:=vergent',
        '-p',
        'rate:=20.0',
        '-p',
        'patience:=0.2',
        '-p',
        'rig:=topic',
        *words,
    )
    markers = g.hear(MarkerArray, 'stereo_depth/markers', LATCHED)
    g.start(StereoDepth)
    known = g.tell(TransformStamped, 'rig', LATCHED)
    known.publish(messages.transform_message(rig('vergent'), 1, *FRAMES))
    g.start(SyntheticCamera)
    g.until(lambda: markers)
    g.close()
    shown = {
        marker.ns: np.array([[p.x, p.y, p.z] for p in marker.points])
        for marker in markers[0].markers
    }
    assert list(shown) == ['camera left', 'epipolar curves', 'image points', 'measured points']
    distance = np.linalg.norm(shown['measured points'], axis=-1)
    assert len(distance) == 33 and (frame != 'world' or distance == pytest.approx(2.0))
    assert {marker.header.frame_id for marker in markers[0].markers} == {frame}
    start, end = shown['epipolar curves'].reshape(-1, 2, 3).swapaxes(0, 1)
    points, along = shown['image points'], end - start
    assert len(points) == 33 and len(start) > 33 * 50
    part = ((points[:, None] - start) * along).sum(axis=-1) / (along**2).sum(axis=-1)
    nearest = start + np.clip(part, 0, 1)[..., None] * along
    off = np.linalg.norm(points[:, None] - nearest, axis=-1).min(axis=1)
    assert off.max() < 0.5 * _PIXEL  # curves are drawn in straight pieces
    if frame != 'world':
        assert np.ptp(points[:, 2]) < 1e-12 and np.abs(points[:, :2]).max() < 768 * _PIXEL


def test_a_camera_opens_along_its_viewing_axis() -> None:
    turned = Pose(rotation_from_vector(np.array([0.0, 0.5, 0.0])), np.array([1.0, 2.0, 3.0]))
    edges = turned.into_body(camera_shape(turned, 'left', 1.0).points).reshape(4, 2, 2, 3)
    np.testing.assert_allclose(edges[:, 0, 0], 0.0, atol=1e-12)  # the tip
    corners = edges[:, 0, 1]
    np.testing.assert_allclose(corners[:, 2], 0.1)  # ahead
    np.testing.assert_allclose(
        corners[:, :2], 0.04 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    )
    np.testing.assert_allclose(edges[:, 1], np.stack([corners, np.roll(corners, -1, 0)], 1))


def test_rays_lead_from_landmarks_to_their_viewpoints_on_the_axis() -> None:
    lens = load_lens(lens_path('fish214'))
    turned = Pose(rotation_from_vector(np.array([0.0, 0.5, 0.0])), np.array([1.0, 2.0, 3.0]))
    theta = np.array([0.3, 1.0])
    local = np.stack([2 * np.sin(theta), 0 * theta, 2 * np.cos(theta)], axis=-1)
    shift, _ = lens.viewpoint_shift.value_and_slope(theta, np.tan(theta / 2))
    local[:, 2] += shift
    rays = rays_shape(lens, turned, turned.transform(local), 'left')
    start, end = turned.into_body(rays.points.reshape(2, 2, 3)).swapaxes(0, 1)
    np.testing.assert_allclose(end, local, atol=1e-12)
    np.testing.assert_allclose(start, shift[:, None] * [0, 0, 1], atol=1e-12)


def test_the_left_image_is_drawn_by_the_left_lens() -> None:
    left, right = (
        ForwardModel(
            Lens(
                name,
                width,
                width * 3 // 4,
                width / 3,
                width / 3,
                width / 2,
                width * 3 / 8,
                Equidistant(),
                1.5,
            )
        )
        for name, width in (('left', 1024), ('right', 640))
    )
    points, place = np.array([[0.4, 0.2, 1.0], [-0.5, 0.1, 1.2]]), rig('parallel')
    uv = [
        model.project(seen[None]).uv[0]
        for model, seen in ((left, place.into_body(points)), (right, points))
    ]
    shown = {
        one.name: one.points for one in _shapes((left, right), place, identity(), *uv, points)
    }['image points']
    np.testing.assert_allclose(shown[:, 2], 0.1)
    base = (uv[0] - np.array([511.5, 383.5])) * 0.08 / 1024
    np.testing.assert_allclose(shown[:, :2], base, atol=1e-9)
