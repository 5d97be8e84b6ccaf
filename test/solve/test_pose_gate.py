"""What a robot should not act on is kept back, with its reason."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest

from fisheye_svp_ros.pose import Pose, identity, rotation_from_vector
from fisheye_svp_ros.solve.pose_gate import GatedPose, GateLimits, OdometryGate, weakness

SMALL = np.diag([1e-4, 1e-4, 1e-4, 1e-5, 1e-5, 1e-5])
LIMITS = GateLimits()
NONE: Mapping[int, float] = MappingProxyType({})


@pytest.mark.parametrize(
    ('pose', 'limits', 'reason'),
    [
        (GatedPose(identity(), SMALL), LIMITS, ''),
        (GatedPose(identity(), SMALL, ambiguous=True), LIMITS, 'a second pose fits as well'),
        (GatedPose(identity(), SMALL, ambiguous=True), LIMITS._replace(ambiguous=True), ''),
        (GatedPose(identity(), SMALL, misfit=4.5), LIMITS, 'residuals of 4.5 sigma_px'),
        (GatedPose(identity(), 900 * SMALL), LIMITS, '0.3 m, above max_std_m (0.2)'),
        (GatedPose(identity(), 900 * SMALL), LIMITS._replace(max_std_m=0.0), ''),
        (
            GatedPose(identity(), SMALL + np.diag([0, 0, 0, 0, 0.04, 0])),
            LIMITS,
            '0.2 rad, above max_std_rad (0.1)',
        ),
        (GatedPose(identity(), np.full((6, 6), np.nan)), LIMITS, 'above max_std_m'),
    ],
)
def test_a_weak_pose_has_its_reason(pose: GatedPose, limits: GateLimits, reason: str) -> None:
    assert reason in weakness(pose, limits) and bool(weakness(pose, limits)) == bool(reason)


def drive(step: int) -> Pose:
    """Return the base on a curve; the odometry starts elsewhere."""
    turn = rotation_from_vector(np.array([0.0, 0.0, 0.05 * step]))
    return Pose(turn, np.array([np.sin(0.05 * step), 1 - np.cos(0.05 * step), 0.0]))


START = Pose(rotation_from_vector(np.array([0.0, 0.0, 2.0])), np.array([5.0, -3.0, 0.0]))


def pose_of(
    step: int, shift: float = 0.0, suspects: Mapping[int, float] = NONE, scale: float = 1.0
) -> GatedPose:
    true = drive(step)
    moved = Pose(true.rotation, true.position + np.array([0.0, shift, 0.0]))
    return GatedPose(moved, scale**2 * SMALL, suspects=suspects)


def judge(gate: OdometryGate, step: int, *pose: Any) -> tuple[str, str]:
    verdict = gate.judge(pose_of(step, *pose), START.compose(drive(step)))
    return verdict.refused, verdict.unconfirmed


def test_a_pose_that_odometry_contradicts_is_refused() -> None:
    gate = OdometryGate(LIMITS)
    assert [judge(gate, step) for step in range(4)] == [('', '')] * 4
    refused, _ = judge(gate, 4, 0.3)
    assert 'sigmas off where odometry has it (max_innovation 5)' in refused
    assert float(refused.split()[0]) > 10
    assert judge(gate, 5) == ('', '')
    assert judge(OdometryGate(LIMITS._replace(max_innovation=0.0)), 9, 9.0) == ('', '')


def test_odometry_may_be_off_by_its_share_of_the_way() -> None:
    for share, passes in ((0.05, False), (0.5, True)):
        gate = OdometryGate(LIMITS._replace(odom_error=share))
        judge(gate, 0)
        assert (judge(gate, 10, 0.2)[0] == '') == passes


def test_a_wrong_first_pose_does_not_keep_out_the_others() -> None:
    gate = OdometryGate(LIMITS)
    judge(gate, 0, 0.5)
    passed = [not judge(gate, step)[0] for step in range(1, 8)]
    assert not passed[0] and all(passed[3:])


def test_a_doubtful_tag_is_confirmed_by_poses_without_it() -> None:
    gate, third, both = OdometryGate(LIMITS), {3: 0.05}, {3: 0.05, 5: 0.05}
    alone = ('', 'no other tag confirms the pose by tag 3')
    assert judge(gate, 0, 0.0, third) == alone, 'nothing before the first'
    assert judge(OdometryGate(LIMITS), 0, 0.0, both) == ('', f'{alone[1]} and 5')
    assert judge(gate, 1, 0.0, both) == alone, 'the pose before is not by tag 5'
    assert judge(gate, 2, 0.0, third) == alone, 'tag 3 is suspect in the poses before, too'
    assert judge(gate, 3) == ('', '')
    assert judge(gate, 4, 0.0, third) == ('', '')
    assert judge(gate, 5, 0.05, third) == alone, 'not as closely as it states'
    assert judge(gate, 6, 0.0, {3: 0.6}) == alone, 'it probably moved'
    assert judge(gate, 7, 0.0, {9: 0.05}) == ('', ''), 'poses of which tag 9 is no doubt agree'


def test_a_pose_known_less_well_confirms_nothing() -> None:
    for scale, confirms in ((0.5, True), (3.0, False)):
        gate = OdometryGate(LIMITS)
        judge(gate, 0, 0.0, NONE, scale)
        assert (judge(gate, 1, 0.0, {3: 0.05})[1] == '') == confirms
