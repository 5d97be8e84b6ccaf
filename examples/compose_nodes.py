"""Run a camera, its localizer and a node of your own in one process and one executor.

    python examples/compose_nodes.py

Nodes take what rclpy.node.Node takes: a name, a namespace, parameter_overrides, a context.
"""

from __future__ import annotations

import rclpy
from geometry_msgs.msg import Vector3Stamped
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter

from fisheye_svp_ros.nodes.localizer import Localizer
from fisheye_svp_ros.nodes.synthetic_camera import SyntheticCamera

COUNT = 5


class Listener(Node):
    """Prints what the localizer is off by, and ends after some sets."""

    def __init__(self) -> None:
        super().__init__('listener', namespace='front')
        self.create_subscription(Vector3Stamped, 'localizer/position_error', self.print_error, 10)
        self._left = COUNT

    def print_error(self, message: Vector3Stamped) -> None:
        """Print one error, m."""
        error = message.vector
        print(f'x {error.x:.6f}  y {error.y:.6f}  z {error.z:.6f} m')
        self._left -= 1
        if not self._left:
            raise ExternalShutdownException


def main() -> None:
    """Compose the nodes and spin them."""
    rclpy.init()
    executor = SingleThreadedExecutor()
    nodes = [
        SyntheticCamera(namespace='front', parameter_overrides=[Parameter('radius', value=0.5)]),
        Localizer(namespace='front', parameter_overrides=[Parameter('svp', value='true')]),
        Listener(),
    ]
    try:
        for node in nodes:
            executor.add_node(node)
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()


if __name__ == '__main__':
    main()
