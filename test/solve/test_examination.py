"""The limits by which a pose is believed or not, each against the distribution it stands for."""

import numpy as np
import pytest
from scipy import stats

from benchmark.studies.poses import SIGMA, spoilt
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.pose import identity
from fisheye_svp_ros.scene.observations import views_of
from fisheye_svp_ros.scene.rigs import rig
from fisheye_svp_ros.solve.localization import Localization, localize
from fisheye_svp_ros.solve.reliability import (
    _consensus_pose,
    _noise_from_median,
    _outliers_reason,
    _suspect,
    doubt_of_pairs,
    examine,
    misfit_fails,
    noise_sigma,
)


def clean(count=1, kind='room', seed=3):
    return spoilt('clean', kind, count, np.random.default_rng(seed))


def test_a_misfit_fails_once_in_ten_thousand_clean_views():
    """The upper tail of chi-square, at every number of degrees of freedom; none count as one."""
    freedom = np.array([1, 2, 5, 34, 400])
    limit = stats.chi2.isf(1e-4, freedom)
    assert misfit_fails(limit * (1 + 1e-9), freedom).all()
    assert not misfit_fails(limit * (1 - 1e-9), freedom).any()
    assert misfit_fails(np.array([15.2, 15.1]), np.array([0, -2])).tolist() == [True, False]


def solved_with(residual, freedom, weight=None):
    """Return views and a localization of such whitened residuals (S, N, 2)."""
    systems, points = residual.shape[:2]
    views = views_of(np.zeros((points, 3)), np.zeros(residual.shape))
    weight = np.ones((systems, points)) if weight is None else weight
    cost = (np.square(residual * weight[..., None])).sum(axis=(1, 2))
    found = Localization.of_one_minimum(
        identity(systems),
        np.tile(np.eye(6), (systems, 1, 1)),
        residual,
        cost,
        np.ones(systems, dtype=bool),
        np.zeros(systems, dtype=np.int64),
    )
    return views._replace(weight=weight), found, np.full(systems, freedom)


@pytest.mark.parametrize(('ratio', 'suspect'), [(3.7, False), (3.9, True)])
def test_a_residual_stands_out_at_so_many_times_the_others(ratio, suspect):
    """3.8 times the root mean square of a point's residual: sqrt(2) times that of a row."""
    points, freedom = 60, 114
    rest = np.full((1, points, 2), 0.1)
    rest[0, 0] = 0.0
    others = (rest**2).sum()
    # Of a square x among squares whose sum is `others`: x = 2 ratio^2 (others + x) / freedom.
    share = 2 * ratio**2 / freedom
    rest[0, 0, 0] = np.sqrt(share * others / (1 - share))
    for weight in (1.0, 4.0):
        views, found, dof = solved_with(rest / weight, freedom, np.full((1, points), weight))
        assert _suspect(views, found, dof, 1e9)[0] == suspect
    # Points without a weight count for nothing.
    views, found, dof = solved_with(
        rest, freedom, np.where(np.arange(points) == 0, 0.0, 1.0)[None]
    )
    assert not _suspect(views, found, dof, 1e9)[0]


def test_a_view_is_suspect_where_its_whole_misfit_is():
    rest = np.full((2, 20, 2), 1.0) * np.array([1.0, 1.6])[:, None, None]
    views, found, dof = solved_with(rest, 34)
    assert 40 < stats.chi2.isf(1e-4, 34) < 1.6**2 * 40
    assert _suspect(views, found, dof, 1.0).tolist() == [False, True]
    assert _suspect(views, found, dof, 2.0).tolist() == [False, False]


def test_noise_is_by_rows_less_unknowns():
    assert noise_sigma(18.0, 10, 8) == 3.0
    assert noise_sigma(4.0, 6, 6) == 2.0  # of none left: as of one
    rng = np.random.default_rng(0)
    columns = rng.normal(size=(16, 6))
    left = np.eye(16) - columns @ np.linalg.pinv(columns)
    costs = ((0.3 * rng.normal(size=(4000, 16)) @ left) ** 2).sum(axis=1)
    squares = [noise_sigma(cost, 16, 6) ** 2 for cost in costs]
    # The mean of 4 000 estimates of 10 degrees of freedom each, within three standard errors.
    assert np.mean(squares) == pytest.approx(0.09, rel=3 * np.sqrt(2 / 10 / 4000))


@pytest.mark.parametrize('points', [8, 20])
def test_the_noise_that_a_median_residual_shows_is_that_of_a_coordinate(points):
    """What the pose takes up of few residuals is given back: to a tenth, in the mean."""
    model, views, _ = clean(150)
    views = views.take_points(np.arange(points))._replace(weight=np.ones((150, points)))
    found = _noise_from_median(views, localize(model, views))
    assert found.mean() == pytest.approx(SIGMA, rel=0.1)


def test_weights_count_in_a_median_residual():
    views, found, _ = solved_with(np.full((1, 50, 2), 1.0), 94, np.full((1, 50), 0.5))
    expected = np.sqrt(2) / 2 / np.sqrt(2 * np.log(2)) * np.sqrt(50 / 47)
    assert _noise_from_median(views, found)[0] == pytest.approx(expected, rel=1e-3)


def test_an_excess_is_a_ratio_of_standard_deviations():
    """Its square scales the covariance, and divides the gap to a second minimum."""
    model, views, _ = spoilt('half size', 'room', 3, np.random.default_rng(6))
    found = localize(model, views)._replace(gap=np.full(3, 1e9))
    checked = examine(model, views, found)
    ratio = np.sqrt(found.cost / (2 * 20 - 6))
    assert (ratio > 3).all()
    np.testing.assert_allclose(checked.excess, ratio)
    scaled = checked.result.covariance - checked.result.added
    np.testing.assert_allclose(scaled, ratio[:, None, None] ** 2 * found.covariance)
    np.testing.assert_allclose(checked.result.gap, 1e9 / ratio**2)
    # Half the stated sigma is twice the ratio.
    twice = views._replace(weight=2 * views.weight)
    again = examine(model, twice, localize(model, twice))
    np.testing.assert_allclose(again.excess, 2 * ratio, rtol=1e-6)


def test_an_unknown_noise_is_that_of_the_views_that_pass():
    """Root of their squares over rows less six a view; covariances are scaled by it."""
    model, views, _ = clean(8)
    views = views._replace(weight=np.ones(views.weight.shape))
    views.uv[7] = 0.5 * views.uv[7] + 300.0  # no pose explains it
    found = localize(model, views)
    checked = examine(model, views, found, sigma_known=False)
    assert [bool(reason) for reason in checked.reasons] == [False] * 7 + [True]
    expected = np.sqrt(found.cost[:7].sum() / (7 * (2 * 20 - 6)))
    assert checked.sigma == pytest.approx(expected, rel=1e-9)
    assert expected == pytest.approx(SIGMA, rel=4 / np.sqrt(2 * 7 * 34))
    scaled = (checked.result.covariance - checked.result.added)[:7]
    np.testing.assert_allclose(scaled, expected**2 * found.covariance[:7])
    assert (checked.excess[:7] == 1).all() and checked.excess[7] > 3


def test_points_left_out_are_no_rows_of_the_noise():
    model, views, _ = clean(5, seed=4)
    views = views._replace(weight=np.ones(views.weight.shape))
    views.uv[2, [3, 7]] += [[30.0, 0.0], [0.0, -25.0]]
    checked = examine(model, views, localize(model, views), sigma_known=False)
    assert checked.outliers.sum() == 2 and checked.outliers[2, [3, 7]].all()
    kept = views._replace(weight=np.where(checked.outliers, 0.0, views.weight))
    cost = localize(model, kept).cost
    passed = np.arange(5) != 2  # the view with outliers has its reason
    expected = np.sqrt(cost[passed].sum() / (4 * 34))
    assert checked.sigma == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(('points', 'wrong', 'searched'), [(20, 8, True), (20, 9, False)])
def test_three_fifths_of_the_points_must_agree(points, wrong, searched):
    model, views, _ = clean(seed=7)
    rng = np.random.default_rng(1)
    views.uv[0, :wrong] += rng.uniform(20, 60, (wrong, 2)) * rng.choice([-1, 1], (wrong, 2))
    checked = examine(model, views, localize(model, views))
    assert bool(checked.outliers.any()) == searched
    if searched:
        assert set(np.flatnonzero(checked.outliers[0])) == set(range(wrong))


@pytest.mark.parametrize(('points', 'found'), [(8, True), (7, False)])
def test_three_points_beyond_a_minimal_set_must_agree(points, found):
    """Of eight points seven are enough, of seven six are not, though most by far."""
    model, views, _ = clean(seed=8)
    views = views.take_points(np.arange(points))
    views.uv[0, 2] += [50.0, -20.0]
    checked = examine(model, views, localize(model, views))
    assert np.flatnonzero(checked.outliers[0]).tolist() == ([2] if found else [])
    assert checked.reasons[0]


@pytest.mark.parametrize(('most', 'told'), [(99.0, False), (102.0, True)])
def test_landmarks_are_far_beyond_a_hundred_meters(most, told):
    """By those that count: one without a weight is no reason."""
    model, views, true = clean(seed=9)
    away = views.points[0] - true.position[0]
    points = views.points.copy()
    points[0, 4] = true.position[0] + away[4] / np.linalg.norm(away[4]) * most
    views = views._replace(points=points)
    found = localize(model, views)
    assert ('in meters' in examine(model, views, found).reasons[0]) == told
    ignored = views._replace(weight=np.where(np.arange(20) == 4, 0.0, views.weight))
    assert not examine(model, ignored, localize(model, ignored)).reasons[0]


def test_outliers_are_named_largest_first_and_no_more_than_five():
    model, views, _ = clean(seed=10)
    wrong, size = np.array([2, 5, 8, 11, 14, 17, 19]), np.array([20, 60, 30, 80, 40, 50, 70.0])
    views.uv[0, wrong, 0] += size
    reason = examine(model, views, localize(model, views)).reasons[0]
    names = [part.split(' (')[0].split()[-1] for part in reason.split(', ')]
    assert names == ['11', '19', '5', '17', '14'] and reason.endswith(' and 2 more')


def test_a_point_without_an_image_is_named_before_all_others():
    views = views_of(np.zeros((3, 3)), np.zeros((1, 3, 2)))
    residual = np.array([[3.0, 4.0], [np.nan, np.nan], [30.0, 40.0]])
    reason = _outliers_reason(views, np.array([False, True, True]), residual, False)
    assert reason == 'outliers rejected: landmarks 1 (inf px), 2 (50 px)'


@pytest.mark.parametrize(('noise', 'agrees'), [(0.7, True), (1.1, False)])
def test_a_pose_that_most_agree_on_passes_the_test_of_its_misfit(noise, agrees):
    """Of the variance of sigma times the tolerance 2.2 times, for 34 degrees of freedom."""
    model, views, true = clean(seed=12)
    exact = model.predict(true, views).uv
    off = views.uv - exact
    size = np.sqrt((localize(model, views).residual ** 2).sum() / 34)
    views = views._replace(uv=exact + noise / size * off, weight=np.ones(views.weight.shape))
    found = _consensus_pose(model, views, views, localize(model, views), 0.3, 2.0)
    assert (found is not None) == agrees


class TestPairs:
    """Of a rig: a pair's least reprojection error has one degree of freedom."""

    def pairs(self, noise=0.0, seed=2):
        model, rng = ForwardModel(load_lens(lens_path('fish180'))), np.random.default_rng(seed)
        d = np.stack([rng.uniform(-0.3, 0.3, 40), rng.uniform(-0.3, 0.3, 40), np.ones(40)], -1)
        points, left = d * rng.uniform(0.5, 3.0, (40, 1)), rig('parallel')
        uv = [
            project(model.lens, seen).uv + noise * rng.normal(size=(40, 2))
            for seen in (left.into_body(points), points)
        ]
        return (model, model), left, uv

    def doubt(self, models, left, uv, sigma=SIGMA):
        return doubt_of_pairs(models, left, tuple(uv), np.arange(100, 140), sigma)

    @pytest.mark.parametrize(('sigmas', 'named'), [(4.8, False), (5.2, True)])
    def test_a_pair_does_not_match_beyond_five_standard_deviations(self, sigmas, named):
        """Both images share the offset across epipolar lines: sqrt(2) sigma of each."""
        models, left, uv = self.pairs()
        uv[0][7, 1] += sigmas * np.sqrt(2) * SIGMA
        text = self.doubt(models, left, uv)
        assert text.startswith('pairs that do not match: landmark 107 (') == named
        if named:
            px = float(text.partition('(')[2].split(' px')[0])
            assert px == pytest.approx(sigmas * SIGMA, rel=0.02)
        else:
            assert text == ''

    @pytest.mark.parametrize(('factor', 'fails'), [(0.98, False), (1.02, True)])
    def test_all_pairs_fail_once_in_ten_thousand(self, factor, fails):
        models, left, uv = self.pairs()
        limit = np.sqrt(stats.chi2.isf(1e-4, 40) / 40)
        uv[0][:, 1] += factor * limit * np.sqrt(2) * SIGMA * np.where(np.arange(40) % 2, 1, -1)
        text = self.doubt(models, left, uv)
        assert text.startswith('the residuals are 1.') == fails and bool(text) == fails

    @pytest.mark.parametrize(('behind', 'refused'), [(16, False), (17, True)])
    def test_two_fifths_of_the_pairs_may_meet_behind_the_cameras(self, behind, refused):
        models, left, uv = self.pairs()
        for part in range(behind):  # what left and right saw is swapped: rays diverge
            uv[0][part], uv[1][part] = uv[1][part].copy(), uv[0][part].copy()
        assert ('do not meet' in self.doubt(models, left, uv)) == refused


def test_a_search_is_for_what_fails_alone():
    """Two views, one of them spoilt: the other's result is that of `localize`, to the last bit."""
    model, views, _ = clean(2, seed=11)
    views.uv[1, 3] += [40.0, 10.0]
    found = localize(model, views)
    checked = examine(model, views, found)
    for before, after in zip(found.take([0]).pose, checked.result.take([0]).pose, strict=True):
        np.testing.assert_array_equal(before, after)
    assert checked.excess.tolist() == [1.0, 1.0] and not checked.reasons[0]
    assert checked.result.cost[1] < found.cost[1] / 50
