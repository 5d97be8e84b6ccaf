"""A live camera, or a recording of one: its images to a pose and a diagnosis."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

PACKAGE = 'fisheye_svp_ros'
ARGUMENTS = {
    'board': ('chessboard:9x6:25mm', 'the board, as for `fisheye-svp detect`'),
    'lens': ('', 'lens file, also of other tools'),
    'image': ('image', 'topic of the images; compressed ones are taken from IMAGE/compressed'),
    'namespace': ('', 'namespace of the nodes'),
}


def nodes(context):
    """Return the detector and what follows it."""
    value = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    lens = {'lens': value['lens']} if value['lens'] else {}
    parameters = {'detector': {'board': value['board']}, 'localizer': lens, 'model_critic': lens}
    topics = [('image', value['image']), ('image/compressed', f'{value["image"]}/compressed')]
    return [
        Node(package=PACKAGE, executable=name, namespace=value['namespace'], output='screen',
             parameters=[given], remappings=topics)
        for name, given in parameters.items()
    ]


def generate_launch_description():
    """Return arguments and nodes."""
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=default, description=text)
          for name, (default, text) in ARGUMENTS.items()),
        OpaqueFunction(function=nodes),
    ])
