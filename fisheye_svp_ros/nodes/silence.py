"""Why nothing comes on a topic, as far as a node can see it, and what to do about it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from difflib import SequenceMatcher
from typing import Any

from rclpy.qos import QoSCompatibility, ReliabilityPolicy, qos_check_compatible

from fisheye_svp_ros.nodes.quality import PREFIX, qos_words
from fisheye_svp_ros.nodes.subscriptions import Input

LIMIT = 5.0  # s without a message after which it is said
_MAX_PROPOSALS = 3  # topics to propose


def silent_inputs(
    needed: Iterable[Sequence[str]], inputs: dict[str, Input], limit: float
) -> list[Sequence[Input]]:
    """Return the inputs on which nothing has come, or comes any more.

    needed: topics one of which has to come, each; limit: s without a message.
    """
    open_ones = [[inputs[topic] for topic in topics if topic in inputs] for topics in needed]
    return [ones for ones in open_ones if ones and all(one.is_silent(limit) for one in ones)]


def explain_silence(node: Any, inputs: Sequence[Input]) -> tuple[str, str]:
    """Say on which topic nothing comes, and since when; and why, and what to do.

    inputs: alternatives.
    """
    publishers = {one: node.get_publishers_info_by_topic(one.resolved) for one in inputs}
    one = next((one for one, found in publishers.items() if found), inputs[0])
    one = next((known for known in inputs if known.has_messages), one)
    since = f' for {one.silent_for():.0f} s' if one.has_messages else ''
    return (f'no message on {one.resolved}{since}',
            _reason(node, inputs, one, publishers[one]))


def _reason(node: Any, inputs: Sequence[Input], one: Input, publishers: Sequence[Any]) -> str:
    if not publishers:
        if one.has_messages:
            return 'its publisher is gone; start it again'
        return 'it has no publisher; ' + _proposal(node, inputs)
    right = [info for info in publishers if info.topic_type == one.typename]
    if not right:
        kinds = ', '.join(sorted({info.topic_type for info in publishers}))
        return (f'its type is {kinds}, but {one.typename} is needed; '
                + _proposal(node, inputs))
    names = ', '.join(sorted({info.node_name for info in right}))
    if one.has_messages:
        return (f'{names} is still connected; check its own input, and run ros2 topic hz '
                f'{one.resolved}')
    offers = [info.qos_profile for info in right]
    if all(qos_check_compatible(offered, asked)[0] == QoSCompatibility.ERROR
           for offered in offers for asked in one.profiles):
        return (f'{names} offers {qos_words(offers[0])}, but this node requests '
                f'{qos_words(one.profiles[0])}; remove {PREFIX}{one.resolved}.subscription.*')
    lossy = all(asked.reliability == ReliabilityPolicy.BEST_EFFORT for asked in one.profiles)
    large = (' (best effort loses large messages: raise net.core.rmem_max, or set '
             f'{PREFIX}{one.resolved}.subscription.reliability:=reliable)' if lossy else '')
    return f'{names} is connected, but no message has arrived{large}'


def _comes_from_elsewhere(node: Any, topic: str) -> bool:
    own = node.get_name(), node.get_namespace()
    return any((info.node_name, info.node_namespace) != own
               for info in node.get_publishers_info_by_topic(topic))


def _proposal(node: Any, inputs: Sequence[Input]) -> str:
    """Return the topics of the same type that are most alike, and how to listen to the first."""
    wanted, known = inputs[0], {one.typename for one in inputs}
    own = {one.resolved for one in inputs}
    found = [topic for topic, kinds in node.get_topic_names_and_types()
             if known & {*kinds} and topic not in own and _comes_from_elsewhere(node, topic)]
    if not found:
        return (f'no topic here has type {wanted.typename}; start its publisher with the same '
                'ROS_DOMAIN_ID')
    found.sort(key=lambda topic: -SequenceMatcher(None, topic, wanted.resolved).ratio())
    topic = found[0].removesuffix('/compressed') if len(inputs) > 1 else found[0]
    return (f'{wanted.typename} is on {", ".join(found[:_MAX_PROPOSALS])}; subscribe to it with '
            f'-r {wanted.name}:={topic}')
