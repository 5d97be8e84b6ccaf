"""A few seconds of the soak (benchmark/hardening/soak): hostile messages, each counted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from random import Random
from typing import Any

from helpers.graph import Graph

from diagnostic_msgs.msg import DiagnosticArray  # isort: skip
from geometry_msgs.msg import PoseStamped  # isort: skip
from sensor_msgs.msg import PointCloud2  # isort: skip

from benchmark.hardening.soak import hostile
from fisheye_svp_ros.io.decoding import read_key_values, stamp_of
from fisheye_svp_ros.nodes.localizer import Localizer

KINDS = {
    'landmarks': PointCloud2,
    'scenario': DiagnosticArray,
    'true_pose': PoseStamped,
    'image_points': PointCloud2,
}


def test_every_hostile_message_is_received_read_and_counted(graph: Callable[..., Graph]) -> None:
    g = graph('patience:=5.0', 'backlog:=10000')
    results, diagnostics = (
        g.hear(DiagnosticArray, 'localizer/result'),
        g.hear(DiagnosticArray, '/diagnostics'),
    )
    g.start(Localizer)
    writers = {topic: g.tell(kind, topic) for topic, kind in KINDS.items()}
    scratch = {
        topic: g.probe.create_publisher(kind, f'nowhere/{topic}', 1)
        for topic, kind in KINDS.items()
    }

    def sends(topic: str, data: bytes) -> bool:
        try:
            scratch[topic].publish(data)
        except RuntimeError:  # RCLError
            return False
        return True

    rng, sent, unusable = Random(5), Counter[str](), Counter[str]()
    attacks = {
        topic: hostile.pool(topic, kind, 80, rng, lambda data, topic=topic: sends(topic, data))
        for topic, kind in KINDS.items()
    }
    for stamp in range(1, 301):
        for topic, pool in attacks.items():
            attack = rng.choice(pool)
            sent[topic] += 1
            unusable[topic] += not attack.usable
            writers[topic].publish(attack.at(stamp))
        g.executor.spin_once(timeout_sec=0)

    def counts() -> dict[str, str]:
        diagnostics.clear()
        return read_key_values(g.until(lambda: diagnostics)[-1])

    def everything() -> dict[str, str] | None:
        now = counts()
        all_there = all(now[f'{topic}: received'] == str(sent[topic]) for topic in KINDS)
        return now if all_there and now['sets: waiting'] == '0' else None

    told: dict[str, str] = g.until(everything)
    assert told['internal errors'] == '0'
    for topic in ('scenario', 'true_pose'):
        unread = sent[topic] - int(told[f'{topic}: read'])
        assert 0 <= unusable[topic] - int(told[f'{topic}: dropped']) <= unread
    ((stamp, good),) = hostile.good_sets(('',), 1, 10**9)
    for topic, data in good:
        writers[topic].publish(data)

    def answer() -> Any:
        return next((m for m in results if stamp_of(m) == stamp), None)

    g.until(answer)
    assert float(read_key_values(answer())['rms_px']) < 0.5


def test_no_hostile_message_is_empty_for_the_middleware_sends_nothing_after_it(
    ros_domain: int,
) -> None:
    for seed in range(3):
        attacks = hostile.pool('true_pose', PoseStamped, 1000, Random(seed), lambda _: True)
        assert all(attack.data for attack in attacks)
