"""What the library hands to other programs, and options that it shares with the command."""

from __future__ import annotations

import sys

import cv2
import numpy as np
import pytest
from helpers.lenses import FRONT, points_on_rays

import fisheye_svp_ros as fsvp
from fisheye_svp_ros.errors import ObservationError, ParameterError


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


def test_observations_are_a_dataframe(monkeypatch: pytest.MonkeyPatch) -> None:
    table = seen()
    frame = table.to_dataframe()
    assert [*frame] == ['frame', 'camera', 'landmark', *'uv', *'xyz', 'board', 't', 'sigma']
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
