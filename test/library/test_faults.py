"""What leaves the library: errors of its own, masks that count, results that come back."""

from __future__ import annotations

import json
import subprocess
import sys
import warnings
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.nodes import ROOT
from helpers.photographs import BOARD, LENS, poses, true_corners

import fisheye_svp_ros as fsvp
from fisheye_svp_ros.library.results import Diagnosed, Localized

POINTS = np.array([[0.1, 0.2, 1.0], [0.3, 0.1, 1.0], [0.0, 0.0, 1.0]])
CORNERS = true_corners(poses(4).take(0))
TABLE = fsvp.observations(*CORNERS.T, np.arange(30), BOARD)


def test_masks_count() -> None:
    hidden = np.ma.masked_array(POINTS, mask=[[0, 0, 0], [0, 1, 0], [0, 0, 0]])
    image = fsvp.project(LENS, hidden)
    assert image.valid.tolist() == [True, False, True] and np.isnan(image.uv[1]).all()
    rays = fsvp.back_project(
        LENS, np.ma.masked_equal(np.round(image.uv, 3), round(image.uv[2, 0], 3))
    )
    assert rays.valid.tolist() == [True, False, False]
    u = np.ma.masked_array(CORNERS[:, 0], mask=np.arange(30) == 7)
    number = np.ma.masked_array(np.arange(30), mask=np.arange(30) == 3)
    seen = fsvp.observations(u, CORNERS[:, 1], number, BOARD, frame=np.full(30, 5))
    assert seen.landmark.tolist() == [i for i in range(30) if i not in (3, 7)]
    assert set(seen.frame.tolist()) == {5}
    one = fsvp.observations(u[8:], CORNERS[8:, 1], np.arange(8, 30), BOARD)
    assert len(one) == 22


def test_a_lens_is_a_key() -> None:
    @lru_cache
    def field(lens: fsvp.Lens) -> float:
        return lens.max_incidence

    again = fsvp.load_lens('fish180')
    assert hash(again) == hash(fsvp.load_lens('fish180'))
    assert len({again, fsvp.load_lens('fish180'), fsvp.load_lens('fish214')}) == 2
    assert field(again) == again.max_incidence and len({LENS, LENS}) == 1
    assert len({TABLE, TABLE}) == 1


@pytest.mark.parametrize(
    ('rotation', 'position', 'said'),
    [
        (np.ones((3, 3)), np.zeros(3), 'det R = 1 are needed'),
        (np.eye(3), 0, r'not \(3, 3\) and \(\)'),
        (np.eye(3), np.zeros(4), r'not \(3, 3\) and \(4,\)'),
        (np.diag([1.0, 1.0, -1.0]), np.zeros(3), 'det R = 1 are needed'),
        (2 * np.eye(3), np.zeros(3), 'R RT = 1'),
        (np.eye(4)[:3], np.zeros(3), r'not \(3, 4\) and \(3,\)'),
    ],
)
def test_a_pose_is_a_rotation_and_a_position(rotation: Any, position: Any, said: str) -> None:
    with pytest.raises(fsvp.FisheyeSvpError, match=f'a pose (has|is not) .*{said}'):
        fsvp.Pose(rotation, position)


def test_a_pose_of_lists() -> None:
    pose = fsvp.Pose([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [1, 2, 3])
    assert pose.inverse().compose(pose).position.tolist() == [0, 0, 0]


@pytest.mark.parametrize(
    'call',
    [
        lambda: fsvp.localize(TABLE, [LENS]),
        lambda: fsvp.localize(TABLE, 'x' * 5000),
        lambda: fsvp.localize('x' * 5000, LENS),
        lambda: fsvp.budget('fish180', noise_px='0.3'),
        lambda: fsvp.budget('fish180', noise_px=None),
        lambda: fsvp.budget('fish180', baseline='wide'),
        lambda: fsvp.budget('fish180', style=3),
        lambda: fsvp.rig('parallel', 'x'),
        lambda: fsvp.rig(['parallel']),
        lambda: fsvp.render(LENS, BOARD, poses(1).take(0), seed='x'),
        lambda: fsvp.render(LENS, BOARD, poses(1).take(0), noise='x'),
        lambda: fsvp.calibrate(TABLE, ['equidistant'], (424, 400)),
        lambda: fsvp.calibrate(TABLE, 'equidistant', (424, 400), free=3),
        lambda: fsvp.calibrate(TABLE, 'equidistant', (424, 400), poses=3),
        lambda: fsvp.diagnose(TABLE, LENS, poses=3),
        lambda: fsvp.diagnose(TABLE, LENS, held_out=3),
        lambda: fsvp.stereo_depth(TABLE, LENS, {}, 'rig.yaml'),
        lambda: fsvp.undistort_maps(LENS, ['pinhole']),
        lambda: fsvp.undistort_maps(LENS, range_m='1'),
        lambda: fsvp.write_lens(LENS, '/dev/null/x', 'ros'),
        lambda: fsvp.write_lens(LENS, 'x', 3),
        lambda: fsvp.write_observations('x\0.csv', TABLE),
        lambda: fsvp.read_poses('x\0'),
        lambda: fsvp.load_rig('y' * 5000),
        lambda: fsvp.detect(3, BOARD),
        lambda: fsvp.detect('.', BOARD, every='a'),
        lambda: fsvp.plot_lens(3),
        lambda: fsvp.simulate_scenario(lens=3),
        lambda: fsvp.sweep({'radius': [{}]}),
        lambda: fsvp.calibrate_rig(TABLE, {'': 3}),
        lambda: fsvp.localize_rig(TABLE, {'': LENS}, 3),
    ],
)
def test_errors_are_those_of_the_package(call: Callable[[], object]) -> None:
    with pytest.raises(fsvp.FisheyeSvpError) as refusal:
        call()
    assert '\n' not in str(refusal.value)


def test_a_call_that_does_not_fit_is_a_type_error_as_ever() -> None:
    with pytest.raises(TypeError, match='missing a required argument'):
        fsvp.project(LENS)  # type: ignore[call-arg]


def test_what_is_not_finite_is_not_valid_and_no_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        image = fsvp.project(LENS, [[np.inf, 0, 1], [0, -np.inf, 1], [np.nan, 0, 1], [0, 0, 1]])
        rays = fsvp.back_project(LENS, [[np.inf, 0], [np.nan, 3], [212.0, 200.0]])
        fsvp.project('fish214', [[0, 0, np.inf], [1e300, 0, 1]])
    assert image.valid.tolist() == [False, False, False, True]
    assert rays.valid.tolist() == [False, False, True]


def test_results_are_what_comes_back(tmp_path: Path) -> None:
    seen = fsvp.simulate_scenario(
        lens='fish214', radius=0.5, noise_px=0.2, poses_file='calibration'
    )
    found = fsvp.diagnose(seen.observations, seen.lens.svp())
    found.save(tmp_path / 'found.json')
    assert Diagnosed.load(tmp_path / 'found.json').document == found.document
    assert json.loads(json.dumps(found.document)) == found.document
    localized = fsvp.localize(seen.observations, seen.lens)
    localized.save(tmp_path / 'localized.json')
    again = Localized.load(tmp_path / 'localized.json')
    assert (again.left_out, again.reasons) == (localized.left_out, localized.reasons)


def test_the_package_is_a_program() -> None:
    said = subprocess.run(
        [sys.executable, '-m', 'fisheye_svp_ros', '--version'],
        cwd=ROOT,
        check=True,
        text=True,
        capture_output=True,
    ).stdout
    assert said == f'fisheye-svp {fsvp.__version__}\n'
