"""Images a second that the rectifier takes on one core: python -m benchmark.speed.rectifier_rate.

Images of 1280 x 800 px go to a rectifier, a process of its own that is kept to one core, for some
seconds at a pace; another process sends them and counts what comes back.  The processor time that
the node takes for an image says what it could do with the core to itself.  Both use shared memory
that holds images (config/fastdds/images.xml); --defaults takes that of Fast DDS, which loses them.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image

from benchmark import study
from fisheye_svp_ros.io.lens_files import save_lens
from fisheye_svp_ros.io.rig_files import save_rig
from fisheye_svp_ros.nodes.messages import image_message
from fisheye_svp_ros.optics.curves import Gennery, KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.scene.rigs import rig

LENS = Lens(
    'wide',
    1280,
    800,
    420.0,
    421.0,
    633.3,
    404.4,
    KannalaBrandt(-0.02, 0.003, -0.001, 0.0001),
    np.radians(95.0),
    Gennery(e0=0.004),
)
PROFILE = Path(__file__).parents[2] / 'config' / 'fastdds' / 'images.xml'
SENSOR = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)


def rate(channels: int, cameras: tuple[str, ...], pace: float, seconds: float) -> str:
    """Return what was sent and came back, and what it cost the node, as a line."""
    shape = (800, 1280) if channels == 1 else (800, 1280, channels)
    message = image_message(np.random.default_rng(0).integers(0, 255, shape, np.uint8), 1, 'c')
    with tempfile.TemporaryDirectory() as folder:
        for name in cameras:
            save_lens(LENS, Path(folder) / f'{name or "camera"}.yaml')
        save_rig(rig('parallel'), Path(folder) / 'rig.yaml')
        process = psutil.Process(
            subprocess.Popen(
                study.node_command(
                    'rectifier', f'lens:={folder}/', f'stereo:={str(len(cameras) > 1).lower()}'
                ),
                preexec_fn=lambda: os.sched_setaffinity(0, {max(os.sched_getaffinity(0))}),
            ).pid
        )
        try:
            return _measured(message, cameras, pace, seconds, process)
        finally:
            process.terminate()
            process.wait()


def _measured(
    message: Any, cameras: tuple[str, ...], pace: float, seconds: float, process: psutil.Process
) -> str:
    node, executor = rclpy.create_node('sender'), SingleThreadedExecutor()
    executor.add_node(node)
    back = []
    senders = []
    for name in cameras:
        start = f'{name}/' if name else ''
        node.create_subscription(Image, f'{start}image_rect', lambda _: back.append(1), SENSOR)
        node.create_subscription(CameraInfo, f'{start}camera_info', lambda _: None, SENSOR)
        senders.append(node.create_publisher(Image, f'{start}image', SENSOR))
    while len(back) < len(cameras):  # until maps are there, and everybody knows each other
        for sender in senders:
            sender.publish(message)
        executor.spin_once(0.2)
    time.sleep(1.0)
    for _ in range(100):
        executor.spin_once(0.0)
    back.clear()
    before, start, sent = sum(process.cpu_times()[:2]), time.monotonic(), 0
    while (now := time.monotonic()) - start < seconds:
        if sent < (now - start) * pace:
            sent += 1
            for sender in senders:
                message.header.stamp.nanosec = sent
                sender.publish(message)
        executor.spin_once(1e-3)
    for _ in range(200):
        executor.spin_once(5e-3)
    took = (sum(process.cpu_times()[:2]) - before) / max(len(back), 1)
    node.destroy_node()
    kind = message.encoding + (', a pair' if len(cameras) > 1 else '')
    return (
        f'{kind}: {len(back) / len(cameras) / seconds:.1f} Hz of {sent / seconds:.1f} Hz came '
        f'back; {1e3 * took:.1f} ms of a core for an image'
    )


def main() -> None:
    """Measure and print."""
    args = study.parser(
        'rectifier_rate',
        __doc__,
        None,
        room='speed',
        workers=False,
        pace=(30.0, 'images a second (30)'),
        seconds=(10.0, 'for each line (10)'),
        defaults=(False, 'the transports of Fast DDS'),
    ).parse_args()
    study.stay_on_this_machine()
    if not args.defaults:
        os.environ.setdefault('FASTRTPS_DEFAULT_PROFILES_FILE', str(PROFILE))
    rclpy.init(args=[])
    for channels, cameras in product((1, 3), (('',), ('left', 'right'))):
        print(rate(channels, cameras, args.pace, args.seconds), flush=True)
    rclpy.try_shutdown()


if __name__ == '__main__':
    main()
