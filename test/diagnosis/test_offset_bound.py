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


def test_off_by_at_least_is_a_bound_and_the_gain_that_of_a_fresh_lens():
    rng = np.random.default_rng(3)
    model, _ = ray_model(moved, np.diag(STDERR**2), UV)
    excess, gains, sizes = [], [], []
    for _ in range(200):
        true = 3 * STDERR * rng.normal(size=3)
        error = STDERR * rng.normal(size=3)
        off = model.columns @ (true - error)
        found = _offset(model, (off, off), LENS, UV, 0.1)
        size, fresh = (
            1e3 * np.sqrt(((model.columns[1] @ step) ** 2).sum(axis=-1).mean())
            for step in (true, error)
        )
        excess.append(found.mrad > size)
        sizes.append(found.mrad / size)
        gains.append((found.gain, size / fresh))
    assert np.mean(excess) < 0.08 and np.median(sizes) > 0.4
    stated, real = np.array(gains).T
    assert np.median(real[stated >= 2]) > 2 > np.median(real[stated < 2])
