"""A board that sags by its own weight bends as it is turned: that is no center of the image."""

import pytest
from helpers.sagging import FREE, photographs
from helpers.water import AIR

from fisheye_svp_ros.diagnosis import Action, NullModel, diagnose
from fisheye_svp_ros.diagnosis.fitted_model import refit
from fisheye_svp_ros.diagnosis.lens_evidence import _generalized_state
from fisheye_svp_ros.diagnosis.random_effects import NAMES
from fisheye_svp_ros.diagnosis.uncertainty import standard_errors
from fisheye_svp_ros.solve.bundle_adjustment import adjust
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.rig_state import group_by_frame

SAG = NAMES.index('frame_sag')


@pytest.mark.parametrize('seed', [4, 8])
def test_a_sagging_board_does_not_move_the_center(seed):
    data = group_by_frame(photographs(seed, 1e-3))
    null = NullModel.estimate(data, adjust(data, initial_state(data, AIR), FREE), FREE)
    assert null.variances.alive[SAG]
    fitted = refit(data, null.linear.state, FREE, null.variances)
    error = standard_errors(null)[FREE.index('cy')]
    assert abs(null.linear.state.lens.cy - AIR.cy) > 5 * error
    # The mean bend, which stays, is a cause of its own and not in this model.
    assert abs(fitted.lens.cy - AIR.cy) < 3 * error < 0.4
    # Nor is a lens that `calibrate` writes off the fit that it is compared with.
    assert abs(_generalized_state(null).lens.cy - fitted.lens.cy) < error


def test_a_board_that_sags_is_to_be_supported():
    found = diagnose(photographs(9, 1e-3, frames=12), AIR, free_intrinsics=True)
    assert [c.effect for c in found.causes if c.effect != 'target_shape'] == []
    (sag,) = (one for one in found.components if one.name == 'frame_sag')
    assert sag.p_value < 1e-9
    (advice,) = (one for one in found.advice if one.action is Action.SUPPORT_BOARD)
    assert 0.8e-3 < advice.value < 1.2e-3 and advice.boards == [0]


@pytest.mark.parametrize(('sag', 'bend'), [(1e-3, 0.0), (1e-3, 2e-3)])
def test_a_bend_beside_a_sag_has_odds(sag, bend):
    """Of a board that only sags, the mean bend was called one that stays."""
    found = diagnose(photographs(8, sag, bend, frames=12), AIR, free_intrinsics=True)
    (cause,) = (cause for cause in found.causes if cause.effect == 'target_shape')
    assert sum(cause.odds.values()) == pytest.approx(1)
    assert (cause.odds['frame_sag'] > 0.9) == (bend == 0)
    assert cause.indistinguishable_from == ['frame_sag'] * (bend == 0)


def test_a_board_whose_bend_stays_does_not_sag():
    data = group_by_frame(photographs(1, 0.0, 2e-3))
    null = NullModel.estimate(data, adjust(data, initial_state(data, AIR), FREE), FREE)
    assert not null.variances.alive[SAG]
