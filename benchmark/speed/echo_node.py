"""Answers each set of image points with a pose, without a look at it; run by round_trip.py."""

from __future__ import annotations

import sys
from contextlib import suppress

import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2

QOS = QoSProfile(depth=100)


class Echo(Node):
    """The least that a localizer could do."""

    def __init__(self):
        super().__init__('localizer')
        self._pose = self.create_publisher(PoseWithCovarianceStamped, '~/pose', QOS)
        self.create_subscription(PointCloud2, 'image_points', self._answer, QOS)

    def _answer(self, message):
        self._pose.publish(PoseWithCovarianceStamped(header=message.header))


if __name__ == '__main__':
    rclpy.init(args=sys.argv)
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(Echo())
