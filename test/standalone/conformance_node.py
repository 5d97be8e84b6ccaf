"""A plain rclpy node that writes down what it sees; the same transcript is expected everywhere.

It uses what the nodes of this package use. Given `--ros-args` it applies them; it ends after the
service `~/finish` was called, or on Ctrl-C.
"""

from __future__ import annotations

import array
import sys

import numpy as np
import rclpy
from builtin_interfaces.msg import Time as TimeMsg
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    ParameterType,
    SetParametersResult,
)
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterAlreadyDeclaredException,
    ParameterNotDeclaredException,
)
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, PointCloud2, PointField
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

LATCHED = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=2,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)


def say(*words: object) -> None:
    print(*words, flush=True)


class Conformance(Node):
    """Goes through publisher, subscription, timer, service and parameters, one after the other."""

    def __init__(self) -> None:
        super().__init__('conformance')
        say('node', self.get_name(), self.get_namespace(), self.get_fully_qualified_name())
        self._declare()
        self._try_parameters()
        self._use_messages()
        self._use_time()
        self._done = False
        self._received = 0
        self._values = self.create_publisher(Float64, 'values', LATCHED)
        for value in (1.0, 2.0, 3.0):
            self._values.publish(Float64(data=value))
        self._late = self.create_subscription(Float64, 'values', self._on_value, LATCHED)
        self._cloud = self.create_publisher(PointCloud2, '~/cloud', 10)
        self._echo = self.create_subscription(PointCloud2, '~/cloud', self._on_cloud, 10)
        self._absolute = self.create_publisher(PoseStamped, '/absolute/pose', 1)
        say('topics', self._values.topic_name, self._cloud.topic_name, self._late.topic_name,
            self._absolute.topic_name)  # fmt: skip
        self._service = self.create_service(Trigger, '~/finish', self._on_finish)
        say('service', self._service.service_name)
        self._ticks = 0
        self._timer = self.create_timer(0.02, self._on_tick)

    @property
    def done(self) -> bool:
        return self._done

    def _declare(self) -> None:
        rate = ParameterDescriptor(
            description='how often',
            floating_point_range=[FloatingPointRange(from_value=0.5, to_value=50.0)],
        )
        count = ParameterDescriptor(
            integer_range=[IntegerRange(from_value=1, to_value=9)], read_only=False)
        for given in (
            ('rate', 10.0, rate),
            ('count', 3, count),
            ('name', 'fish', ParameterDescriptor()),
            ('flags', [True, False]),
            ('matrix', [1.0, 0.0, 0.0, 1.0]),
            ('ids', [1, 2, 3]),
            ('words', ['a', 'b']),
            ('lens.f', 400.0),
            ('lens.model.name', 'equidistant'),
            ('fixed', 1, ParameterDescriptor(read_only=True)),
            ('any', None, ParameterDescriptor(dynamic_typing=True)),
        ):
            self.declare_parameter(*given)
        for name in ('rate', 'count', 'name', 'flags', 'matrix', 'ids', 'words', 'lens.f',
                     'lens.model.name', 'fixed', 'any'):  # fmt: skip
            parameter = self.get_parameter(name)
            say('parameter', parameter.name, parameter.type_, parameter.value)
        below = self.get_parameters_by_prefix('lens')
        say('prefix', sorted((name, p.value) for name, p in below.items()))
        self.add_on_set_parameters_callback(self._on_set)

    def _on_set(self, parameters: list[Parameter]) -> SetParametersResult:
        for parameter in parameters:
            if parameter.name == 'name' and not parameter.value:
                return SetParametersResult(successful=False, reason='a name is needed')
        return SetParametersResult(successful=True)

    def _try_parameters(self) -> None:
        for name, value in (('rate', 20.0), ('rate', 100.0), ('rate', 0.7), ('rate', 5),
                            ('count', 5), ('count', 4), ('count', 11), ('name', ''),
                            ('name', 'eye'), ('fixed', 2), ('any', 'text'), ('any', 2.5),
                            ('ids', [4]), ('ids', [0.5]), ('flags', True)):  # fmt: skip
            (result,) = self.set_parameters([Parameter(name, value=value)])
            say('set', name, value, result.successful, result.reason,
                self.get_parameter(name).value)  # fmt: skip
        result = self.set_parameters_atomically([
            Parameter('rate', Parameter.Type.DOUBLE, 1.0), Parameter('name', value='')])
        say('atomically', result.successful, result.reason, self.get_parameter('rate').value)
        descriptor = self.describe_parameter('rate')
        say('described', descriptor.name, descriptor.description,
            descriptor.type == ParameterType.PARAMETER_DOUBLE)  # fmt: skip
        narrow = ParameterDescriptor(integer_range=[IntegerRange(from_value=0, to_value=1)])
        for attempt in (
            lambda: self.get_parameter('nowhere'),
            lambda: self.declare_parameter('rate', 1.0),
            lambda: self.declare_parameter('narrow', 7, narrow),
            lambda: self.declare_parameter('mistyped', 7.0),
            lambda: Parameter('mixed', value=[1, 'a']),
        ):
            try:
                say('accepted', attempt())
            except (InvalidParameterTypeException, InvalidParameterValueException,
                    ParameterAlreadyDeclaredException,
                    ParameterNotDeclaredException) as error:  # fmt: skip
                say(type(error).__name__, error)
            except (TypeError, ValueError) as error:
                say(type(error).__name__)
        say('has', self.has_parameter('rate'), self.has_parameter('nowhere'))

    def _use_messages(self) -> None:
        pose = PoseWithCovarianceStamped()
        pose.pose.covariance[7] = 0.25
        pose.header.stamp.sec = 4
        say('pose', pose)
        info = CameraInfo(width=640, d=[0.1, 0.2], k=np.eye(3).reshape(-1))
        say('info', info.width, type(info.d).__name__, list(info.d), type(info.k).__name__, info.k)
        status = DiagnosticStatus(level=DiagnosticStatus.WARN, values=[KeyValue(key='k')])
        say('status', DiagnosticArray(status=[status]), status.level == DiagnosticStatus.WARN)
        say('constants', PointField.FLOAT64, PointField.UINT32, DiagnosticStatus.ERROR)
        say('equal', TimeMsg(sec=1) == TimeMsg(sec=1), TimeMsg(sec=1) == TimeMsg(sec=2))
        try:
            pose.heading = 1.0
        except AttributeError:
            say('no such field')

    def _use_time(self) -> None:
        now = self.get_clock().now()
        say('clock', now.nanoseconds // 10**9 == now.to_msg().sec > 1_600_000_000)

    def _on_value(self, message: Float64) -> None:
        say('value', message.data)

    def _on_tick(self) -> None:
        # One message at a time, so that the order of the transcript does not depend on timing.
        if self._echo_is_ready() and self._ticks == self._received:
            self._ticks += 1
            data = np.arange(self._ticks, dtype=np.float64).tobytes()
            self._cloud.publish(PointCloud2(
                width=self._ticks, fields=[PointField(name='x', datatype=PointField.FLOAT64)],
                data=array.array('B', data)))  # fmt: skip
        if self._ticks == 3:
            self._timer.cancel()
            self.get_logger().info('ticked')

    def _echo_is_ready(self) -> bool:
        return self._cloud.get_subscription_count() == 1

    def _on_cloud(self, message: PointCloud2) -> None:
        values = np.frombuffer(message.data, np.float64)
        say('cloud', message.width, type(message.data).__name__, values, message.fields)
        for _ in range(3):
            self.get_logger().warning('only once', once=True)
            self.get_logger().error('seldom', throttle_duration_sec=60.0)
            self.get_logger().debug('never')
        self._received += 1
        if self._received == 3:
            say('ready', self._timer.is_canceled())

    def _on_finish(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        say('request', request)
        self._done = True
        response.success = True
        response.message = self.get_parameter('name').value
        return response


def main() -> None:
    rclpy.init(args=sys.argv)
    try:
        node = Conformance()
        while rclpy.ok() and not node.done:
            rclpy.spin_once(node)
        # The answer to the last request is still on its way.
        rclpy.spin_once(node, timeout_sec=0.5)
        node.destroy_node()
    except (KeyboardInterrupt, ExternalShutdownException) as end:
        say('ended', type(end).__name__)
    finally:
        rclpy.try_shutdown()
    say('ok', rclpy.ok())


if __name__ == '__main__':
    main()
