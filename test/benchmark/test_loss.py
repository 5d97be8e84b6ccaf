"""The simulator of the study of alarms makes what it says, and its counts are right."""

import numpy as np

from benchmark.studies.loss import (
    BAD,
    CENTER,
    FOCAL,
    SOUND,
    Outcome,
    draw,
    project,
    report,
    true_points,
)
from fisheye_svp_ros.solve.ray_errors import RANGES


def test_points_on_true_rays_are_imaged_where_they_come_from():
    uv = np.array([[700.0, 500.0], [300.0, 200.0], [640.0, 800.0]])
    points = true_points(uv)
    assert np.allclose(np.linalg.norm(points, axis=-1), np.array(RANGES)[:, None])
    for there in points:
        np.testing.assert_allclose(project(there, FOCAL, np.array(CENTER))[0], uv, atol=1e-3)


def test_every_kind_is_drawn():
    for kind in (*SOUND, *BAD):
        table, noise = draw(kind, np.random.default_rng(1))
        assert len(table) > 60 and noise > 0


def outcome(kind, lens, photographs, true):
    true = np.array([true] * 3)
    return Outcome(kind, 0.1, lens, photographs, true, 0 * true, np.array([0.25, 0.15, 0.35]))


def test_alarms_and_reassurances_are_counted():
    found = [outcome(kind, 'keep', 'enough', 0.2) for kind in (*SOUND, *BAD)]
    found += [outcome('flat', 'undecided', 'retake', 0.2), outcome('flat', 'keep', 'enough', 2.0)]
    page = report(found, 'command')
    assert f'False alarms: 1 of {len(SOUND) + 1} sound sets' in page
    assert f'False reassurances: {len(BAD)} of {len(BAD)} bad sets' in page
    assert '89 %, 0 %, 89 % at 0.3, 1' in page.replace('\n', ' ')
