"""Lens calibration: from nothing, for every model, and with the covariance it claims."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.data import DATA, NO_DATA
from helpers.targets import cube, plane, poses_around

from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import GeometryError, LensError, ObservationError
from fisheye_svp_ros.io.lens_files import load_lens, save_lens
from fisheye_svp_ros.io.readers import read_observations
from fisheye_svp_ros.optics.camera import back_project
from fisheye_svp_ros.optics.curves import IMAGE_HEIGHTS, FlatPort, Gennery, KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens, field_of_view
from fisheye_svp_ros.scene.observations import group_views
from fisheye_svp_ros.simulate.simulation import simulate
from fisheye_svp_ros.solve.bundle_adjustment import adjust_lens
from fisheye_svp_ros.solve.lens_calibration import _check_focal, calibrate, refit_without_outliers
from fisheye_svp_ros.solve.localization import localize
from fisheye_svp_ros.solve.measured_poses import posable_views, rms_px
from fisheye_svp_ros.solve.table_poses import solve_table

OV_PLANE = DATA / 'ov_plane'
SIZE = (1280, 960)
SAMPLES = 120
CURVED = (-0.05, 0.01, -0.003, 0.0002)
MODELS = [
    ('orthographic', 80),
    ('equidistant', 30),
    ('equidistant', 110),
    ('equisolid', 100),
    ('stereographic', 95),
    ('kannala_brandt', 25),
    ('kannala_brandt', 110),
]
TARGETS = {'plane': plane, 'cube': cube}


def make_lens(model, corner_deg):
    """Return a lens whose farthest image corner looks at an incidence angle of `corner_deg`."""
    curve = IMAGE_HEIGHTS[model](*(CURVED if model == 'kannala_brandt' else ()))
    height, _ = curve.value_and_slope(np.radians(corner_deg))
    focal = np.hypot(*SIZE) / 2 / float(height)
    lens = Lens('made', *SIZE, focal, 1.002 * focal, 653.0, 470.5, curve, 1.0)
    return replace(lens, max_incidence=field_of_view(lens))


def make_table(lens, target, frames, seed, *, sigma=0.1, **where):
    """Return observations of a target from all over the field of view; sigma is not told.

    Frames in which the image cuts most of the target off are left out.
    """
    rng = np.random.default_rng(seed)
    landmarks = target()
    if lens.max_incidence < np.radians(45):
        where = {'distance': (1.0, 3.0), **where}
    where = {'widest': 0.9 * lens.max_incidence, **where}
    poses = poses_around(landmarks, frames, rng, **where)
    table = simulate(ForwardModel(lens), landmarks, poses, sigma, rng)
    table = table.take(np.bincount(table.frame)[table.frame] >= 12)
    return replace(table, sigma=np.full(len(table), np.nan))


def parameters(lens, names):
    return np.array([lens.fx if name == 'f' else lens.parameters[name] for name in names])


@pytest.mark.parametrize('target', TARGETS)
@pytest.mark.parametrize(('model', 'corner_deg'), MODELS)
def test_finds_the_lens_from_nothing(model, corner_deg, target):
    lens = make_lens(model, corner_deg)
    table = make_table(lens, TARGETS[target], 10, 1)
    calibration = calibrate(table, model, SIZE)
    adjusted = calibration.adjusted
    assert adjusted.converged
    assert calibration.sigma == pytest.approx(0.1, rel=0.12)
    off = parameters(adjusted.lens, adjusted.names) - parameters(lens, adjusted.names)
    # Chi-squared of up to 8 parameters: above 40 once in 300 000 trials.
    assert off @ np.linalg.solve(adjusted.covariance, off) < 40
    assert adjusted.lens.calibration == {
        'rms_px': pytest.approx(0.1 * np.sqrt(2), rel=0.12),
        'observations': len(table),
        'frames': len(table.frames),
        'source': table.source,
        'reached_deg': pytest.approx(np.degrees(back_project(lens, table.uv).theta.max()), abs=1),
    }


@pytest.mark.parametrize('target', TARGETS)
def test_points_beyond_90_degrees_are_used(target):
    lens = make_lens('equidistant', 120)
    table = make_table(lens, TARGETS[target], 10, 3, sigma=0.0)
    calibration = calibrate(table, 'equidistant', SIZE)
    theta = back_project(lens, table.uv).theta
    assert (theta > np.radians(95)).sum() > 30
    assert rms_px(calibration.adjusted.residual) < 1e-8
    found = parameters(calibration.adjusted.lens, ('fx', 'fy', 'cx', 'cy'))
    np.testing.assert_allclose(found, (lens.fx, lens.fy, lens.cx, lens.cy), rtol=1e-9)


@pytest.mark.parametrize(
    ('shift', 'names'),
    [
        (Gennery(0.0, 0.006, 0.003, 0.0), ('e0', 'e1')),
        (FlatPort(0.02, 1.5), ('thickness', 'refractive_index')),
    ],
)
def test_finds_a_viewpoint_shift(shift, names):
    lens = replace(make_lens('equidistant', 80), viewpoint_shift=shift)
    lens = replace(lens, max_incidence=field_of_view(lens))
    table = make_table(lens, plane, 10, 4, sigma=0.0)
    free = ('fx', 'fy', 'cx', 'cy', *names)
    adjusted = calibrate(table, 'equidistant', SIZE, free).adjusted
    assert adjusted.names == free
    np.testing.assert_allclose(parameters(adjusted.lens, free), parameters(lens, free), rtol=1e-6)


def test_one_focal_length_and_fixed_parameters():
    lens = replace(make_lens('equisolid', 70), cx=639.5, cy=479.5)
    lens = replace(lens, fy=lens.fx)
    adjusted = calibrate(make_table(lens, plane, 6, 5), 'equisolid', SIZE, ('f',)).adjusted
    assert adjusted.lens.fx == adjusted.lens.fy == pytest.approx(lens.fx, rel=1e-3)
    assert (adjusted.lens.cx, adjusted.lens.cy) == (639.5, 479.5)


def test_covariances_hold():
    """Refits from noisy data scatter as the covariances say: lens parameters and poses."""
    lens = make_lens('kannala_brandt', 70)
    names = ('fx', 'fy', 'cx', 'cy', *lens.image_height.coefficient_names)
    rng = np.random.default_rng(6)
    landmarks = plane()
    poses = poses_around(landmarks, 5, rng, widest=0.9)
    truth = simulate(ForwardModel(lens), landmarks, poses, 0.0, rng)
    true_values = parameters(lens, names)
    lens_nees, pose_nees = [], []
    for _ in range(SAMPLES):
        noisy = replace(
            truth,
            uv=truth.uv + rng.normal(0, 0.2, truth.uv.shape),
            sigma=np.full(len(truth), 0.2),
        )
        fit = adjust_lens(lens, group_views(noisy), poses, names)
        off = parameters(fit.lens, names) - true_values
        lens_nees.append(off @ np.linalg.solve(fit.covariance, off))
        moved = fit.pose.difference(poses)
        pose_nees.append(
            np.einsum('si,sij,sj->s', moved, np.linalg.inv(fit.pose_covariance), moved)
        )
    # Four standard errors of the means of chi-squared variables; the poses share the lens.
    assert np.mean(lens_nees) == pytest.approx(8, abs=4 * np.sqrt(16 / SAMPLES))
    assert np.mean(pose_nees) == pytest.approx(6, abs=4 * np.sqrt(12 / SAMPLES))


def test_no_view_fits_better_when_it_is_posed_afresh():
    """The lens that is begun with takes one of these views for the other pose of a plane."""
    table = make_table(make_lens('equidistant', 110), plane, 8, 13, sigma=0.5, distance=(0.8, 2.5))
    found = calibrate(table, 'equidistant', SIZE)
    afresh = localize(ForwardModel(found.adjusted.lens), found.views)
    np.testing.assert_allclose(found.adjusted.cost, afresh.cost, rtol=1e-6)


@pytest.mark.parametrize('order', ['scrambled', 'begun elsewhere'])
def test_a_view_of_another_order_is_fitted_around(order):
    true = make_lens('equidistant', 80.0)
    table = make_table(true, plane, 8, 7)
    rows = np.flatnonzero(table.frame == 3)
    rng = np.random.default_rng(0)
    other = rng.permutation(rows) if order == 'scrambled' else np.roll(rows, len(rows) // 2)
    uv = table.uv.copy()
    uv[rows] = uv[other]
    found = calibrate(replace(table, uv=uv), 'kannala_brandt', (true.width, true.height))
    assert [*found.views.frame] == [f for f in np.unique(table.frame) if f != 3]
    assert not found.left_out
    assert rms_px(found.adjusted.residual) < 0.2
    assert found.adjusted.lens.fx == pytest.approx(true.fx, rel=0.01)


def test_many_views_of_another_order_are_not_fitted_around():
    true = make_lens('equidistant', 80.0)
    table = make_table(true, plane, 8, 7)
    uv, rng = table.uv.copy(), np.random.default_rng(0)
    for frame in (1, 3, 5):
        rows = np.flatnonzero(table.frame == frame)
        uv[rows] = uv[rng.permutation(rows)]
    with pytest.raises(GeometryError, match='belong together'):
        calibrate(replace(table, uv=uv), 'kannala_brandt', (true.width, true.height))


def test_estimated_and_given_sigma_agree():
    lens = make_lens('equidistant', 60)
    table = make_table(lens, plane, 8, 7, sigma=0.3)
    estimated = calibrate(table, 'equidistant', SIZE)
    given = calibrate(replace(table, sigma=np.full(len(table), 0.3)), 'equidistant', SIZE)
    assert given.sigma is None
    ratio = estimated.adjusted.covariance / given.adjusted.covariance
    np.testing.assert_allclose(ratio, (estimated.sigma / 0.3) ** 2, rtol=1e-4)
    assert estimated.sigma == pytest.approx(0.3, rel=0.1)


class TestMaxIncidence:
    def test_reaches_the_farthest_image_corner(self):
        lens = make_lens('equidistant', 60)
        found = calibrate(make_table(lens, plane, 8, 8, sigma=0.0), 'equidistant', SIZE)
        corner = back_project(replace(lens, max_incidence=np.pi), np.array([-0.5, 959.5])).theta
        assert found.adjusted.lens.max_incidence == pytest.approx(float(corner), rel=1e-8)
        assert found.beyond == 0

    def test_ends_where_the_curve_turns_back(self, tmp_path):
        # h grows up to 69 degrees, which is short of the corner.
        curve = KannalaBrandt(k1=-0.23)
        assert np.degrees(curve.limit) == pytest.approx(69, abs=0.1)
        lens = Lens('turning', *SIZE, 800.0, 800.0, 639.5, 479.5, curve, 0.99 * curve.limit)
        table = make_table(lens, plane, 10, 9, sigma=0.01, widest=1.0)
        found = calibrate(table, 'kannala_brandt', SIZE).adjusted.lens
        limit = found.image_height.limit
        assert limit < np.pi / 2
        assert 0.99 * limit < found.max_incidence < limit
        save_lens(found, tmp_path / 'lens.yaml')
        assert load_lens(tmp_path / 'lens.yaml').max_incidence == pytest.approx(
            found.max_incidence
        )

    def test_counts_what_the_fitted_curve_cannot_image(self):
        lens = make_lens('equidistant', 115)
        found = calibrate(make_table(lens, cube, 10, 10), 'orthographic', SIZE)
        assert found.adjusted.lens.max_incidence <= np.pi / 2
        pose, views = found.adjusted.pose, found.views
        inside = pose.into_body(views.points)[views.used]
        theta = np.arctan2(np.hypot(inside[:, 0], inside[:, 1]), inside[:, 2])
        assert found.beyond == (theta > found.adjusted.lens.max_incidence).sum()

    def test_covers_what_was_observed(self):
        # Points measured a little outside the image, as tags cut off by its edge are.
        lens = make_lens('equidistant', 60)
        large = replace(lens, width=1400, height=1080, cx=lens.cx + 60, cy=lens.cy + 60)
        large = replace(large, max_incidence=field_of_view(large))
        table = make_table(large, plane, 30, 11, sigma=0.0, widest=large.max_incidence)
        found = calibrate(replace(table, uv=table.uv - 60), 'equidistant', SIZE).adjusted
        widest = back_project(large, table.uv).theta.max()
        assert widest > field_of_view(lens)
        assert found.lens.max_incidence == pytest.approx(widest, rel=1e-9)


class TestBadInput:
    @pytest.fixture(scope='class')
    @classmethod
    def table(cls):
        return make_table(make_lens('equidistant', 60), plane, 6, 12)

    @pytest.mark.parametrize(
        ('free', 'says'),
        [
            (('cx', 'cy'), 'must name f'),
            (('fx', 'cx'), 'must name f'),
            (('f', 'fx', 'fy'), 'must name f'),
            (('f', 'f'), 'twice'),
            (('f', 'k1'), "no parameter 'k1'"),
            (('f', 'e0', 'thickness'), "no parameter 'thickness'"),
            ((), 'must name f'),
        ],
    )
    def test_names_that_cannot_be_freed(self, table, free, says):
        with pytest.raises(LensError, match=says):
            calibrate(table, 'equidistant', SIZE, free)

    def test_unknown_model(self, table):
        with pytest.raises(LensError, match='choose from orthographic'):
            calibrate(table, 'pinhole', SIZE)

    def test_impossible_image_size(self, table):
        with pytest.raises(LensError, match='image size is 0x960'):
            calibrate(table, 'equidistant', (0, 960))

    def test_image_size_of_another_camera(self, table):
        with pytest.raises(ObservationError, match='outside an image of 640x480'):
            calibrate(table, 'equidistant', (640, 480))

    def test_shift_that_the_poses_absorb(self, table):
        with pytest.raises(GeometryError, match='s0 is confounded with the poses'):
            calibrate(table, 'equidistant', SIZE, ('fx', 'fy', 'cx', 'cy', 's0'))

    def test_image_points_that_are_all_one(self, table):
        with pytest.raises(GeometryError):
            calibrate(replace(table, uv=np.full_like(table.uv, 300.0)), 'equidistant', SIZE)

    def test_image_points_of_other_landmarks(self, table):
        uv = np.random.default_rng(0).uniform(0, 900, table.uv.shape)
        with pytest.raises(GeometryError, match='belong together'):
            calibrate(replace(table, uv=uv), 'equidistant', SIZE)

    def test_too_few_observations(self, table):
        few = table.take((table.frame == table.frame[0]) & (np.arange(len(table)) % 13 == 0))
        with pytest.raises(GeometryError, match='do not determine 4 lens parameters'):
            calibrate(few, 'equidistant', SIZE)

    def test_focal_length_that_one_view_does_not_give(self):
        lens = make_lens('equidistant', 25)
        table = make_table(lens, plane, 1, 13, tilt=0.0, widest=0.0)
        with pytest.raises(GeometryError, match=r'fx is known only to \d+ %.*Add views'):
            calibrate(table, 'kannala_brandt', SIZE)

    def test_the_error_of_the_focal_length_is_said_in_percent(self):
        adjusted = SimpleNamespace(
            names=('cx', 'fx'),
            covariance=np.diag([0.01, (0.75 * 400) ** 2]),
            lens=SimpleNamespace(fx=400.0),
            residual=np.full((1, 5, 2), 0.3),
        )
        with pytest.raises(GeometryError, match=r'known only to 75 %, rms 0\.424 px'):
            _check_focal(adjusted, 'table.csv')

    def test_frames_that_cannot_be_posed_are_named(self, table):
        on_a_line = (table.frame == 1) & (table.landmark // 9 != 3)
        three_points = (table.frame == 4) & (table.landmark > 20)
        three_points |= (table.frame == 4) & ~np.isin(
            table.landmark, table.landmark[table.frame == 4][:3]
        )
        found = calibrate(table.take(~on_a_line & ~three_points), 'equidistant', SIZE)
        assert found.left_out == (1, 4)
        assert found.adjusted.lens.calibration['frames'] == 4

    def test_no_frame_that_can_be_posed(self, table):
        with pytest.raises(GeometryError, match='no frame can be posed'):
            calibrate(table.take(table.landmark // 9 == 3), 'equidistant', SIZE)

    def test_rows_of_two_cameras(self, table):
        mixed = replace(table, camera=table.frame % 2, cameras=('left', 'right'))
        with pytest.raises(ObservationError, match='left, right; keep the rows of one'):
            calibrate(mixed, 'equidistant', SIZE)


@pytest.mark.skipif(not OV_PLANE.exists(), reason=NO_DATA)
class TestMeasuredData:
    @pytest.fixture(scope='class')
    @classmethod
    def calibration(cls):
        train = read_observations(OV_PLANE / 'train.csv')
        return calibrate(train, 'kannala_brandt', (1280, 800))

    def test_reaches_the_published_misfit(self, calibration):
        assert calibration.adjusted.lens.calibration['rms_px'] <= 0.482

    def test_predicts_the_test_images(self, calibration):
        model = ForwardModel(calibration.adjusted.lens)
        test = solve_table(read_observations(OV_PLANE / 'test.csv'), model)
        assert rms_px(test.result.residual) <= 0.475
        assert test.left_out == ()

    def test_poses_are_those_of_localization(self, calibration):
        adjusted = calibration.adjusted
        alone = localize(ForwardModel(adjusted.lens), calibration.views)
        assert np.abs(alone.pose.difference(adjusted.pose)).max() < 1e-6


class TestMeasuredPoses:
    @pytest.fixture(scope='class')
    @classmethod
    def model(cls):
        return ForwardModel(make_lens('equidistant', 60))

    def test_estimated_sigma_scales_the_covariance(self, model):
        table = make_table(model.lens, cube, 5, 14, sigma=0.4)
        estimated = solve_table(table, model)
        given = solve_table(replace(table, sigma=np.full(len(table), 0.4)), model)
        assert given.sigma is None
        assert estimated.sigma == pytest.approx(0.4, rel=0.1)
        ratio = estimated.result.covariance / given.result.covariance
        np.testing.assert_allclose(ratio, (estimated.sigma / 0.4) ** 2, rtol=1e-3)

    def test_points_outside_the_field_of_view_do_not_count(self, model):
        narrow = ForwardModel(replace(model.lens, max_incidence=np.radians(20)))
        table = make_table(model.lens, plane, 8, 15)
        theta = back_project(model.lens, table.uv).theta
        views, left_out = posable_views(table, narrow)
        assert left_out
        for frame in left_out:
            inside = (table.frame == frame) & (theta < np.radians(20))
            assert len(np.unique(table.landmark[inside] // 9)) < 2 or inside.sum() < 4
        assert set(views.frame) | set(left_out) == set(table.frames)

    def test_nothing_to_pose(self, model):
        table = make_table(model.lens, plane, 2, 16)
        with pytest.raises(GeometryError, match='inside the field of view of lens'):
            solve_table(table, ForwardModel(replace(model.lens, max_incidence=1e-3)))


@pytest.mark.parametrize('target', TARGETS.values(), ids=TARGETS)
@pytest.mark.parametrize(('model', 'corner_deg'), [('kannala_brandt', 110), ('stereographic', 95)])
def test_a_lens_fitted_anew_without_some_points_is_that_of_a_fit_from_nothing(
    target, model, corner_deg
):
    table = make_table(make_lens(model, corner_deg), target, 10, 8)
    uv = table.uv.copy()
    uv[::97] += 3.0  # of outliers
    table = replace(table, uv=uv)
    fewer = table.take(np.arange(len(table)) % 97 > 0)
    first, expected = (calibrate(some, model, SIZE) for some in (table, fewer))
    found, names = refit_without_outliers(first, fewer), first.adjusted.names
    off, error = (
        parameters(found.adjusted.lens, names) - parameters(expected.adjusted.lens, names),
        np.sqrt(np.diag(expected.adjusted.covariance)),
    )
    assert np.abs(off / error).max() < 1e-3
    for figures in (found.adjusted.lens.calibration, expected.adjusted.lens.calibration):
        assert figures['observations'] == len(fewer)
    moved = parameters(first.adjusted.lens, names) - parameters(expected.adjusted.lens, names)
    assert np.abs(moved / error).max() > 0.1  # the points that are gone mattered
    assert refit_without_outliers(first, table.take(table.frame > table.frame.min())) is None
