"""Outliers of a table, by limits that follow from the noise; what is none; and who is to blame."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.robot import LENS
from helpers.targets import plane, poses_around
from scipy import special

from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.scene.observations import make_observations
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.outliers import (
    FAR_POINT,
    FRAME,
    LANDMARK,
    MEDIAN_NORM,
    NO_OUTLIERS,
    SWAPPED_POINT,
    UNSEEN_PX,
    VIEW,
    WrongLandmark,
    cross_camera_offsets,
    find_outliers,
    relative_sigma,
    robust_scale,
    without_points,
)
from fisheye_svp_ros.solve.rig_state import RigState, group_by_frame

NOISE = 0.1  # px
RIG = Pose(rotation_from_vector(np.array([0.0, 0.05, 0.01])), np.array([0.12, 0.0, 0.0]))


class Table:
    """Image points (F, C, N, 2) of a board before a camera or a pair, and what moves them."""

    def __init__(self, seed=0, frames=10, cameras=1, noise=NOISE):
        rng = np.random.default_rng(seed)
        self.board, self.cameras = plane(), cameras
        poses = poses_around(self.board, frames, rng, widest=0.6, distance=(0.35, 0.6), tilt=25.0)
        self.places = [poses, poses.compose(RIG)][:cameras]
        model = ForwardModel(LENS)
        views = [place.into_body(self.board.points[None]) for place in self.places]
        self.exact = np.stack(
            [model.predict(place, self.views_like(place)).uv for place in self.places], axis=1
        )
        assert all((view[..., 2] > 0).all() for view in views)
        self.uv = self.exact + noise * rng.normal(size=self.exact.shape)
        self.sigma = np.full(self.uv.shape[:3], np.nan)

    def views_like(self, place):
        frames, count = len(place.position), len(self.board.ids)
        table = make_observations(
            np.repeat(np.arange(frames), count),
            np.tile(self.board.ids, frames),
            np.zeros((frames * count, 2)),
            np.tile(self.board.points, (frames, 1)),
        )
        return group_by_frame(table).views

    @property
    def data(self):
        frames, cameras, count = self.uv.shape[:3]
        frame, camera, landmark = (
            grid.ravel() for grid in np.indices((frames, cameras, count), dtype=np.int64)
        )
        table = make_observations(
            frame,
            self.board.ids[landmark],
            self.uv.reshape(-1, 2),
            self.board.points[landmark],
            camera=camera,
            cameras=('left', 'right')[:cameras] if cameras > 1 else ('',),
            sigma=self.sigma.ravel(),
        )
        return group_by_frame(table)

    def row(self, frame, landmark, camera=0):
        return (frame * self.cameras + camera) * len(self.board.ids) + landmark

    def outliers(self):
        """Return the reasons by row, and the distances."""
        data = self.data
        found = find_outliers(data, initial_state(data, LENS))[1]
        return dict(zip(found.rows.tolist(), zip(found.why, found.px, strict=True), strict=True))


def test_clean_points_are_none():
    for seed in range(4):
        assert not Table(seed).outliers()


@pytest.mark.parametrize('direction', [(1.0, 0.0), (0.6, -0.8)])
@pytest.mark.parametrize(('sigmas', 'far'), [(7.0, False), (9.2, True)])
def test_a_point_is_an_outlier_beyond_eight_standard_deviations(sigmas, far, direction):
    """Of a coordinate: the distance over the noise, which 63 points tell to a tenth."""
    table = Table(1)
    offset = sigmas * NOISE * np.array(direction)
    table.uv[3, 0, 20] = table.exact[3, 0, 20] + offset
    found = table.outliers()
    assert list(found) == ([table.row(3, 20)] if far else [])
    if far:
        why, px = found[table.row(3, 20)]
        assert why == FAR_POINT and px == pytest.approx(sigmas * NOISE, rel=0.06)


def test_an_outlier_bends_no_pose_that_judges_the_others():
    """Every seventh point of a view is off one way: by least squares none is 8 sigma off."""
    table = Table(2)
    wrong = np.arange(2, 63, 7)
    table.uv[4, 0, wrong] += [4.0, 3.0]
    assert set(table.outliers()) == {table.row(4, landmark) for landmark in wrong.tolist()}


def test_a_landmark_that_is_off_in_most_views_is_not_many_outliers():
    table = Table(3)
    rng = np.random.default_rng(3)
    table.uv[:, 0, 30] += 2.0 * rng.normal(size=(10, 2))
    assert not table.outliers()
    table.uv[:7, 0, 30] = table.exact[:7, 0, 30]
    assert {row % 63 for row in table.outliers()} <= {30}


@pytest.mark.parametrize(('sigmas', 'far'), [(20.0, False), (32.0, True)])
def test_a_point_of_a_larger_sigma_may_lie_so_much_further_off(sigmas, far):
    """Three times that of most: 24 standard deviations of the others; told in px."""
    table = Table(4)
    table.sigma[:] = NOISE
    table.sigma[2, 0, 7] = 3 * NOISE
    table.uv[2, 0, 7] = table.exact[2, 0, 7] + [sigmas * NOISE, 0.0]
    found = table.outliers()
    assert list(found) == ([table.row(2, 7)] if far else [])
    if far:
        assert found[table.row(2, 7)][1] == pytest.approx(sigmas * NOISE, rel=0.03)


def test_sigma_counts_beside_the_median_and_only_where_it_is_larger():
    table = Table(5, frames=2)
    table.sigma[:] = 0.2
    table.sigma[0, 0, :3] = 0.05, 0.2, 0.8
    views = table.data.views
    found = relative_sigma(views._replace(row=np.where(views.landmark == 5, -1, views.row)))
    assert found[0, :3].tolist() == pytest.approx([1.0, 1.0, 4.0])
    assert found[0, 5] == 1.0 and np.isfinite(found).all()


def test_the_scale_of_a_view_is_that_of_a_coordinate():
    """Of the median distance; the error of one of 4 000 is 1.1 %.  Calm views have the usual."""
    rng = np.random.default_rng(6)
    sigma = np.array([0.5, 1.0, 1.0, 3.0])
    offset = np.linalg.norm(rng.normal(size=(4, 4000, 2)), axis=-1) * sigma[:, None]
    assert pytest.approx(np.sqrt(2 * np.log(2)), abs=1e-4) == MEDIAN_NORM
    scale = robust_scale(offset)[:, 0]
    typical = np.median(offset) / MEDIAN_NORM
    np.testing.assert_allclose(scale, np.maximum(sigma, typical), rtol=0.04)
    # Unseen points and padding are no reason for an infinite scale.
    offset[3, :2500], offset[1, ::2] = np.inf, np.nan
    scale = robust_scale(offset)[:, 0]
    assert scale[3] == UNSEEN_PX / MEDIAN_NORM and scale[1] == pytest.approx(1.0, rel=0.06)
    assert (robust_scale(np.zeros((2, 5))) > 0).all()


@pytest.mark.parametrize(('px', 'whole'), [(2.4, False), (4.5, True)])
def test_a_view_belongs_elsewhere_beyond_fifteen_times_the_usual_and_three_px(px, whole):
    table = Table(7)
    rng = np.random.default_rng(7)
    table.uv[5] = table.exact[5] + px * rng.normal(size=table.exact[5].shape)
    found = table.outliers()
    assert set(found) == ({table.row(5, landmark) for landmark in range(63)} if whole else set())
    assert {why for why, _ in found.values()} <= {VIEW}


def test_a_view_of_little_noise_is_measured_by_the_usual_one():
    """Two px are more than 15 times a noise of 0.1 px, and less than any order of points is off.

    Where the usual noise is 0.4 px, a view of 4.5 px is still of the same camera.
    """
    table = Table(8, noise=0.4)
    rng = np.random.default_rng(8)
    table.uv[5] = table.exact[5] + 4.5 * rng.normal(size=table.exact[5].shape)
    assert VIEW not in {why for why, _ in table.outliers().values()}


def test_views_that_are_a_fifth_of_all_are_a_model_that_errs():
    table = Table(9)
    rng = np.random.default_rng(9)
    table.uv[[2, 6]] = table.exact[[2, 6]] + 6.0 * rng.normal(size=table.exact[[2, 6]].shape)
    assert VIEW not in {why for why, _ in table.outliers().values()}


def test_points_that_have_changed_places_are_told_from_those_that_are_far_off():
    table = Table(10)
    table.uv[3, 0, [8, 40]] = table.uv[3, 0, [40, 8]]
    table.uv[6, 0, 11] = (table.exact[6, 0, 11] + table.exact[6, 0, 21]) / 2  # between landmarks
    found = table.outliers()
    assert {row: why for row, (why, _) in found.items()} == {
        table.row(3, 8): SWAPPED_POINT,
        table.row(3, 40): SWAPPED_POINT,
        table.row(6, 11): FAR_POINT,
    }


def test_where_landmarks_are_dense_a_far_point_is_near_another_by_chance():
    """Within six standard deviations of any is most of the board: as many do as by chance."""
    table = Table(11, noise=1.2)
    table.uv[3, 0, 8] = table.exact[3, 0, 40]
    found = table.outliers()
    spacing = np.median(np.linalg.norm(np.diff(table.exact[3, 0, :9], axis=0), axis=1))
    by_chance = np.pi * (6 * 1.2 / spacing) ** 2
    assert special.pdtrc(0, by_chance) > 0.01
    assert found[table.row(3, 8)][0] == FAR_POINT


def test_cameras_that_contradict_each_other_are_a_frame_that_belongs_elsewhere():
    """A board that the right camera saw turned by half a turn, its points in reversed order."""
    table = Table(12, cameras=2)
    assert not table.outliers()
    table.uv[4, 1] = table.uv[4, 1, ::-1]
    found = table.outliers()
    assert {why for why, _ in found.values()} == {FRAME}
    assert set(found) == {table.row(4, n, camera) for n in range(63) for camera in (0, 1)}


def test_frames_are_told_only_where_they_are_a_minority():
    table = Table(13, cameras=2)
    table.uv[:5, 1] = table.uv[:5, 1, ::-1]
    assert FRAME not in {why for why, _ in table.outliers().values()}


def test_a_rig_that_is_rough_everywhere_contradicts_no_frame():
    """Off by as much in most frames: then it is the rig that is not known."""
    table = Table(14, cameras=2)
    data = table.data
    state = initial_state(data, LENS)
    off = state.rig.position + np.array([[0.0, 0, 0], [0.0, 0.01, 0.0]])
    rough = replace(state, rig=Pose(state.rig.rotation, off))
    assert not len(find_outliers(data, rough)[1].rows)


def test_what_another_camera_predicts_is_by_the_rig():
    """Medians of the distances; a frame that one camera saw has no other."""
    table = Table(15, cameras=2, noise=0.0)
    data = table.data.select(np.arange(20) != 5)
    lens_views = data.views
    place = Pose(
        np.stack([table.places[c].rotation[f] for f, c in zip(*seen(data), strict=True)]),
        np.stack([table.places[c].position[f] for f, c in zip(*seen(data), strict=True)]),
    )
    rig = Pose.stack([Pose(np.eye(3), np.zeros(3)), RIG])
    state = RigState(table.places[0], rig, LENS, ())
    median, apart = cross_camera_offsets(data, state, place)
    alone = 4  # of frame 2, whose right view is gone
    assert np.isinf(median[alone]) and not apart[alone].any()
    np.testing.assert_allclose(np.delete(median, alone), 0.0, atol=1e-6)
    moved = RigState(table.places[0], Pose.stack([rig.take(0), rig.take(0)]), LENS, ())
    median, apart = cross_camera_offsets(data, moved, place)
    others = np.delete(np.arange(len(median)), alone)
    np.testing.assert_allclose(np.median(apart, axis=1)[others], median[others])
    assert (median[others] > 20).all() and len(lens_views.frame) == 19


def seen(data):
    return data.frame_of.tolist(), data.camera_of.tolist()


def test_points_and_views_without_any_are_left_out():
    data = Table(16, frames=3).data
    mask = np.zeros(data.views.used.shape, dtype=bool)
    mask[0, 3] = True
    mask[1] = True
    kept = without_points(data, mask)
    assert kept.views.frame.tolist() == [0, 2] and kept.views.used.sum() == 63 * 2 - 1
    assert kept.views.weight[0, 3] == 0 and kept.views.row[0, 3] == -1


def test_outliers_are_gathered_by_reason():
    table = Table(17, frames=2).data.observations
    wrong = WrongLandmark(5, 2, 4.0, np.array([0.01, 0.0, 0.0]))
    lost = WrongLandmark(9, 2, 9.0, np.full(3, np.nan))
    found = NO_OUTLIERS.append(np.array([3]), np.array([1.5]), SWAPPED_POINT)
    found = found.append_landmarks(table, [wrong, lost])
    assert found.rows.tolist() == [3, 5, 9, 68, 72]
    assert found.px.tolist() == [1.5, 4.0, 9.0, 4.0, 9.0]
    assert found.why == (SWAPPED_POINT, *[LANDMARK] * 4) and found.swap_count == 1
    assert found.landmarks == (wrong, lost)
    rest = found.without_landmarks()
    assert rest.rows.tolist() == [3] and rest.why == (SWAPPED_POINT,) and not rest.landmarks
    assert wrong.is_displaced and not lost.is_displaced
    assert wrong.to_dict()['offset'] == [0.01, 0.0, 0.0] and lost.to_dict()['offset'] is None
