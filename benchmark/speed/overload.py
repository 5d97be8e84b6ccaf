"""What becomes of sets that come faster than they are solved: python -m benchmark.speed.overload.

A localizer, a process of its own, is told so many sets of 33 points a second; its /diagnostics
says what became of each, and its results are counted where they come to.
Leave the machine alone meanwhile.
"""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2

from benchmark import study
from fisheye_svp_ros.io.decoding import read_key_values, stamp_of
from fisheye_svp_ros.io.landmark_files import environment
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.simulate.scenario import Scenario, simulate_scenario

RATES = (10, 30, 100, 300, 1000)
FATES = ('solved', 'not solved', 'dropped', 'incomplete', 'waiting')
PATIENCE = 60.0  # s
ALL = QoSProfile(history=HistoryPolicy.KEEP_ALL, depth=0)


class Trial:
    """A graph of one localizer, and what it was told and has told."""

    def __init__(self) -> None:
        self.node = rclpy.create_node('overload')
        self.results: list[int] = []
        self.counts: dict[str, str] = {}
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.node.create_subscription(
            DiagnosticArray, 'localizer/result', lambda m: self.results.append(stamp_of(m)), ALL
        )
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._hear, 10)
        self.landmarks = self.node.create_publisher(PointCloud2, 'landmarks', latched)
        self.points = self.node.create_publisher(PointCloud2, 'image_points', ALL)
        self.landmarks.publish(messages.landmarks_message(environment('whole', 2.0), 0, 'world'))
        self.seen = simulate_scenario(Scenario()).observations
        self.sent = 0

    def _hear(self, message: DiagnosticArray) -> None:
        counts = read_key_values(message)
        if 'sets: taken' in counts:
            self.counts = counts

    def until(self, true: Callable[[], bool]) -> None:
        """Listen until something is true."""
        end = time.monotonic() + PATIENCE
        while not true():
            if time.monotonic() > end:
                raise SystemExit(f'{self.sent} sets were sent, {self.counts}')
            rclpy.spin_once(self.node, timeout_sec=0.01)

    def tell(self) -> None:
        """Tell one more set."""
        self.sent += 1
        self.points.publish(
            messages.image_points_message(self.seen.landmark, self.seen.uv, self.sent, 'camera')
        )

    def fates(self) -> dict[str, int]:
        """Return what became of the sets, once none waits."""
        self.counts = {}
        self.until(
            lambda: (
                self.counts.get('sets: waiting') == '0'
                and int(self.counts['sets: taken']) >= self.sent
            )
        )
        return {name: int(self.counts[f'sets: {name}']) for name in ('taken', *FATES)}

    def row(self, rate: int, seconds: float) -> list[str]:
        """Tell sets at a rate, and return a row of the table."""
        before, sent, results = self.fates(), self.sent, len(self.results)
        begun = time.monotonic()
        while (elapsed := time.monotonic() - begun) < seconds:
            if self.sent - sent <= elapsed * rate:
                self.tell()
            rclpy.spin_once(self.node, timeout_sec=0.0)
        reached = (self.sent - sent) / seconds
        after = self.fates()
        became = {name: after[name] - before[name] for name in after}
        answered = became['solved'] + became['not solved']
        self.until(lambda: len(self.results) - results >= answered)
        heard = self.results[results:]
        total = sum(became[name] for name in FATES)
        exact = total == became['taken'] == self.sent - sent and len(set(heard)) == answered
        return [
            str(rate),
            f'{reached:.0f}',
            *(str(became[name]) for name in ('taken', *FATES)),
            str(len(heard)),
            'yes' if exact else 'no',
        ]


def main() -> None:
    """Measure, and print a table."""
    seconds = (
        study.parser(
            'overload', __doc__, None, workers=False, room='speed', seconds=(10.0, 'at each rate')
        )
        .parse_args()
        .seconds
    )
    study.stay_on_this_machine()
    rclpy.init(args=[])
    localizer = subprocess.Popen(
        study.node_command(
            'localizer',
            'lens:=fish214',
            'svp:=true',
            'qos_overrides./image_points.subscription.history:=keep_all',
        )
    )
    try:
        trial = Trial()
        trial.until(lambda: trial.points.get_subscription_count() > 0)
        trial.until(lambda: 'sets: taken' in trial.counts)
        names = ('a second', 'reached', 'taken', *FATES, 'results heard', 'sum exact')
        print(f'| {" | ".join(names)} |', f'|{" ---: |" * len(names)}', sep='\n')
        for rate in RATES:
            print(f'| {" | ".join(trial.row(rate, seconds))} |', flush=True)
    finally:
        localizer.terminate()
        localizer.wait()


if __name__ == '__main__':
    main()
