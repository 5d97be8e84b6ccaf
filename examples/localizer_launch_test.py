"""A launch test: a localizer poses what a synthetic camera shows it, to a millimeter.

    launch_test localizer_launch_test.py

Copy it, put your camera and lens in its place, and `add_launch_test` (CMake) or pytest with
launch_pytest runs it with the other tests of your package.
"""

import time
import unittest

import launch
import launch_ros.actions
import launch_testing.actions
import launch_testing.asserts
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

TIMEOUT = 180.0  # s, on a busy machine
SETS = 5


@pytest.mark.launch_test
def generate_test_description():
    """Return camera and localizer, which are tested once they run."""
    nodes = [
        launch_ros.actions.Node(
            package='fisheye_svp_ros',
            executable=name,
            parameters=[{'svp': 'false', 'gate': 3.0} if name == 'localizer' else {'rate': 20.0}],
        )
        for name in ('localizer', 'synthetic_camera')
    ]
    return launch.LaunchDescription([*nodes, launch_testing.actions.ReadyToTest()])


class TestPoses(unittest.TestCase):
    """What the localizer answers while it runs."""

    def setUp(self):  # noqa: N802
        """Listen to the results."""
        rclpy.init()
        self.node = rclpy.create_node('listener')
        self.statuses = []
        self.node.create_subscription(
            DiagnosticArray,
            'localizer/result',
            lambda message: self.statuses.extend(message.status),
            10,
        )

    def tearDown(self):  # noqa: N802
        """Listen no more."""
        self.node.destroy_node()
        rclpy.shutdown()

    def test_errors_are_below_a_millimeter_and_nothing_is_doubtful(self):
        """Each set is solved, and near to where the camera is."""
        end = time.monotonic() + TIMEOUT
        while len(self.statuses) < SETS and time.monotonic() < end:
            rclpy.spin_once(self.node, timeout_sec=0.1)
        self.assertGreaterEqual(len(self.statuses), SETS)
        for status in self.statuses:
            metrics = {pair.key: float(pair.value) for pair in status.values}
            self.assertEqual((status.level, status.message), (DiagnosticStatus.OK, ''))
            self.assertLess(metrics['position_error_m'], 1e-3)


@launch_testing.post_shutdown_test()
class TestEnd(unittest.TestCase):
    """How the processes ended."""

    def test_nodes_end_cleanly(self, proc_info):
        """Neither reports a failure."""
        launch_testing.asserts.assertExitCodes(proc_info)
