"""Lens files of others as they come: line ends, comments, several cameras, missing entries."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.lens_files import load_lens, read_lens_file

K4 = (0.031, -0.012, 0.002, -0.0003)
COLMAP = """\
# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
1 OPENCV_FISHEYE 1752 1168 600 600.5 876 584 0.031 -0.012 0.002 -0.0003
2 SIMPLE_FISHEYE 1752 1168 600 876 584
"""
# As Kimera has it
EUROC = """\
%YAML:1.0
camera_id: left_cam
T_BS: {cols: 4, rows: 4, data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}
resolution: [1752, 1168]
camera_model: pinhole
intrinsics: [600, 600.5, 875.5, 583.5] #fu, fv, cu, cv
distortion_model: equidistant
distortion_coefficients: [0.031, -0.012, 0.002, -0.0003]
"""
CAMERA = {
    'w': 1752,
    'h': 1168.0,
    'fl_x': 600,
    'fl_y': 600.5,
    'cx': 876,
    'cy': 584,
    **{f'k{i}': k for i, k in enumerate(K4, start=1)},
}
NERF = json.dumps(
    {
        'camera_model': 'OPENCV_FISHEYE',
        **CAMERA,
        'aabb_scale': 16,
        'frames': [{'file_path': 'a.png'}, {'file_path': 'b.png'}],
    },
    indent=2,
)
OPENCV = """\
%YAML:1.0
---
image_width: 1752
image_height: 1168
fisheye_model: 1
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 600., 0., 875.5, 0., 600.5, 583.5, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 4
   cols: 1
   dt: d
   data: [ 0.031, -0.012, 2.0000000000000000e-03, -0.0003 ]
"""
METASHAPE = """\
<?xml version="1.0" encoding="UTF-8"?>
<calibration>
  <projection>fisheye</projection>
  <width>1752</width>
  <height>1168</height>
  <f>600</f>
  <b1>0</b1>
  <k1>0.031</k1>
</calibration>
"""
INFO = """\
image_width: 1752
image_height: 1168
camera_name: front
camera_matrix: {rows: 3, cols: 3, data: [600, 0, 875.5, 0, 600.5, 583.5, 0, 0, 1]}
distortion_model: equidistant
distortion_coefficients: {rows: 1, cols: 4, data: [0.031, -0.012, 0.002, -0.0003]}
"""


@pytest.mark.parametrize(
    'text',
    [COLMAP, EUROC, NERF, OPENCV, INFO],
    ids=['colmap', 'euroc', 'nerfstudio', 'opencv', 'ros'],
)
@pytest.mark.parametrize('line_end', ['\n', '\r\n'], ids=['unix', 'windows'])
def test_line_ends_and_a_byte_order_mark(text: str, line_end: str, tmp_path: Path) -> None:
    path = tmp_path / 'lens'
    path.write_bytes(('\ufeff' + text).replace('\n', line_end).encode())
    lens = load_lens(path)
    assert (lens.width, lens.height) == (1752, 1168)
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == (600, 600.5, 875.5, 583.5)
    assert lens.image_height.coefficients == pytest.approx(K4)


def test_rows_of_colmap_with_comments_and_sizes_with_a_fraction(tmp_path: Path) -> None:
    path = tmp_path / 'cameras.txt'
    path.write_text(
        COLMAP.replace('-0.0003\n', '-0.0003  # front\n').replace('1752 1168', '1752.0 1168.0')
    )
    assert [*read_lens_file(path).lenses] == ['1', '2']
    assert load_lens(f'{path}#2').cx == 875.5


def test_frames_of_nerfstudio_with_lenses_of_their_own(tmp_path: Path) -> None:
    path = tmp_path / 'transforms.json'
    frames = [
        {**CAMERA, 'file_path': f'{name}.png', 'fl_x': focal}
        for name, focal in (('a', 600), ('b', 700), ('c', 600))
    ]
    path.write_text(json.dumps({'camera_model': 'OPENCV_FISHEYE', 'frames': frames}))
    lenses = read_lens_file(path).lenses
    assert {name: lens.fx for name, lens in lenses.items()} == {'camera1': 600, 'camera2': 700}
    path.write_text(json.dumps({'frames': [frames[0], {**frames[1], 'cx': None}]}))
    with pytest.raises(LensError, match='camera2: cx is None; a finite number is needed'):
        load_lens(path)


def test_four_coefficients_of_a_pinhole_are_no_fisheye(tmp_path: Path) -> None:
    path = tmp_path / 'pinhole.yml'
    path.write_text(
        OPENCV.replace('fisheye_model: 1', 'fisheye_model: 0').replace(
            '[ 0.031, -0.012, 2.0000000000000000e-03, -0.0003 ]', '[ 0., 0., 0., 0. ]'
        )
    )
    lens = load_lens(path)
    angle = np.arctan(500 / 600)
    assert lens.fx * lens.image_height.value_and_slope(np.array([angle]))[0] == pytest.approx(
        500, abs=1e-9
    )


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        (
            COLMAP.replace('0.031', 'O.031'),
            'camera 1: width, height and the parameters of '
            "OPENCV_FISHEYE must be numbers (could not convert string to float: 'O.031')",
        ),
        (COLMAP.replace('0.031', 'nan'), 'camera 1: k1 to k4 are (nan, '),
        (COLMAP.replace('1752 1168', '1752.5 1168'), 'the image size is 1752.5 x 1168.0; whole'),
        (METASHAPE.replace('<width>1752</width>', ''), ': width is None; a number is needed'),
        (METASHAPE.replace('<f>600<', '<f>600,5<'), ": f is '600,5'; a number is needed"),
        (METASHAPE.replace('<b1>0<', '<b1><'), ": b1 is ''; a number is needed"),
        (
            INFO.replace('image_height: 1168\n', ''),
            'not a whole camera_info; image_height is missing',
        ),
        (
            EUROC.replace('equidistant', 'radtan').replace('[0.031, ', '['),
            'distortion_coefficients has 3 numbers, not 4 or 5',
        ),
        (
            'Calibration results \n====\nCamera-system parameters:\ncam0 (/cam0/image_raw):\n'
            '    distortion: [0.1] +- [0.1]\n',
            "Kalibr's text of results (take its camchain YAML) cannot be read; readable are ",
        ),
        (
            '{"camera_angle_x": 0.69, "frames": []}',
            'a transforms.json without fl_x cannot be read',
        ),
        (
            'pinhole: {fx: 450, fy: 451}\nmodel: kannala_brandt\nsymmetric: [1.0]\n',
            'a BoofCV model other than omnidirectional_universal cannot be read',
        ),
        (
            'Camera:\n  name: "x"\n  setup: "monocular"\n  model: "fisheye"\n',
            'a configuration of stella_vslam cannot be read',
        ),
    ],
)
def test_what_is_missing_is_named(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / 'lens').write_text(text)
    with pytest.raises(LensError, match=re.escape(said)) as error:
        load_lens(tmp_path / 'lens')
    assert '\n' not in str(error.value)


def test_the_binary_form_of_colmap(tmp_path: Path) -> None:
    (tmp_path / 'cameras.bin').write_bytes(bytes([1, 0, 0, 0, 216, 6]))
    with pytest.raises(LensError, match=r'cameras\.bin: .* model_converter --output_type TXT'):
        load_lens(tmp_path / 'cameras.bin')
