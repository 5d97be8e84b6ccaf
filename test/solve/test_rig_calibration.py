"""Rigs of four cameras around a robot: little overlap, errors as stated, what nothing holds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.surround import CAMERAS, LENS, NOISE, RIG, photographs
from scipy.stats import chi2

from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.solve.rig_calibration import (
    RigCalibration,
    calibrate_rig,
    connected_cameras,
)

ALL_SEAMS = (45.0, 135.0, 225.0, 315.0)
LENSES = dict.fromkeys(CAMERAS, LENS)


def test_transforms_lie_within_their_stated_errors() -> None:
    errors = []
    for seed in range(8):
        found = calibrate_rig(photographs(seed, ALL_SEAMS), LENSES, CAMERAS)
        assert found.cameras == CAMERAS
        assert found.sigma_px == pytest.approx(NOISE, rel=0.05)
        off = found.rig.difference(RIG)[1:]
        errors += [
            one @ np.linalg.solve(covariance, one)
            for one, covariance in zip(off, found.covariance, strict=True)
        ]
    low, high = chi2.ppf([0.001, 0.999], 6 * len(errors)) / len(errors)
    assert low < np.mean(errors) < high
    assert found.rig.position[1] == pytest.approx([0.1, 0.0, -0.1], abs=5e-4)


def test_each_camera_in_the_next_one() -> None:
    found = calibrate_rig(photographs(1, ALL_SEAMS), LENSES, CAMERAS)
    point = np.array([0.3, -0.2, 0.9])
    for number, step in enumerate(found.steps()):
        first = found.rig.take(number).transform(point)
        assert found.rig.take(number + 1).transform(step.transform(point)) == pytest.approx(first)


def test_cameras_are_reached_through_others_in_any_order() -> None:
    """No frame shows the board to cam0 and cam1; cam3 and cam2 hold them together."""
    table = photographs(2, ALL_SEAMS[1:])
    assert connected_cameras(table) == [('cam0', 'cam3', 'cam2', 'cam1')]
    found = calibrate_rig(table, LENSES, CAMERAS)
    assert found.cameras == CAMERAS
    assert found.rig.position == pytest.approx(RIG.position, abs=1e-3)


def test_what_nothing_holds_is_a_group_of_its_own() -> None:
    table = photographs(3, (45.0, 225.0))
    assert connected_cameras(table) == [('cam0', 'cam1'), ('cam2', 'cam3')]
    found = calibrate_rig(table, LENSES, ('cam2', 'cam3'))
    assert found.cameras == ('cam2', 'cam3')
    true = RIG.take(2).inverse().compose(RIG.take(3))
    assert found.rig.take(1).position == pytest.approx(true.position, abs=1e-3)


def test_photographs_of_other_moments_are_left_out() -> None:
    table = photographs(4, ALL_SEAMS)
    uv = table.uv.copy()
    torn = (table.frame == 7) & (table.camera == table.camera[table.frame == 7][0])
    uv[torn] += [25.0, 10.0]
    found = calibrate_rig(replace(table, uv=uv), LENSES, CAMERAS)
    assert found.left_out == (7,)
    assert found.sigma_px == pytest.approx(NOISE, rel=0.05)


def test_lenses_are_fitted_with_the_rig_as_far_as_they_are_unsure() -> None:
    table = photographs(5, ALL_SEAMS)

    def fit(lens: Lens) -> RigCalibration:
        return calibrate_rig(table, dict.fromkeys(CAMERAS, lens), CAMERAS)

    off = replace(
        LENS,
        cx=LENS.cx + 0.8,
        fx=LENS.fx + 1.0,
        calibration={'stderr': {'cx': 0.5, 'fx': 1.0}, 'covariance': [[0.25, 0.0], [0.0, 1.0]]},
    )
    unsure, known = fit(off), fit(LENS)
    assert known.lenses == (LENS,) * 4
    sigma = [np.sqrt(np.diagonal(one.covariance, axis1=1, axis2=2)) for one in (unsure, known)]
    assert (sigma[0] > sigma[1]).all()
    assert (np.abs(unsure.rig.difference(RIG)[1:]) < 4 * sigma[0]).all()
    assert [lens.fx for lens in unsure.lenses] == pytest.approx([LENS.fx] * 4, abs=0.3)


def test_too_few_points_are_refused() -> None:
    table = photographs(6, ALL_SEAMS, 4)
    few = table.take(np.arange(len(table)) % 18 == 0)
    with pytest.raises(GeometryError):
        calibrate_rig(few, LENSES, CAMERAS)
