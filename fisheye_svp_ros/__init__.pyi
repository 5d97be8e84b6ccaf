from fisheye_svp_ros.errors import FisheyeSvpError as FisheyeSvpError
from fisheye_svp_ros.io.readers import read_observations as read_observations
from fisheye_svp_ros.io.readers import read_poses as read_poses
from fisheye_svp_ros.io.readers import write_observations as write_observations
from fisheye_svp_ros.io.result_files import Columns as Columns
from fisheye_svp_ros.io.rig_files import load_rig as load_rig
from fisheye_svp_ros.library import back_project as back_project
from fisheye_svp_ros.library import budget as budget
from fisheye_svp_ros.library import calibrate as calibrate
from fisheye_svp_ros.library import calibrate_stereo as calibrate_stereo
from fisheye_svp_ros.library import diagnose as diagnose
from fisheye_svp_ros.library import load_lens as load_lens
from fisheye_svp_ros.library import localize as localize
from fisheye_svp_ros.library import project as project
from fisheye_svp_ros.library import rectify_maps as rectify_maps
from fisheye_svp_ros.library import save_lens as save_lens
from fisheye_svp_ros.library import simulate_scenario as simulate_scenario
from fisheye_svp_ros.library import stereo_depth as stereo_depth
from fisheye_svp_ros.library import sweep as sweep
from fisheye_svp_ros.library import undistort_maps as undistort_maps
from fisheye_svp_ros.optics.lens import Lens as Lens
from fisheye_svp_ros.pose import Pose as Pose
from fisheye_svp_ros.scene.observations import Observations as Observations
from fisheye_svp_ros.scene.rigs import rig as rig

__version__: str
