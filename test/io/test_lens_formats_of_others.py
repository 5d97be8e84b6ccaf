"""Lens files of others: right values against the tool itself or its documented projection."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.data import DATA

from fisheye_svp_ros import cli
from fisheye_svp_ros.effects.forward import project_corrected
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.lens_files import load_lens, read_lens_file, save_lens
from fisheye_svp_ros.io.rig_files import load_rig
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.optics.curves import Gennery, KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens

_PINHOLES_OF_OPENCV = ('SIMPLE_RADIAL', 'RADIAL', 'OPENCV', 'FULL_OPENCV')
# Two points at 18 and 40 degrees, and where pycolmap 4.2.1 projects them, in COLMAP's own pixels
SEEN = np.array([[0.234163, 0.227965, 1.0], [-0.785580, -0.266029, 1.0]])
OF_COLMAP = [
    ('SIMPLE_PINHOLE', '500 500 400', [(617.081529, 513.982530), (107.209846, 266.985296)]),
    ('PINHOLE', '500 510 505 395', [(622.081529, 511.262180), (112.209846, 259.325002)]),
    ('SIMPLE_RADIAL', '500 500 400 -.05', [(616.456311, 513.373861), (120.720022, 271.560390)]),
    ('RADIAL', '500 500 400 -.05 .01', [(616.469666, 513.386862), (118.861270, 270.930941)]),
    (
        'SIMPLE_RADIAL_FISHEYE',
        '300 500 400 .03',
        [(568.100232, 466.297705), (300.421221, 332.414517)],
    ),
    (
        'RADIAL_FISHEYE',
        '300 500 400 .03 -.01',
        [(568.093473, 466.291126), (300.873468, 332.567666)],
    ),
    (
        'OPENCV',
        '500 505 500 400 -.1 .02 .001 -.002',
        [(615.694719, 513.917698), (128.799501, 273.622071)],
    ),
    (
        'OPENCV_FISHEYE',
        '300 305 500 400 .03 -.01 .002 -.0003',
        [(568.093606, 467.396109), (300.833222, 331.429938)],
    ),
    (
        'FULL_OPENCV',
        '500 505 500 400 .3 .02 .0005 -.0007 .001 .5 .03 0',
        [(614.646595, 512.791888), (147.705941, 279.761954)],
    ),
    ('FOV', '400 405 500 400 .9', [(597.391152, 495.998499), (215.627805, 302.496272)]),
    (
        'THIN_PRISM_FISHEYE',
        '300 305 500 400 .03 -.01 .001 -.0007 .002 -.0003 .0004 -.0006',
        [(568.093034, 467.416602), (300.696817, 331.456323)],
    ),
    (
        'RAD_TAN_THIN_PRISM_FISHEYE',
        '300 305 500 400 .03 -.01 .002 -.0003 .0001 -.00001 .0011 -.0007 .0004 -.0002 '
        '-.0006 .0001',
        [(568.151096, 467.369434), (301.267556, 331.320906)],
    ),
    ('SIMPLE_DIVISION', '400 500 400 -.1', [(592.685688, 490.232416), (204.839836, 300.046777)]),
    ('DIVISION', '400 405 500 400 -.1', [(592.685688, 491.360321), (204.839836, 298.797361)]),
    ('SIMPLE_FISHEYE', '300 500 400', [(567.897011, 466.099864), (303.251082, 333.372823)]),
    ('FISHEYE', '300 305 500 400', [(567.897011, 467.201528), (303.251082, 332.262370)]),
    ('EUCM', '300 305 500 400 .6 1.1', [(567.921539, 467.225805), (302.823299, 332.115091)]),
]


def loaded(folder: Path, text: str) -> tuple[Lens, float]:
    """Return the first lens of a text, and its worst deviation, px."""
    (folder / 'lens').write_text(text)
    foreign = read_lens_file(folder / 'lens')
    assert foreign is not None
    return load_lens(folder / 'lens'), next(iter(foreign.worst_px.values()), 0.0)


def rays(limit: float) -> np.ndarray:
    """Return directions (400, 3) up to an incidence angle, rad, all around."""
    theta, azimuth = np.meshgrid(np.linspace(0.01, limit, 20), np.linspace(0, 2 * np.pi, 20))
    sin = np.sin(theta)
    return np.stack([sin * np.cos(azimuth), sin * np.sin(azimuth), np.cos(theta)], -1).reshape(
        -1, 3
    )


def off(lens: Lens, points: np.ndarray, uv: np.ndarray) -> float:
    """Return the largest deviation, px, of image points in the image."""
    inside = ((uv > -0.5) & (uv < [lens.width - 0.5, lens.height - 0.5])).all(axis=1)
    seen = project_corrected(lens, points)
    inside &= seen.valid
    assert inside.sum() > 100
    return float(np.abs(seen.uv - uv)[inside].max())


@pytest.mark.parametrize(('model', 'values', 'uv'), OF_COLMAP, ids=[row[0] for row in OF_COLMAP])
def test_every_camera_of_colmap_as_colmap_projects_it(
    model: str, values: str, uv: list[tuple[float, float]], tmp_path: Path
) -> None:
    lens, worst = loaded(tmp_path, f'# Camera list\n#\n1 {model} 1000 800 {values}\n')
    assert worst < 0.6
    fisheye = 'FISHEYE' in model and 'PRISM' not in model
    exact = fisheye or 'PINHOLE' in model or model in _PINHOLES_OF_OPENCV
    assert (worst == 0) == exact
    assert np.abs(project_corrected(lens, SEEN).uv + 0.5 - uv).max() < 1.05 * worst + 3e-4


def test_the_cameras_of_a_file_of_colmap(tmp_path: Path) -> None:
    path = tmp_path / 'cameras.txt'
    path.write_text(
        '# id\n1 OPENCV_FISHEYE 1752 1168 600.12 600.5 876.2 584.1 0.031 -0.012 '
        '0.002 -0.0003\n7, SIMPLE_RADIAL_FISHEYE, 1752, 1168, 600.12, 876.2, 584.1, '
        '0.031\n'
    )
    assert [*read_lens_file(path).lenses] == ['1', '7']
    assert load_lens(f'{path}#7').parameters['k1'] == 0.031
    assert load_lens(path).cx == 875.7


def equidistant(lens: Lens, points: np.ndarray, k: tuple[float, ...]) -> np.ndarray:
    """Return image points as cv2.fisheye projects them."""
    matrix = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1.0]])
    front = points / points[:, 2:]
    return cv2.fisheye.projectPoints(
        front[:, None], np.zeros(3), np.zeros(3), matrix, np.array(k)
    )[0][:, 0]


K4 = (0.031, -0.012, 0.002, -0.0003)
NERF = {
    'camera_model': 'OPENCV_FISHEYE',
    'fl_x': 600.1,
    'fl_y': 600.5,
    'cx': 876.2,
    'cy': 584.1,
    'w': 1752,
    'h': 1168,
    **{f'k{i}': k for i, k in enumerate(K4, start=1)},
    'frames': [],
}
EUROC = """\
sensor_type: camera
T_BS: {{cols: 4, rows: 4, data: [1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0]}}
resolution: [1752, 1168]
camera_model: pinhole
intrinsics: [600.1, 600.5, 875.7, 583.6] #fu, fv, cu, cv
distortion_model: {}
distortion_coefficients: {}
"""
ORB = """\
%YAML:1.0
File.version: "1.0"
Camera.type: "KannalaBrandt8"
Camera1.fx: 600.1
Camera1.fy: 600.5
Camera1.cx: 875.7
Camera1.cy: 583.6
Camera1.k1: 0.031
Camera1.k2: -0.012
Camera1.k3: 0.002
Camera1.k4: -0.0003
Camera.width: 1752
Camera.height: 1168
"""
VINS = """\
%YAML:1.0
---
model_type: KANNALA_BRANDT
camera_name: front
image_width: 1752
image_height: 1168
projection_parameters:
   k2: 0.031
   k3: -0.012
   k4: 0.002
   k5: -0.0003
   mu: 600.1
   mv: 600.5
   u0: 875.7
   v0: 583.6
"""
KALIBR = """\
cam0:
  camera_model: pinhole
  intrinsics: [600.1, 600.5, 875.7, 583.6]
  distortion_model: equidistant
  distortion_coeffs: [0.031, -0.012, 0.002, -0.0003]
  resolution: [1752, 1168]
"""
INFO = """\
image_width: 1752
image_height: 1168
camera_name: front
camera_matrix: {{rows: 3, cols: 3, data: [600.1, {}, 875.7, 0.0, 600.5, 583.6, 0.0, 0.0, 1.0]}}
distortion_model: equidistant
distortion_coefficients: {{rows: 1, cols: 5, data: [0.031, -0.012, 0.002, -0.0003, 0.0]}}
"""
METASHAPE = """<?xml version="1.0" encoding="UTF-8"?>
<calibration>
  <projection>{}</projection>
  <width>1752</width><height>1168</height>
  <f>600.5</f><cx>0.2</cx><cy>0.1</cy><b1>-0.4</b1>
  <k1>0.031</k1><k2>-0.012</k2><k3>0.002</k3><k4>-0.0003</k4>{}
  <date>2024-02-10T12:00:00Z</date>
</calibration>
"""


@pytest.mark.parametrize(
    'text',
    [
        json.dumps(NERF),
        json.dumps({**NERF, 'camera_model': None, 'is_fisheye': True}).replace(
            '"camera_model": null, ', ''
        ),
        json.dumps({'camera_model': 'OPENCV_FISHEYE', 'frames': [NERF, NERF]}),
        EUROC.format('equidistant', list(K4)),
        EUROC.format('equidistant', [*K4, 0.0]),
        ORB,
        ORB.replace('Camera1', 'Camera'),
        VINS,
        KALIBR,
        '%YAML:1.0 # as OpenVINS has it\n' + KALIBR,
        KALIBR.replace('-0.0003]', '-0.0003, 0.0]'),
        INFO.format('0.0'),
        METASHAPE.format('fisheye', ''),
        METASHAPE.format('equidistant_fisheye', ''),
        '<document><chunk><sensors><sensor type="fisheye">'
        + METASHAPE.format('fisheye', '')
        .partition('?>')[2]
        .replace('<calibration>', '<calibration class="initial">')
        + METASHAPE.format('', '')
        .partition('?>')[2]
        .replace(
            '<calibration>',
            '<calibration type="fisheye" '
            'class="adjusted"><resolution width="1752" '
            'height="1168"/>',
        )
        .replace('<projection></projection>', '')
        + '</sensor></sensors></chunk></document>',
    ],
    ids=[
        'nerfstudio',
        'ngp',
        'frames',
        'euroc',
        'euroc5',
        'orb3',
        'orb',
        'vins',
        'kalibr',
        'openvins',
        'kalibr5',
        'ros5',
        'metashape',
        'metashape2',
        'metashape_project',
    ],
)
def test_one_lens_in_every_form(text: str, tmp_path: Path) -> None:
    lens, worst = loaded(tmp_path, text)
    assert worst == 0
    assert (lens.width, lens.height) == (1752, 1168)
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == pytest.approx((600.1, 600.5, 875.7, 583.6))
    assert lens.image_height == KannalaBrandt(*K4)
    points = rays(np.radians(85))
    assert off(lens, points, equidistant(lens, points, K4)) < 1e-6


def test_the_radial_tangential_lens_of_euroc(tmp_path: Path) -> None:
    d = (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)
    text = (
        EUROC.format('radial-tangential', list(d))
        .replace('1752, 1168', '752, 480')
        .replace('600.1, 600.5, 875.7, 583.6', '458.654, 457.296, 367.215, 248.375')
    )
    lens, worst = loaded(tmp_path, text)
    assert worst == 0.0
    points = rays(np.radians(39))
    matrix = np.array([[458.654, 0, 367.215], [0, 457.296, 248.375], [0, 0, 1.0]])
    uv = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(d))[0][:, 0]
    assert off(lens, points, uv) < 1e-9


def test_omnidir_of_opencv(tmp_path: Path) -> None:
    path = tmp_path / 'omni.yml'
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in (
        ('K', np.array([[830.0, 0, 373.0], [0, 831.0, 253.0], [0, 0, 1]])),
        ('D', np.array([[-0.1, 0.05, 0.0002, -0.0003]])),
        ('xi', np.array([[1.1]])),
        ('image_width', 752),
        ('image_height', 480),
    ):
        storage.write(name, value)
    storage.release()
    lens, worst = loaded(tmp_path, path.read_text())
    points = rays(np.radians(60))
    plane = points[:, :2] / (points[:, 2:] + 1.1)
    x, y = plane.T
    z = x * x + y * y
    p1, p2 = 0.0002, -0.0003
    stretch = 1 - 0.1 * z + 0.05 * z * z
    uv = np.stack(
        [
            830 * (x * stretch + 2 * p1 * x * y + p2 * (z + 2 * x * x)) + 373,
            831 * (y * stretch + p1 * (z + 2 * y * y) + 2 * p2 * x * y) + 253,
        ],
        axis=-1,
    )
    assert off(lens, points, uv) < 1.05 * worst < 0.2


def test_the_fov_model_of_kalibr(tmp_path: Path) -> None:
    lens, worst = loaded(
        tmp_path,
        KALIBR.replace('equidistant', 'fov').replace('[0.031, -0.012, 0.002, -0.0003]', '[0.92]'),
    )
    points = rays(np.radians(75))
    theta = np.arccos(points[:, 2:])
    h = np.arctan(2 * np.tan(theta) * np.tan(0.46)) / 0.92
    uv = h * points[:, :2] / np.sin(theta) * [600.1, 600.5] + [875.7, 583.6]
    assert off(lens, points, uv) < max(1.05 * worst, 1e-6) < 0.01


@pytest.mark.parametrize('projection', ['fisheye', 'equisolid_fisheye', 'frame'])
def test_metashape_moves_points_sideways_and_has_a_skew(projection: str, tmp_path: Path) -> None:
    """Against the projection as its manual (2.3, appendix D) has it."""
    text = METASHAPE.format(projection, '<p1>0.0005</p1><p2>-0.0003</p2><b2>1.5</b2>')
    if projection == 'frame':
        text = text.replace('0.031', '-0.1').replace('-0.012', '0.02').replace('600.5', '1500.5')
    lens, worst = loaded(tmp_path, text)
    points = rays(np.radians(40 if projection == 'frame' else 80))
    theta = np.arccos(points[:, 2:])
    base = {'fisheye': theta, 'equisolid_fisheye': 2 * np.sin(theta / 2), 'frame': np.tan(theta)}[
        projection
    ]
    x, y = (base * points[:, :2] / np.sin(theta)).T
    z = x * x + y * y
    f, *k = [float(re.search(f'<{tag}>(.*?)<', text)[1]) for tag in ('f', 'k1', 'k2', 'k3', 'k4')]
    p1, p2 = 0.0005, -0.0003
    stretch = 1 + sum(one * z ** (i + 1) for i, one in enumerate(k))
    u = x * stretch + p1 * (z + 2 * x * x) + 2 * p2 * x * y
    v = y * stretch + p2 * (z + 2 * y * y) + 2 * p1 * x * y
    uv = np.stack([876 + 0.2 + u * f - 0.4 * u + 1.5 * v, 584 + 0.1 + v * f], axis=-1) - 0.5
    assert off(lens, points, uv) < 1.1 * worst + 0.01 < 0.5
    assert lens.corrections['skew']['parameters']['shear'] * lens.fx == pytest.approx(1.5, rel=0.1)


OCAM = """\
#polynomial coefficients for the DIRECT mapping function (ocam_model.ss in MATLAB). These are used by cam2world

5 -1.860750e+02 0.000000e+00 1.845950e-03 -1.680820e-06 6.630810e-09

#polynomial coefficients for the inverse mapping function (ocam_model.invpol in MATLAB). These are used by world2cam

6 289.5 157.7 -6.2 20.1 3.4 1.9

#center: "row" and "column", starting from 0 (C convention)

240.3 322.8

#affine parameters "c", "d", "e"

0.9998 {} -0.0001

#image size: "height" and "width"

480 640
"""  # noqa: E501


@pytest.mark.parametrize('d', [0.0, 0.002])
def test_ocamcalib_as_its_cam2world_has_it(d: float, tmp_path: Path) -> None:
    """Pixels (row, column) to rays as ocam_functions.c does it, and back by our lens."""
    lens, worst = loaded(tmp_path, OCAM.format(d))
    assert worst < 0.2
    column, row = (
        grid.ravel() for grid in np.meshgrid(np.arange(4.0, 640, 8), np.arange(4.0, 480, 8))
    )
    c, e = 0.9998, -0.0001
    down, right = np.linalg.solve([[c, d], [e, 1.0]], [row - 240.3, column - 322.8])
    rho = np.hypot(down, right)
    z = np.polynomial.polynomial.polyval(
        rho, [-1.860750e02, 0, 1.845950e-03, -1.680820e-06, 6.630810e-09]
    )
    points = np.stack([right, down, -z], axis=-1)
    # Our camera is turned about the axis so that v does not grow with x.
    angle = np.arctan2(d, c)
    points[:, :2] @= np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    assert off(lens, points, np.stack([column, row], axis=-1)) < 1.2 * worst


def test_the_rig_of_orbslam(tmp_path: Path) -> None:
    """T_c1_c2 is the right camera in the left one."""
    right = ORB[ORB.index('Camera1.fx') : ORB.index('Camera.width')].replace('Camera1', 'Camera2')
    (tmp_path / 'rig.yaml').write_text(
        ORB
        + right.replace('600.1', '601.1')
        + (
            'Stereo.T_c1_c2: !!opencv-matrix\n  rows: 4\n  cols: 4\n  dt: f\n'
            '  data: [1.0, 0.0, 0.0, 0.11, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.02, 0, '
            '0, 0, 1.0]\n'
        )
    )
    assert load_rig(tmp_path / 'rig.yaml').position == pytest.approx([-0.11, 0, -0.02])
    assert load_lens(f'{tmp_path / "rig.yaml"}#right').fx == 601.1


def test_the_mei_camera_of_camodocal(tmp_path: Path) -> None:
    lens, worst = loaded(
        tmp_path,
        """\
%YAML:1.0
---
model_type: MEI
camera_name: camera
image_width: 752
image_height: 480
mirror_parameters: {xi: 1.9}
distortion_parameters: {k1: -0.05, k2: 0.4, p1: 0.0005, p2: -0.0002}
projection_parameters: {gamma1: 1162.0, gamma2: 1161.0, u0: 378.6, v0: 231.2}
""",
    )
    points = rays(np.radians(55))
    x, y = (points[:, :2] / (points[:, 2:] + 1.9)).T
    z = x * x + y * y
    u = x * (1 - 0.05 * z + 0.4 * z * z) + 2 * 0.0005 * x * y - 0.0002 * (z + 2 * x * x)
    v = y * (1 - 0.05 * z + 0.4 * z * z) + 0.0005 * (z + 2 * y * y) - 2 * 0.0002 * x * y
    uv = np.stack([1162 * u + 378.6, 1161 * v + 231.2], axis=-1)
    assert off(lens, points, uv) < 1.05 * worst < 0.3


def test_the_skew_of_a_camera_matrix_is_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lens, worst = loaded(tmp_path, INFO.format('2.5'))
    assert worst == 0
    points = rays(np.radians(80))
    bare = equidistant(lens, points, K4)
    bare[:, 0] += 2.5 * (bare[:, 1] - 583.6) / 600.5
    assert off(lens, points, bare) < 1e-6
    for form in ('ros', 'opencv'):
        assert (
            cli.main(
                ['lens', str(tmp_path / 'lens'), '-o', str(tmp_path / form), '--format', form]
            )
            == 0
        )
        assert 'left out' not in capsys.readouterr().out
        assert project_corrected(load_lens(tmp_path / form), points).uv == pytest.approx(
            project_corrected(lens, points).uv, abs=1e-6, nan_ok=True
        )
    assert (
        cli.main(
            ['lens', str(tmp_path / 'lens'), '-o', str(tmp_path / 'out'), '--format', 'kalibr']
        )
        == 0
    )
    assert 'left out: skew' in capsys.readouterr().out


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        (
            '1 EQUIRECTANGULAR 1000 800 1000 800\n',
            'camera 1: model is EQUIRECTANGULAR; those that can be read are OPENCV_FISHEYE, ',
        ),
        (
            '1 OPENCV_FISHEYE 1000 800 300 300 500 400 0.1\n',
            'OPENCV_FISHEYE has 5 parameters; needed are fx, fy, cx, cy, k1',
        ),
        (
            json.dumps({**NERF, 'camera_model': 'EQUIRECTANGULAR'}),
            "camera_model is 'EQUIRECTANGULAR'",
        ),
        (json.dumps({**NERF, 'cx': None}), 'cx is None; a finite number is needed'),
        (METASHAPE.format('spherical', ''), "projection is 'spherical'; those that can be read"),
        (
            EUROC.format('fov', [0.9]),
            "distortion_model is 'fov'; equidistant and radial-tangential",
        ),
        (EUROC.format('equidistant', [*K4, 0.1]), 'distortion_coefficients has 5 numbers, not 4'),
        (ORB.replace('KannalaBrandt8', 'Rectified'), "Camera.type is 'Rectified'"),
        (ORB.replace('Camera.width: 1752\n', ''), 'Camera.width is None'),
        (
            VINS.replace('KANNALA_BRANDT', 'SCARAMUZZA'),
            "model_type is 'SCARAMUZZA'; those that can",
        ),
        (
            OCAM.format(0.0).replace('5 -1.860750e+02', '6 -1.860750e+02'),
            'the direct polynomial must',
        ),
        (OCAM.format(0.0).replace('480 640', ''), 'image size is missing'),
        (
            KALIBR.replace('pinhole', 'omni').replace('[600.1', '[1.0, 600.1'),
            'omni with equidistant cannot be read. Readable are pinhole with equidistant',
        ),
        ('{"sfm_data_version": "0.3"}', 'an OpenMVG scene cannot be read; readable are '),
        ('<lensdatabase version="2"></lensdatabase>', 'a lensfun database cannot be read'),
        ('p f2 w3000 h1500 v360\ni w2000 h2000 f3 v180\n', 'Hugin or PTGui'),
        ('some words\n', 'it has no projection, and no format of ROS camera_info, Kalibr'),
    ],
)
def test_a_format_is_named_and_what_can_be_read(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / 'lens').write_text(text)
    with pytest.raises(LensError, match=re.escape(said)) as error:
        load_lens(tmp_path / 'lens')
    assert '\n' not in str(error.value)


@pytest.mark.parametrize('form', ['colmap', 'nerfstudio'])
def test_written_as_others_read_it(form: str, tmp_path: Path) -> None:
    lens = Lens('front', 1752, 1168, 600.1, 600.5, 875.7, 583.6, KannalaBrandt(*K4), 1.7)
    save_lens(lens, tmp_path / 'lens.yaml')
    out = tmp_path / 'out'
    assert cli.main(['lens', str(tmp_path / 'lens.yaml'), '-o', str(out), '--format', form]) == 0
    if form == 'colmap':
        words = out.read_text().splitlines()[-1].split()
        assert words[:4] == ['1', 'OPENCV_FISHEYE', '1752', '1168']
        assert [*map(float, words[4:])] == pytest.approx([600.1, 600.5, 876.2, 584.1, *K4])
    else:
        assert json.loads(out.read_text()) == pytest.approx(NERF)


def test_what_is_odd_about_a_lens_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / 'lens.yaml'
    path.write_text("""\
pinhole: {fx: 4650.0, fy: 3750.0, cx: 4100.0, cy: -600.0, width: 3104, height: 3000, skew: 0.0}
model: omnidirectional_universal
radial_tangential: {radial: [0.001, -0.0467], t1: 0.0, t2: 0.0}
mirror_offset: 0.0125
""")
    assert cli.main(['lens', str(path)]) == 0
    told = capsys.readouterr()
    assert 'principal point (4100.0, -600.0) lies outside the image of 3104x3000 px' in told.err
    worst = read_lens_file(path).worst_px['camera']
    assert worst > 1
    assert f'the nearest lens is {worst:.2g} px off the model of this file' in told.err
    assert f'kannala_brandt fitted to BoofCV, at most {worst:.2g} px off' in told.out
    assert cli.main(['budget', '--lens', str(path)]) == 2  # without a viewpoint shift
    assert 'lies outside the image' in capsys.readouterr().err
    save_lens(replace(load_lens(path), cx=1500.0, cy=1500.0), tmp_path / 'inside.yaml')
    assert cli.main(['lens', str(tmp_path / 'inside.yaml')]) == 0
    assert capsys.readouterr().err == ''


@pytest.mark.parametrize(
    ('changes', 'told'),
    [
        ({'viewpoint_shift': Gennery(0.0, 4.0)}, r'the viewpoint shift is 2\.3 m at 90 deg; its'),
        ({'max_incidence': np.radians(1.6)}, r'max_incidence_deg is 1\.6; it is in degrees'),
        ({'viewpoint_shift': Gennery(0.0, 0.004)}, ''),
    ],
)
def test_other_units_in_a_lens_file_are_told(
    changes: dict[str, object], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_lens(replace(load_lens(lens_path('fish180')), **changes), tmp_path / 'lens.yaml')
    assert cli.main(['lens', str(tmp_path / 'lens.yaml')]) == 0
    assert re.search(told, capsys.readouterr().err) if told else not capsys.readouterr().err


# Focal lengths that the files state, px; of a field-of-view model 2 tan(w / 2) / w times as much,
# of a polynomial its first coefficient, less its affine part.
FOCAL = {
    'camera_info_five': 285.0,
    'colmap_cameras': 600.12,
    'euroc_sensor': 458.654,
    'kalibr_fov': 300.1 * 2 * np.tan(0.46) / 0.92,
    'metashape': 1712.4,
    'nerf': 600.1,
    'ocam': 186.075,
    'orb3': 190.978477,
}


def test_files_that_others_wrote() -> None:
    folder = DATA.parent / 'faults' / 'lens_files'
    if not folder.exists():
        pytest.skip('the files are not here')
    paths = sorted(folder.iterdir())
    assert {path.stem for path in paths} >= set(FOCAL)
    for path in paths:
        lens, foreign = load_lens(path), read_lens_file(path)
        assert lens.max_incidence > 0.5
        assert lens.fx == pytest.approx(FOCAL.get(path.stem, lens.fx), rel=5e-3)
        assert max(foreign.worst_px.values(), default=0.0) < (
            5 if path.stem == 'center_outside' else 0.3
        )


_OPENCV8 = (0.2, 0.05, 0.001, -0.001, 0.01, 0.3, 0.1, 0.02)
_SAME_LENS = {
    'mrcal': "{{'lensmodel': 'LENSMODEL_OPENCV8', 'imagersize': [640, 480], 'intrinsics': "
    '[300, 310, 320, 240, {}]}}',
    'Basalt': '{{"value0": {{"resolution": [[640, 480]], "intrinsics": [{{"camera_type": '
    '"pinhole-radtan8", "intrinsics": {{"fx": 300, "fy": 310, "cx": 320, "cy": 240, '
    '{}}}}}]}}}}',
    'ROS': 'image_width: 640\nimage_height: 480\ncamera_matrix: {{data: [300, 0, 320, 0, 310, '
    '240, 0, 0, 1]}}\ndistortion_model: rational_polynomial\ndistortion_coefficients: '
    '{{data: [{}]}}\n',
    'echo of a topic': 'header: {{frame_id: front}}\nheight: 480\nwidth: 640\n'
    'distortion_model: rational_polynomial\nd: [{}]\nk: [300, 0, 320, 0, 310, '
    '240, 0, 0, 1]\nbinning_x: 0\nbinning_y: 0\nroi: {{x_offset: 0, y_offset: '
    '0, height: 0, width: 0, do_rectify: false}}\n',
}


@pytest.mark.parametrize('form', _SAME_LENS)
def test_the_rational_model_is_read_alike_from_every_tool(form: str, tmp_path: Path) -> None:
    """As OpenCV projects it."""
    names = ('k1', 'k2', 'p1', 'p2', 'k3', 'k4', 'k5', 'k6')
    numbers = ', '.join(
        f'"{name}": {value}' if form == 'Basalt' else str(value)
        for name, value in zip(names, _OPENCV8, strict=True)
    )
    lens, worst = loaded(tmp_path, _SAME_LENS[form].format(numbers))
    matrix = np.array([[300, 0, 320], [0, 310, 240], [0, 0, 1.0]])
    right = cv2.projectPoints(SEEN, np.zeros(3), np.zeros(3), matrix, np.array(_OPENCV8))[0]
    seen = project_corrected(lens, SEEN)
    assert worst == 0.0 and seen.valid.any()
    np.testing.assert_allclose(seen.uv[seen.valid], right[seen.valid, 0], rtol=0, atol=1e-9)


@pytest.mark.parametrize('count', [0, 4, 5])
def test_perspective_models_of_mrcal_are_those_of_opencv(count: int, tmp_path: Path) -> None:
    values = (-0.2, 0.05, 0.001, -0.001, -0.01)[:count]
    lens, worst = loaded(
        tmp_path,
        str(
            {
                'lensmodel': f'LENSMODEL_OPENCV{count}' if count else 'LENSMODEL_PINHOLE',
                'imagersize': [640, 480],
                'intrinsics': [300, 310, 320, 240, *values],
            }
        ),
    )
    matrix = np.array([[300, 0, 320], [0, 310, 240], [0, 0, 1.0]])
    right = cv2.projectPoints(SEEN, np.zeros(3), np.zeros(3), matrix, np.array(values))[0]
    assert worst == 0.0
    np.testing.assert_allclose(project_corrected(lens, SEEN).uv, right[:, 0], rtol=0, atol=1e-9)
