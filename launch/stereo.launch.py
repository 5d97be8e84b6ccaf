"""A synthetic rig, its calibration and its depth."""

from launch import LaunchDescription
from launch.actions import OpaqueFunction

from fisheye_svp_ros.nodes.launching import (
    arguments,
    file_arguments,
    node,
    style_argument,
    value,
)

SOLVERS = ['stereo_calibrator', 'stereo_depth']
RIG = [('rig', 'stereo_calibrator/rig')]


def nodes(context):
    """Return the nodes; what the arguments leave empty is left to the parameter files."""
    rig = {'style': value(context, 'style'), 'poses_file': 'calibration'}
    return [node(context, 'synthetic_camera', rig),
            *(node(context, name, {}, RIG) for name in SOLVERS)]


def generate_launch_description():
    """Return arguments and nodes."""
    return LaunchDescription([
        *arguments(), style_argument(), *file_arguments(['synthetic_camera', *SOLVERS]),
        OpaqueFunction(function=nodes),
    ])
