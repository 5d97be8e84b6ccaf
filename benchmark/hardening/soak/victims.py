"""Nodes in processes of their own, and the account of what was sent to them."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from random import Random
from types import MappingProxyType
from typing import Any, NamedTuple

import psutil
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile
from sensor_msgs.msg import CompressedImage, Image, PointCloud2

from benchmark import study
from benchmark.hardening.soak import hostile
from benchmark.hardening.soak.hostile import Attack

_POOL = 2000  # messages a topic, over and over with other stamps
_VALID = 0.15  # of the messages of a set, so that some sets are solved
_STEREO = ('left/', 'right/')
_ALL = QoSProfile(history=HistoryPolicy.KEEP_ALL, depth=0)


class Kind(NamedTuple):
    """A node: its cameras, what it hears but sets (topic: type), its arguments."""

    cameras: tuple[str, ...] = ()
    others: Mapping[str, Any] = MappingProxyType({})
    arguments: tuple[str, ...] = ()


_CAMERA = {'answer': DiagnosticArray}
KINDS = {
    'localizer': Kind(('',)),
    'stereo_calibrator': Kind(_STEREO),
    'stereo_depth': Kind(_STEREO),
    'model_critic': Kind(('',), arguments=('every_frames:=5000', 'max_frames:=20')),
    'detector': Kind(
        (), {'image': Image, 'image/compressed': CompressedImage}, (f'board:={hostile.BOARD}',)
    ),
    'synthetic_camera': Kind((), _CAMERA, ('lock_step:=answer',)),
    'measured_camera': Kind((), _CAMERA, ('lock_step:=answer', 'observations:={observations}')),
}
_SOLVING = ('patience:=0.5', 'backlog:=10000')


class Wire:
    """The attacker's own node; a thread takes in what comes."""

    def __init__(self) -> None:
        rclpy.init(args=[])
        self.node = Node('attacker')
        executor = SingleThreadedExecutor()
        executor.add_node(self.node)
        threading.Thread(target=executor.spin, daemon=True).start()

    def hear(self, topic: str, kind: Any) -> deque[Any]:
        """Return a queue that fills with the messages of a topic."""
        heard: deque[Any] = deque()
        self.node.create_subscription(kind, topic, lambda one: heard.append(one), _ALL)
        return heard


class Victim:
    """A node under attack; exactly: nothing is lost in its readers, so that all can be counted."""

    def __init__(self, name: str, wire: Wire, folder: Path, exactly: bool) -> None:
        self.name, self._kind = name, KINDS[name]
        self._space = f'/{"counted" if exactly else "flooded"}{os.getpid()}/{name}'
        self.title = f'{self._space}/{name}: inputs'  # of its diagnostics
        self.topics = dict(self._kind.others)
        if self._kind.cameras:
            self.topics |= {'landmarks': PointCloud2, 'scenario': DiagnosticArray}
            for camera in self._kind.cameras:
                self.topics[f'{camera}true_pose'] = PoseStamped
                self.topics[f'{camera}image_points'] = PointCloud2
        self.sent: Counter[str] = Counter()
        self.hostile: Counter[str] = Counter()
        self.unusable: Counter[str] = Counter()
        self.lost: Counter[str] = Counter()
        self.counts: dict[str, int] = {}
        self.memory: list[float] = []
        self.rng = Random(f'soak {name}')
        self.stamp = 10**9
        self._wire = wire
        self._start(folder, exactly)
        rng = Random(f'pool {name}')
        self._pools = {
            topic: hostile.pool(topic, kind, _POOL, rng, self._sends(kind))
            for topic, kind in self.topics.items()
        }
        self._writers = {topic: self._writer(topic, kind) for topic, kind in self.topics.items()}
        # A detector looks at images where somebody wants to know what is in them.
        self._listener = self.hear_topic('image_points', PointCloud2)
        self._good = dict(self.good(1)[-1][1])

    def _start(self, folder: Path, exactly: bool) -> None:
        observations = folder / 'observations.csv'
        observations.write_text(
            'frame,landmark,u,v,x,y,z\n'
            + ''.join(
                f'{frame},{i},{10 * i},{5 * i},0,{i},1\n' for frame in range(3) for i in range(5)
            )
        )
        given = [word.format(observations=observations) for word in self._kind.arguments]
        if exactly:
            given += [*_SOLVING] if self._kind.cameras else []
            for topic in self.topics:
                at = f'qos_overrides.{self._space}/{topic}.subscription'
                given += [f'{at}.history:=keep_all', f'{at}.reliability:=reliable']
        self._log = folder / f'{self.name}_{exactly}.log'
        with self._log.open('ab') as log:
            self._process = subprocess.Popen(
                [*study.node_command(self.name, *given), '-r', f'__ns:={self._space}'],
                stdout=log,
                stderr=log,
                env={**os.environ, 'OMP_NUM_THREADS': '1'},
            )

    def _writer(self, topic: str, kind: Any) -> Any:
        return self._wire.node.create_publisher(kind, f'{self._space}/{topic}', _ALL)

    def _sends(self, kind: Any) -> Callable[[bytes], bool]:
        nowhere = self._writer(f'nowhere/{kind.__name__}', kind)
        return lambda data: _publish(nowhere, data)

    def hear_topic(self, topic: str, kind: Any) -> deque[Any]:
        """Return a queue that fills with the messages of a topic in the node's namespace."""
        return self._wire.hear(f'{self._space}/{topic}', kind)

    def has_publisher(self, topic: str) -> bool:
        """Say whether somebody publishes on a topic in the node's namespace."""
        return bool(self._wire.node.count_publishers(f'{self._space}/{topic}'))

    def connected(self) -> bool:
        """Say whether the node hears every topic."""
        return all(writer.get_subscription_count() for writer in self._writers.values())

    def alive(self) -> bool:
        """Say whether the process has not ended."""
        return self._process.poll() is None

    def trouble(self) -> str:
        """Return why the node is not up."""
        deaf = [
            topic for topic, writer in self._writers.items() if not writer.get_subscription_count()
        ]
        return f'{self.name}: {deaf} {self._log.read_text(errors="replace")[-500:]}'

    def good(self, count: int) -> list[tuple[int, hostile.Told]]:
        """Return good sets, with stamps later than any before."""
        self.stamp += count
        return list(hostile.good_sets(self._kind.cameras, count, self.stamp - count + 1))

    def attack(self, count: int) -> None:
        """Send so many hostile messages, and some good ones between them."""
        end = self.hostile.total() + count
        while self.hostile.total() < end:
            self.stamp += 1
            topics = [topic for topic in self.topics if self.rng.random() < 0.7]
            for topic in topics:
                valid = self._good.get(topic) if self.rng.random() < _VALID else None
                if valid is not None:
                    self.tell(topic, Attack(valid, True, True).at(self.stamp))
                    continue
                attack = self.rng.choice(self._pools[topic])
                self.hostile[topic] += 1
                self.unusable[topic] += not attack.usable
                # Landmarks of no stamp are taken at once, others with their set.
                keep = topic == 'landmarks' and self.rng.random() < 0.3
                self.tell(topic, attack.data if keep else attack.at(self.stamp))

    def tell(self, topic: str, data: bytes) -> None:
        """Send a message."""
        self.sent[topic] += 1
        self.lost[topic] += not _publish(self._writers[topic], data)

    def hear(self, values: dict[str, str]) -> None:
        """Take in what the node counts."""
        self.counts = {
            key: int(value) for key, value in values.items() if value.lstrip('-').isdigit()
        }

    def received(self, what: str = 'received') -> int:
        """Return how many messages the node says that it has received, or read."""
        return sum(self.counts.get(f'{topic}: {what}', 0) for topic in self.topics)

    def behind(self) -> int:
        """Return how many of the messages that were sent the node has not counted yet."""
        return self.sent.total() - self.lost.total() - self.received()

    def waiting(self) -> int:
        """Return how many sets the node has not come to yet."""
        return self.counts.get('sets: waiting', 0)

    def measure(self) -> None:
        """Note the memory of the node and its children, MB."""
        with suppress(psutil.Error):  # it may be dead
            node = psutil.Process(self._process.pid)
            self.memory.append(
                sum(
                    one.memory_info().rss / 2**20 for one in (node, *node.children(recursive=True))
                )
            )

    def end(self) -> str:
        """End the node; return what it said of internal errors."""
        if self.alive():
            self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(20)
        except subprocess.TimeoutExpired:
            self._process.kill()
        text = self._log.read_text(errors='replace')
        return text[text.index('Traceback') :][:3000] if 'Traceback' in text else ''


def _publish(publisher: Any, data: bytes) -> bool:
    """Publish CDR as it is; return whether the middleware took it."""
    try:
        publisher.publish(data)
    except RuntimeError:  # RCLError
        return False
    return True


class Watch:
    """Reads `/diagnostics` of all nodes."""

    def __init__(self, wire: Wire) -> None:
        self._heard = wire.hear('/diagnostics', DiagnosticArray)

    def look(self, victims: dict[str, Victim]) -> None:
        """Hand every node's counts to its account."""
        while self._heard:
            status = self._heard.popleft().status[0]
            for victim in victims.values():
                if status.name == victim.title:
                    victim.hear({pair.key: pair.value for pair in status.values})

    def until(self, victims: dict[str, Victim], condition: Any, seconds: float) -> bool:
        """Look until a condition holds, False where it never does."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.look(victims)
            if condition():
                return True
            time.sleep(0.02)
        return False
