"""What the launch files share: their arguments, and nodes that take them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from fisheye_svp_ros.errors import GraphError, ParameterError

PACKAGE = 'fisheye_svp_ros'
STYLES = ('parallel', 'vergent', 'divergent')
_LEVELS = ('debug', 'info', 'warn', 'error', 'fatal')
_FLAG = ('true', 'false', 'True', 'False')  # launch itself and Python's own words
_WORDS = {'detector': (), **dict.fromkeys(('synthetic_camera', 'measured_camera'), ('lens',))}
_OF_TF = ('synthetic_camera', 'measured_camera', 'localizer', 'stereo_calibrator')

# By name: what it is for, the default, and the choices if there are any.
COMMON: Mapping[str, tuple[str, str, Sequence[str]]] = {
    'lens': ('lens file, or name in config/lenses; empty: as the parameter files have it', '', ()),
    'svp': ('solve without the viewpoint shift of the lens; empty: as the parameter files have it',
            '', ('', 'auto', *_FLAG)),
    'namespace': ('namespace of the nodes', '', ()),
    'params': ('parameter file for all nodes, after their own; empty: none', '', ()),
    'publish_tf': ('tell tf2 the cameras, as estimated and as true, and the rig; empty: as the '
                   'parameter files have it', '', ('', *_FLAG)),
    'use_sim_time': ('take the time from /clock; empty: as the parameter files have it', '',
                     ('', *_FLAG)),
    'log_level': ('what the nodes log from', 'info', _LEVELS),
    'respawn': ('start a node again when it ends', 'false', _FLAG),
}


def arguments(names: Iterable[str] = COMMON) -> list[Any]:
    """Return declarations of common arguments."""
    wanted = set(names)
    return [
        DeclareLaunchArgument(name, description=text, default_value=default,
                              **({'choices': list(choices)} if choices else {}))
        for name, (text, default, choices) in COMMON.items() if name in wanted
    ]


def style_argument() -> Any:
    """Return the declaration of the style of a rig."""
    return DeclareLaunchArgument('style', default_value=STYLES[0], choices=list(STYLES),
                                 description='how the cameras of the rig stand')


def file_arguments(names: Iterable[str]) -> list[Any]:
    """Return declarations of a parameter file for each node."""
    config = PathJoinSubstitution([FindPackageShare(PACKAGE), 'config'])
    return [
        DeclareLaunchArgument(f'{name}_params', description=f'parameter file of {name}',
                              default_value=PathJoinSubstitution([config, f'{name}.yaml']))
        for name in names
    ]


def value(context: Any, name: str) -> str:
    """Return the value of an argument; true and false as YAML has them."""
    text = str(LaunchConfiguration(name).perform(context))
    return text.lower() if text in _FLAG else text


def node(
    context: Any, name: str, given: Mapping[str, Any], remappings: Sequence[Any] = ()
) -> Any:
    """Return a node with its files, then what was given; lens and svp where it has them.

    Raises ParameterError for a file that is not there, of which launch_ros would only warn.
    """
    words = _WORDS.get(name, ('lens', 'svp'))
    flags = ('use_sim_time', 'publish_tf') if name in _OF_TF else ('use_sim_time',)
    files = {word: value(context, word) for word in (f'{name}_params', 'params')}
    for word, file in files.items():
        if file and not Path(file).is_file():
            raise ParameterError(f'{word}: {file!r} is no file; name a parameter file')
    return Node(
        package=PACKAGE, executable=name, namespace=value(context, 'namespace'), output='screen',
        parameters=[
            *filter(None, files.values()),
            {word: value(context, word) for word in words if value(context, word)},
            {flag: value(context, flag) == 'true' for flag in flags if value(context, flag)},
            dict(given),
        ],
        ros_arguments=['--log-level', value(context, 'log_level')],
        respawn=value(context, 'respawn') == 'true', respawn_delay=1.0,
        remappings=list(remappings),
    )


def fail(event: Any, context: Any) -> None:
    """End a launch that cannot do its work without a process, and say which one it was."""
    if event.returncode and not context.is_shutdown:
        raise GraphError(f'{event.process_name} ended with status {event.returncode}; its '
                              'last lines above say why')
