"""The engines that the projection and its solvers run on."""

from fisheye_svp_ros.engines.numpy_engine import (
    incidence as incidence,
)
from fisheye_svp_ros.engines.numpy_engine import (
    linearise as linearise,
)
from fisheye_svp_ros.engines.numpy_engine import (
    linearise_views as linearise_views,
)
from fisheye_svp_ros.engines.numpy_engine import (
    pose_equations as pose_equations,
)
from fisheye_svp_ros.engines.numpy_engine import (
    project as project,
)
