"""A board that sags by its own weight bends as it is turned: that is no center of the image."""

import numpy as np
import pytest
from helpers.water import AIR

from fisheye_svp_ros.diagnosis import NullModel, diagnose
from fisheye_svp_ros.diagnosis.fitted_model import refit
from fisheye_svp_ros.diagnosis.random_effects import NAMES
from fisheye_svp_ros.diagnosis.uncertainty import standard_errors
from fisheye_svp_ros.effects.forward import project
from fisheye_svp_ros.pose import rotation_from_vector
from fisheye_svp_ros.scene.observations import make_observations
from fisheye_svp_ros.solve.bundle_adjustment import adjust
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.rig_state import group_by_frame

FREE = ('fx', 'fy', 'cx', 'cy', 'k1', 'k2')
SAG = NAMES.index('frame_sag')


def photographs(seed, sag, bend=0.0, frames=16, noise=0.05):
    """Return a board of 0.8 m, held at two edges before a camera at rest.

    sag: of its middle, m, by its own weight; bend: that stays.
    """
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(9) - 4.0, np.arange(6) - 2.5)
    board = 0.1 * np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=-1)
    middle = 1 - (board[:, 0] / 0.4) ** 2
    shown = []
    while len(shown) < frames:
        angle, azimuth = rng.uniform(0, 0.7), rng.uniform(0, 2 * np.pi)
        way = [np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)]
        turn = rotation_from_vector(rng.normal(size=3) * [0.5, 0.5, 0.3])
        off = (bend + sag * turn[1, 2]) * middle  # gravity is along y
        bent = board + np.outer(off, [0.0, 0.0, 1.0])
        image = project(AIR, bent @ turn.T + np.exp(rng.uniform(-0.7, 0.4)) * np.array(way))
        seen = np.flatnonzero(
            image.valid
            & (image.uv > 0).all(axis=1)
            & (image.uv < [AIR.width, AIR.height]).all(axis=1)
        )
        if len(seen) > 0.8 * len(board):
            uv = image.uv[seen] + noise * rng.normal(size=(len(seen), 2))
            shown.append((np.full(len(seen), len(shown)), seen, uv, board[seen]))
    return make_observations(*map(np.concatenate, zip(*shown, strict=True)))


@pytest.mark.parametrize('seed', [4, 8])
def test_a_sagging_board_does_not_move_the_center(seed):
    data = group_by_frame(photographs(seed, 1e-3))
    null = NullModel.estimate(data, adjust(data, initial_state(data, AIR), FREE), FREE)
    assert null.variances.alive[SAG]
    fitted = refit(data, null.linear.state, FREE, null.variances)
    error = standard_errors(null)[FREE.index('cy')]
    assert abs(null.linear.state.lens.cy - AIR.cy) > 5 * error
    assert abs(fitted.lens.cy - AIR.cy) < 3 * error < 0.3


def test_a_board_that_sags_is_to_be_supported():
    found = diagnose(photographs(9, 1e-3, frames=12), AIR, free_intrinsics=True)
    assert [c.effect for c in found.causes if c.effect != 'target_shape'] == []
    (sag,) = (one for one in found.components if one.name == 'frame_sag')
    assert sag.p_value < 1e-9
    (advice,) = (one for one in found.advice if 'support the board' in one.what)
    assert 0.8 < float(advice.what.split(' mm')[0].split()[-1]) < 1.2 and advice.boards == [0]


def test_a_board_whose_bend_stays_does_not_sag():
    data = group_by_frame(photographs(1, 0.0, 2e-3))
    null = NullModel.estimate(data, adjust(data, initial_state(data, AIR), FREE), FREE)
    assert not null.variances.alive[SAG]
