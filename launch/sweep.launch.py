"""A sweep through the node graph in lock-step, recorded; ends by itself.

The same rows as `fisheye-svp sweep FILE` computes offline: `fisheye-svp table BAG`.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from fisheye_svp_ros.commands.sweep_file import read_sweep
from fisheye_svp_ros.io.share import sweep_path

PACKAGE = 'fisheye_svp_ros'
PATIENCE = 3600.0  # s: in lock-step nothing is lost, only late


def nodes(context):
    """Return recorder, solvers and camera; a bad sweep file ends the launch before any starts."""
    path = sweep_path(LaunchConfiguration('sweep').perform(context))
    solvers = list(read_sweep(path).solvers)
    return [
        Node(package=PACKAGE, executable='fisheye-svp', output='screen',
             arguments=['record', '-o', LaunchConfiguration('bag').perform(context)]),
        *(
            Node(package=PACKAGE, executable=name, output='screen', parameters=[
                str(path), {'wait_for_subscribers': 2, 'patience': PATIENCE}])
            for name in solvers
        ),
        Node(package=PACKAGE, executable='synthetic_camera', output='screen', parameters=[
            str(path),
            {'wait_for_subscribers': len(solvers) + 1, 'repeat': False,
             'lock_step': ' '.join(f'{name}/result' for name in solvers)},
        ], on_exit=Shutdown(reason='the sweep is done')),
    ]


def generate_launch_description():
    """Return arguments and nodes."""
    return LaunchDescription([
        DeclareLaunchArgument('sweep', description='sweep file, or name of one in config/sweeps'),
        DeclareLaunchArgument('bag', default_value='sweep_recording',
                              description='folder of the recording; it must not exist'),
        OpaqueFunction(function=nodes),
    ])
