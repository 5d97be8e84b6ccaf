"""What the library hands to other programs, and options that it shares with the command."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.lenses import FRONT, points_on_rays

import fisheye_svp_ros as fsvp
from fisheye_svp_ros.errors import ObservationError, ParameterError
from fisheye_svp_ros.optics.curve_base import ImageHeight
from fisheye_svp_ros.optics.curves import KannalaBrandt, Perspective
from fisheye_svp_ros.optics.pinhole import BrownConrady, RationalPolynomial, TangentialDistortion
from fisheye_svp_ros.simulate.render import Print
from fisheye_svp_ros.simulate.targets import board_views


def seen() -> fsvp.Observations:
    return fsvp.simulate_scenario(
        lens='fish180', environment='whole', radius=0.5, noise_px=0.2, poses_file='calibration'
    ).observations


def test_k_and_d_are_those_of_opencv() -> None:
    k, d = fsvp.opencv_matrices(FRONT)
    points = points_on_rays(FRONT, np.random.default_rng(0), 60, edge=0.8)
    none = np.zeros(3)
    expected = cv2.fisheye.projectPoints(points[:, None], none, none, k, d)[0][:, 0]
    ahead = points[:, 2] > 0
    np.testing.assert_allclose(fsvp.project(FRONT, points).uv[ahead], expected[ahead], atol=1e-6)


@pytest.mark.parametrize(
    ('curve', 'tangential', 'expected'),
    [
        (Perspective(), None, [0.0] * 5),
        (BrownConrady(-0.2, 0.05, -0.01), None, [-0.2, 0.05, 0.0, 0.0, -0.01]),
        (
            BrownConrady(-0.2),
            TangentialDistortion(p1=0.001, p2=-0.002),
            [-0.2, 0, 0.001, -0.002, 0],
        ),
        (
            RationalPolynomial(0.3, 0.1, 0.01, 0.4, 0.2, 0.02),
            None,
            [0.3, 0.1, 0.0, 0.0, 0.01, 0.4, 0.2, 0.02],
        ),
        (BrownConrady(-0.1), TangentialDistortion(s1=0.002), [-0.1, *[0.0] * 7, 0.002, 0, 0, 0]),
        (Perspective(), TangentialDistortion(tau_y=0.02), [*[0.0] * 13, 0.02]),
    ],
)
def test_pinhole_lenses_have_the_coefficients_of_opencv(
    curve: ImageHeight, tangential: TangentialDistortion | None, expected: list[float]
) -> None:
    lens = fsvp.Lens('p', 640, 480, 500.0, 501.0, 320.0, 241.0, curve, 0.6, tangential=tangential)
    k, d = fsvp.opencv_matrices(lens)
    assert d.tolist() == expected
    points = np.random.default_rng(0).uniform((-0.4, -0.3, 1.0), (0.4, 0.3, 1.0), (50, 3))
    told = cv2.projectPoints(points, np.zeros(3), np.zeros(3), k, d)[0][:, 0]
    np.testing.assert_allclose(fsvp.project(lens, points).uv, told, atol=1e-9)


def test_a_dataframe_is_written_as_a_table_that_is_read(tmp_path: Path) -> None:
    """Columns without a value were refused: "t is ''; a number is needed"."""
    one = replace(seen(), cameras=('left',), t=np.arange(len(seen())) / 10)
    for table in (one, seen()):
        table.to_dataframe().to_csv(tmp_path / 'table.csv', index=False)
        again = fsvp.read_observations(tmp_path / 'table.csv')
        for name in ('frame', 'landmark', 'uv', 'xyz', 'board', 't', 'sigma'):
            np.testing.assert_array_equal(getattr(again, name), getattr(table, name))
        assert again.cameras == table.cameras


def test_observations_are_a_dataframe(monkeypatch: pytest.MonkeyPatch) -> None:
    table = seen()
    frame = table.to_dataframe()
    assert [*frame] == ['frame', 'landmark', *'uv', *'xyz', 'board', 'sigma']
    np.testing.assert_array_equal(frame[['u', 'v']], table.uv)
    monkeypatch.setitem(sys.modules, 'pandas', None)
    with pytest.raises(ObservationError, match='needs pandas; pip install pandas'):
        table.to_dataframe()


@pytest.mark.parametrize(
    ('options', 'said'),
    [
        ({'with_': ['bent_light']}, 'bent_light'),
        ({'without': 'skew'}, 'without'),
        ({'with_': ['skew'], 'without': ['skew']}, "'skew' is in with_ and in without"),
    ],
)
def test_effects_that_cannot_be_are_refused(options: dict, said: str) -> None:
    with pytest.raises(ParameterError, match=said):
        fsvp.diagnose(seen(), 'fish180', **options)


def test_a_set_is_not_compared_with_itself() -> None:
    table = seen()
    with pytest.raises(ObservationError):
        fsvp.diagnose(table, 'fish180', against=table)


def test_a_size_and_model_that_are_known_need_not_be_said(tmp_path: Path) -> None:
    table = tmp_path / 'observations.csv'
    fsvp.write_observations(table, seen())
    with pytest.raises(ParameterError, match='the image size is unknown; give image_size='):
        fsvp.calibrate(table)
    size = fsvp.load_lens('fish180').width, fsvp.load_lens('fish180').height
    (tmp_path / 'observations.detect.json').write_text(json.dumps({'image_size': size}))
    found = fsvp.calibrate(table)
    assert isinstance(found.lens.image_height, KannalaBrandt)
    assert found.lens == fsvp.calibrate(table, 'kannala_brandt', size).lens
    assert found.lens == fsvp.calibrate(table, image_size=size).lens
    assert found.lens == fsvp.calibrate_cameras(table).cameras[''].lens


def test_a_diagnosis_lists_the_photographs_to_take_next() -> None:
    lens, rng = fsvp.load_lens('fish180'), np.random.default_rng(0)
    pattern = Print(7, 5, 0.04)
    pose = board_views(lens, pattern, 6, (0.15, 0.4), rng)
    image = fsvp.project(lens, pose.into_body(np.broadcast_to(pattern.corners, (6, 35, 3))))
    frame, corner = np.nonzero(image.valid)
    u, v = (image.uv + rng.normal(0, 0.1, image.uv.shape))[frame, corner].T
    table = fsvp.observations(u, v, corner, pattern.corners, frame=frame)
    for options, said in (
        ({'next': -1}, 'next is -1'),
        ({'next': 2, 'room': (0.3, 0.1)}, 'room is'),
        ({'next': 2, 'number': 'e9'}, 'e9'),
    ):
        with pytest.raises(ParameterError, match=said):
            fsvp.diagnose(table, lens, **options)
    found = fsvp.diagnose(table, lens, next=2, number='e0', room=(0.1, 0.3))
    wanted = found.document['next']
    assert [one['asked'] for one in wanted] == ['e0'] * 2
    assert all(0.1 <= one['distance_m'] <= 0.3 for one in wanted)
    assert wanted[1]['stderr_after'] < wanted[1]['stderr_before'] == wanted[0]['stderr_after']
