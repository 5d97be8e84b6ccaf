"""What is said of a lens beyond the points that it was calibrated on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.solve.lens_checks import extrapolated_points

LENS = load_lens(lens_path('fish214')).svp()
KNOWN = replace(LENS, calibration={'reached_deg': 60.0})


def seen_at(*degrees: float) -> np.ndarray:
    theta = np.radians(degrees)
    points = np.stack([0.6 * np.sin(theta), 0.8 * np.sin(theta), np.cos(theta)], axis=-1)
    return project(LENS, points).uv


def test_points_beyond_the_angle_of_the_calibration_are_told() -> None:
    assert extrapolated_points(LENS, seen_at(5.0, 80.0)) is None  # nobody says how far
    assert extrapolated_points(KNOWN, seen_at(0.0, 30.0, 59.9, 61.5)) is None
    found = extrapolated_points(KNOWN, seen_at(10.0, 70.0, 85.0, 20.0))
    assert found is not None
    assert found.share == 0.5
    assert np.degrees([found.farthest, found.known]) == pytest.approx([85.0, 60.0], abs=1e-6)
