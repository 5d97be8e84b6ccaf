"""By how much a lens is off at least, and what a fresh calibration would gain: against truth."""

from dataclasses import replace

import numpy as np

from fisheye_svp_ros.diagnosis.lens_evidence import _offset
from fisheye_svp_ros.optics.curves import Equidistant
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.solve.ray_errors import ray_model

LENS = Lens('made', 1280, 960, 400.0, 400.0, 640.0, 480.0, Equidistant(), 1.5)
UV = np.stack(np.meshgrid(np.linspace(250, 1030, 12), np.linspace(90, 870, 12)), axis=-1).reshape(
    -1, 2
)
STDERR = np.array([1.0, 0.8, 0.8])


def moved(step):
    return replace(LENS, fx=400 + step[0], fy=400 + step[0], cx=640 + step[1], cy=480 + step[2])


def offsets(count):
    """Yield the offset of a lens, what its rays are off by and that over those of a fresh fit."""
    rng = np.random.default_rng(3)
    model, _ = ray_model(moved, np.diag(STDERR**2), UV)
    for _ in range(count):
        true = 3 * STDERR * rng.normal(size=3)
        error = STDERR * rng.normal(size=3)
        off = model.columns @ (true - error)
        found = _offset(model, off, np.zeros_like(off), LENS, UV, 0.1)
        size, fresh = (
            1e3 * np.sqrt(((model.columns[1] @ step) ** 2).sum(axis=-1).mean())
            for step in (true, error)
        )
        yield found, size, size / fresh


def test_off_by_at_least_is_a_bound():
    shares = np.array([found.mrad / size for found, size, _ in offsets(200)])
    assert np.mean(shares > 1) < 0.08 and np.median(shares) > 0.35


def test_a_fresh_calibration_is_as_often_twice_as_good_as_is_said():
    stated, real = np.array([(found.better, ratio >= 2) for found, _, ratio in offsets(200)]).T
    sure, unsure = stated > 0.9, (stated > 0.3) & (stated < 0.7)
    assert real[sure].mean() > 0.85 and 0.25 < real[unsure].mean() < 0.75


def test_a_fresh_calibration_that_is_off_as_much_is_no_remedy():
    """Beside a shift that no calibration knows of, lenses were to be calibrated again."""
    model, _ = ray_model(moved, np.diag(STDERR**2), UV)
    off = model.columns @ (8 * STDERR)
    found = _offset(model, off, off, LENS, UV, 0.1)
    assert found.p_value < 0.01 and found.better == 0.0 and not found.matters(0.1)
    assert _offset(model, off, np.zeros_like(off), LENS, UV, 0.1).matters(0.1)
