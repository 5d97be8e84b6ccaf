"""Two engines, one formula: they agree to rounding, and nobody notices which one runs."""

import os
import shutil
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from helpers.lenses import HEIGHTS, LENSES, SHIFTS, make_lens, points_around, points_on_rays

from fisheye_svp_ros import cli
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import GeometryError, ParameterError
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.optics import engines, formulas
from fisheye_svp_ros.optics.camera import project, project_with_jacobian
from fisheye_svp_ros.optics.curve_base import SumOfShifts
from fisheye_svp_ros.optics.curves import (
    IMAGE_HEIGHTS,
    VIEWPOINT_SHIFTS,
    Equidistant,
    Gennery,
    KannalaBrandt,
)
from fisheye_svp_ros.optics.engines import marquardt, numpy_engine
from fisheye_svp_ros.optics.engines.results import PLANARITY
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, identity
from fisheye_svp_ros.scene.observations import views_of
from fisheye_svp_ros.scene.rigs import calibration_poses, rig
from fisheye_svp_ros.solve import localization, stereo_calibration
from fisheye_svp_ros.solve.localization import MIN_POINTS, localize
from fisheye_svp_ros.solve.stereo_calibration import calibrate_stereo

FISH214 = load_lens(lens_path('fish214'))
SAME = 1e-12  # relative


@pytest.fixture
def compiled():
    """Return the compiled engine, to be called beside the reference."""
    pytest.importorskip('numba', reason='the engine numba comes with the extra `fast`')
    from fisheye_svp_ros.optics.engines import numba_engine

    return numba_engine


def both_equal(expected, found, scale=1.0):
    for a, b in zip(expected, found, strict=True):
        assert a.shape == b.shape
        finite = np.isfinite(a)
        np.testing.assert_array_equal(finite, np.isfinite(b))
        np.testing.assert_allclose(a[finite], b[finite], rtol=SAME, atol=SAME * scale)


def points_of_all_kinds(lens):
    """Points on rays, near the lens, far, behind it, on its axis, at it, and no points at all."""
    rng = np.random.default_rng(91)
    special = [
        [0, 0, 0.3],
        [1e-12, 0, 0.3],
        [0, 1e-5, 0.4],
        [0, 0, -0.3],
        [0, 0, 0],
        [np.nan, 0.1, 0.2],
        [0.1, 0.2, np.inf],
        [0.3, 0, 0],
        [0, -0.2, 1e-9],
    ]
    return np.concatenate(
        [
            points_on_rays(lens, rng, 300),
            points_around(rng, 300, 0.01, 0.3, 180.0),
            points_around(rng, 400, 0.3, 1e4, 180.0),
            special,
        ]
    )


def test_the_engine_is_compiled_by_one_process_of_the_tests(
    compiled, request: pytest.FixtureRequest
) -> None:
    """The group was given after pytest-xdist had read it: each worker compiled."""
    grouped = bool(request.config.getoption('loadgroup', False))
    assert request.node.nodeid.endswith('@engines') == grouped


@pytest.mark.parametrize('lens', LENSES)
@pytest.mark.parametrize('limited', [True, False])
def test_projection_and_derivatives_of_any_point(compiled, lens, limited):
    points = points_of_all_kinds(lens)
    projected, expected, found = (
        numpy_engine.project(lens, points, limited),
        *(
            [part[0] for part in engine.linearize_views(lens, *identity(1), points[None], limited)]
            for engine in (numpy_engine, compiled)
        ),
    )
    both_equal(projected, compiled.project(lens, points, limited), scale=lens.fx)
    some = np.isfinite(points).all(axis=1)  # no rotation turns a point at infinity
    both_equal([p[some] for p in projected], [e[some] for e in expected[:2]], scale=lens.fx)
    both_equal(expected[:2], found[:2], scale=lens.fx)
    seen = expected[1]
    size = np.abs(expected[2][seen]).max(axis=(1, 2), keepdims=True)
    both_equal([expected[2][seen] / size], [found[2][seen] / size])


@pytest.mark.parametrize('count', [0, 1, 33, 255, 256, 257, 20_000])
def test_derivatives_by_the_pose_whatever_the_number_of_points(compiled, count):
    rng = np.random.default_rng(92)
    pose = identity(3).retract(rng.normal(size=(3, 6)))
    local = points_on_rays(FISH214, rng, 3 * count, nearest=0.3).reshape(3, count, 3)
    points = np.stack([p.transform(x) for p, x in zip(map(Pose, *pose), local, strict=True)])
    expected, found = (
        engine.linearize_views(FISH214, *pose, points, True) for engine in (numpy_engine, compiled)
    )
    both_equal(expected, found, scale=1e3)


@pytest.mark.parametrize('threads', [1, 2, 3])
def test_any_number_of_threads(compiled, monkeypatch, threads):
    monkeypatch.setattr(compiled, '_threads', lambda: threads)
    points = points_on_rays(FISH214, np.random.default_rng(93), 100_001, nearest=0.3)
    both_equal(
        numpy_engine.project(FISH214, points, True),
        compiled.project(FISH214, points, True),
        scale=1e3,
    )
    views = *identity(1000), points[1:].reshape(1000, 100, 3)
    both_equal(
        numpy_engine.linearize_views(FISH214, *views, True),
        compiled.linearize_views(FISH214, *views, True),
        scale=1e3,
    )


def views_and_poses(count, points=33, noise=0.3):
    rng = np.random.default_rng(94)
    landmarks = points_around(rng, points, 0.4, 2.0, 80.0)
    pose = identity(count).retract(0.05 * rng.normal(size=(count, 6)))
    uv = project(FISH214, pose.into_body(landmarks)).uv
    uv += noise * rng.normal(size=uv.shape)
    uv[rng.uniform(size=uv.shape[:2]) < 0.1] = np.nan
    return views_of(landmarks, uv), pose


def njit_of(rule):
    from numba import njit

    return njit(rule)


def on_each(run):
    answers = []
    for name in ('numpy', 'numba'):
        engines.use(name)
        answers.append(run())
    return answers


@pytest.mark.parametrize('count', [1, 700])
def test_poses_and_their_covariances(compiled, engine, count):
    views, pose = views_and_poses(count)
    model = ForwardModel(FISH214)
    expected, found = on_each(lambda: localize(model, views, pose))
    assert expected.converged.all() and found.converged.all()
    assert np.abs(found.pose.difference(expected.pose)).max() < 1e-11
    np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-6)
    np.testing.assert_allclose(found.residual, expected.residual, rtol=0, atol=1e-8)
    np.testing.assert_allclose(found.cost, expected.cost, rtol=1e-10)
    np.testing.assert_array_equal(found.iterations, expected.iterations)


def test_exact_images_cost_nothing(compiled):
    views, pose = views_and_poses(5, noise=0.0)
    start = pose.retract(np.full((5, 6), 1e-3))
    found, remaining, _ = compiled.localize(
        FISH214, views.solver_inputs, views.row, MIN_POINTS, start
    )
    assert remaining == 0 and found.converged.all() and found.cost.max() < 1e-12
    assert np.abs(found.pose.difference(pose)).max() < 1e-9


def test_small_changes_of_poses_are_those_of_the_reference(compiled):
    from fisheye_svp_ros.optics.engines.kernels import retract

    rng = np.random.default_rng(97)
    pose = identity(1).retract(rng.normal(size=(1, 6)))
    for size in (1e-8, 1e-3, 1.0):
        change, found = size * rng.normal(size=(1, 6)), identity(1)
        retract(
            pose.rotation[0], pose.position[0], change[0], found.rotation[0], found.position[0]
        )
        assert np.abs(found.difference(pose.retract(change))).max() < 1e-14


def test_flat_targets_are_told_by_the_eigenvalues_of_their_spread(compiled):
    from fisheye_svp_ros.optics.engines.entries import _is_planar

    rng, said = np.random.default_rng(98), []
    for thickness in PLANARITY * np.geomspace(0.05, 20.0, 60):
        points = rng.normal(size=(30, 3)) * [1.0, 0.6, thickness]
        points = identity(1).retract(rng.normal(size=(1, 6))).take(0).transform(points) + 40.0
        weight = rng.uniform(0.5, 2.0, 30)
        least, _, largest = np.linalg.eigvalsh(np.cov(points.T, aweights=weight, ddof=0))
        if abs(np.log(least / largest / PLANARITY**2)) > 0.1:
            said.append(_is_planar(points, weight))
            assert said[-1] == (least < PLANARITY**2 * largest)
    assert 20 < sum(said) < len(said) - 20


def test_an_information_is_inverted_whatever_its_units_unless_it_is_nearly_singular(compiled):
    from fisheye_svp_ros.optics.engines.entries import _invert

    rng, found = np.random.default_rng(99), np.empty((6, 6))
    scale = 10.0 ** np.array([-7.0, 7.0, -3.0, 0.0, 2.0, 5.0])
    columns = rng.normal(size=(20, 6))
    for likeness, determined in ((1.0, True), (1e-4, True), (1e-7, False)):
        columns[:, 1] = columns[:, 0] + likeness * rng.normal(size=20)
        hessian = columns.T @ columns * scale * scale[:, None]
        assert _invert(hessian, np.empty((6, 6)), found) == determined
        if determined:
            np.testing.assert_allclose(
                found @ hessian * scale[:, None] / scale, np.eye(6), atol=1e-6
            )


def test_both_take_the_same_steps(compiled, monkeypatch):
    """Far starts: steps are refused, damping grows and shrinks, the last step is the same one."""
    views, pose = views_and_poses(60)
    start = pose.retract(0.6 * np.random.default_rng(95).normal(size=(60, 6)))
    ends, given = set(), (FISH214, views.solver_inputs, views.row, MIN_POINTS, start)
    # What is given up for the reference takes no steps of the compiled form to the end.
    kept = compiled.localize(*given)[0].converged
    assert kept.sum() > 40
    # The array form, whichever engine other tests have made the one that answers.
    monkeypatch.setattr(localization.engines, 'localize', lambda *_: None)
    for limit in range(1, 40):
        monkeypatch.setattr(localization, 'MAX_ITERATIONS', limit)
        expected = localization.localize(ForwardModel(FISH214), views, start)
        expected, found = expected.take(kept), compiled.localize(*given, limit)[0].take(kept)
        np.testing.assert_array_equal(found.iterations, expected.iterations)
        assert np.abs(found.pose.difference(expected.pose)).max() < 1e-8
        np.testing.assert_allclose(found.cost, expected.cost, rtol=1e-6)
        ends |= set(found.iterations.tolist())
    assert len(ends) > 10


def test_the_rules_of_damping_are_the_same_compiled(compiled):
    rng = np.random.default_rng(96)
    damping, growth, cost, before, moved, moved_before = 10.0 ** rng.uniform(-14, 6, (6, 400))
    cost[::7] = np.inf
    moved[::11], cost[1::13] = 0.0, before[1::13]
    quick = [
        njit_of(rule)
        for rule in (marquardt.is_last, marquardt.is_better, marquardt.update_damping)
    ]
    better = marquardt.is_better(cost, before)
    arguments = (
        (moved, moved_before, before, damping),
        (cost, before),
        (damping, growth, better, before - cost, moved),
    )
    for rule, compiled_rule, given in zip(
        (marquardt.is_last, marquardt.is_better, marquardt.update_damping),
        quick,
        arguments,
        strict=True,
    ):
        want = np.stack(np.atleast_2d(rule(*given)), axis=-1)
        found = [np.atleast_1d(compiled_rule(*numbers)) for numbers in zip(*given, strict=True)]
        np.testing.assert_allclose(found, want, rtol=1e-12)


def test_rigs_and_their_covariances(compiled, engine, monkeypatch):
    rng = np.random.default_rng(95)
    model, landmarks = ForwardModel(FISH214), points_around(rng, 33, 0.5, 2.0, 60.0) * [1, 1, -1]
    left, right = (
        views_of(landmarks, uv + 0.3 * rng.normal(size=uv.shape))
        for uv in (
            project(FISH214, p.into_body(landmarks)).uv
            for p in (calibration_poses().compose(rig('vergent')), calibration_poses())
        )
    )
    for systems in (1, 2):
        expected, found = on_each(lambda n=systems: calibrate_stereo(model, model, left, right, n))
        assert expected.converged.all() and found.converged.all()
        assert np.abs(found.rig.difference(expected.rig)).max() < 1e-10
        assert np.abs(found.pose.difference(expected.pose)).max() < 1e-10
        np.testing.assert_allclose(found.rig_covariance, expected.rig_covariance, rtol=1e-6)
        np.testing.assert_allclose(found.cost, expected.cost, rtol=1e-10)
    engines.use('numba')  # and needs nothing of the reference
    monkeypatch.setattr(stereo_calibration, 'levenberg_marquardt', None)
    assert calibrate_stereo(model, model, left, right, 2).converged.all()


def test_points_near_the_lens_and_singular_systems_go_to_the_reference(compiled, engine):
    views, pose = views_and_poses(3)
    model = ForwardModel(FISH214)
    line = np.linspace(0.2, 0.6, 33)[:, None] * [1.0, 0.5, 2.0]
    near = views.points.copy()
    near[1] = line  # fixes no pose
    near[2, 0] = 0.0, 0.0, 0.02  # inside the lens
    expected, found = on_each(lambda: localize(model, views._replace(points=near), pose))
    assert expected.converged.tolist() == found.converged.tolist() == [True, False, True]
    changed = views._replace(points=near)
    quick, remaining, flat = compiled.localize(
        FISH214, changed.solver_inputs, changed.row, MIN_POINTS, pose
    )
    assert quick.converged.tolist() == [True, False, False] and remaining == 2 and flat == 1
    both_equal(expected.pose, found.pose)
    assert np.isnan(found.covariance[1]).all()
    views.weight[1, 3:] = 0.0
    for name in ('numpy', 'numba'):
        engines.use(name)
        with pytest.raises(GeometryError, match=r'frame 1 has . usable points'):
            localize(model, views, pose)


def test_residuals_of_unweighted_points_near_the_lens_are_those_of_the_reference(compiled, engine):
    """A fit keeps clear of them, so that only the residuals meet them."""
    views, pose = views_and_poses(2)
    near = views.points.copy()
    near[1, 5] = pose.position[1] + [0.02, 0.0, 3e-3]
    views = views._replace(points=near)
    views.uv[1, 5], views.weight[1, 5] = 400.0, 0.0
    expected, found = on_each(lambda: localize(ForwardModel(FISH214), views, pose))
    np.testing.assert_allclose(found.residual, expected.residual, rtol=0, atol=1e-8)


def test_a_curve_without_a_formula_goes_to_the_reference(compiled):
    shift = SumOfShifts((FISH214.viewpoint_shift, Gennery(0.001)))
    lens = replace(FISH214, viewpoint_shift=shift)
    points = points_around(np.random.default_rng(96), 50, 0.3, 2.0, 90.0)
    assert compiled.pack_lens(lens) is None
    both_equal(numpy_engine.project(lens, points, True), compiled.project(lens, points, True))
    views = *identity(1), points[None]
    both_equal(
        numpy_engine.linearize_views(lens, *views, True),
        compiled.linearize_views(lens, *views, True),
    )


def test_many_lenses_in_turn_are_not_mixed_up(compiled):
    point = np.array([[0.3, 0.0, 0.4]])
    for f in range(100, 300):
        lens = Lens('', 1, 1, f, f, 0.0, 0.0, Equidistant(), 1.5)
        uv, _ = compiled.project(lens, point, True)
        assert uv[0, 0] == pytest.approx(f * np.arctan2(0.3, 0.4), rel=1e-14)


@pytest.fixture
def unsettled(monkeypatch):
    """Leave the choice to the package, whatever is chosen for the tests."""
    monkeypatch.setattr(engines, '_engine', numpy_engine)
    monkeypatch.setenv(engines.VARIABLE, 'auto')


@pytest.mark.parametrize(
    ('filled', 'points', 'chosen'),
    [
        (True, engines.LOADING - 1, 'numpy'),
        (True, engines.LOADING, 'numba'),
        (False, engines.LOADING, 'numpy'),
        (False, 1e10, 'numba'),
    ],
)
def test_the_compiled_engine_comes_where_it_pays(
    compiled, unsettled, monkeypatch, filled, points, chosen
):
    monkeypatch.setattr(engines.cache, 'is_compiled', lambda: filled)
    assert engines.settle(points) == chosen
    assert engines.settle(1) == chosen


def test_what_was_asked_for_stays(compiled, unsettled):
    engines.use('numpy')
    assert engines.settle(1e10) == 'numpy'


@pytest.mark.parametrize('name', ['auto', 'numba'])
def test_a_numba_that_does_not_go_with_this_numpy(unsettled, monkeypatch, name):
    pytest.importorskip('numba', reason='its version is part of what is said')
    monkeypatch.setitem(sys.modules, 'fisheye_svp_ros.optics.engines.numba_engine', None)
    monkeypatch.delattr(engines, 'numba_engine', raising=False)
    monkeypatch.setattr(engines, 'find_spec', lambda _: 'there')
    if name == 'auto':
        assert engines.settle(1e10) == 'numpy'
    else:
        with pytest.raises(ParameterError, match='the engine numba cannot be loaded'):
            engines.use(name)


def test_what_another_installation_compiled_is_not_there(tmp_path):
    pytest.importorskip('numba', reason='the engine numba comes with the extra `fast`')
    here, there = Path(engines.__file__).parents[3], tmp_path / 'elsewhere'
    shutil.copytree(here / 'fisheye_svp_ros', there / 'fisheye_svp_ros')
    code = (
        'from fisheye_svp_ros.optics.engines import cache\n'
        'cache.folder().mkdir(parents=True, exist_ok=True)\n'
        '{} or print(cache.is_compiled())'
    )

    def run(where, line):
        environment = os.environ | {'XDG_CACHE_HOME': str(tmp_path), 'PYTHONPATH': str(where)}
        return subprocess.run(
            [sys.executable, '-c', code.format(line)],
            env=environment,
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=True,
        ).stdout

    assert run(here, 'cache.mark_filled()') == 'True\n'
    assert run(there, 'None') == 'False\n'
    assert run(here, 'None') == 'True\n'


def test_small_work_never_loads_numba():
    code = (
        'import sys, numpy as np\n'
        'from fisheye_svp_ros.optics.camera import project\n'
        'from fisheye_svp_ros.io.lens_files import load_lens\n'
        f'project(load_lens({str(lens_path("fish214"))!r}), np.ones((1000, 3)))\n'
        'print("numba" in sys.modules)'
    )
    environment = {k: v for k, v in os.environ.items() if k != engines.VARIABLE}
    ran = subprocess.run(
        [sys.executable, '-c', code], env=environment, capture_output=True, text=True, check=True
    )
    assert ran.stdout.strip() == 'False'


def test_a_wrong_or_missing_engine_is_one_line(monkeypatch, capsys):
    with pytest.raises(ParameterError, match="'fortran'; choose from auto, numpy, numba"):
        engines.use('fortran')
    monkeypatch.setitem(sys.modules, 'fisheye_svp_ros.optics.engines.numba_engine', None)
    monkeypatch.delattr(engines, 'numba_engine', raising=False)
    assert cli.main(['localize', 'none.csv', '--lens', 'none', '--engine', 'numba']) == 2
    assert 'the engine numba cannot be loaded' in capsys.readouterr().err


def test_the_engine_changes_no_answer_of_the_camera(engine):
    points = points_around(np.random.default_rng(97), 200, 0.01, 1.0, 180.0)
    image = project_with_jacobian(FISH214, points)
    both_equal(numpy_engine.project(FISH214, points, True), (image.uv, image.valid), scale=1e3)


@dataclass(frozen=True)
class Bent(KannalaBrandt):
    """A curve of a user's own, made of one of the package."""

    def value_and_slope(self, theta):
        height, slope = super().value_and_slope(theta)
        return height + 0.05 * theta**3, slope + 0.15 * theta**2


@dataclass(frozen=True)
class Doubled(Gennery):
    @property
    def coefficients(self):
        return tuple(2 * value for value in super().coefficients)


@dataclass(frozen=True)
class Enlarged(KannalaBrandt):
    """One with a formula of its own."""

    @staticmethod
    def formula(theta, *k):
        height, slope = formulas.kannala_brandt(theta, *k)
        return 1.1 * height, 1.1 * slope


@pytest.mark.parametrize(
    'changes',
    [
        {'image_height': Bent(-0.01, 0.002)},
        {'image_height': Enlarged(-0.01, 0.002)},
        {'viewpoint_shift': Doubled(0.0, 0.01)},
    ],
)
def test_a_curve_that_is_not_compiled_is_never_computed_as_another(compiled, changes):
    lens = replace(make_lens('kannala_brandt', 'gennery'), max_incidence=1.2, **changes)
    points = np.random.default_rng(5).uniform((-0.3, -0.3, 0.2), (0.3, 0.3, 0.6), (200, 3))
    uv, valid = compiled.project(lens, points, True)
    known, also = numpy_engine.project(lens, points, True)
    assert valid.tolist() == also.tolist() and valid.sum() > 100
    np.testing.assert_allclose(uv[valid], known[valid], atol=1e-9)


def test_a_formula_without_lines_in_the_kernels_gives_nothing(compiled):
    from fisheye_svp_ros.optics.engines import entries, kernels

    lens = make_lens('kannala_brandt', 'svp')
    numbers = compiled.pack_lens(lens).copy()
    numbers[kernels.HEIGHT_KIND] = len(kernels.HEIGHTS)
    uv, state = np.empty((1, 2)), np.empty(1)
    entries.project(np.array([[0.1, 0.2, 0.5]]), numbers, 1.5, uv, state)
    assert np.isnan(uv).all()


def test_the_engines_are_compared_over_the_registries(compiled):
    from fisheye_svp_ros.optics.engines import kernels

    assert {*HEIGHTS} == {*IMAGE_HEIGHTS}
    assert {type(shift) for shift in SHIFTS.values() if shift} == {*VIEWPOINT_SHIFTS.values()}
    for known, registry in ((kernels.HEIGHTS, IMAGE_HEIGHTS), (kernels.SHIFTS, VIEWPOINT_SHIFTS)):
        assert {*known} <= {getattr(kind, 'formula', None) for kind in registry.values()}
