"""What `import rclpy` gives on a machine without ROS 2."""

from __future__ import annotations

from typing import Any

from fisheye_svp_ros.standalone.context import Context, get_default_context
from fisheye_svp_ros.standalone.exceptions import NotSupportedError, RCLError
from fisheye_svp_ros.standalone.executor import SingleThreadedExecutor
from fisheye_svp_ros.standalone.node import Node

__all__ = [
    'create_node',
    'get_default_context',
    'init',
    'ok',
    'shutdown',
    'spin',
    'spin_once',
    'try_shutdown',
]

_executor: SingleThreadedExecutor | None = None


def init(*, args: list[str] | None = None, domain_id: int | None = None) -> None:
    """Join the domain; arguments come from the command line unless given."""
    get_default_context().init(args, domain_id)


def ok(*, context: Context | None = None) -> bool:
    """Say whether nodes may run."""
    return (context or get_default_context()).ok()


def shutdown(*, context: Context | None = None) -> None:
    """Leave the domain; an error when that has happened before."""
    if not ok(context=context):
        raise RCLError('failed to shutdown: rcl_shutdown already called on the given context')
    try_shutdown(context=context)


def try_shutdown(*, context: Context | None = None) -> None:
    """Leave the domain, unless that has happened before."""
    global _executor
    if _executor is not None:
        _executor.shutdown()
        _executor = None
    (context or get_default_context()).shut_down()


def create_node(node_name: str, **options: Any) -> Node:
    """Create a node."""
    return Node(node_name, **options)


def _global_executor() -> SingleThreadedExecutor:
    global _executor
    if _executor is None:
        _executor = SingleThreadedExecutor()
    return _executor


def spin(node: Node, executor: SingleThreadedExecutor | None = None) -> None:
    """Run the callbacks of a node until the context is shut down."""
    executor = executor or _global_executor()
    executor.add_node(node)
    try:
        executor.spin()
    finally:
        executor.remove_node(node)


def spin_once(
    node: Node,
    *,
    executor: SingleThreadedExecutor | None = None,
    timeout_sec: float | None = None,
) -> None:
    """Run one callback of a node, or return after a while without any."""
    executor = executor or _global_executor()
    executor.add_node(node)
    try:
        executor.spin_once(timeout_sec)
    finally:
        executor.remove_node(node)


def __getattr__(name: str) -> Any:
    raise NotSupportedError(f'rclpy.{name} does not exist, or needs an installation of ROS 2')
