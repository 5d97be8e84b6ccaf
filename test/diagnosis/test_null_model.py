"""The null model: its equations are those of the dense matrices, its variances those put in."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from helpers.scenes import lens, observe, scene
from scipy import special, stats

from fisheye_svp_ros.diagnosis import EffectTests, NullModel
from fisheye_svp_ros.diagnosis.fitted_model import FittedModel, refit
from fisheye_svp_ros.diagnosis.random_effects import NAMES, OF_LANDMARKS, make_random_effects
from fisheye_svp_ros.effects.base import ModelTerm
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.mixed_model import (
    LAMBDA_ABSENT,
    Variances,
    component_p_values,
    eliminate,
    estimate_variances,
    factor_equations,
    identifiable_basis,
    initial_variances,
    leave_groups_out,
    make_equations,
    no_variances,
    posterior_covariance,
    posterior_variances,
    score_components,
    solve_equations,
)
from fisheye_svp_ros.mixed_model.reml import update_variances
from fisheye_svp_ros.mixed_model.solution import deviance_without, solution_without
from fisheye_svp_ros.optics.lens import intrinsic_names
from fisheye_svp_ros.reporting.wording.causes import COMPONENTS
from fisheye_svp_ros.solve.bundle_adjustment import adjust, shorten_step
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.rig_state import Linearization, group_by_frame

SIGMA = 0.2
TESTED = ('viewpoint_shift', 'decentering', 'skew', 'target_shape')


def linearized(seed=3, cameras=1, frames=24, offsets=0.0, free=()):
    """Return a linearized fit to a scene whose landmarks are off by normal offsets, m."""
    rng = np.random.default_rng(seed)
    pose, views = scene(rng, cameras, frames)
    observations = observe(lens(), (), pose, views, SIGMA, rng)
    if offsets:
        moves = rng.normal(size=views.points[0].shape) * offsets
        true = views._replace(points=views.points + moves)
        observations = observe(lens(), (), pose, true, SIGMA, rng)
        nominal = dict(enumerate(views.points[0]))
        xyz = np.array([nominal[i] for i in observations.landmark.tolist()])
        observations = replace(observations, xyz=xyz)
    data = group_by_frame(observations)
    return Linearization(data, adjust(data, initial_state(data, lens()), free), free)


def dense_columns(linear, random):
    """Return the columns (rows, P) of all random coefficients and their components."""
    frames, height, width = random.group.shape
    blocks = np.zeros((frames, height, frames, width))
    blocks[np.arange(frames), :, np.arange(frames)] = random.group
    place = np.zeros((frames, height // 2, 2, len(random.unit_label), 3))
    f, n = np.nonzero(random.unit >= 0)
    place[f, n, :, random.unit[f, n]] = random.offset[f, n]
    columns = np.concatenate(
        [
            blocks.reshape(frames * height, -1),
            place.reshape(frames * height, -1),
            random.shared_columns.toarray(),
        ],
        axis=1,
    )
    label = np.concatenate(
        [np.tile(random.group_label, frames), random.unit_label.ravel(), random.shared_label]
    )
    return columns[linear.row_mask.ravel()], label


def dense_poses(linear):
    frames, height, _ = linear.frame_columns.shape
    poses = np.zeros((frames, height, frames, 6))
    poses[np.arange(frames), :, np.arange(frames)] = linear.frame_columns
    return poses.reshape(frames * height, -1)[linear.row_mask.ravel()]


def some_variances(eq, seed=0):
    """Return random variances of every component that there is."""
    first = initial_variances(eq, 0.05)
    rng = np.random.default_rng(seed)
    factor = np.exp(rng.normal(size=len(NAMES)))
    lam = np.where(first.lam < LAMBDA_ABSENT, first.lam * factor, LAMBDA_ABSENT)
    return Variances(1.0, lam, np.exp(0.3 * rng.normal(size=len(first.weight))))


@pytest.mark.parametrize(('cameras', 'frames'), [(1, 1), (2, 3), (1, 12)])
def test_equations_are_those_of_the_dense_matrices(cameras, frames):
    """Either order of elimination: generalised least squares with V = I + Z D Z'."""
    linear = linearized(cameras=cameras, frames=frames)
    random = make_random_effects(linear).columns
    probe = linear.effect_columns(CATALOGUE['skew']())
    border = np.concatenate([probe, linear.residual[..., None]], axis=-1)
    eq = make_equations(random, linear.frame_columns, border)
    assert eq.by_group == (frames > 4)
    now = some_variances(eq)
    f = factor_equations(eq.select(now.alive), now.lam, now.weight)
    z, label = dense_columns(linear, random)
    weight = np.concatenate(
        [
            np.ones(random.group.shape[-1] * frames),
            np.repeat(now.weight, 3),
            np.ones(len(random.shared_label)),
        ]
    )
    v = np.eye(len(z)) + (z / (now.lam[label] * weight)) @ z.T
    tested = probe.reshape(-1, 1)[linear.row_mask.ravel()]
    x = np.concatenate([dense_poses(linear), tested], axis=1)
    y = linear.residual[linear.row_mask]
    poses = x[:, :-1]
    whitened = np.linalg.solve(v, np.column_stack([x, y]))
    inside = (
        poses
        @ np.linalg.lstsq(
            poses.T @ whitened[:, : poses.shape[1]],
            poses.T @ whitened[:, poses.shape[1] :],
            rcond=None,
        )[0]
    )
    left = np.column_stack([x[:, -1], y]) - inside
    np.testing.assert_allclose(f.information, left.T @ np.linalg.solve(v, left), rtol=1e-5)
    solution = solve_equations(f)
    assert solution.values[0] == pytest.approx(f.information[0, 1] / f.information[0, 0])


@pytest.mark.parametrize('frames', [4, 24])
@pytest.mark.parametrize(
    'name', ['landmark_normal', 'image_coarse', 'frame_linear', 'frame_bumps', 'board_in_plane']
)
def test_without_a_component_is_what_the_equations_say_that_never_had_it(frames, name):
    linear = linearized(frames=frames, offsets=2e-3)
    random = make_random_effects(linear).columns
    border = np.concatenate(
        [linear.effect_columns(CATALOGUE['skew']()), linear.residual[..., None]], axis=-1
    )
    eq, kind = make_equations(random, linear.frame_columns, border), NAMES.index(name)
    now = some_variances(eq)
    f = factor_equations(eq.select(now.alive), now.lam, now.weight)
    known = posterior_covariance(f)
    whole = f, solve_equations(f, known.variances), known
    gone = now.without_component(kind)
    direct_f = factor_equations(eq.select(gone.alive), now.lam, now.weight)
    direct = solve_equations(direct_f, posterior_variances(direct_f))
    assert deviance_without(*whole, kind) == pytest.approx(direct.deviance - whole[1].deviance)
    if not (f.equations.blocks.r_label == kind).any():
        return
    found, after = solution_without(*whole, kind), update_variances(direct_f, direct, gone)
    assert found.deviance == pytest.approx(direct.deviance)
    assert found.variance == pytest.approx(direct.variance)
    there = after.alive
    step = update_variances(f, found, gone)
    np.testing.assert_array_equal(step.alive, there)
    np.testing.assert_allclose(step.lam[there], after.lam[there], rtol=1e-6)
    np.testing.assert_allclose(step.weight, after.weight, rtol=1e-6)


@pytest.mark.parametrize('worth', [0.0, np.inf])
@pytest.mark.parametrize('frames', [4, 24])
def test_variances_are_those_of_the_whole_covariance(frames, worth, monkeypatch):
    monkeypatch.setattr('fisheye_svp_ros.mixed_model.threads._WORTH_THREADS', worth)
    linear = linearized(frames=frames, offsets=2e-3)
    border = np.concatenate(
        [linear.effect_columns(CATALOGUE['skew']()), linear.residual[..., None]], axis=-1
    )
    eq = make_equations(make_random_effects(linear).columns, linear.frame_columns, border)
    now = some_variances(eq)
    for alive in (now.alive, np.zeros_like(now.alive)):
        f = factor_equations(eq.select(alive), now.lam, now.weight)
        for ours, whole in zip(
            posterior_variances(f), posterior_covariance(f).variances, strict=True
        ):
            np.testing.assert_allclose(ours, whole, rtol=1e-9)


@pytest.mark.parametrize('frames', [4, 12])
@pytest.mark.parametrize('there', [(), ('landmark_in_plane', 'image_broad', 'frame_focal')])
def test_score_tests_are_those_of_the_dense_matrices(frames, there):
    linear = linearized(frames=frames, offsets=2e-3)
    random = make_random_effects(linear).columns
    probe = linear.effect_columns(CATALOGUE['skew']())
    eq = make_equations(
        random, linear.frame_columns, np.concatenate([probe, linear.residual[..., None]], axis=-1)
    )
    assert eq.by_group == (frames > 4)
    now = some_variances(eq)
    now = replace(now, lam=np.where([name in there for name in NAMES], now.lam, LAMBDA_ABSENT))
    z, label = dense_columns(linear, random)
    weight = np.concatenate(
        [
            np.ones(random.group.shape[-1] * frames),
            np.repeat(now.weight, 3),
            np.ones(len(random.shared_label)),
        ]
    )
    v = np.eye(len(z)) + (z / (now.lam[label] * weight)) @ z.T
    fixed = np.column_stack([dense_poses(linear), probe.reshape(-1, 1)[linear.row_mask.ravel()]])
    inverse = np.linalg.inv(v)
    across = inverse @ fixed
    p = inverse - across @ np.linalg.lstsq(fixed.T @ across, across.T, rcond=None)[0]
    y = linear.residual[linear.row_mask]
    p_values = score_components(eq, now, range(len(NAMES)))
    found = {name: p for name, p in zip(NAMES, p_values, strict=True) if np.isfinite(p)}
    assert len(found) > 10
    for name, p_value in found.items():
        columns = z[:, label == NAMES.index(name)]
        remaining, pull = columns.T @ p @ columns, columns.T @ p @ y
        mean, spread = np.trace(remaining), 2 * (remaining**2).sum()
        variance = y @ p @ y / (len(y) - np.linalg.matrix_rank(fixed))
        size = pull @ pull / variance
        assert p_value == pytest.approx(
            special.gammaincc(mean**2 / spread, size * mean / spread), rel=1e-3, abs=1e-12
        ), name


def test_a_bound_stands_for_p_values_above_a_limit_only():
    linear = linearized()
    random = make_random_effects(linear)
    eq = make_equations(random.columns, linear.frame_columns, linear.residual[..., None])
    nothing = no_variances(len(NAMES), len(random.landmark))
    exact = score_components(eq, nothing, range(len(NAMES)))
    for limit in (0.01, 0.3):
        found = score_components(eq, nothing, range(len(NAMES)), limit)
        np.testing.assert_array_equal(np.isnan(found), np.isnan(exact))
        there = np.isfinite(exact)
        np.testing.assert_array_equal(found[there] < limit, exact[there] < limit)
        assert (found[there] <= exact[there] * (1 + 1e-9)).all()
    assert (found[there] < 0.9 * exact[there]).any()


@pytest.mark.parametrize('kind', ['image_broad', 'image_coarse'])
def test_a_component_that_fixed_columns_take_up_is_not_testable(kind):
    """On a board in a plane stretches were named by the rounding of what was left of them."""
    linear, number = linearized(), NAMES.index(kind)
    random = make_random_effects(linear).columns
    random = random._replace(shared=1e4 * random.shared, fields=1e4 * random.fields)
    columns = random.shared_columns[:, random.shared_label == number].toarray()
    border = columns.reshape(*linear.residual.shape, -1)
    basis = identifiable_basis(linear.frame_columns, border, np.arange(border.shape[-1]))
    eq = make_equations(
        random,
        linear.frame_columns,
        np.concatenate([border, linear.residual[..., None]], axis=-1),
    ).combine_columns(basis)
    nothing = no_variances(len(NAMES), len(random.unit_label))
    p_values = score_components(eq, nothing, range(len(NAMES)))
    assert np.isnan(p_values[number])
    assert np.isfinite(p_values[NAMES.index('frame_bumps')])


def test_another_border_beside_the_same_variances_needs_no_other_factor():
    linear = linearized()
    random, probe = make_random_effects(linear).columns, linear.residual[..., None]

    def equations():
        border = np.concatenate([linear.frame_columns[..., :1] * probe, probe], axis=-1)
        return make_equations(random, linear.frame_columns, border)

    eq = equations()
    now = some_variances(eq)
    other = replace(now, lam=np.where(now.alive, 3 * now.lam, now.lam))
    without = now.without_component(int(np.flatnonzero(now.alive)[0]))
    half = eq.combine_columns(np.full((1, 1), 0.5))
    first = factor_equations(eq.select(now.alive), now.lam, now.weight)
    assert factor_equations(half.select(now.alive), now.lam, now.weight).factor is first.factor
    for variances in (other, without, now):  # what was remembered is not what is asked for
        again, alone = (
            factor_equations(one.select(variances.alive), variances.lam, variances.weight)
            for one in (half, equations().combine_columns(np.full((1, 1), 0.5)))
        )
        np.testing.assert_array_equal(again.factor, alone.factor)
        np.testing.assert_array_equal(again.information, alone.information)


def test_many_frames_need_no_matrix_of_all_that_they_have_of_their_own():
    """A recording of 340 frames took 15 GB."""
    linear, kind = linearized(frames=150), NAMES.index('frame_bumps')
    eq = make_equations(
        make_random_effects(linear).columns, linear.frame_columns, linear.residual[..., None]
    )
    count = (eq.blocks.e_label == kind).sum()
    now = some_variances(eq)
    f = factor_equations(eq, now.lam, now.weight)
    known = posterior_covariance(f)
    solution = solve_equations(f, known.variances)
    tracemalloc.start()
    deviance_without(f, solution, known, kind)
    score_components(eq, now.without_component(kind), [kind])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert count > 3000 and peak < 2 * 8 * count**2


def test_a_direction_that_random_parts_have_taken_up_stays_where_it_is():
    linear = linearized(frames=1)
    eq = make_equations(
        make_random_effects(linear).columns, linear.frame_columns, linear.residual[..., None]
    )
    f = factor_equations(eq, some_variances(eq).lam, np.ones(len(eq.units)))
    root = replace(f, information=np.ones((3, 3))).root
    np.testing.assert_allclose(root @ root.T, np.ones((2, 2)), atol=1e-4)


def test_what_the_data_determine_is_the_trace_of_the_dense_matrix():
    linear = linearized(frames=5)
    random = make_random_effects(linear).columns
    border = np.concatenate(
        [linear.effect_columns(CATALOGUE['skew']()), linear.residual[..., None]], axis=-1
    )
    eq = make_equations(random, linear.frame_columns, border)
    now = some_variances(eq)
    f = factor_equations(eq.select(now.alive), now.lam, now.weight)
    solution = solve_equations(f, posterior_variances(f))
    z, label = dense_columns(linear, random)
    precision = np.where(label >= 0, now.lam[label], 0.0) * np.concatenate(
        [
            np.ones(5 * random.group.shape[-1]),
            np.repeat(now.weight, 3),
            np.ones(len(random.shared_label)),
        ]
    )
    probe = border[..., :1].reshape(-1, 1)[linear.row_mask.ravel()]
    x = np.concatenate([dense_poses(linear), probe], axis=1)
    full = np.concatenate([x, z], axis=1)
    matrix = full.T @ full + np.diag(np.concatenate([np.zeros(x.shape[1]), precision]))
    scale = np.sqrt(np.diag(matrix))
    inverse = np.linalg.inv(matrix / scale / scale[:, None]) / scale / scale[:, None]
    expected = np.diag(inverse)[x.shape[1] :]
    frame, landmark, shared = f.equations.split(solution.spread_e, solution.spread_r)
    found = np.concatenate([frame[:, 6:].ravel(), landmark.ravel(), shared])
    np.testing.assert_allclose(found, expected, rtol=1e-4)


@pytest.mark.parametrize('by_group', [False, True])
def test_a_frame_left_out_is_as_if_it_had_never_been(by_group):
    linear = linearized(cameras=2, frames=6)
    random, pose = make_random_effects(linear).columns, linear.frame_columns
    if not by_group:  # what single frames have of their own makes their blocks the larger part
        random = random._replace(group=random.group[..., :2], group_label=random.group_label[:2])
    border = np.concatenate(
        [linear.effect_columns(CATALOGUE['decentering']()), linear.residual[..., None]], axis=-1
    )
    eq = make_equations(random, pose, border)
    now = some_variances(eq)
    f = factor_equations(eq.select(now.alive), now.lam, now.weight)
    assert f.equations.by_group == by_group
    found = leave_groups_out(f, random, pose, border)
    keep = np.arange(len(pose)) != 3
    rows = np.repeat(keep, linear.residual.shape[1])[:, None]
    gone = random._replace(
        group=random.group * keep[:, None, None],
        offset=random.offset * keep[:, None, None, None],
        shared=random.shared.multiply(rows).tocsr(),
        unit=np.where(keep[:, None], random.unit, -1),
    )
    rest = make_equations(gone, pose * keep[:, None, None], border * keep[:, None, None])
    direct = factor_equations(rest.select(now.alive), now.lam, now.weight)
    np.testing.assert_allclose(f.information - found.information[3], direct.information, rtol=1e-4)
    # What the others predict of the frame's image, its pose fitted to what they leave.
    way = np.array([0.0, 0.0, 1.0])
    _, landmark, shared = direct.equations.split(*direct.coefficients(way))
    offset = np.zeros((len(random.unit_label) + 1, 3))
    offset[direct.equations.units] = landmark
    moved = (random.offset[3] @ offset[random.unit[3]][..., None]).ravel()
    height = linear.residual.shape[1]
    left = linear.residual[3] - moved - random.shared_columns[3 * height : 4 * height] @ shared
    left -= pose[3] @ np.linalg.lstsq(pose[3], left, rcond=1e-9)[0]
    np.testing.assert_allclose(found.rows[3] @ way, left, atol=1e-5 * np.abs(left).max())
    field = random.shared[3 * height : 4 * height] @ shared[: random.shared.shape[1]]
    np.testing.assert_allclose(found.fields[3] @ way, field, atol=1e-5 * np.abs(field).max())


def test_variances_that_were_put_in_come_out():
    linear = linearized(seed=5, offsets=2e-4)
    null = NullModel.estimate(linear.data, linear.state, ())
    tau = dict(zip(NAMES, null.variances.tau, strict=True))
    # Of a t distribution, so the scale is below the standard deviation of the bulk, 0.2 mm.
    assert 0.1 < tau['landmark_in_plane'] < 0.25
    assert null.variances.sigma == pytest.approx(SIGMA, rel=0.08)
    p = component_p_values(null.equations_of(null.included_columns), null.variances)
    assert p[NAMES.index('landmark_in_plane')] < 1e-9


def test_a_variance_of_zero_is_rarely_called_for():
    p_values = []
    for seed in range(8):
        linear = linearized(seed=40 + seed, frames=12)
        border = linear.residual[..., None]
        eq = make_equations(make_random_effects(linear).columns, linear.frame_columns, border)
        nothing = Variances(1.0, np.full(len(NAMES), LAMBDA_ABSENT), np.ones(len(eq.units)))
        p = score_components(eq, nothing, range(len(NAMES)))
        p_values += p[np.isfinite(p)].tolist()
    assert len(p_values) > 60
    assert np.mean(np.array(p_values) < 0.1) < 0.2
    assert min(p_values) > 1e-5


def test_without_variances_there_is_nothing_but_noise():
    linear = linearized(seed=6)
    null = NullModel.estimate(linear.data, linear.state, ())
    assert null.variances.sigma == pytest.approx(SIGMA, rel=0.08)
    fitted = FittedModel.of_state(null.linear, null.variances)
    left = fitted.residuals()[linear.row_mask]
    freedom = 1 - fitted.leverages()[linear.row_mask].mean()
    assert np.sqrt((left**2).mean() / freedom) == pytest.approx(SIGMA, rel=0.08)


def test_estimates_lower_the_deviance():
    linear = linearized(seed=7, offsets=3e-4)
    border = linear.residual[..., None]
    eq = make_equations(make_random_effects(linear).columns, linear.frame_columns, border)
    first = initial_variances(eq)
    f = factor_equations(eq.select(first.alive), first.lam, first.weight)
    before = solve_equations(f).deviance
    found, rest = estimate_variances(eq, first)
    after = solve_equations(factor_equations(rest, found.lam, found.weight)).deviance
    assert after < before
    # Where a fit has run away, so have the variances that the next one begins with.
    found, rest = estimate_variances(eq, replace(first, lam=np.full(len(NAMES), 1e-18)))
    assert solve_equations(factor_equations(rest, found.lam, found.weight)).deviance < before


def test_a_step_that_takes_points_out_of_sight_is_cut_short():
    linear = linearized(seed=7)
    port = CATALOGUE['flat_port']()

    def after(part):
        return replace(linear.state, terms=(ModelTerm(port, np.array([10.0 * part])),))

    assert not np.isfinite(Linearization(linear.data, after(1.0), ()).residual).all()
    state, residual = shorten_step(linear.data, (), after)
    assert np.isfinite(residual).all() and state.terms[0].values < 10.0
    refitted = refit(
        linear.data, after(0.0), (), NullModel.estimate(linear.data, linear.state, ()).variances
    )
    assert np.isfinite(Linearization(linear.data, refitted, ()).residual).all()


def test_score_is_the_f_test_of_nested_models_where_nothing_is_random():
    free = intrinsic_names(lens())
    linear = linearized(seed=8, free=free)
    null = NullModel.estimate(linear.data, linear.state, free)
    nothing = Variances(1.0, np.full(len(NAMES), LAMBDA_ABSENT), null.variances.weight)
    bare = replace(null, variances=nothing)
    own = null.included_columns
    form = next(i for i, e in enumerate(null.fixed.forms.effects) if e.name == 'decentering')
    columns = null.form_columns(form)
    found = EffectTests(bare).score(eliminate(bare.information, own), columns)
    used = linear.row_mask.ravel()
    wide = np.concatenate(
        [
            dense_poses(linear),
            linear.shared_columns.reshape(len(used), -1)[used],
            linear.effect_columns(null.fixed.forms.effects[form]).reshape(len(used), -1)[used],
        ],
        axis=1,
    )
    y = linear.residual[linear.row_mask]
    small, large = (
        float(((y - m @ np.linalg.lstsq(m, y, rcond=None)[0]) ** 2).sum())
        for m in (wide[:, :-2], wide)
    )
    assert found.rank == 2
    assert found.statistic == pytest.approx(small - large, rel=1e-5)


def test_doubt_about_variances_has_its_degrees_of_freedom():
    linear = linearized(seed=31, offsets=3e-4)
    null = NullModel.estimate(linear.data, linear.state, ())
    own = null.included_columns
    form = next(i for i, e in enumerate(null.fixed.forms.effects) if e.name == 'target_shape')
    columns = null.form_columns(form)
    tests = EffectTests(null)
    score = tests.score(eliminate(null.information, own), columns)
    sure = tests.adjust_p_value(score, own, columns)
    assert sure.p_value == pytest.approx(
        stats.f.sf(score.statistic / score.rank, score.rank, sure.freedom)
    )
    assert sure.p_value > 1.5 * score.p_value

    # Satterthwaite: two over the variance of the logarithm of what the columns tell.
    now, way = null.variances, score.estimate * null.scale[columns]

    def told(change):
        """Return the logarithm of it for changes of log tau^2 and, last, of log sigma^2."""
        lam = np.where(now.alive, now.lam * np.exp(change[-1] - change[:-1]), LAMBDA_ABSENT)
        sigma = now.sigma * np.exp(change[-1] / 2)
        other = replace(null, variances=replace(now, lam=lam, sigma=sigma))
        block = eliminate(other.information, own)[np.ix_(columns, columns)]
        return np.log(way @ block @ way)

    steps = 1e-4 * np.eye(len(NAMES) + 1)
    slope = np.array([(told(step) - told(-step)) / 2e-4 for step in steps])
    assert sure.freedom == pytest.approx(2 / (slope @ now.covariance @ slope), rel=1e-3)


def test_p_values_are_uniform_without_an_effect():
    p_values = []
    for seed in range(10):
        linear = linearized(seed=100 + seed, offsets=2e-4 * (seed % 2))
        null = NullModel.estimate(linear.data, linear.state, ())
        left, tests = eliminate(null.information, null.included_columns), EffectTests(null)
        for form, effect in enumerate(null.fixed.forms.effects):
            simplest = effect == next(e for e in null.fixed.forms.effects if e.name == effect.name)
            if simplest and effect.name in TESTED:
                columns = null.form_columns(form)
                score = tests.score(left, columns)
                sure = tests.adjust_p_value(score, null.included_columns, columns)
                p_values.append(sure.p_value)
    # 40 values; a sound build fails this less than once in ten thousand runs.
    assert stats.kstest(p_values, 'uniform').pvalue > 1e-4


def test_predicted_offsets_are_near_the_true_ones():
    rng = np.random.default_rng(9)
    pose, views = scene(rng)
    moves = rng.normal(size=views.points[0].shape) * 1e-3
    table = observe(lens(), (), pose, views._replace(points=views.points + moves), SIGMA, rng)
    table = replace(table, xyz=views.points[0][table.landmark])
    data = group_by_frame(table)
    state = adjust(data, initial_state(data, lens()), ())
    null = NullModel.estimate(data, state, ())
    found = FittedModel.of_state(null.linear, null.variances).predicted_offsets()
    true = moves[found.landmark]
    # Poses and the catalogue take up part of what all landmarks do together.
    assert np.corrcoef(found.offset.ravel(), true.ravel())[0, 1] > 0.7


def test_every_component_has_words():
    assert set(NAMES) <= set(COMPONENTS)


@pytest.mark.parametrize('seed', [9, 28])
def test_a_scale_for_each_landmark_does_not_make_more_of_chance(seed):
    linear = linearized(seed)
    null = NullModel.estimate(linear.data, linear.state, ())
    fitted, eq = null.variances, null.equations_of(null.included_columns)
    assert fitted.weight.min() < 0.8
    p, without = (
        component_p_values(eq, now)[NAMES.index('landmark_in_plane')]
        for now in (fitted, fitted.with_equal_weights(OF_LANDMARKS))
    )
    assert p > 0.1
    assert without == pytest.approx(p, rel=1e-6)
