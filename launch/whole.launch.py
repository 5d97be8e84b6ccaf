"""Everything: one camera below mono/, a rig below stereo/."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction, IncludeLaunchDescription
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

SHARED = {
    'lens': 'lens file, or name in config/lenses; empty: as the parameter files have it',
    'svp': 'auto, true or false: solve with the SVP model; empty: as the parameter files have it',
}
STYLES = ['parallel', 'vergent', 'divergent']


def include(name, arguments, namespace):
    """Return a launch file in a scope of its own: both declare arguments of the same names."""
    path = PathJoinSubstitution([FindPackageShare('fisheye_svp_ros'), 'launch', name])
    given = {argument: LaunchConfiguration(argument) for argument in arguments}
    given['namespace'] = namespace
    return GroupAction([IncludeLaunchDescription(path, launch_arguments=given.items())])


def generate_launch_description():
    """Return arguments and both graphs."""
    return LaunchDescription([
        *(
            DeclareLaunchArgument(name, default_value='', description=text)
            for name, text in SHARED.items()
        ),
        DeclareLaunchArgument('style', default_value=STYLES[0], choices=STYLES,
                              description='how the cameras of the rig stand'),
        include('mono.launch.py', SHARED, 'mono'),
        include('stereo.launch.py', [*SHARED, 'style'], 'stereo'),
    ])
