"""What the first set of image points would wait for: libraries and compiled code are loaded."""

from __future__ import annotations

import numpy as np

from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.optics.curves import KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import identity
from fisheye_svp_ros.scene.observations import views_of
from fisheye_svp_ros.solve.poses import solve_poses
from fisheye_svp_ros.solve.weak_geometry import is_ambiguous

_LENS = Lens('warm up', 1280, 960, 330.0, 330.0, 640.0, 480.0, KannalaBrandt(0.0), 1.5)
_SQUARE = np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
_CENTERS = np.array([[-1.0, 0.2, 1.5], [0.8, 0.5, 2.0], [0.1, -0.6, 1.0], [0.5, -0.4, 2.5]])


def load_solver() -> None:
    """Solve sets of tags once: of all of them with an outlier, and of one that two poses fit."""
    model, size = ForwardModel(_LENS), len(_SQUARE)
    points = (_CENTERS[:, None] + 0.1 * _SQUARE).reshape(-1, 3)
    uv = model.predict(identity(1), views_of(points)).uv
    uv[0, :size] += 20.0
    for shown in (len(points), size):
        corners = np.arange(shown)[None]
        views = views_of(points[:shown], uv[:, :shown], np.full(corners.shape, 1.0))
        views = views._replace(landmark=corners, board=corners // size)
        is_ambiguous(solve_poses(model, views, tags=True).result)
