"""Round trips through a localizer and through an echo node; prints JSON; run by nodes.py.

Both nodes are processes of their own and get the same message in turns; this process sends and
waits for the pose.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from benchmark.speed.scenes import LANDMARKS, localization, motion
from fisheye_svp_ros.commands.processes import domain
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.scene.observations import Landmarks

_LENS = 'fish214'
_VIEWS = 150
_PATIENCE = 30.0  # s
_LASTING = 1.0  # s of sets at one rate
_RATES = (100, 200, 400, 800, 1600, 3200)
_ECHO = Path(__file__).with_name('echo_node.py')


class Probe:
    """Sends sets of image points and hears poses, by stamp; the nodes are told by namespace."""

    def __init__(self, names: tuple[str, ...]) -> None:
        import rclpy
        from geometry_msgs.msg import PoseWithCovarianceStamped
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node
        from sensor_msgs.msg import PointCloud2

        from fisheye_svp_ros.nodes import messages
        from fisheye_svp_ros.nodes.quality import LATCHED, RELIABLE

        rclpy.init(args=[])
        self._node = Node('probe')
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self.heard: dict[str, dict[int, int]] = {name: {} for name in names}
        self._publishers = {}
        lens = load_lens(lens_path(_LENS))
        scenes = {'motion': motion(lens, _VIEWS), 'jumps': localization(lens, _VIEWS)}
        landmarks = Landmarks(np.arange(LANDMARKS), scenes['motion'].landmarks)
        self._known = []
        for name in names:
            known = self._node.create_publisher(PointCloud2, f'/{name}/landmarks', LATCHED)
            known.publish(messages.landmarks_message(landmarks, 0, 'world'))
            self._known.append(known)
            self._publishers[name] = self._node.create_publisher(
                PointCloud2, f'/{name}/image_points', RELIABLE
            )
            self._node.create_subscription(
                PoseWithCovarianceStamped, f'/{name}/localizer/pose', self._hear(name), RELIABLE
            )
        self.scene = 'motion'
        self._sets = {
            name: [
                messages.image_points_message(landmarks.ids, uv, 0, 'camera')
                for uv in scene.views.uv
            ]
            for name, scene in scenes.items()
        }
        self._sent = 0

    def send(self, name: str) -> int:
        """Send the next set; return its stamp."""
        from fisheye_svp_ros.nodes import messages

        self._sent += 1
        message = self._sets[self.scene][self._sent % _VIEWS]
        message.header = messages.header(self._sent, 'camera')
        self._publishers[name].publish(message)
        return self._sent

    def hear(self, name: str, stamp: int, patience: float) -> int:
        """Wait for the pose of a set; return when it came, ns, or raise TimeoutError."""
        end = time.perf_counter() + patience
        while stamp not in self.heard[name]:
            left = end - time.perf_counter()
            if left < 0:
                raise TimeoutError(f'no pose from {name}')
            self._executor.spin_once(timeout_sec=left)
        return self.heard[name][stamp]

    def listen(self, seconds: float) -> None:
        """Hear poses for a while."""
        end = time.perf_counter() + seconds
        while (left := end - time.perf_counter()) > 0:
            self._executor.spin_once(timeout_sec=left)

    def greet(self, name: str) -> None:
        """Wait until a node answers and waits for nothing else."""
        end = time.perf_counter() + _PATIENCE
        while True:
            try:
                self.hear(name, self.send(name), 3.0)
                return
            except TimeoutError:
                if time.perf_counter() > end:
                    raise

    def close(self) -> None:
        """Leave the graph."""
        import rclpy

        self._node.destroy_node()
        rclpy.try_shutdown()

    def _hear(self, name: str) -> Any:
        def receive(message: Any) -> None:
            stamp = message.header.stamp
            self.heard[name][stamp.sec * 10**9 + stamp.nanosec] = time.perf_counter_ns()

        return receive


def round_trips(probe: Probe, names: tuple[str, ...], count: int) -> dict[str, list[float]]:
    """Return the seconds from sending a set to its pose, in turns."""
    seconds: dict[str, list[float]] = {name: [] for name in names}
    for _ in range(count):
        for name in names:
            start = time.perf_counter_ns()
            seconds[name].append((probe.hear(name, probe.send(name), _PATIENCE) - start) / 1e9)
            probe.listen(2e-3)  # what comes after the pose belongs to no round trip
    return seconds


def throughput(probe: Probe, name: str) -> list[tuple[float, float]]:
    """Return rates, sets a second as they were sent, and the part of them that was answered."""
    found = []
    for rate in _RATES:
        count = int(rate * _LASTING)
        start, stamps = time.perf_counter(), []
        for i in range(count):
            stamps.append(probe.send(name))
            probe.listen(max(start + (i + 1) / rate - time.perf_counter(), 1e-5))
        sent = count / (time.perf_counter() - start)
        probe.listen(1.0)
        answered = sum(stamp in probe.heard[name] for stamp in stamps) / count
        found.append((sent, answered))
        if answered < 1:
            break
    return found


@contextmanager
def nodes() -> Iterator[tuple[str, str]]:
    """Run both nodes as processes; yield their namespaces, the echo node first."""
    names = ('echo', 'localizer_under_test')
    commands = (
        [str(_ECHO), '--ros-args'],
        [
            '-m',
            'fisheye_svp_ros.cli',
            'run',
            'localizer',
            '--ros-args',
            '-p',
            f'lens:={_LENS}',
            '-p',
            'svp:=false',
            '-p',
            'patience:=0.5',
        ],
    )
    running = [
        subprocess.Popen([sys.executable, *command, '-r', f'__ns:=/{name}'])
        for name, command in zip(names, commands, strict=True)
    ]
    try:
        yield names
    finally:
        for process in running:
            process.send_signal(signal.SIGINT)
        for process in running:
            process.wait(_PATIENCE)


def main(count: int) -> None:
    """Print the medians, s, of each scene, and the throughput: of the echo node, the localizer."""
    os.environ['ROS_DOMAIN_ID'] = domain()
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    with nodes() as names:
        probe = Probe(names)
        for name in names:
            probe.greet(name)
        round_trips(probe, names, max(count // 10, 1))
        found: dict[str, Any] = {}
        for probe.scene in ('jumps', 'motion'):
            seconds = round_trips(probe, names, count)
            found[probe.scene] = [median(values) for values in seconds.values()]
        found['throughput'] = [throughput(probe, name) for name in names]
        print(json.dumps(found))
        probe.close()


if __name__ == '__main__':
    main(int(sys.argv[1]))
