"""Sets of image points to poses: the one way there is.

Commands, library, nodes, sweeps and the paper's evaluation all come by here, with one camera or a
rig, so they tell the same numbers.
"""

from __future__ import annotations

import numpy as np

from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Views
from fisheye_svp_ros.solve.localization import localize
from fisheye_svp_ros.solve.reliability import examine
from fisheye_svp_ros.solve.solved_poses import SolvedPoses
from fisheye_svp_ros.solve.weak_geometry import hold_weak_geometry


def solve_poses(
    model: ForwardModel,
    views: Views,
    start: Pose | None = None,
    *,
    known_sigma: bool = True,
    examined: bool = True,
    searched: bool = True,
    tags: bool = False,
) -> SolvedPoses:
    """Solve sets of image points (S,) to poses; no start values are needed.

    The views hold what is known besides: covariances of landmarks, a prior of the poses.
    start (S,): poses that are near; known_sigma: whether weights are 1 / sigma, else the noise is
    estimated; examined: test the misfit against sigma; searched: leave outliers out where that
    fails, see `examine`: not of sets whose errors by the SVP model are to be measured; tags: the
    boards of the views are tags, whose points stand or fall together.
    Raises GeometryError as `localize` does.
    """
    solution = localize(model, views, start)
    if examined:
        return examine(model, views, solution, known_sigma, searched, tags)
    solution = hold_weak_geometry(model, views, solution)
    count = len(solution.cost)
    nothing = np.zeros(views.used.shape, dtype=bool)
    return SolvedPoses(model, views, solution, nothing, ('',) * count, None, np.ones(count))
