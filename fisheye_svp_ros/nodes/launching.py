"""What the launch files share: their arguments, and nodes that take them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

import yaml
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from fisheye_svp_ros.errors import GraphError, ParameterError
from fisheye_svp_ros.io.parameters import node_parameters, read_parameter_file

PACKAGE = 'fisheye_svp_ros'
PROGRAM = 'fisheye-svp'
STYLES = ('parallel', 'vergent', 'divergent')
_LEVELS = ('debug', 'info', 'warn', 'error', 'fatal')
_FLAG = ('true', 'false', 'True', 'False')  # launch itself and Python's own words
_NODE_ARGUMENTS = {
    'detector': (),
    **dict.fromkeys(
        ('synthetic_camera', 'measured_camera'), ('lens', 'world_frame', 'camera_frame')
    ),
}
_OF_TF = ('synthetic_camera', 'measured_camera', 'localizer', 'stereo_calibrator')

# By name: what it is for, the default, and the choices if there are any.
COMMON: Mapping[str, tuple[str, str, Sequence[str]]] = {
    'lens': ('lens file, or name in config/lenses; empty: from the parameter files', '', ()),
    'svp': (
        'solve without the viewpoint shift of the lens; empty: from the parameter files',
        '',
        ('', 'auto', *_FLAG),
    ),
    'namespace': ('namespace of the nodes', '', ()),
    'params': ('parameter file for all nodes, after their own; empty: none', '', ()),
    'publish_tf': (
        'publish estimated and true cameras and the rig on tf2; empty: from the parameter files',
        '',
        ('', *_FLAG),
    ),
    'world_frame': ('frame of the landmarks; empty: from the parameter files', '', ()),
    'camera_frame': (
        'frame of the camera, for a rig without left_ and right_; empty: from the parameter files',
        '',
        (),
    ),
    'use_sim_time': (
        'take the time from /clock; empty: from the parameter files',
        '',
        ('', *_FLAG),
    ),
    'log_level': ('lowest severity that the nodes log', 'info', _LEVELS),
    'respawn': ('restart a node when it ends', 'false', _FLAG),
}


def arguments(names: Iterable[str] = COMMON) -> list[Any]:
    """Return declarations of common arguments."""
    wanted = set(names)
    return [
        DeclareLaunchArgument(
            name,
            description=text,
            default_value=default,
            **({'choices': list(choices)} if choices else {}),
        )
        for name, (text, default, choices) in COMMON.items()
        if name in wanted
    ]


def style_argument() -> Any:
    """Return the declaration of the style of a rig."""
    return DeclareLaunchArgument(
        'style',
        default_value=STYLES[0],
        choices=list(STYLES),
        description='arrangement of the cameras of the rig',
    )


def file_arguments(names: Iterable[str]) -> list[Any]:
    """Return declarations of a parameter file for each node."""
    config = PathJoinSubstitution([FindPackageShare(PACKAGE), 'config'])
    return [
        DeclareLaunchArgument(
            f'{name}_params',
            description=f'parameter file of {name}',
            default_value=PathJoinSubstitution([config, f'{name}.yaml']),
        )
        for name in names
    ]


def value(context: Any, name: str) -> str:
    """Return the value of an argument; true and false as YAML has them."""
    text = str(LaunchConfiguration(name).perform(context))
    return text.lower() if text in _FLAG else text


def node(context: Any, name: str, given: Mapping[str, Any], remappings: Sequence[Any] = ()) -> Any:
    """Return a node with its files, then what was given; lens, svp and frames where it has them.

    Raises ParameterError for a file that is not there, of which launch_ros would only warn.
    """
    return Node(
        # With its name, since what is for one node wins over what a file says of all.
        executable=name,
        name=name,
        parameters=[*_files(context, name), {**_node_parameters(context, name), **given}],
        remappings=list(remappings),
        **_node_options(context),
    )


def compose_nodes(
    context: Any, given: Mapping[str, Mapping[str, Any]], remappings: Sequence[Any] = ()
) -> Any:
    """Return one process with several nodes; given: parameters by their names, in their order.

    What a file says of all nodes is for the one whose file it is, so all go into one file.
    """
    space = '/'.join(filter(None, ['', value(context, 'namespace').strip('/')]))
    document = {}
    for name, own in given.items():
        values: dict[str, Any] = {}
        for file in _files(context, name):
            values |= node_parameters(f'{space}/{name}', read_parameter_file(Path(file)))
        values |= {**_node_parameters(context, name), **own}
        document[f'{space}/{name}'] = {'ros__parameters': values}
    with NamedTemporaryFile('w', prefix='composed_', suffix='.yaml', delete=False) as stream:
        yaml.safe_dump(document, stream)
    return Node(
        executable=PROGRAM,
        arguments=['run', *given],
        parameters=[stream.name],
        remappings=list(remappings),
        **_node_options(context),
    )


def _node_options(context: Any) -> dict[str, Any]:
    return {
        'package': PACKAGE,
        'namespace': value(context, 'namespace'),
        'output': 'screen',
        'ros_arguments': ['--log-level', value(context, 'log_level')],
        'respawn': value(context, 'respawn') == 'true',
        'respawn_delay': 1.0,
    }


def _files(context: Any, name: str) -> list[str]:
    files = {word: value(context, word) for word in (f'{name}_params', 'params')}
    for word, file in files.items():
        if file and not Path(file).is_file():
            raise ParameterError(f'{word}: no file {file!r}; name a parameter file')
    return [*filter(None, files.values())]


def _node_parameters(context: Any, name: str) -> dict[str, Any]:
    """Return the arguments that are parameters of a node and not empty."""
    words = _NODE_ARGUMENTS.get(name, ('lens', 'svp'))
    flags = ('use_sim_time', 'publish_tf') if name in _OF_TF else ('use_sim_time',)
    return {word: value(context, word) for word in words if value(context, word)} | {
        flag: value(context, flag) == 'true' for flag in flags if value(context, flag)
    }


def fail(event: Any, context: Any) -> None:
    """End a launch that cannot do its work without a process, and say which one it was."""
    if event.returncode and not context.is_shutdown:
        raise GraphError(
            f'{event.process_name} ended with status {event.returncode}; its '
            'last lines above say why'
        )
