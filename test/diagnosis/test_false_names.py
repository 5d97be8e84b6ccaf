"""What must not be named after an effect that it resembles."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.scenes import lens, observe, scene

from fisheye_svp_ros.diagnosis.diagnosis import diagnose

SIGMA = 0.2


def test_intrinsics_that_are_wrong_throughout_are_no_step_after_the_first_frames():
    rng = np.random.default_rng(40)
    pose, views = scene(rng)
    true = lens().with_parameters(('fx', 'fy', 'cx'), [1.002 * lens().fx, 1.002 * lens().fy,
                                                       lens().cx + 0.6])
    found = diagnose(observe(true, (), pose, views, SIGMA, rng), lens(), free_intrinsics=False)
    assert {cause.effect for cause in found.causes} == {'focal_length', 'principal_point'}


def test_landmarks_that_scatter_more_are_no_noise_that_grows_with_the_angle():
    rng = np.random.default_rng(51)
    pose, views = scene(rng)
    clean = observe(lens(), (), pose, views, 0.0, rng)
    sigma = np.where(clean.board == 0, 3 * SIGMA, SIGMA)[:, None]
    found = diagnose(replace(clean, uv=clean.uv + rng.normal(size=clean.uv.shape) * sigma), lens())
    assert [cause.effect for cause in found.causes] == []
    assert 'scatter_vs_theta' in [s.variable for s in found.remaining]


@pytest.mark.parametrize('seed', [3, 8, 10])
def test_a_smooth_image_field_is_not_named_after_the_effect_that_it_resembles(seed):
    rng = np.random.default_rng(seed)
    pose, views = scene(rng)
    table = observe(lens(), (), pose, views, SIGMA, rng)
    centres, widths = rng.uniform(0, 1536, (12, 2)), rng.uniform(150, 600, 12)
    heights = SIGMA / 2 * rng.normal(size=(12, 2))
    squares = ((table.uv[:, None] - centres) ** 2).sum(axis=-1)
    field = np.exp(-squares / 2 / widths**2) @ heights
    found = diagnose(replace(table, uv=table.uv + field), lens())
    assert [cause.effect for cause in found.causes] == []
