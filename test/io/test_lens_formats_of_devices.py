"""Lenses and rigs as devices, apps and SLAM systems write them."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from fisheye_svp_ros import cli
from fisheye_svp_ros.effects.forward import project_corrected
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.lens_files import load_lens, read_lens_file
from fisheye_svp_ros.io.rig_files import load_cameras, load_rig
from fisheye_svp_ros.pose import Pose, rotation_from_vector

K = np.array([[410.3, 0, 640.2], [0, 409.1, 470.1], [0, 0, 1.0]])
FISHEYE = np.array([-0.01, 0.003, -0.002, 0.0002])
BROWN = np.array([-0.08, 0.012, 0.0004, -0.0003])
_X, _Y = np.meshgrid(np.linspace(-0.8, 0.8, 9), np.linspace(-0.7, 0.7, 9))
POINTS = np.stack([_X, _Y, np.ones_like(_X)], axis=-1).reshape(-1, 3)


def opencv_points(d: np.ndarray, k: np.ndarray = K) -> np.ndarray:
    none = np.zeros(3)
    if len(d) == 4 and d is not BROWN:
        return cv2.fisheye.projectPoints(POINTS[:, None], none, none, k, d)[0][:, 0]
    return cv2.projectPoints(POINTS, none, none, k, d)[0][:, 0]


def off(path: Path, right: np.ndarray, camera: str = '') -> float:
    lens = load_lens(f'{path}#{camera}' if camera else path)
    return float(np.abs(project_corrected(lens, POINTS).uv - right).max())


def written(folder: Path, document: object, name: str = 'camera.json') -> Path:
    text = yaml.safe_dump(document) if name.endswith('.yaml') else json.dumps(document)
    (folder / name).write_text(text)
    return folder / name


def storage(model: str, d: np.ndarray, head: str = '%YAML:1.0\n---\n') -> str:
    return (
        f'{head}image_width: 1280\nimage_height: 960\n'
        f'camera_matrix: {{rows: 3, cols: 3, data: {K.ravel().tolist()}}}\n'
        f'distortion_model: {model}\n'
        f'distortion_coefficients: {{rows: 1, cols: {len(d)}, data: {d.tolist()}}}\n'
    )


@pytest.mark.parametrize('head', ['', '%YAML:1.0\n---\n'])
@pytest.mark.parametrize(
    ('model', 'd'),
    [
        ('plumb_bob', BROWN),
        ('RadTan', BROWN),
        ('Rational_Polynomial', np.array([*BROWN, 0.001, 0.01, -0.002, 0.0003])),
        ('FISHEYE', FISHEYE),
        ('equidistant', FISHEYE),
        ('KannalaBrandt8', FISHEYE),
    ],
)
def test_a_stated_model_decides(
    model: str, d: np.ndarray, head: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In the notation of ROS and of OpenCV, in capitals or not, and without a note."""
    path = tmp_path / 'camera.yaml'
    path.write_text(storage(model, d, head))
    worst = read_lens_file(path).deviation_px(load_lens(path))
    assert off(path, opencv_points(d)) < 1.05 * worst + 1e-6 < 4
    assert cli.main(['lens', str(path)]) == 0
    assert 'coefficients are read as' not in capsys.readouterr().err


def test_the_fisheye_of_rtabmap_has_two_zeros(tmp_path: Path) -> None:
    path = tmp_path / 'camera.yaml'
    path.write_text(storage('fisheye', np.array([*FISHEYE[:2], 0, 0, *FISHEYE[2:]])))
    assert off(path, opencv_points(FISHEYE)) < 1e-6


def test_an_unknown_stated_model_is_refused(tmp_path: Path) -> None:
    path = tmp_path / 'camera.yaml'
    path.write_text(storage('division', FISHEYE))
    with pytest.raises(LensError, match="distortion model is 'division'; choose from equidistant"):
        load_lens(path)


PHOTON = {
    'resolution': {'width': 1280.0, 'height': 960.0},
    'cameraIntrinsics': {'rows': 3, 'cols': 3, 'type': 6, 'data': K.ravel().tolist()},
    'distCoeffs': {'rows': 1, 'cols': 8, 'type': 6, 'data': [*BROWN.tolist(), 0.001, 0, 0, 0]},
    'observations': [],
    'lensmodel': 'LENSMODEL_OPENCV',
}
GYROFLOW = {
    'calib_dimension': {'w': 1280, 'h': 960},
    'orig_dimension': {'w': 2560, 'h': 1920},
    'input_horizontal_stretch': 1.0,
    'fisheye_params': {
        'RMS_error': 0.5,
        'camera_matrix': K.tolist(),
        'distortion_coeffs': FISHEYE.tolist(),
    },
}
DEPTHAI_CAMERA = {
    'cameraType': 1,
    'distortionCoeff': [*FISHEYE.tolist(), *[0.0] * 10],
    'extrinsics': {
        'rotationMatrix': [[0.0] * 3] * 3,
        'toCameraSocket': -1,
        'translation': {'x': 0.0, 'y': 0.0, 'z': 0.0},
    },
    'height': 960,
    'intrinsicMatrix': K.tolist(),
    'width': 1280,
}
THEIA = {
    'image_width': 1280,
    'image_height': 960,
    'intrinsic_type': 'FISHEYE',
    'intrinsics': {
        'aspect_ratio': K[1, 1] / K[0, 0],
        'focal_length': K[0, 0],
        'principal_pt_x': K[0, 2],
        'principal_pt_y': K[1, 2],
        'skew': 0.0,
        **{f'radial_distortion_{i}': k for i, k in enumerate(FISHEYE.tolist(), start=1)},
    },
}
MC_CALIB = {
    'nb_camera': 1,
    'camera_0': {
        'camera_matrix': {'rows': 3, 'cols': 3, 'dt': 'd', 'data': K.ravel().tolist()},
        'distortion_vector': {'rows': 1, 'cols': 4, 'dt': 'd', 'data': FISHEYE.tolist()},
        'distortion_type': 1,
        'img_width': 1280,
        'img_height': 960,
    },
}


@pytest.mark.parametrize(
    ('document', 'd'),
    [
        (PHOTON, np.array([*BROWN, 0.001])),
        (GYROFLOW, FISHEYE),
        (
            GYROFLOW
            | {
                'distortion_model': 'opencv_standard',
                'fisheye_params': {
                    'camera_matrix': K.tolist(),
                    'distortion_coeffs': [*BROWN.tolist(), 0.001],
                },
            },
            np.array([*BROWN, 0.001]),
        ),
        ({'cameraData': [[0, DEPTHAI_CAMERA]]}, FISHEYE),
        (
            {
                'cameraData': [
                    [
                        2,
                        DEPTHAI_CAMERA
                        | {'cameraType': 0, 'distortionCoeff': [*BROWN.tolist(), *[0.0] * 10]},
                    ]
                ]
            },
            BROWN,
        ),
        (THEIA, FISHEYE),
    ],
)
def test_devices_with_the_models_of_opencv(document: dict, d: np.ndarray, tmp_path: Path) -> None:
    path = written(tmp_path, document)
    lens = load_lens(path)
    assert (lens.width, lens.height) == (1280, 960)
    worst = read_lens_file(path).deviation_px(lens)
    assert off(path, opencv_points(d)) < 1.05 * worst + 1e-6 < 4


def test_the_rig_of_mc_calib_has_lenses_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    both = json.loads(json.dumps(MC_CALIB | {'camera_1': MC_CALIB['camera_0']}))
    path = tmp_path / 'cameras.yml'
    path.write_text('%YAML:1.0\n---\n' + yaml.safe_dump(both))
    assert off(path, opencv_points(FISHEYE), 'camera_1') < 1e-6
    assert cli.main(['lens', str(path)]) == 0
    assert 'have the unit of the board and are not read; use --rig' in capsys.readouterr().err


def test_the_division_of_theia_is_in_pixels(tmp_path: Path) -> None:
    """x_u = x_d / (1 + k r_d^2), after the focal length; fy is aspect_ratio times f."""
    k, aspect = -4e-7, 1.004
    intrinsics = THEIA['intrinsics'] | {'div_undist_distortion': k, 'aspect_ratio': aspect}
    path = written(
        tmp_path, THEIA | {'intrinsic_type': 'DIVISION_UNDISTORTION', 'intrinsics': intrinsics}
    )
    uv = POINTS[:, :2] * 180 + 30.0  # of distorted pixels about the principal point
    undistorted = uv / (1 + k * (uv**2).sum(axis=1, keepdims=True))
    rays = np.column_stack([undistorted / [K[0, 0], K[0, 0] * aspect], np.ones(len(uv))])
    lens = load_lens(path)
    worst = read_lens_file(path).deviation_px(lens)
    assert 0 < np.abs(project_corrected(lens, rays).uv - uv - K[:2, 2]).max() < 1.05 * worst < 2


def test_woodscape_begins_at_the_corner(tmp_path: Path) -> None:
    k = [339.749, -31.988, 48.275, -7.201]
    path = written(
        tmp_path,
        {
            'intrinsic': {
                'aspect_ratio': 1.001,
                'cx_offset': 3.942,
                'cy_offset': -3.093,
                'height': 966.0,
                'width': 1280.0,
                **{f'k{i}': value for i, value in enumerate(k, start=1)},
                'model': 'radial_poly',
                'poly_order': 4,
            },
            'name': 'FV',
        },
    )
    theta = np.arctan(np.linalg.norm(POINTS[:, :2], axis=1))
    rho = sum(value * theta ** (i + 1) for i, value in enumerate(k))
    around = POINTS[:, :2] / np.maximum(np.linalg.norm(POINTS[:, :2], axis=1), 1e-12)[:, None]
    right = rho[:, None] * around * [1, 1.001] + [640 + 3.942 - 0.5, 483 - 3.093 - 0.5]
    lens = load_lens(path)
    assert lens.name == 'FV'
    worst = read_lens_file(path).deviation_px(lens)
    assert off(path, right) < 1.05 * worst < 2


@pytest.mark.parametrize(
    ('document', 'reason'),
    [
        (
            PHOTON | {'lensmodel': 'LENSMODEL_STEREOGRAPHIC'},
            'of PhotonVision LENSMODEL_OPENCV',
        ),
        (GYROFLOW | {'distortion_model': 'ptlens'}, "distortion_model is 'ptlens'; of Gyroflow"),
        (GYROFLOW | {'input_horizontal_stretch': 1.33}, 'input_horizontal_stretch is 1.33'),
        (GYROFLOW | {'digital_lens': 'gopro_superview'}, "digital_lens is 'gopro_superview'"),
        ({'cameraData': [[0, DEPTHAI_CAMERA | {'cameraType': 3}]]}, 'CAM_A: cameraType is 3; 0'),
        ({'cameraData': {'0': 1}}, 'cameraData must be pairs'),
        ({'cameraData': []}, 'no camera that is calibrated'),
        (THEIA | {'intrinsic_type': 'ORTHOGRAPHIC'}, "intrinsic_type is 'ORTHOGRAPHIC'; those"),
        (
            THEIA | {'intrinsics': {**THEIA['intrinsics'], 'radial_distortion_3': None}},
            'intrinsics: radial_distortion_3 is None',
        ),
        ({'intrinsic': {'model': 'radial_poly'}}, 'intrinsic: width is None'),
        (
            {'tags': [{'ID': 1, 'pose': {'translation': {'x': 1}}}], 'field': {'length': 16}},
            'a field layout of WPILib .a tag map, no lens. cannot be read',
        ),
    ],
)
def test_what_cannot_be_read_is_named(document: dict, reason: str, tmp_path: Path) -> None:
    with pytest.raises(LensError, match=reason) as error:
        load_lens(written(tmp_path, document))
    assert '\n' not in str(error.value)


def test_the_rig_of_depthai_is_in_centimeters(tmp_path: Path) -> None:
    """Extrinsics bring points of a camera into another: B to C, and C to A."""
    turn = rotation_from_vector(np.array([0.01, -0.02, 0.03]))

    def camera(target: int, rotation: np.ndarray, place: tuple[float, ...]) -> dict:
        shift = dict(zip('xyz', place, strict=True))
        return DEPTHAI_CAMERA | {
            'extrinsics': {
                'rotationMatrix': rotation.tolist(),
                'toCameraSocket': target,
                'translation': shift,
            }
        }

    path = written(
        tmp_path,
        {
            'cameraData': [
                [1, camera(2, turn, (-7.5, 0.01, 0.02))],
                [2, camera(0, np.eye(3), (3.75, 0.0, 0.1))],
                [0, DEPTHAI_CAMERA],
            ]
        },
    )
    names, cameras = load_cameras(path)
    assert names == ('CAM_A', 'CAM_B', 'CAM_C')
    b, c = (cameras.take(i) for i in (1, 2))
    left_in_right = c.inverse().compose(b)
    assert left_in_right.position == pytest.approx([-0.075, 1e-4, 2e-4])
    assert left_in_right.rotation == pytest.approx(turn)
    assert c.position == pytest.approx([0.0375, 0, 0.001])


def chain(key: str, poses: list[Pose], step: Pose | None = None) -> str:
    """A camchain of cameras with the IMU in them (T_cam_imu), or themselves in it (T_imu_cam)."""

    def rows(pose: Pose) -> list[list[float]]:
        return [*np.column_stack([pose.rotation, pose.position]).tolist(), [0.0, 0, 0, 1]]

    document = {
        f'cam{i}': {
            key: rows(pose if key == 'T_cam_imu' else pose.inverse()),
            'camera_model': 'pinhole',
            'distortion_model': 'equidistant',
            'distortion_coeffs': FISHEYE.tolist(),
            'intrinsics': [410.3, 409.1, 640.2, 470.1],
            'resolution': [1280, 960],
        }
        for i, pose in enumerate(poses)
    }
    if step is not None:
        document['cam1']['T_cn_cnm1'] = rows(step)
    return '%YAML:1.0\n---\n' + yaml.safe_dump(document)


IMU = [
    Pose(rotation_from_vector(np.array(turn)), np.array(place))
    for turn, place in (
        ([1.2, -1.1, 1.3], [0.02, 0.01, -0.05]),
        ([1.2, -1.0, 1.3], [0.03, -0.08, -0.05]),
        ([0.1, 2.0, 0.4], [-0.1, 0.0, 0.3]),
    )
]


@pytest.mark.parametrize('key', ['T_cam_imu', 'T_imu_cam'])
def test_a_rig_through_its_imu(
    key: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / 'chain.yaml', tmp_path / 'out.yaml'
    path.write_text(chain(key, IMU))
    point = np.array([0.3, -0.2, 1.0])  # in the IMU
    for file in (path, out):
        _, cameras = load_cameras(file)
        for pose, camera in zip(IMU, (cameras.take(i) for i in range(3)), strict=True):
            in_first = camera.rotation @ pose.transform(point) + camera.position
            assert in_first == pytest.approx(IMU[0].transform(point), abs=1e-9)
        if file == path:
            assert cli.main(['lens', str(path), '-o', str(out), '--format', 'kalibr']) == 0
            assert 'only cam0 is written' not in capsys.readouterr().err
            assert 'T_cn_cnm1' in out.read_text() and 'imu' not in out.read_text()


def test_a_stated_neighbor_comes_before_the_imu(tmp_path: Path) -> None:
    path, step = tmp_path / 'chain.yaml', Pose(np.eye(3), np.array([-0.2, 0.0, 0.0]))
    path.write_text(chain('T_cam_imu', IMU[:2], step))
    assert load_rig(path).position == pytest.approx([-0.2, 0, 0])


def info(r: np.ndarray, p: np.ndarray, echoed: bool) -> str:
    if echoed:
        return yaml.safe_dump(
            {
                'header': {'frame_id': 'camera'},
                'height': 960,
                'width': 1280,
                'distortion_model': 'equidistant',
                'd': FISHEYE.tolist(),
                'k': K.ravel().tolist(),
                'r': r.ravel().tolist(),
                'p': p.ravel().tolist(),
                'roi': dict.fromkeys(('x_offset', 'y_offset', 'height', 'width'), 0),
                'binning_x': 0,
                'binning_y': 0,
            }
        )
    entries = {'rectification_matrix': r, 'projection_matrix': p}
    return storage('equidistant', FISHEYE, '') + yaml.safe_dump(
        {name: {'rows': len(m), 'cols': m.shape[1], 'data': m.ravel().tolist()}
         for name, m in entries.items()}
    )  # fmt: skip


@pytest.mark.parametrize('form', ['yaml', 'echo', 'opencv'])
def test_two_camera_infos_are_a_rig(
    form: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = Pose(rotation_from_vector(np.array([0.02, -0.03, 0.01])), np.array([-0.11, 0.002, 0.01]))
    r1, r2, p1, p2, *_ = cv2.fisheye.stereoRectify(
        K, FISHEYE, K, FISHEYE, (1280, 960), rig.rotation, rig.position, 0
    )
    for name, r, p in (('left', r1, p1), ('right', r2, p2)):
        text = info(r, p, form == 'echo')
        (tmp_path / f'{name}.yaml').write_text('%YAML:1.0\n---\n' * (form == 'opencv') + text)
    found = load_rig(tmp_path)
    assert found.position == pytest.approx(rig.position, abs=1e-9)
    assert found.rotation == pytest.approx(rig.rotation, abs=1e-9)
    names, cameras = load_cameras(tmp_path)
    assert names == ('left', 'right') and np.linalg.norm(cameras.position[1]) > 0.1
    assert cli.main(['lens', f'{tmp_path}/']) == 0
    assert 'camera 0 in camera 1 at -110.000, 2.000, 10.000 mm' in capsys.readouterr().out
    sides = [f'--lens={name}={tmp_path}/{name}.yaml' for name in names]
    out = tmp_path / 'out'
    assert cli.main(['undistort', *sides, '-o', str(out), '--fov', '80', '--size', '64x48']) == 0
    document = json.loads((out / 'undistort.json').read_text())
    assert document['baseline_m'] == pytest.approx(np.linalg.norm(rig.position))


def test_cameras_calibrated_by_themselves_are_no_rig(tmp_path: Path) -> None:
    p = np.column_stack([K, np.zeros(3)])
    for name in ('left', 'right'):
        (tmp_path / f'{name}.yaml').write_text(info(np.eye(3), p, False))
    with pytest.raises(LensError, match=re.escape('rig.yaml')):
        load_rig(tmp_path)
    with pytest.raises(LensError, match='give the folder with both camera_info files'):
        load_rig(tmp_path / 'left.yaml')
