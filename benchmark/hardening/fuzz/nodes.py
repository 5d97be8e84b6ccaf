"""The callbacks of nodes, called with messages as they come off the wire, without a wire."""

from __future__ import annotations

from collections.abc import Callable
from inspect import signature
from pathlib import Path
from random import Random
from typing import Any

import cv2
import numpy as np

from benchmark.hardening.fuzz.mutations import WORDS, mutated, nasty
from benchmark.hardening.fuzz.surfaces import Surface, Trial
from fisheye_svp_ros.commands.processes import missing_rclpy
from fisheye_svp_ros.io.landmark_files import environment
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.parameters import rows
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.simulate.scenario import Scenario, simulate_scenario

_NUMBERS = (0.0, -0.0, 1e308, -1e308, 5e-324, 1e12, np.inf, -np.inf, np.nan, 1e-9, 1e9)
_GOOD_EVERY = 25  # hostile inputs
_NAMES = (
    'localizer',
    'stereo_calibrator',
    'stereo_depth',
    'model_critic',
    'detector',
    'synthetic_camera',
    'measured_camera',
    'rectifier',
)
_SOLVING = ('lens:=fish214', 'svp:=true', 'patience:=0.0')


class _Silent:
    """A publisher that keeps the latest message; somebody seems to listen."""

    def __init__(self) -> None:
        self.latest: Any = None

    def publish(self, message: Any) -> None:
        self.latest = message

    def get_subscription_count(self) -> int:
        return 1


class _Node:
    """A node without a wire: what it hears, by topic, and what it has announced."""

    def __init__(self, name: str, folder: Path) -> None:
        from importlib import import_module

        import rclpy
        from rclpy.executors import SingleThreadedExecutor

        module = import_module(f'fisheye_svp_ros.nodes.{name}')
        kind = getattr(module, ''.join(word.capitalize() for word in name.split('_')))
        told: dict[str, _Silent] = {}
        refused: list[Exception] = []
        heard: dict[str, tuple[Any, Callable[[bytes], None]]] = {}

        class Unwired(kind):  # type: ignore[misc]
            def unforeseen(self, error: Exception) -> None:
                raise error

            def drop(self, topic: str, error: Exception) -> None:
                super().drop(topic, error)
                refused.append(error)

            def announce(self, _: Any, topic: str, *arguments: Any, **more: Any) -> _Silent:
                return told.setdefault(topic, _Silent())

            def create_subscription(
                self, sort: Any, topic: str, callback: Any, *arguments: Any, **more: Any
            ) -> Any:
                heard.setdefault(topic, (sort, callback))
                return super().create_subscription(sort, topic, callback, *arguments, **more)

        if not rclpy.ok():
            path = folder / 'observations.csv'
            path.write_text(
                'frame,landmark,u,v,x,y,z\n'
                + ''.join(f'0,{i},{10 * i},{5 * i},0,{i},1\n' for i in range(5))
            )
            given = [f'{node}:{text}' for node in _NAMES[:4] for text in _SOLVING]
            given += [
                'synthetic_camera:lock_step:=localizer/result',
                f'measured_camera:observations:={path}',
            ]
            rclpy.init(
                args=[
                    '--ros-args',
                    '--log-level',
                    'fatal',
                    *(word for text in given for word in ('-p', text)),
                ]
            )
        self.told, self.heard, self.refused = told, heard, refused
        self.node = Unwired()
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)

    def hear(self, topic: str, data: bytes) -> None:
        """Hand the node a message, and let it do what follows from it."""
        receive = self.heard[topic][1]
        wants_info = len(signature(receive).parameters) == 2  # as rclpy asks
        receive(data, *[{'publication_sequence_number': 0}] * wants_info)
        for _ in range(3):
            self._executor.spin_once(timeout_sec=0)


def seeds() -> dict[str, list[bytes]]:
    """Return valid messages by type name, CDR."""
    from rclpy.serialization import serialize_message
    from sensor_msgs.msg import CompressedImage, Image

    from fisheye_svp_ros.nodes import messages

    found = simulate_scenario(Scenario(shift_scale=0.0))
    seen, world = found.observations, environment('whole', 2.0)
    pose = found.poses[0].take(0)
    picture = np.zeros((48, 64), np.uint8)
    files = [cv2.imencode(kind, picture)[1].tobytes() for kind in ('.png', '.jpg', '.webp')]
    made = {
        'PointCloud2': [
            messages.landmarks_message(world, 7, 'world'),
            messages.image_points_message(seen.landmark, seen.uv, 7, 'camera'),
        ],
        'PoseStamped': [messages.pose_message(pose, 7, 'world')],
        'TransformStamped': [messages.transform_message(pose, 7, 'a', 'b')],
        'DiagnosticArray': [
            messages.key_values_message(
                's', {'lens': 'fish214', 'shift_scale': 0.5, 'radius': 2.0, 'scenario': 1}, 7
            )
        ],
        'CameraInfo': [messages.camera_info_message(load_lens(lens_path('fish214')), 7, 'camera')],
        'Image': [
            Image(
                header=messages.header(7),
                height=48,
                width=64,
                encoding='mono8',
                step=64,
                data=picture.tobytes(),
            )
        ],
        'CompressedImage': [
            CompressedImage(header=messages.header(7), format='png', data=data) for data in files
        ],
    }
    return {kind: [serialize_message(one) for one in several] for kind, several in made.items()}


def spoilt(data: bytes, rng: Random) -> bytes:
    """Return a message with faults where its fields are, or anywhere."""
    chance = rng.random()
    if chance < 0.4 and len(data) > 60:
        place = 4 + 8 * rng.randrange((len(data) - 12) // 8)
        number = np.float64(rng.choice((*_NUMBERS, rng.uniform(-10, 10))))
        return data[:place] + number.tobytes() + data[place + 8 :]
    if chance < 0.6:
        place = 4 + 4 * rng.randrange((len(data) - 8) // 4 or 1)
        number = rng.choice((0, 1, 2**31, 2**32 - 1, rng.randrange(2**32)))
        return data[:place] + number.to_bytes(4, 'little') + data[place + 4 :]
    return mutated(data, rng, binary=True)


def tags(rng: Random) -> bytes:
    """Return a scenario with two odd values, CDR."""
    from rclpy.serialization import serialize_message

    from fisheye_svp_ros.nodes import messages

    values = {'lens': 'fish214', 'shift_scale': 0.5}
    names = (*values, 'radius', 'scenario', 'scenarios', 'set', 'sets', 'x')
    values |= {
        rng.choice(names): str(rng.choice((*WORDS, nasty(rng, float)))).replace('\0', '')
        for _ in range(2)
    }
    return serialize_message(messages.key_values_message('s', values, rng.randrange(5)))


def _callbacks(name: str, folder: Path) -> Trial:
    one, valid = _Node(name, folder), seeds()
    good = _Good(one) if name == 'localizer' else None
    table = {row.name: row for row in rows(type(one.node).SETTINGS) if not row.fixed}
    count = 0

    def trial(rng: Random) -> str:
        nonlocal count
        count += 1
        one.refused.clear()
        if rng.random() < 0.1:
            _set(one.node, table, rng)
        else:
            topic = rng.choice(list(one.heard)) if one.heard else ''
            if topic:
                kind = one.heard[topic][0].__name__
                data = rng.choice(valid[kind])
                scenario = kind == 'DiagnosticArray' and rng.random() < 0.5
                one.hear(topic, tags(rng) if scenario else spoilt(data, rng))
        if one.refused:
            raise one.refused[0]
        if good is not None and count % _GOOD_EVERY == 0:
            return good.wrong()
        return ''

    return trial


def _set(node: Any, table: dict[str, Any], rng: Random) -> None:
    """Change a parameter, and change it back."""
    from rclpy.parameter import Parameter

    row = table[rng.choice(list(table))]
    old = node.get_parameter(row.name).value
    value = nasty(rng, type(row.default))
    if row.name in ('rate', 'trajectory_steps') or type(value) not in (int, float, str, bool):
        return
    if isinstance(value, int) and abs(value) >= 2**63:
        return
    node.set_parameters([Parameter(row.name, value=value)])
    node.set_parameters([Parameter(row.name, value=old)])


class _Good:
    """A set that a localizer must answer well, whatever has come before."""

    def __init__(self, one: _Node) -> None:
        self._one, self._stamp = one, 10**12

    def wrong(self) -> str:
        """Say what is wrong with the answer."""
        from rclpy.serialization import serialize_message

        from fisheye_svp_ros.io.decoding import read_key_values, stamp_of
        from fisheye_svp_ros.nodes import messages

        self._stamp += 1
        seen = simulate_scenario(Scenario(shift_scale=0.0)).observations
        self._one.hear(
            'landmarks',
            serialize_message(messages.landmarks_message(environment('whole', 2.0), 0, 'world')),
        )
        self._one.hear(
            'image_points',
            serialize_message(
                messages.image_points_message(seen.landmark, seen.uv, self._stamp, 'camera')
            ),
        )
        result = self._one.told['~/result']
        for _ in range(200):
            if result.latest is not None and stamp_of(result.latest) == self._stamp:
                rms = float(read_key_values(result.latest).get('rms_px', 'nan'))
                return '' if rms < 1e-6 else f'a good set is left with {rms} px'
            self._one.hear('true_pose', b'')
        return 'a good set is not answered'


def node_surfaces() -> list[Surface]:
    """Return the surfaces of the nodes' callbacks, where there is an rclpy."""
    if missing_rclpy():
        return []

    def maker(name: str) -> Callable[[Path], Trial]:
        return lambda folder: _callbacks(name, folder)

    return [Surface(f'node {name}', maker(name), 60) for name in _NAMES]
