"""Poses that came with the photographs: those of the camera, or of a robot that carries it.

Known poses of the camera are held: they show what free poses hide.  Those of a robot's flange, or
poses with noise of their own, are not, and what holds them would be blamed on the lens.  So they
are held only if the whole catalogue, fitted beside them, explains the images as well as free
poses do; else the hand-eye transform and the noise of the robot are fitted.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fisheye_svp_ros.diagnosis.null_model import NullModel
from fisheye_svp_ros.diagnosis.problem import Inputs, Problem
from fisheye_svp_ros.errors import GeometryError, ObservationError
from fisheye_svp_ros.mixed_model import eliminate
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.solve.hand_eye import HandEye, fit_hand_eye, flange_poses
from fisheye_svp_ros.solve.rig_state import Linearization

# F ratio of what known poses leave and free ones do not.  With poses of the camera: about 1, 1 to
# 2 beside local errors of board and image that imitate motions; with those of robots: 30 and more.
_MAX_RATIO = 4.0


def prepare_problem(inputs: Inputs) -> tuple[Problem, bool]:
    """Return the problem, its poses free where the given ones are not the camera's, and if so.

    Raises ObservationError where they are not those of a robot's flange either.
    """
    if inputs.poses is None:
        return Problem.prepare(inputs), False
    free = Problem.prepare(replace(inputs, poses=None))
    if misfit_ratio(free, inputs.poses) <= _MAX_RATIO:
        return Problem.prepare(inputs), False
    find_hand_eye(free.linear, inputs.poses)
    return free, True


def find_hand_eye(linear: Linearization, poses: dict[int, Pose]) -> HandEye:
    """Return the hand-eye calibration of a fitted model, from poses of the flange by frame.

    Raises ObservationError where the poses do not determine it, or no transform explains them.
    """
    data = linear.data
    try:
        return fit_hand_eye(data, linear.state, linear.free, *flange_poses(data, poses))[1]
    except GeometryError as cause:
        raise ObservationError(
            f'{data.observations.source}: the given poses fit neither the camera in the world nor '
            f'a flange that carries it: {cause}; or leave the poses out') from cause


def misfit_ratio(problem: Problem, poses: dict[int, Pose]) -> float:
    """Return the F ratio of known poses against free ones, all effects of the catalogue free.

    problem: with free poses.  Infinite where the camera could not see from the known poses what
    it did.
    """
    data, left_out = problem.data, problem.options.left_out
    known, _ = flange_poses(data, poses)
    held, state = replace(data, poses=known), replace(problem.base, pose=known)
    if not np.isfinite(Linearization(held, state, problem.free).residual).all():
        return np.inf
    free = NullModel.estimate(data, problem.base, problem.free, left_out=left_out)
    fixed = free.relinearize(held, state, problem.free, left_out, finest=False)
    after, freedom = _misfit(free), free.full.rows - free.full.group_rank
    return max(_misfit(fixed) - after, 0.0) / free.full.group_rank / (after / freedom)


def _misfit(null: NullModel) -> float:
    """Return the weighted sum of squares with the whole catalogue free."""
    free = np.concatenate([null.included_columns, null.fixed.own + null.fixed.forms.generic])
    return float(eliminate(null.information, free)[-1, -1])
