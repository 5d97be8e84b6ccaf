"""One camera and its localizer; arguments: lens, svp, namespace, camera, *_params."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import LaunchConfigurationEquals
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
        parameters=parameters,
        output='screen',
        **options,
    )


def generate_launch_description():
    lens = {'lens': ParameterValue(LaunchConfiguration('lens'), value_type=str)}
    svp = {'svp': ParameterValue(LaunchConfiguration('svp'), value_type=bool)}
    return LaunchDescription([
        DeclareLaunchArgument('lens', default_value='fish214',
                              description='lens file, or name in config/lenses'),
        DeclareLaunchArgument('svp', default_value='true',
                              description='solve with the single-viewpoint approximation'),
        DeclareLaunchArgument('namespace', default_value='', description='namespace of the nodes'),
        DeclareLaunchArgument('camera', default_value='synthetic_camera',
                              choices=['synthetic_camera', 'measured_camera'],
                              description='simulated or measured image points'),
        DeclareLaunchArgument('synthetic_camera_params',
                              default_value=config('synthetic_camera.yaml'),
                              description='parameter file of the synthetic camera'),
        DeclareLaunchArgument('measured_camera_params',
                              default_value=config('measured_camera.yaml'),
                              description='parameter file of the measured camera'),
        DeclareLaunchArgument('localizer_params', default_value=config('localizer.yaml'),
                              description='parameter file of the localizer'),
        node('synthetic_camera', [LaunchConfiguration('synthetic_camera_params'), lens],
             condition=LaunchConfigurationEquals('camera', 'synthetic_camera')),
        node('measured_camera', [LaunchConfiguration('measured_camera_params'), lens],
             condition=LaunchConfigurationEquals('camera', 'measured_camera')),
        node('localizer', [LaunchConfiguration('localizer_params'), lens, svp]),
    ])
