"""Everything: one camera below mono/, a rig below stereo/."""

from launch import LaunchDescription
from launch.actions import GroupAction, IncludeLaunchDescription
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

from fisheye_svp_ros.nodes.launching import COMMON, PACKAGE, arguments, style_argument


def include(name, shared, part):
    """Return a launch file in a scope of its own: both declare arguments of the same names."""
    path = PathJoinSubstitution([FindPackageShare(PACKAGE), 'launch', name])
    given = {argument: LaunchConfiguration(argument) for argument in shared}
    given['namespace'] = [LaunchConfiguration('namespace'), f'/{part}']
    return GroupAction([IncludeLaunchDescription(path, launch_arguments=given.items())])


def generate_launch_description():
    """Return arguments and both graphs."""
    return LaunchDescription(
        [
            *arguments(),
            style_argument(),
            include('mono.launch.py', COMMON, 'mono'),
            include('stereo.launch.py', [*COMMON, 'style'], 'stereo'),
        ]
    )
