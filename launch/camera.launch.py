"""A live camera, or a recording of one: its images to a pose and a diagnosis."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction

from fisheye_svp_ros.nodes.launching import (
    COMMON,
    arguments,
    compose_nodes,
    file_arguments,
    node,
    value,
)

NODES = ('detector', 'localizer', 'model_critic')
ARGUMENTS = {
    'image': ('image', 'topic of the images; compressed ones are taken from IMAGE/compressed'),
    'camera_info': ('', 'topic of the camera_info; empty: the one beside the images'),
    'lens': ('camera_info', 'lens file, also of other tools; camera_info: what that topic says'),
    'board': ('chessboard:9x6:25mm', 'the board, as for `fisheye-svp detect`'),
}


def nodes(context):
    """Return the detector and what follows it."""
    image, info = value(context, 'image'), value(context, 'camera_info')
    beside = image.rpartition('/')
    topics = [('image', image), ('camera_info', info or f'{beside[0]}{beside[1]}camera_info')]
    given = {'detector': {'board': value(context, 'board')}, 'localizer': {}, 'model_critic': {}}
    for name, word, frame in (
        ('detector', 'board_frame', 'world_frame'),
        ('localizer', 'camera_frame', 'camera_frame'),
    ):
        if value(context, frame):
            given[name][word] = value(context, frame)
    if value(context, 'composed') == 'true':
        return [compose_nodes(context, given, topics)]
    return [node(context, name, own, topics) for name, own in given.items()]


def generate_launch_description():
    """Return arguments and nodes."""
    return LaunchDescription(
        [
            *arguments(name for name in COMMON if name not in ARGUMENTS),
            *(
                DeclareLaunchArgument(name, default_value=default, description=text)
                for name, (default, text) in ARGUMENTS.items()
            ),
            DeclareLaunchArgument(
                'composed',
                default_value='false',
                choices=['true', 'false'],
                description='all nodes in one process',
            ),
            *file_arguments(NODES),
            OpaqueFunction(function=nodes),
        ]
    )
