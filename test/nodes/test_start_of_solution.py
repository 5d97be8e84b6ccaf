"""Where a localizer looks first: on along the way that the camera went."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from helpers.nodes import need_ros

need_ros()

from helpers.graph import Graph  # noqa: E402

from fisheye_svp_ros.nodes import robot  # noqa: E402
from fisheye_svp_ros.nodes.localizer import Localizer, _pose_at  # noqa: E402
from fisheye_svp_ros.pose import Pose, identity, rotation_from_vector  # noqa: E402

STEP = Pose(rotation_from_vector(np.array([[0.02, -0.05, 0.03]])), np.array([[0.01, 0.0, -0.02]]))


def test_a_steady_motion_is_carried_on_without_drift() -> None:
    latest = [(0, identity(1)), (10, STEP)]
    for stamp in range(20, 3000, 10):
        found = _pose_at(stamp, latest)
        assert found is not None
        latest = [latest[-1], (stamp, found)]
    steps = stamp // 10
    assert np.allclose(found.position, steps * STEP.position)
    turn = rotation_from_vector(steps * np.array([[0.02, -0.05, 0.03]]))
    assert np.abs(found.rotation - turn).max() < 1e-9
    gram = found.rotation[0] @ found.rotation[0].T
    assert np.abs(gram - np.eye(3)).max() < 1e-14


def test_after_a_break_the_latest_pose_is_the_start() -> None:
    assert _pose_at(5, []) is None
    assert _pose_at(5, [(0, STEP)]) is STEP
    assert _pose_at(40, [(0, identity(1)), (10, STEP)]) is STEP
    assert _pose_at(5, [(20, identity(1)), (10, STEP)]) is STEP


def test_a_solver_is_loaded_before_the_first_set_comes(
    graph: Callable[..., Graph], monkeypatch: pytest.MonkeyPatch
) -> None:
    loads: list[int] = []
    monkeypatch.setattr(robot, 'load_solver', lambda: loads.append(1))
    one = graph('lens:=fish214')
    one.start(Localizer)
    assert not loads, 'a start does not wait for it'
    one.until(lambda: loads)
    for _ in range(20):
        one.executor.spin_once(timeout_sec=0.02)
    assert len(loads) == 1
