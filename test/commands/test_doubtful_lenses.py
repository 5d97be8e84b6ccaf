"""What a lens file, or a robot, says of itself that cannot be is told in a note."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.commands import refused

from fisheye_svp_ros.cli import main
from fisheye_svp_ros.io.lens_files import load_lens, save_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.reporting.wording.calibration import hand_eye_warnings
from fisheye_svp_ros.solve.lens_checks import probable_size

LENS = load_lens(lens_path('fish180')).svp()
OPENCV = """%YAML:1.0
image_width: 1200
image_height: 900
fisheye_model: 1
camera_matrix: !!opencv-matrix {{rows: 3, cols: 3, dt: d,
  data: [{f}, 0., 599.5, 0., {f}, 449.5, 0., 0., 1.]}}
distortion_coefficients: !!opencv-matrix {{rows: 4, cols: 1, dt: d, data: [{k}, 0., 0., 0.]}}
avg_reprojection_error: {error}
"""


@pytest.mark.parametrize('part', [0.25, 0.5, 0.7, 1.4])
def test_a_lens_of_another_image_size_is_told(
    part: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    width, height = round(LENS.width / part), round(LENS.height / part)
    save_lens(replace(LENS, width=width, height=height), tmp_path / 'l.yaml')
    assert main(['lens', str(tmp_path / 'l.yaml')]) == 0
    told = re.search(r'would be the center of (\d+)x(\d+) px', capsys.readouterr().err)
    assert told is not None
    assert [int(size) for size in told.groups()] == pytest.approx([LENS.width, LENS.height], abs=2)


def test_a_center_that_is_that_of_no_image_has_no_size() -> None:
    assert probable_size(LENS) is None
    assert probable_size(replace(LENS, cx=0.3 * LENS.width)) is None


@pytest.mark.parametrize(
    ('f', 'k', 'error', 'told'),
    [
        (1200 / np.pi, 0.0, 173.0, 'the file states 173 px, f = width / pi'),
        (1200 / np.pi, 0.0, 0.3, "f = width / pi without distortion is OpenCV's start value"),
        (400.0, 0.01, 30.0, 'the file states 30 px: this fit failed'),
        (400.0, 0.01, 0.3, ''),
        (1200 / np.pi, 0.0, '', "f = width / pi without distortion is OpenCV's start value"),
        (
            1200 / np.pi,
            0.0,
            'unknown',
            "f = width / pi without distortion is OpenCV's start value",
        ),
        (400.0, 0.01, '', ''),
    ],
)
def test_a_calibration_that_failed_is_told(
    f: float, k: float, error: float | str, told: str, tmp_path: Path, capsys: Any
) -> None:
    text = OPENCV.format(f=f, k=k, error=error)
    (tmp_path / 'l.yml').write_text(text if error else text.partition('avg_')[0])
    assert main(['lens', str(tmp_path / 'l.yml')]) == 0
    said = capsys.readouterr().err
    assert told in said and ('this fit failed' in said) is bool(told)


@pytest.mark.parametrize(
    ('values', 'told'),
    [
        ({'scale': 1.14}, ['+14.0 % off .* would have to be 21.9 mm']),
        ({'scale': 0.95}, ['-5.0 % off .* would have to be 26.3 mm']),
        ({'scale': 1.01}, []),
        ({'scale': 1.14, 'stderr': [0.1]}, []),
        ({'noise_m': 4.2e-3}, ['noise of the robot is 4.2 mm']),
        ({'noise_rad': np.radians(0.4)}, ['noise of the robot is 0.1 mm and 0.4 deg']),
    ],
)
def test_lengths_and_noise_of_a_robot(values: dict[str, Any], told: list[str]) -> None:
    robot: Any = SimpleNamespace(
        **{
            'scale': 1.0,
            'stderr': [0.004],
            'noise_m': 1e-4,
            'noise_rad': 1e-4,
            'fixed_camera': False,
            **values,
        }
    )
    robot.residual = np.full((8, 6), 1e-5)
    warnings = hand_eye_warnings(robot)
    assert len(warnings) == len(told)
    assert all(re.search(one.replace('+', r'\+'), warnings[0]) for one in told)


@pytest.mark.parametrize('number', ['nan', '0', '-1'])
def test_a_range_that_is_none_is_refused_of_any_lens(
    number: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of a lens with a single viewpoint, it "changes nothing"."""
    save_lens(LENS, tmp_path / 'a.yaml')
    wanted = ('-o', tmp_path / 'b.yaml', '--format', 'ros', f'--range={number}')
    assert f'--range {number}: a distance in m, above 0' in refused(
        capsys, 'lens', tmp_path / 'a.yaml', *wanted
    )
