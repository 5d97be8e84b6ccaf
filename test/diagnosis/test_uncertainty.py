"""Uncertainty: noise, parameters, and the misfit that remains."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.scenes import lens, observe, scene
from helpers.water import AIR, photographs
from scipy import linalg

from fisheye_svp_ros.diagnosis import DiagnosisOptions, NullModel, diagnose
from fisheye_svp_ros.diagnosis.fitted_model import FittedModel
from fisheye_svp_ros.diagnosis.model_errors import ModelErrors
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.optics.lens import intrinsic_names
from fisheye_svp_ros.solve.bundle_adjustment import adjust, adjust_poses
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.localization import localize
from fisheye_svp_ros.solve.rig_state import group_by_frame


def errors_of(observations, free):
    data = group_by_frame(observations)
    null = NullModel.estimate(data, adjust(data, initial_state(data, AIR), free), free)
    return ModelErrors.from_null_model(null, FittedModel.solve_null_model(null)), null.linear


def rigid_motions(at):
    """Return what unit translations and turns about the origin do to a point, (3, 6)."""
    return np.transpose([*np.eye(3), *(np.cross(axis, at) for axis in np.eye(3))])


def displaced(frames, seed, size=5e-4):
    """Photographs of a board whose points are off by so many m, anew for each seed.

    Of a motion of the whole board they have none: it would be the pose.
    """
    seen = photographs(AIR, None, frames, noise=0.02)
    rng = np.random.default_rng(seed)
    offset = size * rng.normal(size=(35, 3)) * [1.0, 1.0, 0.0]
    points = seen.landmarks().points
    motions = np.linalg.qr(np.concatenate([rigid_motions(at) for at in points]))[0]
    offset -= (motions @ (motions.T @ offset.ravel())).reshape(-1, 3)
    return replace(seen, xyz=seen.xyz - offset[seen.landmark])


def test_noise_alone_is_the_covariance_of_localization():
    seen = photographs(AIR, None, 6)
    errors, linear = errors_of(replace(seen, sigma=np.full(len(seen), 0.1)), ())
    solved = localize(ForwardModel(AIR), linear.data.views)
    parts = errors.of_poses(linear)
    # Localization takes sigma as stated, the null model as it is.
    np.testing.assert_allclose(
        parts.noise, errors.variances.sigma**2 * solved.covariance, rtol=1e-4, atol=1e-16
    )
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
        off = adjust_poses(linear.data, linear.state).pose.difference(true.pose)
        sd = np.sqrt(np.diagonal(parts.total, axis1=1, axis2=2))
        assert np.trace(parts.misfit.mean(axis=0)) > 5 * np.trace(parts.noise.mean(axis=0))
        pulls.append(off / sd)
    assert 0.7 < np.sqrt(np.mean(np.square(pulls))) < 1.4


def test_a_diagnosis_tells_how_far_off_poses_may_be():
    options = DiagnosisOptions(quick=True)
    found = diagnose(displaced(6, 0), AIR, options=options).evaluation.uncertainty
    assert found['position_m']['misfit'] > found['position_m']['noise'] > 0
    assert found['image_px']['noise'] == pytest.approx(0.02, rel=0.5)


def test_what_the_data_know_of_this_target_is_in_its_poses_errors():
    """Its landmarks are off by what was predicted, not by as much as any target's might be."""
    data = group_by_frame(displaced(8, 3))
    null = NullModel.estimate(data, adjust(data, initial_state(data, AIR), ()), ())
    fitted, sigma = FittedModel.solve_null_model(null), null.variances.sigma
    modes, alone = fitted.target_modes(sigma)
    square = (modes**2).sum(axis=-1) + alone**2
    off = np.einsum('lab,lb->la', fitted.random.axes, fitted.predicted_offsets().offset)
    motions = target_motions(data, fitted)
    off = (off.ravel() - motions @ (motions.T @ off.ravel())).reshape(-1, 3)
    assert (square >= (1 - 1e-6) * off**2 - 1e-20).all()
    assert square.sum() == pytest.approx((off**2).sum(), rel=0.2)
    # One and the same target moves all poses alike: a mode, not a doubt of each landmark's own.
    assert (alone**2).sum() < 0.1 * square.sum()
    remove = np.eye(len(motions)) - motions @ motions.T
    dense = remove @ dense_square(null, sigma) @ remove
    whole = modes.reshape(len(dense), -1)
    whole = whole @ whole.T + np.diag(alone.ravel() ** 2)
    np.testing.assert_allclose(np.diag(whole), np.diag(dense), rtol=1e-5, atol=1e-15)
    assert np.linalg.norm(whole - dense) < 0.05 * np.linalg.norm(dense)


def target_motions(data, fitted):
    """Return an orthonormal basis (3 L, 6) of what a motion of the target does to its points."""
    points = data.observations.landmarks().points
    along = [axes @ rigid_motions(at) for axes, at in zip(fitted.random.axes, points, strict=True)]
    return np.linalg.qr(np.concatenate(along))[0]


def test_a_motion_of_the_whole_target_is_no_error_of_its_landmarks():
    """Poses take it up: the datum of the offsets has none of it."""
    data = group_by_frame(displaced(8, 3))
    null = NullModel.estimate(data, adjust(data, initial_state(data, AIR), ()), ())
    fitted = FittedModel.solve_null_model(null)
    modes, _ = fitted.target_modes(null.variances.sigma)
    motions = target_motions(data, fitted)
    moved = np.linalg.norm(motions.T @ modes.reshape(len(motions), -1))
    assert moved < 1e-9 * np.linalg.norm(modes)


def test_cameras_without_a_common_frame_have_poses_of_their_own():
    """Nothing says how they stand to each other, and no pose of one of them depends on it."""
    rng = np.random.default_rng(5)
    seen = observe(lens(), (), *scene(rng, cameras=2, frames=12), 0.1, rng)
    apart = replace(seen, frame=seen.frame + 100 * seen.camera)
    lenses, quick = {'left': lens(), 'right': lens()}, DiagnosisOptions(quick=True)
    rig, own = (
        diagnose(one, lenses, options=quick, free_intrinsics=True).evaluation.uncertainty
        for one in (seen, apart)
    )
    for name in ('position_m', 'rotation_rad'):
        assert 0 < own[name]['parameters'] < 3 * rig[name]['parameters']


def dense_square(null, sigma):
    """Return the mean square (3 L, 3 L), m^2, of landmarks' offsets given the data, densely."""
    linear, variances = null.linear, null.variances
    random = null.random.select(variances.alive).columns
    frames = linear.frame_columns
    fixed = np.concatenate(
        [
            linalg.block_diag(*frames),
            linear.shared_columns.reshape(frames.shape[0] * frames.shape[1], -1),
        ],
        axis=1,
    )
    blocks = [
        linalg.block_diag(*random.group),
        random.unit_columns.toarray(),
        random.shared_columns.toarray(),
    ]
    lam = np.append(variances.lam, 1e12)
    prior = [
        np.tile(lam[random.group_label], len(frames)),
        (lam[random.unit_label] * variances.weight[:, None]).ravel(),
        lam[random.shared_label],
    ]
    columns = np.concatenate([fixed, *blocks], axis=1)
    ridge = np.concatenate([np.zeros(fixed.shape[1]), *prior])
    inverse = np.linalg.inv(columns.T @ columns + np.diag(ridge))
    mean = inverse @ (columns.T @ linear.residual.ravel())
    way = np.zeros((random.unit_columns.shape[1], len(inverse)))
    start_of = fixed.shape[1] + blocks[0].shape[1]
    way[:, start_of : start_of + len(way)] = np.eye(len(way))
    way[:, len(inverse) - random.fields.shape[1] :] = random.fields.toarray()
    mean = way @ mean
    return 1e-6 * (sigma**2 * way @ inverse @ way.T + np.outer(mean, mean))
