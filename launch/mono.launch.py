"""One camera, simulated or measured, and its localizer."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction

from fisheye_svp_ros.nodes.launching import arguments, file_arguments, node, value

CAMERAS = ['synthetic_camera', 'measured_camera']


def nodes(context):
    """Return the nodes; what the arguments leave empty is left to the parameter files."""
    return [node(context, value(context, 'camera'), {}), node(context, 'localizer', {})]


def generate_launch_description():
    """Return arguments and nodes."""
    return LaunchDescription([
        *arguments(),
        DeclareLaunchArgument('camera', default_value=CAMERAS[0], choices=CAMERAS,
                              description='simulated or measured image points'),
        *file_arguments([*CAMERAS, 'localizer']),
        OpaqueFunction(function=nodes),
    ])
