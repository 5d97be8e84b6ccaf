"""An rclpy for machines without ROS 2, on Eclipse Cyclone DDS.

Nodes are written for rclpy. Where ROS 2 is installed they run on it and nothing here is used;
elsewhere `install()` makes `import rclpy` and the message packages work:

>>> from fisheye_svp_ros import standalone
>>> standalone.install()
>>> import rclpy
>>> from geometry_msgs.msg import PoseStamped

It covers what the nodes of this package use and raises a clear error for the rest.
"""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec

# Modules of rclpy, and the files here that stand in for them.
_MODULES = {
    'rclpy': 'rclpy',
    'rclpy.clock': 'clock',
    'rclpy.event_handler': 'qos',
    'rclpy.exceptions': 'exceptions',
    'rclpy.executors': 'executor',
    'rclpy.lifecycle': 'lifecycle',
    'rclpy.node': 'node',
    'rclpy.parameter': 'parameters',
    'rclpy.qos': 'qos',
    'rclpy.qos_overriding_options': 'qos',
    'rclpy.serialization': 'messages',
}

_installed = False


def is_genuine() -> bool:
    """Say whether `import rclpy` gives the rclpy of an installed ROS 2."""
    return not _installed and find_spec('rclpy') is not None


def install() -> None:
    """Make rclpy and the message packages importable, unless ROS 2 already does."""
    global _installed
    if _installed or is_genuine():
        return
    from fisheye_svp_ros.standalone.messages import packages

    _installed = True
    sys.modules.update(packages())
    root = import_module('fisheye_svp_ros.standalone.rclpy')
    for name, file in _MODULES.items():
        module = import_module(f'fisheye_svp_ros.standalone.{file}')
        sys.modules[name] = module
        if name != 'rclpy':
            setattr(root, name.removeprefix('rclpy.'), module)
