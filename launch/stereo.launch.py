"""A synthetic rig, its calibration and its depth; arguments: lens, svp, style, namespace, ..."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

PACKAGE = 'fisheye_svp_ros'


def config(name):
    return PathJoinSubstitution([FindPackageShare(PACKAGE), 'config', name])


def node(executable, parameters, **options):
    return Node(
        package=PACKAGE,
        executable=executable,
        namespace=LaunchConfiguration('namespace'),
        parameters=[LaunchConfiguration(f'{executable}_params'), *parameters],
        output='screen',
        **options,
    )


def generate_launch_description():
    lens = {'lens': ParameterValue(LaunchConfiguration('lens'), value_type=str)}
    svp = {'svp': ParameterValue(LaunchConfiguration('svp'), value_type=bool)}
    rig = {'style': ParameterValue(LaunchConfiguration('style'), value_type=str),
           'poses_file': 'calibration'}
    return LaunchDescription([
        DeclareLaunchArgument('lens', default_value='fish214',
                              description='lens file, or name in config/lenses'),
        DeclareLaunchArgument('svp', default_value='true',
                              description='solve with the single-viewpoint approximation'),
        DeclareLaunchArgument('style', default_value='parallel',
                              choices=['parallel', 'vergent', 'divergent'],
                              description='how the cameras of the rig stand'),
        DeclareLaunchArgument('namespace', default_value='', description='namespace of the nodes'),
        *(
            DeclareLaunchArgument(f'{name}_params', default_value=config(f'{name}.yaml'),
                                  description=f'parameter file of {name}')
            for name in ('synthetic_camera', 'stereo_calibrator', 'stereo_depth')
        ),
        node('synthetic_camera', [lens, rig]),
        node('stereo_calibrator', [lens, svp]),
        node('stereo_depth', [lens, svp], remappings=[('rig', 'stereo_calibrator/rig')]),
    ])
