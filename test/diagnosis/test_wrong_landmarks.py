"""A diagnosis starts from what most landmarks agree on."""

from dataclasses import replace

import numpy as np
from helpers.scenes import lens, observe, scene

from fisheye_svp_ros.diagnosis import DiagnosisOptions
from fisheye_svp_ros.diagnosis.problem import Inputs, Problem
from fisheye_svp_ros.effects.base import ModelTerm
from fisheye_svp_ros.effects.target_effects import LandmarkSurveyEffect

SIGMA = 0.2


def prepared(table, **settings):
    return Problem.prepare(Inputs.check(table, lens(), DiagnosisOptions(), **settings))


def test_clean_data_start_from_the_simulation():
    rng = np.random.default_rng(1)
    problem = prepared(observe(lens(), (), *scene(rng), SIGMA, rng))
    assert problem.start is problem.base and not problem.outliers.landmarks


def test_a_third_of_the_landmarks_displaced_is_where_causes_are_sought_from():
    rng = np.random.default_rng(2)
    effect = LandmarkSurveyEffect(tuple(range(0, 60, 3)))
    moves = 0.04 * rng.normal(size=60)
    table = observe(lens(), [ModelTerm(effect, moves)], *scene(rng), SIGMA, rng)
    for free in (False, True):
        problem = prepared(table, free_intrinsics=free)
        (term,) = problem.start.terms
        found, values = term.effect, term.values
        assert set(found.landmarks) == set(effect.landmarks)
        np.testing.assert_allclose(
            values[np.argsort(np.repeat(found.landmarks, 3), kind='stable')], moves, atol=3e-3
        )
        assert not len(problem.outliers.rows)


def test_points_that_no_place_explains_are_rejected_by_the_name_of_their_landmark():
    rng = np.random.default_rng(3)
    table = observe(lens(), (), *scene(rng), SIGMA, rng)
    uv, mine = table.uv.copy(), np.flatnonzero(table.landmark == 5)
    uv[mine, 0] += np.where(np.arange(len(mine)) % 2, 80.0, -80.0)
    problem = prepared(replace(table, uv=uv))
    assert [landmark.number for landmark in problem.outliers.landmarks] == [5]
    assert set(mine) == set(problem.outliers.rows)
    assert problem.linear.rms_px < 2 * SIGMA
