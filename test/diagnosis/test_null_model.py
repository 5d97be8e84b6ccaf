"""The null model: its equations are those of the dense matrices, its variances those put in."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from helpers.scenes import lens, observe, scene
from scipy import special, stats

from fisheye_svp_ros.diagnosis.adjustment import fit, start
from fisheye_svp_ros.diagnosis.components import significance
from fisheye_svp_ros.diagnosis.doubt import confident
from fisheye_svp_ros.diagnosis.evidence import gather_evidence, identifiable, swept
from fisheye_svp_ros.diagnosis.left_out import left_out_in_turn
from fisheye_svp_ros.diagnosis.mixed import equations, factored
from fisheye_svp_ros.diagnosis.model import Linearised, intrinsic_names, prepare
from fisheye_svp_ros.diagnosis.random_effects import NAMES, design
from fisheye_svp_ros.diagnosis.refit import fit_linear, in_sight, local_offsets, refit
from fisheye_svp_ros.diagnosis.reml import (
    GONE,
    Variances,
    estimate,
    start_variances,
    stepped,
    without,
)
from fisheye_svp_ros.diagnosis.residuals import conditional_residuals, leverages
from fisheye_svp_ros.diagnosis.score_tests import score_components
from fisheye_svp_ros.diagnosis.solution import posterior, ratio_without, solve
from fisheye_svp_ros.diagnosis.solution import without as solution_without
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.reporting.diagnosis_text import COMPONENTS

SIGMA = 0.2
TESTED = ('viewpoint_shift', 'decentering', 'skew', 'target_shape')


def linearised(seed=3, cameras=1, frames=24, offsets=0.0, free=()):
    """Return a linearised fit to a scene whose landmarks are off by normal offsets, m."""
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
    data = prepare(observations)
    return Linearised(data, fit(data, start(data, lens()), free), free)


def dense_columns(linear, random):
    """Return the columns (rows, P) of all random coefficients and their components."""
    frames, height, width = random.frame.shape
    blocks = np.zeros((frames, height, frames, width))
    blocks[np.arange(frames), :, np.arange(frames)] = random.frame
    place = np.zeros((frames, height // 2, 2, len(random.landmark), 3))
    f, n = np.nonzero(random.slot >= 0)
    place[f, n, :, random.slot[f, n]] = random.place[f, n]
    columns = np.concatenate([
        blocks.reshape(frames * height, -1), place.reshape(frames * height, -1),
        random.shared.toarray(),
    ], axis=1)
    label = np.concatenate([
        np.tile(random.frame_label, frames), random.landmark_label.ravel(), random.shared_label
    ])
    return columns[linear.used.ravel()], label


def dense_poses(linear):
    frames, height, _ = linear.frame_columns.shape
    poses = np.zeros((frames, height, frames, 6))
    poses[np.arange(frames), :, np.arange(frames)] = linear.frame_columns
    return poses.reshape(frames * height, -1)[linear.used.ravel()]


def some_variances(eq, seed=0):
    """Return random variances of every component that there is."""
    first = start_variances(eq, 0.05)
    rng = np.random.default_rng(seed)
    lam = np.where(first.lam < GONE, first.lam * np.exp(rng.normal(size=len(NAMES))), GONE)
    return Variances(1.0, lam, np.exp(0.3 * rng.normal(size=len(first.weight))))


@pytest.mark.parametrize(('cameras', 'frames'), [(1, 1), (2, 4), (1, 12)])
def test_equations_are_those_of_the_dense_matrices(cameras, frames):
    """Either order of elimination: generalised least squares with V = I + Z D Z'."""
    linear = linearised(cameras=cameras, frames=frames)
    random = design(linear)
    probe = linear.effect_columns(CATALOGUE['skew']())
    border = np.concatenate([probe, linear.residual[..., None]], axis=-1)
    eq = equations(random, linear.frame_columns, border)
    assert eq.by_frame == (frames > 4)
    now = some_variances(eq)
    f = factored(eq.trimmed(now.alive), now.lam, now.weight)
    z, label = dense_columns(linear, random)
    weight = np.concatenate([
        np.ones(random.frame.shape[-1] * frames), np.repeat(now.weight, 3),
        np.ones(random.shared.shape[1]),
    ])
    v = np.eye(len(z)) + (z / (now.lam[label] * weight)) @ z.T
    x = np.concatenate([dense_poses(linear), probe.reshape(-1, 1)[linear.used.ravel()]], axis=1)
    y = linear.residual[linear.used]
    poses = x[:, :-1]
    whitened = np.linalg.solve(v, np.column_stack([x, y]))
    inside = poses @ np.linalg.lstsq(poses.T @ whitened[:, : poses.shape[1]],
                                     poses.T @ whitened[:, poses.shape[1] :], rcond=None)[0]
    left = np.column_stack([x[:, -1], y]) - inside
    np.testing.assert_allclose(f.information, left.T @ np.linalg.solve(v, left), rtol=1e-5)
    solution = solve(f)
    assert solution.values[0] == pytest.approx(f.information[0, 1] / f.information[0, 0])


@pytest.mark.parametrize('frames', [4, 24])
@pytest.mark.parametrize('name', [
    'landmark_normal', 'image_coarse', 'frame_linear', 'frame_bumps', 'board_in_plane'])
def test_without_a_component_is_what_the_equations_say_that_never_had_it(frames, name):
    linear = linearised(frames=frames, offsets=2e-3)
    random = design(linear)
    border = np.concatenate(
        [linear.effect_columns(CATALOGUE['skew']()), linear.residual[..., None]], axis=-1)
    eq, kind = equations(random, linear.frame_columns, border), NAMES.index(name)
    now = some_variances(eq)
    f = factored(eq.trimmed(now.alive), now.lam, now.weight)
    known = posterior(f)
    whole = f, solve(f, known), known
    gone = without(now, name)
    direct_f = factored(eq.trimmed(gone.alive), now.lam, now.weight)
    direct = solve(direct_f, posterior(direct_f))
    assert ratio_without(*whole, kind) == pytest.approx(direct.deviance - whole[1].deviance)
    if not (f.equations.blocks.r_label == kind).any():
        return
    found, after = solution_without(*whole, kind), stepped(direct_f, direct, gone)
    assert found.deviance == pytest.approx(direct.deviance)
    assert found.variance == pytest.approx(direct.variance)
    there = after.alive
    np.testing.assert_array_equal(stepped(f, found, gone).alive, there)
    np.testing.assert_allclose(stepped(f, found, gone).lam[there], after.lam[there], rtol=1e-6)
    np.testing.assert_allclose(stepped(f, found, gone).weight, after.weight, rtol=1e-6)


@pytest.mark.parametrize('frames', [4, 24])
@pytest.mark.parametrize('there', [(), ('landmark_in_plane', 'image_broad', 'frame_focal')])
def test_score_tests_are_those_of_the_dense_matrices(frames, there):
    linear = linearised(frames=frames, offsets=2e-3)
    random = design(linear)
    probe = linear.effect_columns(CATALOGUE['skew']())
    eq = equations(random, linear.frame_columns,
                   np.concatenate([probe, linear.residual[..., None]], axis=-1))
    now = some_variances(eq)
    now = replace(now, lam=np.where([name in there for name in NAMES], now.lam, GONE))
    z, label = dense_columns(linear, random)
    weight = np.concatenate([
        np.ones(random.frame.shape[-1] * frames), np.repeat(now.weight, 3),
        np.ones(random.shared.shape[1])])
    v = np.eye(len(z)) + (z / (now.lam[label] * weight)) @ z.T
    fixed = np.column_stack([dense_poses(linear), probe.reshape(-1, 1)[linear.used.ravel()]])
    inverse = np.linalg.inv(v)
    across = inverse @ fixed
    p = inverse - across @ np.linalg.lstsq(fixed.T @ across, across.T, rcond=None)[0]
    y = linear.residual[linear.used]
    found = score_components(eq, now, list(NAMES))
    assert len(found) > 10
    for name, p_value in found.items():
        columns = z[:, label == NAMES.index(name)]
        remaining, pull = columns.T @ p @ columns, columns.T @ p @ y
        mean, spread = np.trace(remaining), 2 * (remaining**2).sum()
        variance = y @ p @ y / (len(y) - np.linalg.matrix_rank(fixed))
        size = pull @ pull / variance
        assert p_value == pytest.approx(
            special.gammaincc(mean**2 / spread, size * mean / spread), rel=1e-3, abs=1e-12), name


def test_many_frames_need_no_matrix_of_all_that_they_have_of_their_own():
    """A recording of 340 frames took 15 GB."""
    linear, kind = linearised(frames=150), NAMES.index('frame_bumps')
    eq = equations(design(linear), linear.frame_columns, linear.residual[..., None])
    count = (eq.blocks.e_label == kind).sum()
    now = some_variances(eq)
    f = factored(eq, now.lam, now.weight)
    known = posterior(f)
    solution = solve(f, known)
    tracemalloc.start()
    ratio_without(f, solution, known, kind)
    score_components(eq, without(now, 'frame_bumps'), ['frame_bumps'])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert count > 3000 and peak < 2 * 8 * count**2


def test_a_direction_that_random_parts_have_taken_up_stays_where_it_is():
    linear = linearised(frames=1)
    eq = equations(design(linear), linear.frame_columns, linear.residual[..., None])
    f = factored(eq, some_variances(eq).lam, np.ones(len(eq.landmarks)))
    root = replace(f, information=np.ones((3, 3))).root
    np.testing.assert_allclose(root @ root.T, np.ones((2, 2)), atol=1e-4)


def test_what_the_data_determine_is_the_trace_of_the_dense_matrix():
    linear = linearised(frames=5)
    random = design(linear)
    border = np.concatenate(
        [linear.effect_columns(CATALOGUE['skew']()), linear.residual[..., None]], axis=-1
    )
    eq = equations(random, linear.frame_columns, border)
    now = some_variances(eq)
    f = factored(eq.trimmed(now.alive), now.lam, now.weight)
    solution = solve(f, posterior(f))
    z, label = dense_columns(linear, random)
    precision = np.where(label >= 0, now.lam[label], 0.0) * np.concatenate([
        np.ones(5 * random.frame.shape[-1]), np.repeat(now.weight, 3),
        np.ones(random.shared.shape[1]),
    ])
    probe = border[..., :1].reshape(-1, 1)[linear.used.ravel()]
    x = np.concatenate([dense_poses(linear), probe], axis=1)
    full = np.concatenate([x, z], axis=1)
    matrix = full.T @ full + np.diag(np.concatenate([np.zeros(x.shape[1]), precision]))
    scale = np.sqrt(np.diag(matrix))
    inverse = np.linalg.inv(matrix / scale / scale[:, None]) / scale / scale[:, None]
    expected = np.diag(inverse)[x.shape[1] :]
    frame, landmark, shared = f.equations.sorted(solution.spread_e, solution.spread_r)
    found = np.concatenate([frame[:, 6:].ravel(), landmark.ravel(), shared])
    np.testing.assert_allclose(found, expected, rtol=1e-4)


@pytest.mark.parametrize('by_frame', [False, True])
def test_a_frame_left_out_is_as_if_it_had_never_been(by_frame):
    linear = linearised(cameras=2, frames=6)
    random, pose = design(linear), linear.frame_columns
    if not by_frame:  # what single frames have of their own makes their blocks the larger part
        random = random._replace(frame=random.frame[..., :2], frame_label=random.frame_label[:2])
    border = np.concatenate(
        [linear.effect_columns(CATALOGUE['decentering']()), linear.residual[..., None]], axis=-1
    )
    eq = equations(random, pose, border)
    now = some_variances(eq)
    f = factored(eq.trimmed(now.alive), now.lam, now.weight)
    assert f.equations.by_frame == by_frame
    found = left_out_in_turn(f, random, pose, border)
    keep = np.arange(len(pose)) != 3
    rows = np.repeat(keep, linear.residual.shape[1])[:, None]
    gone = random._replace(
        frame=random.frame * keep[:, None, None], place=random.place * keep[:, None, None, None],
        shared=random.shared.multiply(rows).tocsr(),
        slot=np.where(keep[:, None], random.slot, -1),
    )
    rest = equations(gone, pose * keep[:, None, None], border * keep[:, None, None])
    direct = factored(rest.trimmed(now.alive), now.lam, now.weight)
    np.testing.assert_allclose(f.information - found.information[3], direct.information, rtol=1e-4)
    # What the others predict of the frame's image, its pose fitted to what they leave.
    way = np.array([0.0, 0.0, 1.0])
    _, landmark, shared = direct.equations.sorted(*direct.coefficients(way))
    offset = np.zeros((len(random.landmark) + 1, 3))
    offset[direct.equations.landmarks] = landmark
    moved = (random.place[3] @ offset[random.slot[3]][..., None]).ravel()
    height = linear.residual.shape[1]
    left = linear.residual[3] - moved - random.shared[3 * height : 4 * height] @ shared
    left -= pose[3] @ np.linalg.lstsq(pose[3], left, rcond=1e-9)[0]
    np.testing.assert_allclose(found.rows[3] @ way, left, atol=1e-5 * np.abs(left).max())


def test_variances_that_were_put_in_come_out():
    linear = linearised(seed=5, offsets=2e-4)
    evidence = gather_evidence(linear.data, linear.state, ())
    tau = dict(zip(NAMES, evidence.variances.tau, strict=True))
    # Of a t distribution, so the scale is below the standard deviation of the bulk, 0.2 mm.
    assert 0.1 < tau['landmark_in_plane'] < 0.25
    assert evidence.variances.sigma == pytest.approx(SIGMA, rel=0.08)
    own = np.arange(evidence.own)
    basis = identifiable(linear.frame_columns, evidence.border[..., :-1], own)
    p = significance(evidence.full.bordered(basis), evidence.variances)
    assert p['landmark_in_plane'] < 1e-9


def test_a_variance_of_zero_is_rarely_called_for():
    p_values = []
    for seed in range(8):
        linear = linearised(seed=40 + seed, frames=12)
        border = linear.residual[..., None]
        eq = equations(design(linear), linear.frame_columns, border)
        nothing = Variances(1.0, np.full(len(NAMES), GONE), np.ones(len(eq.landmarks)))
        p_values += score_components(eq, nothing, list(NAMES)).values()
    assert len(p_values) > 60
    assert np.mean(np.array(p_values) < 0.1) < 0.2
    assert min(p_values) > 1e-5


def test_without_variances_there_is_nothing_but_noise():
    linear = linearised(seed=6)
    evidence = gather_evidence(linear.data, linear.state, ())
    assert evidence.variances.sigma == pytest.approx(SIGMA, rel=0.08)
    fitted = fit_linear(evidence.linear, evidence.variances)
    left = conditional_residuals(fitted)[linear.used]
    freedom = 1 - leverages(fitted)[linear.used].mean()
    assert np.sqrt((left**2).mean() / freedom) == pytest.approx(SIGMA, rel=0.08)


def test_estimates_lower_the_deviance():
    linear = linearised(seed=7, offsets=3e-4)
    border = linear.residual[..., None]
    eq = equations(design(linear), linear.frame_columns, border)
    first = start_variances(eq)
    before = solve(factored(eq.trimmed(first.alive), first.lam, first.weight)).deviance
    found, rest = estimate(eq, first)
    after = solve(factored(rest, found.lam, found.weight)).deviance
    assert after < before
    # Where a fit has run away, so have the variances that the next one begins with.
    found, rest = estimate(eq, replace(first, lam=np.full(len(NAMES), 1e-18)))
    assert solve(factored(rest, found.lam, found.weight)).deviance < before


def test_a_step_that_takes_points_out_of_sight_is_cut_short():
    linear = linearised(seed=7)
    port = CATALOGUE['flat_port']()

    def after(part):
        return replace(linear.state, terms=((port, np.array([10.0 * part])),))

    assert not np.isfinite(Linearised(linear.data, after(1.0), ()).residual).all()
    state, residual = in_sight(linear.data, (), after)
    assert np.isfinite(residual).all() and state.terms[0][1] < 10.0
    refitted = refit(linear.data, after(0.0), (), gather_evidence(
        linear.data, linear.state, ()).variances)
    assert np.isfinite(Linearised(linear.data, refitted, ()).residual).all()


def test_score_is_the_f_test_of_nested_models_where_nothing_is_random():
    free = intrinsic_names(lens())
    linear = linearised(seed=8, free=free)
    evidence = gather_evidence(linear.data, linear.state, free)
    nothing = Variances(1.0, np.full(len(NAMES), GONE), evidence.variances.weight)
    bare = replace(evidence, variances=nothing)
    own = np.arange(evidence.own)
    form = next(i for i, e in enumerate(evidence.forms.effects) if e.name == 'decentering')
    columns = evidence.columns_of(form)
    found = bare.score(swept(bare.information, own), columns)
    used = linear.used.ravel()
    wide = np.concatenate([dense_poses(linear), linear.shared_columns.reshape(len(used), -1)[used],
                           linear.effect_columns(evidence.forms.effects[form])
                           .reshape(len(used), -1)[used]], axis=1)
    y = linear.residual[linear.used]
    small, large = (
        float(((y - m @ np.linalg.lstsq(m, y, rcond=None)[0]) ** 2).sum())
        for m in (wide[:, :-2], wide)
    )
    assert found.rank == 2
    assert found.statistic == pytest.approx(small - large, rel=1e-5)


def test_doubt_about_variances_has_its_degrees_of_freedom():
    linear = linearised(seed=31, offsets=3e-4)
    evidence = gather_evidence(linear.data, linear.state, ())
    own = np.arange(evidence.own)
    form = next(i for i, e in enumerate(evidence.forms.effects) if e.name == 'target_shape')
    columns = evidence.columns_of(form)
    score = evidence.score(swept(evidence.information, own), columns)
    sure = confident(evidence, score, own, columns)
    assert sure.p_value == pytest.approx(
        stats.f.sf(score.statistic / score.rank, score.rank, sure.freedom))
    assert sure.p_value > 1.5 * score.p_value

    # Satterthwaite: two over the variance of the logarithm of what the columns tell.
    now, way = evidence.variances, score.estimate * evidence.scale[columns]

    def told(change):
        """Return the logarithm of it for changes of log tau^2 and, last, of log sigma^2."""
        lam = np.where(now.alive, now.lam * np.exp(change[-1] - change[:-1]), GONE)
        sigma = now.sigma * np.exp(change[-1] / 2)
        other = replace(evidence, variances=replace(now, lam=lam, sigma=sigma))
        block = swept(other.information, own)[np.ix_(columns, columns)]
        return np.log(way @ block @ way)

    steps = 1e-4 * np.eye(len(NAMES) + 1)
    slope = np.array([(told(step) - told(-step)) / 2e-4 for step in steps])
    assert sure.freedom == pytest.approx(2 / (slope @ now.covariance @ slope), rel=1e-3)


def test_p_values_are_uniform_without_an_effect():
    p_values = []
    for seed in range(10):
        linear = linearised(seed=100 + seed, offsets=2e-4 * (seed % 2))
        evidence = gather_evidence(linear.data, linear.state, ())
        left = swept(evidence.information, np.arange(evidence.own))
        for form, effect in enumerate(evidence.forms.effects):
            simplest = effect == next(e for e in evidence.forms.effects if e.name == effect.name)
            if simplest and effect.name in TESTED:
                columns = evidence.columns_of(form)
                score = evidence.score(left, columns)
                sure = confident(evidence, score, np.arange(evidence.own), columns)
                p_values.append(sure.p_value)
    # 40 values; a sound build fails this less than once in ten thousand runs.
    assert stats.kstest(p_values, 'uniform').pvalue > 1e-4


def test_predicted_offsets_are_near_the_true_ones():
    rng = np.random.default_rng(9)
    pose, views = scene(rng)
    moves = rng.normal(size=views.points[0].shape) * 1e-3
    table = observe(lens(), (), pose, views._replace(points=views.points + moves), SIGMA, rng)
    table = replace(table, xyz=views.points[0][table.landmark])
    data = prepare(table)
    state = fit(data, start(data, lens()), ())
    evidence = gather_evidence(data, state, ())
    found = local_offsets(fit_linear(evidence.linear, evidence.variances))
    true = moves[found.landmark]
    # Poses and the catalogue take up part of what all landmarks do together.
    assert np.corrcoef(found.offset.ravel(), true.ravel())[0, 1] > 0.7


def test_every_component_has_words():
    assert set(NAMES) <= set(COMPONENTS)


@pytest.mark.parametrize('seed', [9, 28])
def test_a_scale_for_each_landmark_does_not_make_more_of_chance(seed):
    linear = linearised(seed)
    evidence = gather_evidence(linear.data, linear.state, ())
    fitted, eq = evidence.variances, evidence.beside(np.arange(evidence.own))
    assert fitted.weight.min() < 0.8
    p = significance(eq, fitted)['landmark_in_plane']
    assert p > 0.1
    assert significance(eq, fitted.drawn_alike)['landmark_in_plane'] == pytest.approx(p, rel=1e-6)
