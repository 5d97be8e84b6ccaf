"""A sweep through the node graph in lock-step, recorded; ends by itself.

The same rows as `fisheye-svp sweep FILE` computes offline: `fisheye-svp table BAG`.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch_ros.actions import Node

from fisheye_svp_ros.commands.node_sweeps import lens_folder, read_sweep
from fisheye_svp_ros.io.share import sweep_path
from fisheye_svp_ros.nodes.launching import PACKAGE, fail, value

PATIENCE = 3600.0  # s: in lock-step nothing is lost, only late


def ended(event, context):
    """End with the camera: well after the last set, otherwise with the reason."""
    fail(event, context)
    return [Shutdown(reason='the sweep is done')]


def nodes(context):
    """Return recorder, solvers and camera; a bad sweep file ends the launch before any starts."""
    path = sweep_path(value(context, 'sweep'))
    plan = read_sweep(path)
    solvers = list(plan.solvers)
    return [
        # A recording is to be whole, however busy the machine is.
        Node(
            package=PACKAGE,
            executable='fisheye-svp',
            output='screen',
            on_exit=fail,
            sigterm_timeout='60',
            arguments=['record', '-o', value(context, 'bag')],
        ),
        *(
            Node(
                package=PACKAGE,
                executable=name,
                output='screen',
                on_exit=fail,
                parameters=[
                    str(path),
                    {'wait_for_subscribers': 2, 'patience': PATIENCE, 'folder': lens_folder(plan)},
                ],
            )
            for name in solvers
        ),
        Node(
            package=PACKAGE,
            executable='synthetic_camera',
            output='screen',
            on_exit=ended,
            parameters=[
                str(path),
                {
                    'wait_for_subscribers': len(solvers) + 1,
                    'repeat': False,
                    'lock_step': ' '.join(f'{name}/result' for name in solvers),
                },
            ],
        ),
    ]


def generate_launch_description():
    """Return arguments and nodes."""
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                'sweep', description='sweep file, or name of one in config/sweeps'
            ),
            DeclareLaunchArgument(
                'bag',
                default_value='sweep_recording',
                description='folder of the recording; it must not exist',
            ),
            OpaqueFunction(function=nodes),
        ]
    )
