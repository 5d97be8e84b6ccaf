"""Hostile messages, serialized in advance, and good ones that a node must answer."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from random import Random
from typing import Any, NamedTuple

import numpy as np
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CompressedImage, Image, PointCloud2

from benchmark.hardening.fuzz.nodes import seeds, spoilt, tags
from fisheye_svp_ros.errors import FisheyeSvpError
from fisheye_svp_ros.io import decoding
from fisheye_svp_ros.io.landmark_files import environment
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.subscriptions import Count, Unread
from fisheye_svp_ros.simulate.scenario import Scenario, simulate_scenario

_STAMP = slice(4, 12)
_SQUARE = 24  # px
NOISE = 0.1  # px, of good sets
BOARD = 'chessboard:6x5:25mm'
Told = list[tuple[str, bytes]]  # topic and CDR, in their order


class Attack(NamedTuple):
    """CDR, the place of its stamp left alone or not; whether its decoder takes it."""

    data: bytes
    stamped: bool
    usable: bool

    def at(self, stamp: int) -> bytes:
        """Return the message with a stamp, ns, unless the stamp itself is spoilt."""
        if not self.stamped:
            return self.data
        return self.data[:4] + struct.pack('<II', *divmod(stamp, 10**9)) + self.data[12:]


def pool(
    topic: str, kind: Any, count: int, rng: Random, sends: Callable[[bytes], bool]
) -> list[Attack]:
    """Return hostile messages of a topic, some of which a decoder takes all the same.

    sends: whether the middleware sends a message at all.  Zero bytes it takes, but Fast DDS then
    delivers nothing more from the same publisher: there are none.
    """
    good = seeds()[kind.__name__]
    if kind is PointCloud2:
        good = good[:1] if topic == 'landmarks' else good[1:]
    made: list[Attack] = []
    while len(made) < count:
        scenario = topic == 'scenario' and len(made) % 2
        data = tags(rng) if scenario else spoilt(rng.choice(good), rng)
        if not data or not sends(data):
            continue
        stamped = bool(scenario) or data[:12] in {one[:12] for one in good}
        # Of images a node looks at few: which could be used is not asked for.
        usable = kind in (Image, CompressedImage) or is_usable(topic, kind, data)
        made.append(Attack(data, stamped, usable))
    return made


def is_usable(topic: str, kind: Any, data: bytes) -> bool:
    """Say whether the decoder of a topic takes a message."""
    last = topic.rpartition('/')[2]
    decode = {
        'landmarks': decoding.read_landmarks,
        'image_points': decoding.read_image_points,
        'true_pose': decoding.read_pose,
    }.get(last, decoding.read_key_values)
    unread = Unread(topic, kind, data, decode, Count())
    try:
        _ = unread.stamp, unread.read()
    except FisheyeSvpError:
        return False
    return True


def good_sets(cameras: Sequence[str], count: int, first: int) -> Iterator[tuple[int, Told]]:
    """Yield good sets of some cameras (namespaces with their slash) from a stamp on, ns."""
    style = 'parallel' if len(cameras) > 1 else 'mono'
    world = environment('whole', 2.0)
    for stamp in range(first, first + count):
        place = np.random.default_rng(stamp).uniform(-0.1, 0.1, 3)
        scenario = Scenario(
            style=style,
            shift_scale=0.0,
            noise_px=NOISE,
            seed=stamp % 1000,
            poses=(*place.tolist(), 1.0, 0.0, 0.0, 0.0),
        )
        found = simulate_scenario(scenario)
        told = [
            ('landmarks', messages.landmarks_message(world, 0, 'world')),
            (
                'scenario',
                messages.key_values_message(
                    'scenario', {'lens': 'fish214', 'shift_scale': 0.0, 'x': first}, stamp
                ),
            ),
        ]
        for number, camera in enumerate(cameras):
            seen = found.observations.take(found.observations.camera == number)
            pose = found.poses[number].take(0)
            told += [
                (f'{camera}true_pose', messages.pose_message(pose, stamp, 'world')),
                (
                    f'{camera}image_points',
                    messages.image_points_message(seen.landmark, seen.uv, stamp, 'camera'),
                ),
            ]
        yield stamp, [(topic, serialize_message(message)) for topic, message in told]


def good_image(stamp: int) -> bytes:
    """Return an Image of a chessboard (BOARD), CDR."""
    squares = np.indices((6, 7)).sum(axis=0) % 2
    board = np.kron(squares, np.ones((_SQUARE, _SQUARE))) * 180 + 40
    image = np.pad(board.astype(np.uint8), 2 * _SQUARE, constant_values=220)
    return serialize_message(messages.image_message(image, stamp, 'camera'))
