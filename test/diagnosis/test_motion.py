"""A camera in the hand moves while the rows of an image are read: no fault of its lens."""

import math
import re

import numpy as np
import pytest
from helpers.sagging import FREE, photographs
from helpers.water import AIR

from fisheye_svp_ros.diagnosis import Action, NullModel, diagnose
from fisheye_svp_ros.diagnosis.fitted_model import refit
from fisheye_svp_ros.diagnosis.random_effects import NAMES, make_random_effects
from fisheye_svp_ros.diagnosis.uncertainty import standard_errors
from fisheye_svp_ros.reporting.wording.whats_wrong import wrong
from fisheye_svp_ros.solve.bundle_adjustment import adjust
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.rig_state import Linearization, group_by_frame

MOTION = NAMES.index('frame_motion')
TURN = 0.01  # rad about each axis: 1 rad/s for 10 ms, or .3 rad/s for 30 ms


def test_columns_are_what_a_turn_and_a_shift_of_the_pose_do_by_row():
    data = group_by_frame(photographs(2, 0.0, frames=4))
    linear = Linearization(data, adjust(data, initial_state(data, AIR), FREE), FREE)
    random = make_random_effects(linear).columns
    columns = random.group[..., random.group_label == MOTION]
    v = np.repeat(data.blocks(linear.linear.uv[..., None, :])[..., 1], 2, axis=1)
    used = data.views.uv[data.views.used]
    half = np.ptp(used, axis=0).max() / 2
    row = (v - (used[:, 1].min() + used[:, 1].max()) / 2) / half
    frame, seen = 1, linear.row_mask[1]
    position = linear.state.pose.position[frame]
    distance = np.linalg.norm(position - data.views.points[data.views.used].mean(axis=0))
    expected = linear.frame_columns[frame] * row[frame][:, None]
    expected[:, :3] *= distance
    assert columns[frame][seen] == pytest.approx(expected[seen], rel=0.01, abs=0.5)
    assert (columns[frame][~seen] == 0).all()


@pytest.mark.parametrize('seed', [1, 3])
def test_a_motion_while_rows_are_read_does_not_bend_the_lens(seed):
    data = group_by_frame(photographs(seed, 0.0, frames=20, turn_while_read=TURN))
    null = NullModel.estimate(data, adjust(data, initial_state(data, AIR), FREE), FREE)
    assert null.variances.alive[MOTION]
    fitted = refit(data, null.linear.state, FREE, null.variances)
    errors = np.array([getattr(fitted.lens, n) - getattr(AIR, n) for n in FREE[:4]])
    assert (np.abs(errors) < 3 * standard_errors(null)[:4]).all()


def test_a_motion_is_told_with_its_size_and_forbids_no_lens():
    found = diagnose(photographs(1, 0.0, frames=20, turn_while_read=TURN), AIR)
    (motion,) = (one for one in found.components if one.name == 'frame_motion')
    assert motion.p_value < 1e-9
    (advice,) = (one for one in found.advice if one.action is Action.HOLD_STILL)
    assert advice.value == pytest.approx(math.sqrt(3) * TURN, rel=0.3)
    assert found.decision['lens'].say == 'keep' and not found.adequacy.is_misfit
    assert re.search(
        r'the camera turns by 0\.\d+ deg rms while an image is read', wrong(found), re.I
    )


def test_a_global_shutter_has_no_motion():
    data = group_by_frame(photographs(1, 0.0, frames=12))
    null = NullModel.estimate(data, adjust(data, initial_state(data, AIR), FREE), FREE)
    assert not null.variances.alive[MOTION]
