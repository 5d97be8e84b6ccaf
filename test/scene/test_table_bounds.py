"""What no table can mean is refused in one line: sigma, and copies of one frame."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.robot import LENS
from helpers.targets import plane, poses_around

from fisheye_svp_ros.diagnosis.null_model import NullModel
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import GeometryError, ObservationError
from fisheye_svp_ros.io.csv_files import read, write_observations
from fisheye_svp_ros.library import functions as library
from fisheye_svp_ros.scene.table_checks import check_rigid, implausible_sigma
from fisheye_svp_ros.simulate.simulation import simulate
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.measured_poses import usable_observations
from fisheye_svp_ros.solve.rig_state import group_by_frame

SIZE = (LENS.width, LENS.height)


def table(frames=6):
    rng = np.random.default_rng(1)
    poses = poses_around(plane(), frames, rng, widest=0.8)
    return simulate(ForwardModel(LENS), plane(), poses, 0.1, rng)


def copied(frames):
    """Return a table of copies of its first frame."""
    first = table().take(table().frame == 0)
    rows = first.take(np.tile(np.arange(len(first)), frames))
    return replace(rows, frame=np.repeat(np.arange(frames), len(first)))


def test_only_a_sigma_far_below_the_others_is_too_exact():
    assert implausible_sigma(np.array([0.1, 0.1, 0.1, 1e-9, 9e-5])).tolist() == 3 * [False] + 2 * [
        True
    ]
    assert not implausible_sigma(np.array([0.1, 5.0, 2e-3, np.nan])).any()
    assert (
        not implausible_sigma(np.full(3, 1e-5)).any()
        and not implausible_sigma(np.full(3, np.nan)).any()
    )


@pytest.mark.parametrize('sigma', [1e-9, 1e-5])
def test_a_sigma_that_no_detector_has_is_refused(sigma, tmp_path):
    rows = table()
    rows = replace(rows, sigma=np.where(rows.landmark == 3, sigma, rows.sigma))
    write_observations(tmp_path / 'rows.csv', rows)
    with pytest.raises(ObservationError, match=r'line \d+: sigma is .* of the median or more'):
        read(tmp_path / 'rows.csv')
    with pytest.raises(ObservationError, match='sigma of frame 0, landmark 3'):
        library.localize(rows, LENS)


def test_copies_of_one_frame_are_told():
    with pytest.raises(ObservationError, match='4 frames repeat the image points of frame 0'):
        library.calibrate(copied(5), 'equidistant', SIZE)


def test_random_image_points_are_refused_before_anything_is_fitted():
    """Two minutes of fits ended in "fx is known only to 23 %"."""
    rng = np.random.default_rng(3)
    rows = table(20)
    check_rigid(rows)
    random = replace(rows, uv=rng.uniform(0, SIZE, rows.uv.shape))
    for refused in (
        lambda: check_rigid(random),
        lambda: library.calibrate(random, 'equidistant', SIZE),
        lambda: library.diagnose(random, LENS),
    ):
        with pytest.raises(ObservationError, match='close in one frame are not close in others'):
            refused()


def test_a_target_is_rigid_though_many_landmarks_are_wrong_or_points_wild():
    rng = np.random.default_rng(4)
    rows = table(12)
    wild = rng.random(len(rows)) < 0.2
    check_rigid(replace(rows, xyz=rng.permutation(rows.xyz)))
    check_rigid(replace(rows, uv=np.where(wild[:, None], rng.uniform(0, SIZE), rows.uv)))
    check_rigid(rows.take(rows.frame == 0))


def test_what_cannot_be_posed_and_what_is_there_twice_is_left_out_by_one_step():
    rows = table()
    few = (rows.frame == 4) & (rows.landmark > 2)
    rows = rows.take(~few)
    rows = replace(rows, frame=np.where(rows.frame == 5, 7, rows.frame))
    both = rows.take(np.concatenate([np.arange(len(rows)), np.flatnonzero(rows.frame == 2)]))
    frame = np.where(np.arange(len(both)) < len(rows), both.frame, 9)
    usable = usable_observations(replace(both, frame=frame), LENS)
    assert usable.not_posable == (4,) and usable.copies == (9,)
    assert usable.observations.frames.tolist() == [0, 1, 2, 3, 7]


@pytest.mark.parametrize(
    ('within', 'beyond'), [(-0.4, -0.6), (LENS.width - 0.6, LENS.width - 0.4)]
)
def test_an_image_ends_at_the_edges_of_its_outer_pixels(within, beyond):
    rows = table()
    uv = rows.uv.copy()
    uv[::30, 0] = within
    assert len(usable_observations(replace(rows, uv=uv), LENS).observations) == len(rows)
    uv[::30, 0] = beyond
    with pytest.raises(ObservationError, match='image points lie outside the'):
        usable_observations(replace(rows, uv=uv), LENS)


def test_a_state_without_an_image_of_some_points_is_refused():
    data = group_by_frame(table())
    state = initial_state(data, LENS)
    state.pose.position[0] += [0.0, 0.0, np.nan]
    with pytest.raises(GeometryError, match='points lie out of sight of the fitted lens'):
        NullModel.estimate(data, state, ())
