"""One camera, simulated or measured, and its localizer."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

PACKAGE = 'fisheye_svp_ros'
CAMERAS = ['synthetic_camera', 'measured_camera']
ARGUMENTS = {
    'lens': 'lens file, or name in config/lenses; empty: as the parameter files have it',
    'svp': 'auto, true or false: solve with the SVP model; empty: as the parameter file has it',
    'namespace': 'namespace of the nodes',
}


def nodes(context):
    """Return the nodes; what the arguments leave empty is left to the parameter files."""
    def value(name):
        return LaunchConfiguration(name).perform(context)

    lens = {'lens': value('lens')} if value('lens') else {}
    svp = {'svp': value('svp')} if value('svp') else {}
    return [
        Node(package=PACKAGE, executable=name, namespace=value('namespace'), output='screen',
             parameters=[value(f'{name}_params'), given])
        for name, given in ((value('camera'), lens), ('localizer', {**lens, **svp}))
    ]


def generate_launch_description():
    """Return arguments and nodes."""
    config = PathJoinSubstitution([FindPackageShare(PACKAGE), 'config'])
    return LaunchDescription([
        *(
            DeclareLaunchArgument(name, default_value='', description=text)
            for name, text in ARGUMENTS.items()
        ),
        DeclareLaunchArgument('camera', default_value=CAMERAS[0], choices=CAMERAS,
                              description='simulated or measured image points'),
        *(
            DeclareLaunchArgument(f'{name}_params', description=f'parameter file of {name}',
                                  default_value=PathJoinSubstitution([config, f'{name}.yaml']))
            for name in (*CAMERAS, 'localizer')
        ),
        OpaqueFunction(function=nodes),
    ])
