"""Everything: one camera below mono/, a rig below stereo/; arguments: lens, svp, style."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction, IncludeLaunchDescription
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare


def include(name, *arguments, **values):
    path = PathJoinSubstitution([FindPackageShare('fisheye_svp_ros'), 'launch', name])
    given = {argument: LaunchConfiguration(argument) for argument in arguments} | values
    # A scope of its own: the two graphs declare arguments of the same names.
    return GroupAction([IncludeLaunchDescription(path, launch_arguments=given.items())])


def generate_launch_description():
    return LaunchDescription([
        DeclareLaunchArgument('lens', default_value='fish214',
                              description='lens file, or name in config/lenses'),
        DeclareLaunchArgument('svp', default_value='true',
                              description='solve with the single-viewpoint approximation'),
        DeclareLaunchArgument('style', default_value='parallel',
                              choices=['parallel', 'vergent', 'divergent'],
                              description='how the cameras of the rig stand'),
        include('mono.launch.py', 'lens', 'svp', namespace='mono'),
        include('stereo.launch.py', 'lens', 'svp', 'style', namespace='stereo'),
    ])
