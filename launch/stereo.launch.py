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
RIGHT = [(topic, f'right/{topic}') for topic in ('image_points', 'true_pose', 'camera_info')]


def nodes(context):
    """Return the nodes; what the arguments leave empty is left to the parameter files."""
    rig = {'style': value(context, 'style'), 'poses_file': 'calibration'}
    # tf2 has to know where the rig is: the right camera, which points and left camera hang on.
    right = ['localizer'] if value(context, 'publish_tf') == 'true' else []
    return [
        node(context, 'synthetic_camera', rig),
        *(node(context, name, {}, RIG) for name in SOLVERS),
        *(node(context, name, {}, RIGHT) for name in right),
    ]


def generate_launch_description():
    """Return arguments and nodes."""
    return LaunchDescription(
        [
            *arguments(),
            style_argument(),
            *file_arguments(['synthetic_camera', *SOLVERS, 'localizer']),
            OpaqueFunction(function=nodes),
        ]
    )
