"""One camera, simulated or measured, and its localizer."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction

from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.nodes.launching import arguments, file_arguments, node, value

CAMERAS = ['synthetic_camera', 'measured_camera']
FILES = {'observations': 'observations to replay', 'true_poses': 'their true poses, if known'}


def nodes(context):
    """Return the nodes; what the arguments leave empty is left to the parameter files."""
    camera = value(context, 'camera')
    files = {name: value(context, name) for name in FILES if value(context, name)}
    if files and camera != 'measured_camera':
        raise ParameterError(
            f'{", ".join(files)}: only a measured camera replays it; add camera:=measured_camera'
        )
    return [node(context, camera, files), node(context, 'localizer', {})]


def generate_launch_description():
    """Return arguments and nodes."""
    return LaunchDescription(
        [
            *arguments(),
            DeclareLaunchArgument(
                'camera',
                default_value=CAMERAS[0],
                choices=CAMERAS,
                description='simulated or measured image points',
            ),
            *(
                DeclareLaunchArgument(
                    name,
                    default_value='',
                    description=f'{text}; empty: as the parameter files have it',
                )
                for name, text in FILES.items()
            ),
            *file_arguments([*CAMERAS, 'localizer']),
            OpaqueFunction(function=nodes),
        ]
    )
