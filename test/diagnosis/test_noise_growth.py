"""Noise that grows with the incidence angle, in residuals made by hand."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from fisheye_svp_ros.diagnosis.fitted_model import FittedModel
from fisheye_svp_ros.diagnosis.variance_budget import NoiseGrowth, noise_growth
from fisheye_svp_ros.solve.rig_state import RigViews


def find_growth(
    growth: float, ripple: float = 0.0, across: float | None = None, frames: int = 30
) -> NoiseGrowth:
    """Return what is found in noise with a static radial error that is finer than an image field.

    ripple: amplitude of that error, in the inner part of the image only, over the noise; across:
    growth across the radius, where it is another one.
    """
    rng, points = np.random.default_rng(0), 40
    uv = rng.uniform(-1, 1, (frames, points, 2))
    theta = np.linalg.norm(uv, axis=-1)
    radial = ripple * np.cos(40 * theta) * (theta < 0.8)
    side = np.stack([-uv[..., 1], uv[..., 0]], axis=-1)
    noise = np.exp(
        np.array([growth, growth if across is None else across]) * theta[..., None] ** 2
    ) * rng.normal(size=uv.shape)
    errors = ((noise[..., :1] + radial[..., None]) * uv + noise[..., 1:] * side) / theta[..., None]
    data = RigViews.of_one_camera(
        SimpleNamespace(  # type: ignore[arg-type]
            landmark=np.tile(np.arange(points), (frames, 1)), frame=np.arange(frames)
        )
    )
    fitted = SimpleNamespace(
        standardized_residuals=errors.reshape(frames, -1),
        linear=SimpleNamespace(
            data=data,
            row_mask=np.ones((frames, 2 * points), dtype=bool),
            weight=np.ones((frames, points)),
            scene=SimpleNamespace(theta=theta),
            linear=SimpleNamespace(uv=uv),
            state=SimpleNamespace(lenses=[SimpleNamespace(cx=0.0, cy=0.0)]),
        ),
    )
    fitted.point_pairs = lambda: FittedModel.point_pairs(fitted)  # type: ignore[arg-type]
    return noise_growth(fitted)  # type: ignore[arg-type]


@pytest.mark.parametrize('ripple', [0.0, 2.0])
def test_noise_that_grows_is_found_whatever_the_lens_does_along_the_radius(ripple: float) -> None:
    found = find_growth(0.3, ripple)
    assert abs(found.value - 0.3) < 2 * found.stderr < 0.12
    assert found.p_value < 1e-7
    theta2 = np.log(found.variance / found.variance[0, 0]) / (2 * found.value)
    assert np.ptp(theta2) > 1.5  # from the center of the image to near its corners


@pytest.mark.parametrize('ripple', [0.0, 2.0])
def test_noise_that_is_the_same_everywhere_does_not_grow(ripple: float) -> None:
    found = find_growth(0.0, ripple)
    assert abs(found.value) < 2 * found.stderr
    assert found.p_value == 1.0


def test_noise_that_grows_along_the_radius_far_more_than_across_it_does_not_count() -> None:
    assert find_growth(0.4, across=0.3, frames=300).p_value < 1e-12
    assert find_growth(0.6, across=0.1, frames=300).p_value == 1.0
