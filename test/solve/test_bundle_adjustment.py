"""Bundle adjustment: the minimum that SciPy finds, with priors, held parts and two lenses."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.scenes import lens, observe, scene
from scipy.optimize import least_squares

from fisheye_svp_ros.effects.base import ModelTerm
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.effects.image_effects import DecenteringEffect, SkewEffect
from fisheye_svp_ros.effects.ray_effects import ViewpointShiftEffect
from fisheye_svp_ros.effects.rig_effect import assign_camera
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.optics.curves import KannalaBrandt
from fisheye_svp_ros.pose import Pose, identity
from fisheye_svp_ros.solve.bundle_adjustment import (
    PosePrior,
    Prior,
    adjust,
    adjust_lens,
    adjust_lens_from,
    adjust_poses,
    gauss_newton,
    shorten_step,
)
from fisheye_svp_ros.solve.initial_rig import initial_state, localize_frames
from fisheye_svp_ros.solve.least_squares import ArrowEquations, arrow_step
from fisheye_svp_ros.solve.rig_state import Linearization, RigState, group_by_frame

SIGMA = 0.2
FREE = ('fx', 'cx')


def observed(cameras=1, frames=4, seed=5):
    rng = np.random.default_rng(seed)
    pose, views = scene(rng, cameras, frames)
    return group_by_frame(observe(lens(), (), pose, views, SIGMA, rng))


def with_shift(state):
    return replace(state, terms=(ModelTerm(ViewpointShiftEffect(1), np.zeros(1)),))


def prior_rows(prior, state):
    """Return the residuals of a prior, written down anew."""
    rows = []
    if prior.mean is not None:
        rows.append(prior.root @ (state.shared_values(FREE)[-len(prior.mean) :] - prior.mean))
    for known, pose in ((prior.pose, state.pose), (prior.rig, state.rig.take(np.s_[1:]))):
        if known is not None:
            off = pose.difference(known.mean)
            rows += [root @ one for root, one in zip(known.root, off, strict=True)]
    return np.concatenate(rows) if rows else np.zeros(0)


def by_scipy(data, state, prior):
    """Minimize by finite differences, without any of the project's solvers."""
    frames, turned = data.frames, 6 * (data.cameras - 1)

    def after(step):
        return state.retract(FREE, step[: 6 * frames].reshape(-1, 6), step[6 * frames :])

    def rows(step):
        moved = after(step)
        residual = Linearization(data, moved, FREE).residual.ravel()
        return np.concatenate([residual, prior_rows(prior, moved)])

    count = 6 * frames + turned + len(state.shared_values(FREE))
    # Central differences: with those of one side MINPACK stops short.
    return after(
        least_squares(
            rows,
            np.zeros(count),
            jac='3-point',
            x_scale='jac',
            xtol=1e-14,
            ftol=1e-14,
            gtol=1e-14,
            max_nfev=60,
        ).x
    )


def assert_alike(first, second, free=FREE):
    assert np.abs(first.pose.difference(second.pose)).max() < 1e-6
    assert np.abs(first.rig.difference(second.rig)).max() < 1e-6
    np.testing.assert_allclose(
        first.shared_values(free), second.shared_values(free), rtol=1e-5, atol=1e-6
    )


def pose_prior(pose, rng, sigma):
    """Return a prior at poses some sigma away, with correlated roots."""
    shape = (*pose.shape, 6)
    root = rng.normal(size=(*shape, 6)) / sigma
    return PosePrior(pose.retract(5 * sigma * rng.normal(size=shape)), root)


@pytest.mark.parametrize('kind', ['none', 'values', 'last values', 'poses', 'rig', 'all'])
def test_the_minimum_is_scipys_with_a_prior_on_any_part(kind):
    data, rng = observed(cameras=2), np.random.default_rng(8)
    state = with_shift(initial_state(data, lens()))
    prior = Prior()
    if kind in ('values', 'all'):
        prior = prior._replace(
            mean=state.shared_values(FREE) + np.array([3, -2, 0.001]),
            root=np.diag([2.0, 1.0, 1e4]) + 0.1,
        )
    if kind == 'last values':
        prior = Prior(state.shared_values(FREE)[1:] + np.array([-2, 0.001]), np.diag([1.0, 1e4]))
    if kind in ('poses', 'all'):
        prior = prior._replace(pose=pose_prior(state.pose, rng, 0.01))
    if kind in ('rig', 'all'):
        prior = prior._replace(rig=pose_prior(state.rig.take(np.s_[1:]), rng, 0.01))
    fitted = adjust(data, state, FREE, prior)
    assert_alike(fitted, by_scipy(data, state, prior))
    moved = np.abs(fitted.pose.difference(adjust(data, state, FREE).pose)).max()
    assert (moved > 1e-4) == (kind != 'none')


def test_a_prior_far_away_in_rotation_is_followed_exactly():
    data, rng = observed(frames=2), np.random.default_rng(3)
    state = with_shift(initial_state(data, lens()))
    far = state.pose.retract(np.array([0, 0, 0, 0.6, -0.4, 0.5]))
    prior = Prior(pose=PosePrior(far, 3e3 * (np.eye(6) + 0.2 * rng.normal(size=(2, 6, 6)))))
    fitted = adjust(data, state, FREE, prior)
    assert np.abs(fitted.pose.difference(state.pose)[:, 3:]).max() > 0.05
    assert_alike(fitted, by_scipy(data, state, prior))


def test_what_is_held_stays_and_poses_can_be_fitted_alone():
    data = observed()
    state = with_shift(initial_state(data, lens()))
    held = replace(state, terms=(ModelTerm(ViewpointShiftEffect(1), np.array([0.002])),))
    fitted = adjust(data, held, FREE, held=('viewpoint_shift',))
    assert fitted.terms[0].values == 0.002 and fitted.lens.fx != state.lens.fx
    posed = adjust_poses(data, held)
    assert posed.lens == held.lens and posed.terms[0].values == 0.002
    again = localize_frames(data, held)
    assert np.abs(again.pose.difference(posed.pose)).max() < 1e-8


def test_poses_alone_are_at_the_minimum_beside_an_effect_of_the_image():
    """Without its slope no step keeps what it promises: 60 steps, and a worse place."""
    data = observed()
    state = initial_state(data, lens())
    bent = replace(state, terms=(ModelTerm(DecenteringEffect(), np.array([0.02, -0.01])),))
    posed = adjust_poses(data, bent)

    def rows(step):
        moved = bent.retract((), step.reshape(-1, 6), np.zeros(2))
        return Linearization(data, moved, ()).residual.ravel()

    best = least_squares(rows, np.zeros(6 * data.frames), method='lm', xtol=1e-14, ftol=1e-14)
    cost = float((Linearization(data, posed, ()).residual ** 2).sum())
    assert cost == pytest.approx(2 * best.cost, rel=1e-9)


def test_known_poses_are_kept():
    data = observed()
    true = initial_state(data, lens()).pose.retract(np.full(6, 1e-3))
    data = replace(data, poses=true)
    fitted = adjust(data, initial_state(data, lens()), FREE)
    assert np.array_equal(fitted.pose.position, true.position)


def two_lenses():
    other = replace(lens(), fx=380.0, fy=381.0, cx=760.0, image_height=KannalaBrandt(0.01, 0.002))
    return lens(), other


def rig_state(data):
    """Return a state of two lenses that share one effect and have another each for itself."""
    state = initial_state(data, *([two_lenses()[0], two_lenses()[1:]]))
    left, right = (
        assign_camera(DecenteringEffect(), i, label) for i, label in enumerate(('left', 'right'))
    )
    values = np.array([1e-4, -2e-4, 3e-4, 1e-4])
    own = ModelTerm(left.merge_with(right), values)
    return replace(state, terms=(own, ModelTerm(SkewEffect(), np.array([1e-3]))))


def test_columns_of_a_rig_of_two_lenses_are_those_of_differences():
    data = observed(cameras=2)
    state, free = rig_state(data), ('left.fx', 'right.cx', 'right.k1')
    linear = Linearization(data, state, free)
    count = linear.shared_columns.shape[-1]
    assert count == 6 + 3 + 5
    assert (linear.shared_columns[:, :, 6:] ** 2).sum(axis=(0, 1)).min() > 0
    for i in range(count):
        step = 1e-5 * np.eye(count)[i]
        zero = np.zeros((data.frames, 6))
        after, before = (
            Linearization(data, state.retract(free, zero, s * step), free).residual
            for s in (1, -1)
        )
        column = linear.shared_columns[..., i]
        # Derivatives leave out that the decentering varies over the image.
        assert np.abs((before - after) / 2e-5 - column).max() < 2e-3 * np.abs(column).max()


def test_a_rig_predicts_each_view_by_its_camera():
    data = observed(cameras=2)
    state = rig_state(data)
    pose, views = state.view_poses(data), data.views
    linear = state.model.linearize(pose, views)
    for camera in (0, 1):
        rows = np.flatnonzero(views.camera == camera)
        own = state.model.camera(camera)
        alone = own.linearize(pose.take(rows), views.take(rows))
        for name in ('uv', 'valid', 'd_pose', 'ideal', 'optical', 'points'):
            np.testing.assert_array_equal(getattr(linear, name)[rows], getattr(alone, name))
        columns = own.transform_columns(alone, views.take(rows), alone.d_pose)
        whole = state.model.transform_columns(linear, views, linear.d_pose)
        np.testing.assert_allclose(whole[rows], columns, rtol=1e-14)
        image = state.model.predict(pose, views)
        assert np.array_equal(
            image.uv[rows], own.predict(pose.take(rows), views.take(rows)).uv, equal_nan=True
        )
    assert not state.model.is_lens_only and not ForwardModel(two_lenses()).is_lens_only


def test_an_effect_of_single_cameras_is_asked_like_any_other():
    data = observed(cameras=2)
    state = rig_state(data)
    pose, views, effect = state.view_poses(data), data.views, state.terms[0].effect
    linear = state.model.linearize(pose, views)
    seen = state.model.scene(pose, views, linear)
    columns = state.model.effect_columns(effect, seen, linear)
    np.testing.assert_array_equal(effect.columns(seen), columns)
    assert (effect.cameras, effect.form) == (('left', 'right'), DecenteringEffect())


def test_gauss_newton_under_white_noise_is_the_adjustment():
    data = observed(cameras=2)
    state = with_shift(initial_state(data, lens()))
    linear = Linearization(data, state, FREE)
    frame, shared = linear.frame_columns, linear.shared_columns
    turned = np.swapaxes(frame, -1, -2)

    def solve(residual, _):
        flat = shared.reshape(residual.size, -1)
        equations = ArrowEquations(
            (turned @ frame)[None],
            (turned @ shared)[None],
            (flat.T @ flat)[None],
            -(turned @ residual[..., None])[None, ..., 0],
            -(flat.T @ residual.ravel())[None],
        )
        (block, common), _ = arrow_step(tuple(equations), np.zeros(1))
        return block[0], common[0]

    fitted, _ = gauss_newton(linear, solve, 1e-9)
    whole = adjust(data, state, FREE)
    start, found, least = (
        float((Linearization(data, one, FREE).residual ** 2).sum())
        for one in (state, fitted, whole)
    )
    assert found - least < 1e-6 * (start - least)


def test_a_step_out_of_sight_is_shortened_or_not_taken():
    data = observed()
    state = initial_state(data, lens())
    before = float((Linearization(data, state, ()).residual ** 2).sum())

    def after(part):
        return replace(state, pose=state.pose.retract(np.array([0, 0, 0.02 * part, 0, 0, 0])))

    kept, residual = shorten_step(data, (), after, 1.5 * before)
    assert (residual**2).sum() <= 1.5 * before
    assert np.abs(kept.pose.difference(state.pose)).max() < 0.02
    backwards = shorten_step(
        data,
        (),
        lambda part: replace(
            state, pose=Pose(state.pose.rotation, state.pose.position + part * 1e3)
        ),
        before,
    )[0]
    assert np.array_equal(backwards.pose.position, state.pose.position)


def test_a_lens_is_adjusted_from_the_best_of_several_starts():
    data = observed(frames=8)
    pose, names = initial_state(data, lens()).pose, ('f', 'cx', 'cy')
    values = np.array([[250.0, 700.0, 700.0], [lens().fx + 5, 770.0, 765.0], [-1.0, 768.0, 768.0]])
    best = adjust_lens_from(lens(), data.views, Pose.stack([pose] * 3), values, names, 40)
    exact = adjust_lens(best, data.views, pose, names)
    assert exact.converged and best.fx == pytest.approx(exact.lens.fx, rel=1e-6)
    assert abs(exact.lens.fx - lens().fx) < 5 * np.sqrt(exact.covariance[0, 0]) * SIGMA
    assert exact.lens.fx == exact.lens.fy
    state = adjust(data, RigState(pose, identity(1), lens(), ()), names)
    assert state.lens.fx == pytest.approx(exact.lens.fx, rel=1e-9)
    with pytest.raises(GeometryError, match='cannot image all landmarks'):
        adjust_lens(replace(lens(), fx=-1.0), data.views, pose, names)
