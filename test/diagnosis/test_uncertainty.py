"""Uncertainty: noise, parameters, and the misfit that remains."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.water import AIR, photographs

from fisheye_svp_ros.diagnosis.diagnosis import diagnose
from fisheye_svp_ros.diagnosis.evidence import gather_evidence
from fisheye_svp_ros.diagnosis.model import fit, fit_poses, intrinsic_names, prepare, start
from fisheye_svp_ros.diagnosis.uncertainty import ModelError
from fisheye_svp_ros.diagnosis.wanted import Wanted
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.solve.localization import localize


def errors_of(observations, free):
    data = prepare(observations)
    evidence = gather_evidence(data, fit(data, start(data, AIR), free), free)
    return ModelError.of(evidence), evidence.linear


def displaced(frames, seed, size=5e-4):
    """Photographs of a board whose points are off by so many m, anew for each seed."""
    seen = photographs(AIR, None, frames, noise=0.02)
    rng = np.random.default_rng(seed)
    offset = size * rng.normal(size=(35, 3)) * [1.0, 1.0, 0.0]
    return replace(seen, xyz=seen.xyz - offset[seen.landmark])


def test_noise_alone_is_the_covariance_of_localization():
    seen = photographs(AIR, None, 6)
    errors, linear = errors_of(replace(seen, sigma=np.full(len(seen), 0.1)), ())
    solved = localize(ForwardModel(AIR), linear.data.views)
    parts = errors.of_poses(linear)
    # Localization takes sigma as stated, the null model as it is.
    np.testing.assert_allclose(parts.noise, errors.variances.sigma**2 * solved.covariance,
                               rtol=1e-4, atol=1e-16)
    assert not parts.parameters.any()


def test_free_intrinsics_add_to_a_pose():
    free = intrinsic_names(AIR)
    errors, linear = errors_of(photographs(AIR, None, 6), free)
    parts = errors.of_poses(linear)
    assert (np.trace(parts.parameters, axis1=1, axis2=2) > 0).all()
    points = errors.of_points(linear)
    assert np.nanmax(points.parameters) < 1.0 and np.nanmin(points.noise) > 0


def test_poses_scatter_as_the_remaining_misfit_says():
    """Boards with other errors of their points each: poses of the same frame differ by that."""
    true = errors_of(photographs(AIR, None, 6, noise=0.0), ())[1].state
    pulls = []
    for seed in range(12):
        errors, linear = errors_of(displaced(6, seed), ())
        parts = errors.of_poses(linear)
        off = fit_poses(linear.data, linear.state).pose.difference(true.pose)
        sd = np.sqrt(np.diagonal(parts.total, axis1=1, axis2=2))
        assert np.trace(parts.misfit.mean(axis=0)) > 5 * np.trace(parts.noise.mean(axis=0))
        pulls.append(off / sd)
    assert 0.7 < np.sqrt(np.mean(np.square(pulls))) < 1.4


def test_a_diagnosis_tells_how_far_off_poses_may_be():
    found = diagnose(displaced(6, 0), AIR, wanted=Wanted(quick=True)).to_dict()['uncertainty']
    assert found['position_m']['misfit'] > found['position_m']['noise'] > 0
    assert found['image_px']['noise'] == pytest.approx(0.02, rel=0.5)
