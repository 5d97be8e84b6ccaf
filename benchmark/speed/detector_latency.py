"""How long the nodes take from an image to a pose: python -m benchmark.speed.detector_latency.

Rendered images of 848 x 800 px of a board that moves slowly go to a detector and a localizer, each
a process of its own.  What counts is the time from publishing an image, which includes what the
camera takes to serialize and send it, until its pose has come back; camera and listener are one
more process, and all of them share one core.  Leave the machine alone meanwhile.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image

from benchmark import study
from fisheye_svp_ros.io.decoding import stamp_of
from fisheye_svp_ros.io.lens_files import save_lens
from fisheye_svp_ros.nodes.messages import image_message
from fisheye_svp_ros.optics.curves import Gennery, KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.simulate.render import Exposure, Print, render
from fisheye_svp_ros.simulate.targets import board_views

LENS = Lens(
    'wide',
    848,
    800,
    285.2,
    284.9,
    424.3,
    398.7,
    KannalaBrandt(-0.011, 0.0041, -0.0012, 0.0001),
    np.radians(95.0),
    Gennery(e0=0.003),
)
BOARD, PRINTED = 'chessboard:9x6:25mm', Print(9, 6, 0.025)
STEP = 0.002  # m, from image to image
PACE = 5.0  # images a second
PATIENCE = 120.0  # s


def images(count: int) -> list[Any]:
    """Return images of a board past which the camera moves."""
    rng = np.random.default_rng(1)
    start = board_views(LENS, PRINTED, 1, (0.2, 0.25), rng).take(0)
    along = start.rotation[:, 0] * STEP
    poses = [Pose(start.rotation, start.position + i * along) for i in range(count)]
    return [render(LENS, PRINTED, pose, Exposure(), rng) for pose in poses]


def latencies(pictures: list[Any]) -> np.ndarray:
    """Return the time from each image to its pose, s; NaN where none came."""
    rclpy.init(args=[])
    node = rclpy.create_node('clock_keeper')
    arrived: dict[int, float] = {}
    node.create_subscription(
        PoseWithCovarianceStamped,
        '/localizer/pose',
        lambda m: arrived.setdefault(stamp_of(m), time.monotonic()),
        100,
    )
    sender = node.create_publisher(
        Image, '/image', QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    )
    sent: dict[int, float] = {}

    def send(number: int, stamp: int) -> None:
        message = image_message(pictures[number], stamp, 'camera')
        sent[stamp] = time.monotonic()
        sender.publish(message)

    def spin(seconds: float) -> None:
        end = time.monotonic() + seconds
        while (remaining := end - time.monotonic()) > 0:
            # It shares the core with what it measures.
            rclpy.spin_once(node, timeout_sec=remaining)

    end = time.monotonic() + PATIENCE
    while not arrived:  # until everybody has found everybody
        if time.monotonic() > end:
            raise SystemExit('no pose came')
        send(0, 1 + len(sent))
        spin(0.5)
    spin(2.0)
    sent.clear()
    for number in range(len(pictures)):
        send(number, 10_000 + number)
        spin(1 / PACE)
    spin(1.0)
    node.destroy_node()
    rclpy.shutdown()
    return np.array([arrived.get(stamp, np.nan) - when for stamp, when in sent.items()])


def main() -> None:
    """Measure, and print one line."""
    count = (
        study.parser(
            'detector_latency', __doc__, None, workers=False, room='speed', count=(40, 'images')
        )
        .parse_args()
        .count
    )
    pictures = images(count)
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    study.stay_on_this_machine()
    os.environ |= {'OMP_NUM_THREADS': '1', 'OPENBLAS_NUM_THREADS': '1'}
    with tempfile.TemporaryDirectory() as folder:
        lens = Path(folder) / 'lens.yaml'
        save_lens(LENS, lens)
        nodes = [
            subprocess.Popen(study.node_command(*words))
            for words in (
                ('detector', f'board:={BOARD}'),
                ('localizer', f'lens:={lens}', 'patience:=0.0'),
            )
        ]
        try:
            found = 1e3 * latencies(pictures)
        finally:
            for process in nodes:
                process.terminate()
    low, middle, high = np.nanpercentile(found, [5, 50, 95])
    print(
        f'{count} images of {LENS.width} x {LENS.height} px, {np.isfinite(found).sum()} poses: '
        f'median {middle:.0f} ms, 5 to 95 %: {low:.0f} to {high:.0f} ms'
    )


if __name__ == '__main__':
    main()
