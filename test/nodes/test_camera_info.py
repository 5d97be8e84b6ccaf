"""CameraInfo as the lens of the solvers: of a simulated camera, of a driver, of no use."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.graph import LATCHED, Graph
from rclpy.qos import QoSProfile, ReliabilityPolicy

from diagnostic_msgs.msg import DiagnosticArray  # isort: skip
from sensor_msgs.msg import CameraInfo, PointCloud2, RegionOfInterest  # isort: skip

from fisheye_svp_ros.effects import forward
from fisheye_svp_ros.errors import FisheyeSvpError, LensError, ObservationError
from fisheye_svp_ros.io.decoding import read_camera_info, read_key_values, stamp_of
from fisheye_svp_ros.io.landmark_files import environment
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.lens_formats.ros import camera_info_text, distortion_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.localizer import Localizer
from fisheye_svp_ros.nodes.model_critic import ModelCritic
from fisheye_svp_ros.nodes.stereo_calibrator import StereoCalibrator
from fisheye_svp_ros.nodes.stereo_depth import StereoDepth
from fisheye_svp_ros.nodes.synthetic_camera import SyntheticCamera
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.scene.rigs import paper_pose

DRIVER = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
K = (570.0, 571.0, 320.0, 240.0)


@pytest.fixture
def graphs(ros_domain: int) -> Iterator[list[Graph]]:
    started: list[Graph] = []
    yield started
    for one in started:
        one.close()


def start(graphs: list[Graph], *parameters: str) -> Graph:
    graphs.append(Graph(*(word for p in ('lens:=camera_info', *parameters) for word in ('-p', p))))
    return graphs[-1]


def numbers(message: Any) -> dict[str, float]:
    return {name: float(value) for name, value in read_key_values(message).items()}


def test_a_lens_without_a_shift_is_wholly_told_by_camera_info(graphs: list[Graph]) -> None:
    g = start(graphs, 'synthetic_camera:lens:=fish214', 'shift_scale:=0.0', 'rate:=50.0')
    results = g.hear(DiagnosticArray, 'localizer/result')
    g.start(Localizer)
    g.start(SyntheticCamera)
    g.until(lambda: results and numbers(results[-1]))
    assert numbers(results[-1])['position_error_m'] < 1e-6
    assert numbers(results[-1])['rms_px'] < 1e-4


def test_each_camera_of_a_rig_has_its_own(graphs: list[Graph]) -> None:
    g = start(
        graphs,
        'synthetic_camera:lens:=fish214',
        'shift_scale:=0.0',
        'style:=parallel',
        'poses_file:=calibration',
        'repeat:=false',
        'wait_for_subscribers:=2',
        'stereo_calibrator:wait_for_subscribers:=0',
        'stereo_depth:wait_for_subscribers:=0',
        'lock_step:=stereo_calibrator/result stereo_depth/result',
    )
    calibrated = g.hear(DiagnosticArray, 'stereo_calibrator/result')
    measured = g.hear(DiagnosticArray, 'stereo_depth/result')
    nodes = [g.start(StereoCalibrator), g.start(StereoDepth)]
    g.start(SyntheticCamera)
    g.until(lambda: len(calibrated) > 2 and len(measured) > 2)
    assert numbers(calibrated[-1])['position_error_m'] < 1e-5
    assert numbers(measured[-1])['error3_m'] < 1e-5
    for node in nodes:
        left, right = (node._models[f'{name}/'][0] for name in ('left', 'right'))
        assert (left.name, right.name) == ('left_camera_info', 'right_camera_info')


def test_an_ordinary_driver_is_heard_and_the_set_has_the_camera_info_of_its_stamp(
    graphs: list[Graph],
) -> None:
    g = start(graphs, 'patience:=0.3')
    results = g.hear(DiagnosticArray, 'localizer/result')
    node = g.start(Localizer)
    lens = load_lens(lens_path('fish214')).svp()
    landmarks = environment('whole', 2.0)
    told = g.tell(PointCloud2, 'landmarks', LATCHED)
    driver = g.tell(CameraInfo, 'camera_info', DRIVER)
    points = g.tell(PointCloud2, 'image_points')
    told.publish(messages.landmarks_message(landmarks, 0, 'world'))
    longer = replace(lens, fx=1.2 * lens.fx, fy=1.2 * lens.fy)
    stamps = {5: lens, 6: longer}

    def tell(stamp: int, one: Any) -> None:
        image = project(one, paper_pose().into_body(landmarks.points))
        points.publish(
            messages.image_points_message(
                landmarks.ids[image.valid], image.uv[image.valid], stamp, 'camera'
            )
        )

    # Best effort: what comes before the two know of each other, or in a crowd, is lost.
    for count, (stamp, one) in enumerate(stamps.items(), start=1):
        g.until(
            lambda stamp=stamp, one=one, count=count: (
                driver.publish(messages.camera_info_message(one, stamp, 'camera')),
                len(node._infos._heard.get('camera_info', ())) == count,
            )[1]
        )
    for stamp, one in stamps.items():
        tell(stamp, one)
    tell(7, longer)  # of another stamp than any camera_info: the latest holds
    g.until(lambda: len(results) == 3)
    assert {stamp_of(m) for m in results} == {5, 6, 7}
    assert max(numbers(m)['rms_px'] for m in results) < 1e-3


def test_a_set_without_one_says_so(graphs: list[Graph]) -> None:
    g = start(graphs, 'patience:=0.1')
    results = g.hear(DiagnosticArray, 'localizer/result')
    g.start(Localizer)
    told, points = g.tell(PointCloud2, 'landmarks', LATCHED), g.tell(PointCloud2, 'image_points')
    landmarks = environment('whole', 2.0)
    told.publish(messages.landmarks_message(landmarks, 0, 'world'))
    points.publish(
        messages.image_points_message(landmarks.ids, landmarks.points[:, :2] + 9, 3, 'camera')
    )
    g.until(lambda: results)
    assert 'camera_info: no message received' in results[0].status[0].message


def test_the_critic_of_a_rig_takes_one_lens(graphs: list[Graph]) -> None:
    start(graphs, 'stereo:=true')
    with pytest.raises(FisheyeSvpError, match='one lens file for both'):
        graphs[-1].start(ModelCritic)


def info(**changes: Any) -> Any:
    message = CameraInfo(width=640, height=480, distortion_model='equidistant')
    message.k, message.d = [K[0], 0.0, K[2], 0.0, K[1], K[3], 0.0, 0.0, 1.0], [0.1, 0.0, 0.0, 0.0]
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def test_what_a_camera_info_says() -> None:
    model = read_camera_info(info())
    assert model == ('equidistant', (640, 480), (*K, 0.0), (0.1, 0.0, 0.0, 0.0))
    assert read_camera_info(info(k=[K[0], 1.5, *info().k[2:]])).intrinsics == (*K, 1.5)
    assert read_camera_info(info(roi=RegionOfInterest(width=640, height=480))) == model


@pytest.mark.parametrize(
    ('changes', 'reason'),
    [
        ({'k': [0.0] * 9}, 'not calibrated'),
        ({'d': [np.nan] * 4}, 'not a finite number'),
        ({'k': [1e300, 0.0, 320.0, 0.0, 1e300, 240.0, 0.0, 0.0, 1.0]}, r'beyond 1e\+12'),
        ({'roi': RegionOfInterest(x_offset=4)}, r'roi 640x480 at \(4, 0\) is not in the image'),
    ],
)
def test_a_camera_info_of_no_use(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(ObservationError, match=reason):
        read_camera_info(info(**changes))


def test_a_part_of_the_image_and_its_binning_move_the_intrinsics() -> None:
    roi = RegionOfInterest(x_offset=100, y_offset=40, width=400, height=300)
    model = read_camera_info(info(roi=roi, binning_x=2, binning_y=3))
    assert model.size == (200, 100)
    center = (K[2] - 100 + 0.5) / 2 - 0.5, (K[3] - 40 + 0.5) / 3 - 0.5
    expected = K[0] / 2, K[1] / 3, *center, 0.0
    assert model.intrinsics == pytest.approx(expected)


@pytest.mark.parametrize('bins', [2, 3])
def test_a_lens_of_binned_images_projects_to_where_these_show_a_point(bins: int) -> None:
    """Pixels that are averaged move a spot by half of what one of them grows."""
    point, column, row = np.array([[0.31, -0.22, 1.0]]), np.arange(600), np.arange(420)
    known = {'width': 600, 'height': 420, 'd': [0.1, 0.0, 0.0, 0.0]}

    def image_of_point(**changes: Any) -> np.ndarray:
        model = read_camera_info(info(**known, **changes))
        return np.asarray(project(distortion_lens(*model, 'c', 'c'), point).uv[0])

    u, v = image_of_point()
    spot = np.exp(-(((column - u) ** 2 + (row[:, None] - v) ** 2) / (2 * 8.0**2)))
    binned = spot.reshape(420 // bins, bins, 600 // bins, bins).mean(axis=(1, 3))
    shown = [
        (binned.sum(axis=1 - axis) * np.arange(binned.shape[axis])).sum() / binned.sum()
        for axis in (1, 0)
    ]
    assert image_of_point(binning_x=bins, binning_y=bins) == pytest.approx(shown, abs=1e-3)


def test_of_rectified_images_p_is_the_lens() -> None:
    p = [500.0, 0.0, 310.0, -60.0, 0.0, 501.0, 235.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    model = read_camera_info(info(p=p, binning_x=2), 'camera_info', rectified=True)
    assert model == ('', (320, 480), (250.0, 501.0, 154.75, 235.0, 0.0), ())
    with pytest.raises(ObservationError, match=r'p is 0.*set detections_rectified:=false'):
        read_camera_info(info(), 'camera_info', rectified=True)


def test_a_localizer_takes_points_of_rectified_images(graphs: list[Graph]) -> None:
    g = start(graphs, 'detections_rectified:=true', 'patience:=0.1')
    results = g.hear(DiagnosticArray, 'localizer/result')
    g.start(Localizer)
    driver, points = g.tell(CameraInfo, 'camera_info'), g.tell(PointCloud2, 'image_points')
    landmarks, pose = environment('whole', 2.0), paper_pose()
    g.tell(PointCloud2, 'landmarks', LATCHED).publish(
        messages.landmarks_message(landmarks, 0, 'world')
    )
    p = [300.0, 0.0, 310.0, 0.0, 0.0, 301.0, 235.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    x, y, z = pose.into_body(landmarks.points).T
    seen = z > 0.3 * np.hypot(x, y)
    uv = np.stack([310 + 300 * x / z, 235 + 301 * y / z], axis=-1)[seen]
    message = info(p=p)
    message.header.stamp.nanosec = 7
    driver.publish(message)
    points.publish(messages.image_points_message(landmarks.ids[seen], uv, 7, 'camera'))
    g.until(lambda: results)
    assert numbers(results[-1])['rms_px'] < 1e-6


@pytest.mark.parametrize(
    ('model', 'd', 'reason'),
    [
        ('thin_prism', (0.1,), "'thin_prism'; choose from equidistant"),
        ('equidistant', (0.1,), 'has 1 coefficients'),
        ('plumb_bob', (0.1,), 'has 1 coefficients'),
        ('rational_polynomial', (0.1,) * 9, 'has 9 coefficients; 4 or 5 or 8 or 12 or 14'),
        ('', (0.1, 0.0, 0.0, 0.0), "distortion_model is ''; choose from"),
        ('equidistant', (0.1, 1e300, 0.0, 5e-324), 'no real lens'),
    ],
)
def test_a_model_of_no_lens_is_refused(model: str, d: tuple[float, ...], reason: str) -> None:
    with pytest.raises(LensError, match=reason):
        distortion_lens(
            model, (640, 480), (380.0, 380.0, 320.0, 240.0), d, 'camera', 'camera_info'
        )


@pytest.mark.parametrize(
    ('model', 'd'),
    [
        ('EQUIDISTANT', (0.02, -0.01, 0.003, -0.0005)),
        ('', ()),
        ('Plumb_Bob', ()),
        ('plumb_bob', (-0.9, 0.9, 0.01, 0.02, 0.0)),
        ('plumb_bob', (0.1, -0.25, 0.001, -0.002, 0.05)),
        ('plumb_bob', (-0.2, 0.05, 0.001, 0.0005)),
        ('rational_polynomial', (0.3, 0.02, 0.0, 0.0, 0.001, 0.5, 0.03, 0.0)),
    ],
)
def test_every_model_as_opencv_projects_it(model: str, d: tuple[float, ...]) -> None:
    lens = distortion_lens(model, (640, 480), K, d, 'camera', 'camera_info')
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 12), np.linspace(-0.4, 0.4, 12))
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    matrix = np.array([[K[0], 0, K[2]], [0, K[1], K[3]], [0, 0, 1.0]])
    through = cv2.fisheye.projectPoints if model == 'EQUIDISTANT' else cv2.projectPoints
    uv, _ = through(rays[:, None], np.zeros(3), np.zeros(3), matrix, np.array(d or [0.0] * 4))
    seen = forward.project_corrected(lens, rays)
    assert seen.valid.sum() > 100
    assert np.abs(seen.uv - uv[:, 0])[seen.valid].max() < 1e-5


@pytest.mark.parametrize('d', [(), (0.0,) * 5])
def test_a_wide_pinhole_is_taken_as_it_is(d: tuple[float, ...]) -> None:
    """Of 137 degrees over the diagonal, as a rectified image has it."""
    lens = distortion_lens('plumb_bob', (1280, 800), (300.0, 300.0, 640.0, 400.0), d, 'c', 'info')
    rays = np.array([[2.1, 1.3, 1.0], [-2.0, 1.2, 1.0], [0.0, 0.0, 1.0]])
    seen = forward.project_corrected(lens, rays)
    assert seen.valid.all()
    np.testing.assert_allclose(seen.uv, 300 * rays[:, :2] + (640, 400), atol=1e-9)


@pytest.mark.parametrize('skew', [-0.97, 4.26])
@pytest.mark.parametrize('d', [(0.02, -0.01, 0.003, -0.0005), (0.02, -0.01, 0.003, -0.0005, 0.0)])
def test_a_skew_is_taken_over_from_message_and_file(
    skew: float, d: tuple[float, ...], tmp_path: Path
) -> None:
    """Real calibrations have it; some drivers send more coefficients, which are zero."""
    matrix = np.array([[K[0], skew, K[2]], [0, K[1], K[3]], [0, 0, 1.0]])
    model = read_camera_info(info(k=matrix.ravel().tolist(), d=list(d)))
    file = tmp_path / 'info.yaml'
    file.write_text(camera_info_text('camera', (640, 480), matrix, 'equidistant', d, np.eye(3, 4)))
    rays = np.array([[0.3, 0.4, 1.0], [-0.5, 0.2, 1.0], [0.1, -0.6, 1.0]])
    plane, _ = cv2.fisheye.projectPoints(
        rays[:, None], np.zeros(3), np.zeros(3), np.eye(3), np.array(d[:4])
    )
    wanted = plane[:, 0] @ matrix[:2, :2].T + matrix[:2, 2]
    for lens in (distortion_lens(*model, 'camera', 'camera_info'), load_lens(file)):
        assert forward.project_corrected(lens, rays).uv == pytest.approx(wanted, abs=1e-5)
