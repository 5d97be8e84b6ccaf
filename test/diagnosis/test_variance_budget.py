"""The variance budget against what was put into the data."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.scenes import lens, observe, scene

from fisheye_svp_ros.diagnosis import DiagnosisOptions, diagnose
from fisheye_svp_ros.mixed_model import project_out


def draw_alike(rng, count):
    return 3e-4 * rng.normal(size=(count, 3))


def draw_some_far_off(rng, count):
    offset = 1e-4 * rng.normal(size=(count, 3))
    offset[rng.choice(count, 8, replace=False)] *= 8
    return offset


@pytest.mark.parametrize('draw', [draw_alike, draw_some_far_off])
def test_landmarks_add_as_much_as_they_were_displaced_by(draw):
    """Those that are far off counted as little as all others: less than half was stated."""
    rng = np.random.default_rng(1)
    place, views = scene(rng)
    offset = draw(rng, len(np.unique(views.landmark)))
    moved = views._replace(points=views.points + offset[views.landmark])
    as_stated, as_they_are, seen = (
        observe(lens(), [], place, which, sigma, np.random.default_rng(2))
        for which, sigma in ((views, 0.0), (moved, 0.0), (moved, 0.05))
    )
    found = diagnose(
        replace(seen, xyz=as_stated.xyz),
        lens(),
        free_intrinsics=False,
        options=DiagnosisOptions(left_out=('landmark_survey',), quick=True),
    )
    linear = found.evaluation.null.linear
    change = (as_they_are.uv - as_stated.uv).reshape(*linear.data.views.uv.shape)
    whitened = linear.data.blocks(change * linear.weight[..., None])
    left = project_out(whitened[..., None], linear.frame_columns) / linear.weight.max()
    stated = sum(part.sd_px**2 for part in found.components if part.name.startswith('landmark'))
    assert np.sqrt(stated) == pytest.approx(np.sqrt((left**2).mean()), rel=0.15)
