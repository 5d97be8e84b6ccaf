"""Lenses of other tools: their documented files are read, ours come back from each form."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from helpers.commands import convert_lens
from helpers.data import DATA, NO_DATA
from helpers.lenses import FRONT, SHORT

from fisheye_svp_ros import cli
from fisheye_svp_ros.commands.lenses import load_lenses
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.lens_files import cameras_in, load_lens, read_lens_file, save_lens
from fisheye_svp_ros.io.lens_formats import READERS_TO_90_DEG, WRITABLE, write_foreign
from fisheye_svp_ros.io.rig_files import load_cameras, load_rig, save_rig
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.nodes.solver import lenses_of as of_rig
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.optics.curves import (
    Equidistant,
    FlatPort,
    Gennery,
    KannalaBrandt,
    Stereographic,
)
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, quaternion_from_rotation, rotation_from_vector
from fisheye_svp_ros.study.settings import SolverSettings

# The example of Kalibr's wiki (yaml-formats), its second camera made one with fisheye lenses
CAMCHAIN = """
cam0:
  camera_model: pinhole
  intrinsics: [190.978477, 190.973307, 254.931706, 256.897442]
  distortion_model: equidistant
  distortion_coeffs: [0.0034823894, 0.0007150348, -0.0020532361, 0.00020293673]
  resolution: [512, 512]
  rostopic: /cam0/image_raw
cam1:
  camera_model: omni
  intrinsics: [0.80065662, 833.006, 830.345, 373.850, 253.749]
  distortion_model: radtan
  distortion_coeffs: [-0.33518750, 0.13211436, 0.0, 0.0]
  T_cn_cnm1:
  - [ 0.99998854, 0.00216014, 0.00427195,-0.11003785]
  - [-0.00221074, 0.99992702, 0.01187697, 0.00045792]
  - [-0.00424598,-0.01188627, 0.99992034,-0.00064487]
  - [0.0, 0.0, 0.0, 1.0]
  resolution: [752, 480]
  rostopic: /cam1/image_raw
cam2:
  camera_model: ds
  intrinsics: [-0.2, 0.59, 158.0, 158.0, 255.0, 257.0]
  distortion_model: none
  distortion_coeffs: []
  resolution: [512, 512]
"""


def directions(lens: Lens, distance: float = 3.0) -> np.ndarray:
    theta = np.linspace(0.01, 0.97 * lens.max_incidence, 40)
    azimuth = np.linspace(0, 6, 40)
    sin = np.sin(theta)
    return distance * np.stack(
        [sin * np.cos(azimuth), sin * np.sin(azimuth), np.cos(theta)], axis=-1
    )


@pytest.mark.parametrize('form', [form for form in WRITABLE if form != 'mrcal'])
@pytest.mark.parametrize('shift', [None, SHORT.viewpoint_shift])
def test_round_trip(form: str, shift: Gennery | None, tmp_path: Path) -> None:
    path = tmp_path / 'lens.txt'
    path.write_text(write_foreign(replace(FRONT, viewpoint_shift=shift), form))
    back = load_lens(path)
    points = directions(FRONT)
    assert np.abs(project(back, points).uv - project(FRONT, points).uv).max() < 1e-6
    assert (back.width, back.height) == (848, 800)


def test_round_trip_of_cahvore_keeps_the_shift(tmp_path: Path) -> None:
    path = tmp_path / 'lens.cameramodel'
    path.write_text(write_foreign(SHORT, 'mrcal'))
    back = load_lens(path)
    assert back.viewpoint_shift == SHORT.viewpoint_shift
    points = directions(SHORT, 0.2)
    assert np.abs(project(back, points).uv - project(SHORT, points).uv).max() < 1e-6


def test_cahvore_is_written_with_its_loss(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bent = replace(SHORT, image_height=KannalaBrandt(-0.012, 0.0041, -0.0022, 0.00031))
    port = replace(bent, viewpoint_shift=FlatPort(0.005, 1.5), max_incidence=1.4)
    for lens, left_out in ((bent, False), (port, True)):
        given, path = tmp_path / 'lens.yaml', tmp_path / 'lens.cameramodel'
        save_lens(lens, given)
        assert cli.main(['lens', str(given), '-o', str(path), '--format', 'mrcal']) == 0
        said = capsys.readouterr().out
        assert ('left out: the viewpoint shift' in said) == left_out
        back, points = load_lens(path), directions(lens, 2.0)
        uv = project(lens, points).uv
        off = np.linalg.norm(project(back, points).uv - uv, axis=-1)
        inside = ((uv > 0) & (uv < (lens.width, lens.height))).all(axis=-1)
        rows = re.findall(r'^ *\d+((?: +[\d.]+){4}) *$', said, re.MULTILINE)
        told = max(float(row.split()[-1]) for row in rows)
        assert 0.005 < told <= 1.01 * off[inside].max() < 1.0
        assert load_lens(path).viewpoint_shift == (None if left_out else lens.viewpoint_shift)


@pytest.mark.parametrize(('fx', 'degrees'), [(410.0, 95.0), (250.0, 108.0)])
def test_the_loss_is_that_of_the_image(
    fx: float, degrees: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A splined model was said to be 129 px off, beyond the image."""
    lens = Lens(
        'wide',
        1280,
        960,
        fx,
        fx,
        651.2,
        470.7,
        KannalaBrandt(-0.012, 0.0041, -0.0022, 0.00031),
        np.radians(degrees),
    )
    save_lens(lens, tmp_path / 'lens.yaml')
    words = ['lens', str(tmp_path / 'lens.yaml'), '-o', str(tmp_path / 'out'), '--format']
    assert cli.main([*words, 'mrcal']) == 0
    said = capsys.readouterr()
    rows = re.findall(r'^ *\d+((?: +[\d.]+){4}) *$', said.out, re.MULTILINE)
    assert all(float(cell) < 0.01 for row in rows for cell in row.split())
    assert 'beyond 90 deg' not in said.err
    # Pixels beyond 90 degrees, counted
    down, across = np.mgrid[0.0:960.0, 0.0:1280.0][:, ::3, ::3]
    theta = lens.image_height.value_and_slope(np.linspace(0, lens.max_incidence, 5))[0]
    radius = np.hypot(across - lens.cx, down - lens.cy) / fx
    flat = lens.image_height.value_and_slope(np.array([np.pi / 2]))[0][0]
    share = 100 * np.mean(radius[radius < theta[-1]] > flat)
    for form in READERS_TO_90_DEG:
        assert cli.main([*words, form]) == 0
        found = re.search(
            r'note: ([\d.]+) % of the image .* beyond 90 deg', capsys.readouterr().err
        )
        assert found and float(found[1]) == pytest.approx(share, rel=0.1)
    assert cli.main([*words, 'basalt']) == 0
    assert 'beyond 90 deg' not in capsys.readouterr().err


def test_a_curve_that_cahvore_does_not_hold_is_a_splined_model(tmp_path: Path) -> None:
    """A calibrated Kannala-Brandt lens was refused for a viewpoint shift that it has not."""
    path, points = tmp_path / 'lens.cameramodel', directions(FRONT)
    path.write_text(write_foreign(FRONT, 'mrcal'))
    assert 'SPLINED_STEREOGRAPHIC' in path.read_text()
    there = project(load_lens(path), points)
    assert np.abs(there.uv - project(FRONT, points).uv)[there.valid].max() < 0.01
    assert there.valid.mean() > 0.9


@pytest.mark.parametrize('linearity', ['0.37', '-0.5', '0'])
def test_cahvore_of_any_linearity(linearity: str, tmp_path: Path) -> None:
    """Against the projection as Gennery writes it, solved by bisection."""
    path = tmp_path / 'x.cameramodel'
    r, e = [0.01, -0.02, 0.003], [0.004, 0.001, 0.0]
    path.write_text(
        repr(
            {
                'lensmodel': f'LENSMODEL_CAHVORE_linearity={linearity}',
                'imagersize': [800, 800],
                'intrinsics': [300.0, 300.0, 400.0, 400.0, 0, 0, *r, *e],
                'extrinsics': [0] * 6,
            }
        )
    )
    lens, value = load_lens(path), float(linearity)
    worst = next(iter(read_lens_file(path).worst_px.values()))
    for z, radius in ((0.3, 0.1), (0.2, 0.2), (0.1, 0.3)):
        low, high = 0.0, 2.0
        for _ in range(80):
            t = (low + high) / 2
            growth = (t - np.sin(t)) * (e[0] + e[1] * t**2 + e[2] * t**4)
            low, high = (t, high) if z * np.sin(t) - radius * np.cos(t) - growth < 0 else (low, t)
        c = np.tan(value * t) / value if value > 0 else np.sin(value * t) / value if value else t
        u = 400 + 300 * c * (1 + r[0] + r[1] * c**2 + r[2] * c**4)
        found = project(lens, np.array([radius, 0.0, z])).uv[0]
        assert found == pytest.approx(u, abs=worst + 1e-6)


def test_kalibr(tmp_path: Path) -> None:
    path = tmp_path / 'camchain.yaml'
    path.write_text(CAMCHAIN)
    lens = load_lens(path)
    assert lens.parameters['k3'] == -0.0020532361
    foreign = read_lens_file(path)
    assert foreign.rigs[0].position == pytest.approx([-0.11003785, 0.00045792, -0.00064487])
    assert foreign.worst_px['cam0'] == 0
    omni = load_lens(f'{path}#cam1')
    points = directions(omni)
    unit = points / 3.0
    m = unit[:, :2] / (unit[:, 2:] + 0.80065662)
    z = (m**2).sum(axis=1, keepdims=True)
    uv = [833.006, 830.345] * m * (1 - 0.33518750 * z + 0.13211436 * z**2) + [373.850, 253.749]
    assert np.abs(project(omni, points).uv - uv).max() < foreign.worst_px['cam1'] + 1e-6 < 0.1
    sphere = load_lens(f'{path}#cam2')
    unit = directions(sphere) / 3.0
    z = unit[:, 2:] - 0.2
    depth = 0.59 * np.sqrt((unit[:, :2] ** 2).sum(1, keepdims=True) + z**2) + 0.41 * z
    uv = 158.0 * unit[:, :2] / depth + [255.0, 257.0]
    assert np.abs(project(sphere, unit).uv - uv).max() < foreign.worst_px['cam2'] + 1e-6 < 0.1
    with pytest.raises(LensError, match='no camera'):
        load_lens(f'{path}#cam7')


BASALT = json.dumps(
    {
        'value0': {
            'T_imu_cam': [
                {'px': place, 'py': 0, 'pz': 0, 'qx': 0, 'qy': 0, 'qz': 0, 'qw': 1}
                for place in (0.1, 0.3)
            ],
            'intrinsics': 2
            * [
                {
                    'camera_type': 'ds',
                    'intrinsics': {
                        'fx': 158.0,
                        'fy': 158.0,
                        'cx': 255.0,
                        'cy': 257.0,
                        'xi': -0.2,
                        'alpha': 0.59,
                    },
                }
            ],
            'resolution': [[512, 512], [512, 512]],
        }
    }
)


BOOFCV = """model: omnidirectional_universal
pinhole:
  width: 640
  height: 480
  fx: 300.0
  fy: 300.0
  cx: 320.0
  cy: 240.0
mirror_offset: 1.2
radial_tangential:
  radial: [-0.2, 0.05]
  t1: 0.0
"""


def test_opencv_xml_and_basalt(tmp_path: Path) -> None:
    import cv2

    path = tmp_path / 'fisheye.xml'
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write('K', np.array([[300.0, 0, 320], [0, 301.0, 240], [0, 0, 1]]))
    storage.write('D', np.array([[0.01], [0.002], [0.0], [-0.001]]))
    storage.write('image_width', 640)
    storage.write('image_height', 480)
    storage.release()
    lens = load_lens(path)
    assert (lens.fy, lens.cx, lens.parameters['k4']) == (301.0, 320.0, -0.001)
    json_path = tmp_path / 'calibration.json'
    json_path.write_text(BASALT)
    foreign = read_lens_file(json_path)
    assert list(foreign.lenses) == ['cam0', 'cam1']
    assert foreign.rigs[0].position == pytest.approx([-0.2, 0, 0])


def test_a_double_sphere_is_read_up_to_where_its_curve_turns_back(tmp_path: Path) -> None:
    path = tmp_path / 'wide.json'
    path.write_text(BASALT.replace('158.0', '80.0'))
    lens = load_lens(f'{path}#cam0')
    theta = np.linspace(0.5, 3.0, 10_000)
    z = np.cos(theta) - 0.2
    height = np.sin(theta) / (0.59 * np.hypot(np.sin(theta), z) + 0.41 * z)
    turns = theta[np.argmax(np.diff(height) < 0)]
    assert lens.max_incidence == pytest.approx(turns, abs=0.02)


def test_boofcv() -> None:
    path = DATA / 'photos' / 'chessboard' / 'fisheye.yaml'
    if not path.exists():
        pytest.skip(NO_DATA)
    lens = load_lens(path)
    assert (lens.width, lens.height) == (640, 720)
    assert 80 < np.degrees(lens.max_incidence) < 120
    assert next(iter(read_lens_file(path).worst_px.values())) < 0.5


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        (CAMCHAIN.replace('equidistant', 'fov'), 'cam0: distortion_coeffs has 4 numbers, not 1'),
        (CAMCHAIN.replace('resolution: [512, 512]', 'resolution: 512', 1), 'cam0: resolution'),
        (CAMCHAIN.replace('omni', 'omega'), "cam1: camera_model is 'omega'"),
        ('%YAML:1.0\n---\nimage_width: 3\nimage_height: 3\n', 'it has none of'),
        ('<opencv_storage><K>' + '<a>' * 100_000, 'not a whole OpenCV file'),
        (
            '<opencv_storage>' + '<a>' * 100_000 + '</a>' * 100_000 + '</opencv_storage>',
            'it has none of',
        ),
        (
            '<!DOCTYPE a [<!ENTITY b "c">]><opencv_storage></opencv_storage>',
            'document types are not read',
        ),
        ('%YAML:1.0\n---\na: ' + '[' * 100_000, 'nested deeper|nesting depth'),
        (
            '<opencv_storage><K>3</K><D>3</D><width>4</width><height>4.5</height>'
            '</opencv_storage>',
            'a 3 x 3 matrix',
        ),
        (CAMCHAIN.replace('[512, 512]', '[512, 512.5]', 1), 'whole numbers are needed'),
        (CAMCHAIN.replace('158.0', '0', 1), 'no valid numbers'),
        (CAMCHAIN.replace('camera_model: ds', 'camera_model: [ds]'), r'camera_model is'),
        (CAMCHAIN.replace('0.00020293673', '1e300'), 'must be a list of 4 finite numbers'),
        (
            CAMCHAIN.replace(
                'T_cn_cnm1:\n  - [ 0.99998854, 0.00216014, 0.00427195,-0.11003785]',
                'T_cn_cnm1:\n  - [{}, 0.00216014, 0.00427195,-0.11003785]',
            ),
            'T_cn_cnm1 must be a matrix of 4 x 4',
        ),
        (CAMCHAIN + 'cam2: {}\n', "the key 'cam2' a second time"),
        (
            CAMCHAIN
            + CAMCHAIN[CAMCHAIN.index('cam1') : CAMCHAIN.index('cam2')].replace('cam1', 'cam3', 1),
            'cam2 has no T_cn_cnm1, and cam3 after it has one',
        ),
        ('{"camera_type": 1}', 'intrinsics is None; a list of mappings is needed'),
        (BASALT.replace('"xi"', '"x"', 1), 'camera 0: xi is None; a finite number is needed'),
        (BASALT.replace('"ds"', '"kb4"'), 'camera 0: k1 is None; a finite number is needed'),
        (
            BASALT.replace('[512, 512], ', '', 1),
            'a list of width and height of each of the 2 cameras',
        ),
        (BASALT.replace('[512, 512], ', '512, ', 1), 'camera 0: resolution must be a list of 2'),
        (BASALT.replace('"qw"', '"w"', 1), 'T_imu_cam 0: qw is None'),
        (BOOFCV.replace('mirror_offset: 1.2\n', ''), 'mirror_offset is None; a finite number'),
        (BOOFCV.replace('fx: 300.0', ''), 'pinhole: fx is None; a finite number is needed'),
        (BOOFCV.replace('[-0.2, 0.05]', '0.1'), 'radial_tangential: radial must be a list of 2'),
        ('{"camera_type": ' + '[' * 100_000, 'broken JSON'),
        ("{'lensmodel': 'LENSMODEL_CAHVORE', 'a': " + '(' * 5000, 'not a whole .cameramodel'),
        ("'LENSMODEL_CAHVORE'" + '-1' * 120_000, 'more than 100000 values'),
        (
            "{'lensmodel': 'LENSMODEL_CAHVORE_linearity=0...37', 'intrinsics': "
            + str([1.0] * 12)
            + ", 'imagersize': [2, 2]}",
            'can be read',
        ),
        (
            "{'lensmodel': 'LENSMODEL_CAHVORE_linearity=0', 'intrinsics': "
            + str([1.0] * 11)
            + ", 'imagersize': [2, 2]}",
            'has 11 values; LENSMODEL_CAHVORE_linearity=0 needs 12',
        ),
        (
            "{'lensmodel': 'LENSMODEL_OPENCV8', 'intrinsics': [1], 'imagersize': [2, 2]}",
            'intrinsics has 1 values; LENSMODEL_OPENCV8 needs 12',
        ),
        (
            "{'lensmodel': 'LENSMODEL_STEREOGRAPHIC', 'intrinsics': [1, 1, 1, 1], "
            "'imagersize': [2]}",
            'size, fx, fy, cx or cy are incomplete',
        ),
        ("{'lensmodel': 'LENSMODEL_CAHVORE", 'not a whole .cameramodel'),
        (
            'camera_matrix: {data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}\ndistortion_model: scara\n'
            'image_width: 4\nimage_height: 4\ndistortion_coefficients: {data: [0.1]}\n',
            "distortion_model is 'scara'",
        ),
    ],
    ids=lambda text: text[:30],
)
def test_refused_in_one_line(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / 'lens.yaml'
    path.write_text(text)
    with pytest.raises(LensError, match=said.replace('(', r'\(')) as error:
        load_lens(path)
    assert '\n' not in str(error.value)
    assert str(path) in str(error.value)


def test_cameras_of_a_chain_are_in_the_order_of_their_numbers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    chain = {}
    for number in range(11):
        matrix = np.eye(4)
        matrix[0, 3] = number
        camera = yaml.safe_load(CAMCHAIN)['cam1']
        chain[f'cam{number}'] = {**camera, 'T_cn_cnm1': matrix.tolist()}
    path, out = tmp_path / 'camchain.yaml', tmp_path / 'out.yaml'
    path.write_text(yaml.safe_dump(chain, sort_keys=True))
    foreign = read_lens_file(path)
    assert [*foreign.lenses] == [f'cam{number}' for number in range(11)]
    assert [rig.position[0] for rig in foreign.rigs] == [*range(1, 11)]
    assert cli.main(['lens', f'{path}#cam9', '-o', str(out)]) == 0
    assert capsys.readouterr().err == ''
    assert cli.main(['lens', str(path), '-o', str(out)]) == 0
    assert capsys.readouterr().err == (
        f'fisheye-svp: note: {path}: it holds {", ".join(foreign.lenses)}; the first is shown '
        f'and only cam0 is written; use {path}#cam1 for another, or --format kalibr or basalt for '
        'the rig\n'
    )


def test_the_folder_of_a_rig_is_its_lenses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As `calibrate` writes it, and as `diagnose` does."""
    for name in ('{}.yaml', '{}/extended_lens.yaml'):
        folder = tmp_path / name[-9:]
        for camera in ('left', 'right'):
            path = folder / name.format(camera)
            path.parent.mkdir(parents=True, exist_ok=True)
            save_lens(replace(FRONT, name=camera), path)
            assert cameras_in(folder) == (() if camera == 'left' else ('left', 'right'))
        save_rig(Pose(np.eye(3), np.ones(3)), folder / 'rig.yaml', ('left', 'right'))
        assert cameras_in(folder) == ('left', 'right')
        assert load_lens(lens_path(f'{folder}#right')).name == 'right'
        assert [*load_lenses([str(folder)]).names] == ['left', 'right']
        of_node = SolverSettings(lens=str(folder))
        assert [lens.name for lens in of_rig(of_node, ('left/', 'right/')).values()] == [
            'left',
            'right',
        ]
        with pytest.raises(LensError, match="no lens of camera 'top' in it; there are left, rig"):
            load_lens(f'{folder}#top')
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'empty').mkdir()
    (tmp_path / 'fish180').mkdir()  # hides no lens of the package
    assert load_lens(lens_path('fish180')).name == 'fish180'
    with pytest.raises(LensError, match=r"'empty' is a folder, .* write empty/ for the folder"):
        lens_path('empty')
    with pytest.raises(LensError, match='empty: a folder without lenses'):
        load_lens(lens_path(str(tmp_path / 'empty')))


def test_the_folder_of_one_camera_is_its_lens(tmp_path: Path) -> None:
    """As `diagnose` writes it."""
    save_lens(FRONT, tmp_path / 'diagnosis' / 'extended_lens.yaml')
    assert load_lens(lens_path(f'{tmp_path}/diagnosis/')).name == FRONT.name


ECHO = """\
header:
  stamp: {sec: 1, nanosec: 2}
  frame_id: fisheye
height: 480
width: 640
distortion_model: equidistant
d:
- -0.012
- 0.002
- 0.0
- 0.0
k: [193.0, 0.0, 322.3, 0.0, 194.0, 237.1, 0.0, 0.0, 1.0]
binning_x: 0
binning_y: 0
roi: {x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}
---
"""


def test_a_camera_info_as_it_is_echoed(tmp_path: Path) -> None:
    path = tmp_path / 'info.yaml'
    for text in (ECHO, 2 * ECHO, ECHO.replace('\nk:', '\nK:').replace('\nd:', '\nD:')):
        path.write_text(text)
        lens = load_lens(path)
        assert (lens.name, lens.width, lens.fx, lens.fy, lens.cy) == (
            'fisheye',
            640,
            193.0,
            194.0,
            237.1,
        )
        assert lens.parameters['k1'] == -0.012
    for given, wrong, said in (
        ('k: [193.0', 'k: [0.0', 'not calibrated'),
        ('width: 640', 'size: 640', 'not a whole camera_info'),
        ('k: [193.0, ', 'k: [', 'k must be a list of 9'),
    ):
        path.write_text(ECHO.replace(given, wrong))
        with pytest.raises(LensError, match=f'info.yaml: .*{said}'):
            load_lens(path)


def test_a_camera_info_without_its_model_says_what_to_write(tmp_path: Path) -> None:
    path = tmp_path / 'info.yaml'
    text = yaml.safe_load(write_foreign(FRONT, 'ros'))
    del text['distortion_model']
    path.write_text(yaml.safe_dump(text))
    with pytest.raises(LensError, match=r'distortion_model is missing; .* equidistant$'):
        load_lens(path)
    path.write_text(yaml.safe_dump({**text, 'camera_model': 'fisheye'}))
    with pytest.raises(
        LensError,
        match=r'info.yaml: distortion_model is missing; .* '
        r'equidistant in place of camera_model: fisheye$',
    ):
        load_lens(path)


def test_curves_that_a_form_cannot_say() -> None:
    bare = replace(FRONT, image_height=Equidistant())
    assert yaml.safe_load(write_foreign(bare, 'kalibr'))['cam0']['distortion_coeffs'] == (
        pytest.approx([0, 0, 0, 0], abs=1e-9)
    )
    with pytest.raises(LensError, match='px from any'):
        write_foreign(
            replace(
                bare,
                image_height=Stereographic(),
                max_incidence=2.7,
                width=9000,
                height=9000,
                cx=4500.0,
                cy=4500.0,
            ),
            'ros',
        )


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    convert_lens(SHORT, tmp_path, 'ros.yaml', 'ros')
    said = capsys.readouterr().out
    assert 'left out: the viewpoint shift\n' in said
    assert '0.1 m' in said
    assert cli.main(['lens', str(tmp_path / 'ros.yaml'), '-o', str(tmp_path / 'back.yaml')]) == 0
    assert load_lens(tmp_path / 'back.yaml').viewpoint_shift is None
    assert cli.main(['lens', str(tmp_path / 'lens.yaml'), '--format', 'ros']) == 2
    assert '-o FILE' in capsys.readouterr().err


def test_command_says_how_much_is_lost_with_corrections(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tilted = replace(
        FRONT,
        viewpoint_shift=None,
        image_height=Equidistant(),
        fx=400.0,
        fy=400.0,
        corrections={'sensor_tilt': {'parameters': {'about_x': 0.002, 'about_y': 0.0}}},
        target={'landmarks': [[0, 0, 0.0, 0.0, 0.0]]},
    )
    convert_lens(tilted, tmp_path, 'kalibr.yaml', 'kalibr')
    said = capsys.readouterr().out
    assert 'left out: sensor_tilt\n' in said
    off = f'{400 * 0.002 * np.radians(40) ** 2:.3f}'
    assert re.search(rf'^ *40 +{off} +{off} +{off} +{off} *$', said, re.MULTILINE)


def test_command_shows_the_rig_of_calibrate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_rig(RIG, tmp_path / 'rig.yaml')
    assert cli.main(['lens', str(tmp_path / 'rig.yaml')]) == 0
    assert 'camera 0 in camera 1 at -150.000, 10.000, 2.000 mm' in capsys.readouterr().out
    assert cli.main(['localize', 'none.csv', '--lens', str(tmp_path / 'rig.yaml')]) == 2
    assert 'rig.yaml: it holds a rig, but no lens' in capsys.readouterr().err


def test_command_shows_and_writes_all_cameras_of_a_rig(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = 'left', 'front', 'right'
    for name in names:
        save_lens(replace(FRONT, name=name), tmp_path / 'rig' / f'{name}.yaml')
    save_rig([RIG, RIG.inverse()], tmp_path / 'rig' / 'rig.yaml', names)
    out = tmp_path / 'out.yaml'
    assert cli.main(['lens', str(tmp_path / 'rig' / 'rig.yaml'), '-o', str(out)]) == 0
    shown = capsys.readouterr().out
    assert 'camera 0 in camera 1 at -150.000, 10.000, 2.000 mm\n  camera 1 in camera 2' in shown
    cameras, places = load_cameras(out)
    assert cameras == names
    assert np.abs(places.position[2]).max() < 1e-12 < np.abs(places.position[1]).max()
    assert cli.main(['lens', f'{tmp_path}/rig/']) == 0
    said = capsys.readouterr()
    assert said.out.endswith(shown)
    other = said.err.split('use ')[1].split(' for another')[0]
    assert other == f'{tmp_path}/rig/#left'
    assert cli.main(['lens', other]) == 0
    assert capsys.readouterr().out.startswith('left: 848x800 px')


RIG = Pose(rotation_from_vector(np.array([0.02, -0.3, 0.1])), np.array([-0.15, 0.01, 0.002]))
# How the optical frames of RIG hang on a robot: urdf says xyz and roll, pitch, yaw
URDF = """<?xml version="1.0"?>
<robot name="head"><link name="base"/>
<joint name="mount" type="fixed"><parent link="base"/><child link="left_camera"/>
  <origin xyz="0.1 0.2 0.3" rpy="0.1 -0.2 0.7"/></joint>
<joint name="optics" type="fixed"><parent link="left_camera"/><child link="left_optical_frame"/>
  <origin rpy="-1.5707963267948966 0 -1.5707963267948966"/></joint>
<joint name="other" type="fixed"><parent link="left_optical_frame"/>
  <child link="right_optical_frame"/><origin xyz="{}" rpy="{}"/></joint>
</robot>
"""


def of_opencv(folder: Path, suffix: str, shape: tuple[int, int] = (3, 1)) -> Path:
    path = folder / f'stereo{suffix}'
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write('image_width', 848)
    storage.write('image_height', 800)
    for number, lens in ((1, FRONT), (2, SHORT)):
        storage.write(
            f'K{number}', np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
        )
        storage.write(f'D{number}', np.array([lens.image_height.coefficients[:4]]).T)
    storage.write('R', RIG.rotation)
    storage.write('T', RIG.position.reshape(shape))
    storage.release()
    return path


def of_opencv_in_a_row(folder: Path, suffix: str) -> Path:
    return of_opencv(folder, suffix, (1, 3))


def of_urdf(folder: Path, suffix: str) -> Path:
    right = RIG.inverse()
    m = right.rotation
    angles = (np.arctan2(m[2, 1], m[2, 2]), -np.arcsin(m[2, 0]), np.arctan2(m[1, 0], m[0, 0]))
    path = folder / f'robot{suffix}'
    path.write_text(
        URDF.format(
            *(' '.join(f'{value:.15g}' for value in values) for values in (right.position, angles))
        )
    )
    return path


def of_tf(folder: Path, suffix: str) -> Path:
    q = quaternion_from_rotation(RIG.rotation).tolist()
    entry = {
        'header': {'frame_id': 'right_camera_optical_frame'},
        'child_frame_id': 'left_camera_optical_frame',
        'transform': {
            'translation': dict(zip('xyz', RIG.position.tolist(), strict=True)),
            'rotation': dict(zip('xyzw', q, strict=True)),
        },
    }
    path = folder / f'tf_static{suffix}'
    path.write_text(yaml.safe_dump({'transforms': [entry]}) + '---\n')
    return path


def of_ours(folder: Path, suffix: str) -> Path:
    save_rig(RIG, folder / f'rig{suffix}')
    return folder / f'rig{suffix}'


@pytest.mark.parametrize(
    ('write', 'suffix'),
    [
        (of_opencv, '.yml'),
        (of_opencv, '.xml'),
        (of_opencv, '.json'),
        (of_opencv_in_a_row, '.yml'),
        (of_urdf, '.urdf'),
        (of_tf, '.yaml'),
        (of_ours, '.yaml'),
    ],
)
def test_rigs(tmp_path: Path, write: Callable[[Path, str], Path], suffix: str) -> None:
    rig = load_rig(write(tmp_path, suffix))
    assert np.abs(rig.position - RIG.position).max() < 1e-12
    assert np.abs(rig.rotation - RIG.rotation).max() < 1e-12


@pytest.mark.parametrize(
    'end', ['<parent link="left_optical_frame"/>', '<child link="right_optical_frame"/>']
)
def test_a_joint_without_an_end_leads_nowhere(tmp_path: Path, end: str) -> None:
    path = tmp_path / 'robot.urdf'
    path.write_text(
        of_urdf(tmp_path, '.xml')
        .read_text()
        .replace('</robot>', '<joint name="loose" type="fixed">' + end + '</joint></robot>')
    )
    assert np.abs(load_rig(path).position - RIG.position).max() < 1e-12


def test_both_lenses_of_a_rig_of_opencv(tmp_path: Path) -> None:
    path = of_opencv(tmp_path, '.yml')
    assert load_lens(path).image_height == FRONT.image_height
    assert load_lens(f'{path}#right').image_height.coefficients[:2] == (-0.011, 0.0041)


def test_a_robot_is_shown_and_is_no_lens(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    path = of_urdf(tmp_path, '.urdf')
    cli.main(['lens', str(path), '-o', str(tmp_path / 'rig.yaml')])
    assert 'camera 0 in camera 1 at -150.000, 10.000, 2.000 mm' in capsys.readouterr().out
    assert np.abs(load_rig(tmp_path / 'rig.yaml').position - RIG.position).max() < 1e-12
    with pytest.raises(LensError, match='holds a rig, but no lens'):
        load_lens(path)


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        ('<robot name="a"></robot>', 'no fixed transforms'),
        ('<robot', 'not a whole URDF'),
        (URDF.format('0 0', '0 0 0'), 'finite numbers'),
        (URDF.format('0 0 0', '0 0 0').replace('right_optical', 'rear_optical'), 'called right'),
        ('child_frame_id: a\ntranslation: 1\n', 'not a whole transform'),
        ('left_in_right: {position: [0, 0], quaternion: [0, 0, 0, 1]}', 'position must be'),
        ('left_in_right: {position: [0, 0, 0], quaternion: [0, 0, 0, 0]}', 'unit length'),
        (CAMCHAIN.replace('0.99998854', '1.99998854'), 'cam1: T_cn_cnm1: .* rotation matrix'),
        (BASALT.replace('"qw": 1', '"qw": 0'), 'T_imu_cam: .* unit length'),
        (BASALT.replace('"px": 0.1', '"px": NaN'), 'T_imu_cam 0: px is nan'),
        ('name: lens', 'left_in_right'),
    ],
)
def test_what_is_no_rig_is_refused(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / 'rig').write_text(text)
    with pytest.raises(LensError, match=said) as error:
        load_rig(tmp_path / 'rig')
    assert '\n' not in str(error.value)
