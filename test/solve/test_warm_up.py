"""The first set of a node loads nothing any more, after it has warmed up."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

_CODE = """
import sys
from fisheye_svp_ros.solve.warm_up import load_solver
import numpy as np
from helpers.tag_room import LENS, ForwardModel, TagRoom, oval
from fisheye_svp_ros.solve.poses import solve_poses
if sys.argv[1] == 'warm':
    load_solver()
before, room = set(sys.modules), TagRoom(16)
for place, wrong in ((0.1, 0.0), (0.1, 30.0)):
    tags = room.visible(oval(place))
    uv = room.project(oval(place), tags)
    uv[:4] += wrong
    views = room.views(oval(place), uv, tags, 0.2, np.random.default_rng(1))
    solved = solve_poses(ForwardModel(LENS), views, tags=True)
    assert solved.outliers.any() == bool(wrong)
print(len(set(sys.modules) - before))
"""


def test_a_set_loads_no_module_after_the_warm_up() -> None:
    loaded, here = {}, str(Path(__file__).parents[1])
    path = os.pathsep.join(filter(None, (here, os.environ.get('PYTHONPATH'))))
    for how in ('cold', 'warm'):
        command = [sys.executable, '-c', _CODE, how]
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            check=True,
            env={**os.environ, 'PYTHONPATH': path},
        )
        loaded[how] = int(done.stdout)
    assert loaded['cold'] > 0 and loaded['warm'] == 0
