"""What `import rclpy` gives on a machine without ROS 2."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from fisheye_svp_ros.standalone.context import get_default_context
from fisheye_svp_ros.standalone.exceptions import NotSupportedError, RCLError
from fisheye_svp_ros.standalone.executor import SingleThreadedExecutor
from fisheye_svp_ros.standalone.node import Node

_executor: SingleThreadedExecutor | None = None


def init(*, args: list[str] | None = None) -> None:
    """Join the domain; arguments come from the command line unless given."""
    get_default_context().init(args)


def ok() -> bool:
    """Say whether nodes may run."""
    return get_default_context().ok()


def shutdown() -> None:
    """Leave the domain; an error when that has happened before."""
    if not ok():
        raise RCLError('failed to shutdown: rcl_shutdown already called on the given context')
    try_shutdown()


def try_shutdown() -> None:
    """Leave the domain, unless that has happened before."""
    global _executor
    if _executor is not None:
        _executor.shutdown()
        _executor = None
    get_default_context().shut_down()


def create_node(node_name: str, **options: Any) -> Node:
    """Create a node."""
    return Node(node_name, **options)


@contextmanager
def _running(node: Node) -> Iterator[SingleThreadedExecutor]:
    global _executor
    executor = _executor = _executor or SingleThreadedExecutor()
    executor.add_node(node)
    try:
        yield executor
    finally:
        executor.remove_node(node)


def spin(node: Node) -> None:
    """Run the callbacks of a node until the context is shut down."""
    with _running(node) as executor:
        executor.spin()


def spin_once(node: Node, *, timeout_sec: float | None = None) -> None:
    """Run one callback of a node, or return after a while without any."""
    with _running(node) as executor:
        executor.spin_once(timeout_sec)


def __getattr__(name: str) -> Any:
    raise NotSupportedError(f'rclpy.{name} does not exist, or needs an installation of ROS 2')
