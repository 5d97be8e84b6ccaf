"""Order of corners: views turned until their residuals agree, and how sure that is."""

import numpy as np
import pytest

from fisheye_svp_ros.detect.order import agree, of_rig
from fisheye_svp_ros.detect.patterns import parse_pattern
from fisheye_svp_ros.pose import Pose, rotation_from_vector

PATTERN = parse_pattern('chessboard:4x6:30mm')
TURN = PATTERN.symmetries[1]


def turned(field):
    return field[TURN.source] @ TURN.matrix.T


def views(board, rng, count=20):
    """Residuals (V, N, 2) of a board that is held either way up, with noise; and which way."""
    way = rng.integers(2, size=count)
    seen = np.stack([turned(board) if one else board for one in way])
    return seen + rng.normal(size=seen.shape), way


def test_cameras_that_are_no_rig_are_turned_by_themselves():
    rng = np.random.default_rng(5)
    one, other = (
        Pose(rotation_from_vector(rng.normal(size=(9, 3))), rng.normal(size=(9, 3)))
        for _ in range(2)
    )
    assert of_rig(one, other, PATTERN.points[:, :2], PATTERN.symmetries) is None
    still = one.compose(other.take(0))
    assert not of_rig(one, still, PATTERN.points[:, :2], PATTERN.symmetries).any()


@pytest.mark.parametrize('alike', [0.0, 5.0])
def test_errors_that_look_the_same_either_way_hide_nothing(alike):
    rng = np.random.default_rng(3)
    own, even = rng.normal(size=(2, 24, 2))
    field, way = views(own + alike * (even + turned(even)), rng)
    found = agree(field, PATTERN.symmetries)
    right = found.turn == way
    assert right.all() or not right.any()
    assert found.certainty.mean() > 0.95


@pytest.mark.slow
def test_certainty_is_no_more_than_its_share_of_right_ones():
    rng = np.random.default_rng(4)
    for size in (0.0, 0.3, 0.5):
        certainty, right = [], []
        for _ in range(15):
            field, way = views(size * rng.normal(size=(24, 2)), rng)
            found = agree(field, PATTERN.symmetries)
            ok = found.turn == way
            right.append(ok if ok.mean() > 0.5 else ~ok)
            certainty.append(found.certainty)
        assert np.mean(certainty) < np.mean(right) + 0.03
