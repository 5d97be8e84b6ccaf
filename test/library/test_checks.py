"""What the library refuses: one line that names the argument and what is needed, no traceback."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.photographs import BOARD, LENS, poses, true_corners

import fisheye_svp_ros as fsvp
from fisheye_svp_ros.io.rig_files import save_rig

TABLE = fsvp.observations(*true_corners(poses(4).take(0)).T, np.arange(30), BOARD)
RIG = fsvp.rig('parallel')
ROOM = (0.1, 0.3)
SIDE, IMAGE = fsvp.undistort_maps(LENS), np.zeros((400, 424), np.uint8)


@pytest.mark.parametrize(
    ('call', 'said'),
    [
        (
            lambda: fsvp.detect('.', BOARD, detector='zzz'),
            "detector 'zzz' does not find chessboard",
        ),
        (lambda: fsvp.detect('.', BOARD, detector='circles'), 'choose from saddle, quick, sb, cl'),
        (lambda: fsvp.detect('.', 3), "board '3': known kinds are chessboard"),
        (lambda: fsvp.detect([], BOARD), 'no photographs; give at least one'),
        (lambda: fsvp.detect('.', BOARD, every=0), 'every is 0; 1 or more is needed'),
        (lambda: fsvp.detect('.', BOARD, sync=-1), 'sync is -1; seconds are needed'),
        (lambda: fsvp.detect('.', BOARD, sync='5ms'), "sync is '5ms'; seconds are needed"),
        (
            lambda: fsvp.calibrate(TABLE, 'equidistant', '424x400'),
            "image_size is '424x400'; (width, height) in whole px is needed",
        ),
        (lambda: fsvp.calibrate(TABLE, 'equidistant', (424,)), 'image_size is (424,); (width, '),
        (lambda: fsvp.calibrate(TABLE, 'equidistant', (424.5, 400)), 'image_size is (424.5, 400)'),
        (
            lambda: fsvp.calibrate([1, 2], 'equidistant', (424, 400)),
            'observations are of type list; a table or a path is needed',
        ),
        (lambda: fsvp.localize(LENS, TABLE), 'observations are of type Lens; a table or a path'),
        (lambda: fsvp.plan(LENS, BOARD, 0.3), 'room is 0.3; (nearest, farthest) in m is needed'),
        (
            lambda: fsvp.plan(LENS, BOARD, (0.3, 0.1)),
            'room is (0.3, 0.1); two distances above 0, m',
        ),
        (lambda: fsvp.plan(LENS, BOARD, (-1, 0.1)), 'room is (-1, 0.1); two distances above 0'),
        (
            lambda: fsvp.plan(LENS, BOARD, ROOM, count=0),
            'count is 0; a whole number from 1 to 100',
        ),
        (
            lambda: fsvp.plan(LENS, BOARD, ROOM, count=2.5),
            'count is 2.5; a whole number from 1 to',
        ),
        (
            lambda: fsvp.plan(LENS, BOARD, ROOM, count=101),
            'count is 101; a whole number from 1 to',
        ),
        (
            lambda: fsvp.plan(LENS, BOARD, ROOM, noise_px=-1),
            'noise is -1 px; above 0 and up to 1000',
        ),
        (lambda: fsvp.render(LENS, BOARD, None), 'pose is of type NoneType; a Pose is needed'),
        (lambda: fsvp.render(LENS, BOARD, poses(4)), 'pose holds 4 poses; one is needed'),
        (
            lambda: fsvp.render(LENS, BOARD, poses(4).take(0), noise=-1),
            'noise is -1; 0 to 255 gray levels',
        ),
        (
            lambda: fsvp.undistort_maps(LENS, size=(10,)),
            'size is (10,); (width, height) in whole px',
        ),
        (
            lambda: fsvp.undistort_maps(LENS, size='4x4'),
            "size is '4x4'; (width, height) in whole px",
        ),
        (
            lambda: fsvp.undistort_maps(LENS, field_of_view=120),
            'field_of_view is 120; rad are needed',
        ),
        (
            lambda: fsvp.undistort_maps(LENS, field_of_view='90'),
            "field_of_view is '90'; rad are need",
        ),
        (lambda: fsvp.undistort_maps(LENS, range_m='1'), "range_m is '1'; m are needed"),
        (
            lambda: SIDE.remap(None),
            'the image is NoneType; an array (H, W) or (H, W, C) of uint8, ',
        ),
        (lambda: SIDE.remap([[1]]), 'the image is list; an array (H, W) or'),
        (
            lambda: SIDE.remap(IMAGE.astype(np.int64)),
            'the image is int64 (400, 424); an array (H, W',
        ),
        (lambda: SIDE.remap(IMAGE > 0), 'the image is bool (400, 424); an array (H, W)'),
        (
            lambda: fsvp.project(LENS, 'abc'),
            'points is not an array of numbers; (..., 3) is needed',
        ),
        (
            lambda: fsvp.back_project(LENS, [[1, 2], [3]]),
            'uv is not an array of numbers; (..., 2) is',
        ),
        (
            lambda: fsvp.read_observations(None),
            'a NoneType is no path; the name of a file is needed',
        ),
        (lambda: fsvp.read_poses(None), 'a NoneType is no path; the name of a file is needed'),
        (lambda: fsvp.load_rig(None), 'a NoneType is no path; the name of a file is needed'),
        (lambda: fsvp.save_lens(None, 'x.yaml'), 'lens is of type NoneType; a Lens is needed'),
        (lambda: fsvp.save_lens('x.yaml', LENS), 'lens is of type str; a Lens is needed'),
        (
            lambda: fsvp.save_lens(LENS, None),
            'a NoneType is no path; the name of a file is needed',
        ),
        (
            lambda: fsvp.write_observations(TABLE, 'x.csv'),
            'observations are of type str; a table is',
        ),
        (
            lambda: fsvp.rectify_maps(LENS, LENS, 'rig.yaml'),
            'rig.yaml: cannot be read (No such file',
        ),
        (lambda: fsvp.rectify_maps(LENS, LENS, None), 'rig is of type NoneType; a Pose is needed'),
        (lambda: fsvp.stereo_depth(TABLE, LENS, LENS, None), 'rig is of type NoneType; a Pose is'),
        (lambda: fsvp.plot_lens(), 'no lens to draw; give at least one'),
        (lambda: fsvp.plot_budget(None), 'budget is of type NoneType; the result of fsvp.budget'),
        (
            lambda: fsvp.plot_residuals(LENS, TABLE),
            'observations are of type Lens; a table or a path',
        ),
        (lambda: fsvp.sweep({'radius': 0.5}), "over['radius'] is 0.5; a list of values is needed"),
        (
            lambda: fsvp.sweep({'style': 'mono'}),
            "over['style'] is 'mono'; a list of values is needed",
        ),
        (
            lambda: fsvp.sweep({'radius': [0.5]}, stereo_depth={'svp': True}),
            'stereo_depth solves nothing in this sweep: it needs style parallel',
        ),
        (
            lambda: fsvp.calibrate_rig(TABLE, [LENS, LENS]),
            'lenses is of type list; a mapping of cam',
        ),
        (
            lambda: fsvp.observations([1.0], [np.nan], [0], BOARD),
            'u and v must be finite; leave out',
        ),
        (lambda: fsvp.observations([1.0], [2.0], [0.5], BOARD), 'landmark must be whole numbers'),
        (
            lambda: fsvp.observations([1.0], [2.0], [np.nan], BOARD),
            'landmark must be whole numbers',
        ),
        (lambda: fsvp.observations([1.0], [2.0], [1e30], BOARD), 'landmark must be whole numbers'),
        (
            lambda: fsvp.observations('a', [2.0], [0], BOARD),
            'u is not an array of numbers; (N,) is',
        ),
        (
            lambda: fsvp.observations([1.0], ['2'], [0], BOARD),
            'v is not an array of numbers; (N,) is',
        ),
        (lambda: fsvp.observations([1.0], [2.0], ['a'], BOARD), 'landmark is not an array of num'),
        (lambda: fsvp.observations([[1.0], [2]], [2.0, 3], [0, 1], BOARD), 'must have one length'),
        (
            lambda: fsvp.observations(*np.ones((2, 10)), np.arange(10), BOARD, frame=np.arange(3)),
            'frame has the shape (3,); one number, or one for each of the 10 points',
        ),
        (
            lambda: fsvp.observations(*np.ones((2, 10)), np.arange(10) - 1, BOARD),
            'landmarks are 0 to 29; there is -1',
        ),
        (
            lambda: fsvp.observations([1.0], [2.0], [0], [[0, 0, 0], [1, 0]]),
            'board is not an array of nu',
        ),
        (
            lambda: fsvp.observations([1.0], [2.0], [0], [['a', 'b', 'c']]),
            'board is not an array of nu',
        ),
        (
            lambda: fsvp.observations([1.0], [2.0], [0], [[0, np.nan, 0]]),
            'board has places that are',
        ),
        (lambda: fsvp.sweep(None), 'over is of type NoneType; a mapping of lists is needed'),
        (
            lambda: fsvp.sweep({'radius': [1.0]}, localizer=3),
            'localizer is of type int; a mapping of',
        ),
        (lambda: fsvp.simulate_scenario(noise_px=-3), 'noise_px is -3.0; allowed is 0 to '),
        (
            lambda: fsvp.observations([1.0, 2], [2.0, 3], [0, 0], BOARD),
            'a landmark is twice in a fr',
        ),
    ],
)
def test_what_is_wrong_is_named(call: Callable[[], Any], said: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        with pytest.raises(fsvp.FisheyeSvpError, match=re.escape(said)) as error:
            call()
    assert '\n' not in str(error.value)


def test_what_is_near_is_taken(tmp_path: Path) -> None:
    """Arrays in place of tuples and lists, the same landmark in two frames, files of a rig."""
    save_rig(RIG, tmp_path / 'rig.yaml')
    for given in (tmp_path, str(tmp_path / 'rig.yaml')):
        pair = fsvp.rectify_maps(LENS, LENS, given)
        assert pair.right.p[0, 3] == fsvp.rectify_maps(LENS, LENS, RIG).right.p[0, 3]
    assert len(fsvp.observations([1.0, 2], [2.0, 3], [0, 0], BOARD, frame=[0, 1])) == 2
    assert fsvp.undistort_maps(LENS, size=np.array([40, 30])).maps.u.shape == (30, 40)
    assert len(fsvp.sweep({'radius': np.array([0.5, 1.0])}).table()['radius']) == 2
    stamps = 10**18 + np.arange(2)
    assert (
        fsvp.observations([1.0, 2], [2.0, 3], [0, 0], BOARD, frame=stamps).frame == stamps
    ).all()
    seen = fsvp.simulate_scenario(
        radius=np.float32(0.5),
        seed=np.int64(2),
        poses=np.array([[0, 0, 0, 1, 0, 0, 0], [0, 0, 0.1, 1, 0, 0, 0]]),
    )
    assert seen.pose.position.tolist() == [[0, 0, 0], [0, 0, 0.1]]
    assert fsvp.sweep({'seed': [1]}, localizer={'sigma_px': np.float64(2)}).table()['seed'] == [1]


@pytest.mark.parametrize('lens', ['fish214', LENS])
def test_points_however_far_have_the_image_of_their_direction(lens: Any) -> None:
    away = np.array([1.0, 0.2, 1.0])
    image = fsvp.project(lens, away * [[1e9], [1e155], [1e300]])
    np.testing.assert_allclose(image.uv[1:], image.uv[[0, 0]], atol=1e-6)
    assert not fsvp.project(lens, [[np.nan, 1e200, 1]]).valid.any()
