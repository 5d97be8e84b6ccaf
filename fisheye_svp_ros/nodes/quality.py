"""The quality of service of every topic, and the parameters that override it."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from typing import Any

from rclpy.event_handler import PublisherEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from fisheye_svp_ros.errors import ParameterError

# All but images are reliable; inputs are deep enough for what comes while a solver is busy.
RELIABLE = QoSProfile(depth=100)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# What each set has one of: kept as long as its image points, to be sent again where it is lost.
LATCHED_SETS = QoSProfile(depth=RELIABLE.depth, durability=DurabilityPolicy.TRANSIENT_LOCAL)
SENSOR = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
INPUT = QoSProfile(depth=1000)
# Of camera_info: drivers send it as sensor data, and each set has one of its own.
INFO_INPUT = QoSProfile(depth=INPUT.depth, reliability=ReliabilityPolicy.BEST_EFFORT)
TRANSFORMS = {
    '/tf': INPUT,
    '/tf_static': QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL),
}

PREFIX = 'qos_overrides.'
_POLICIES = (
    QoSPolicyKind.HISTORY,
    QoSPolicyKind.DEPTH,
    QoSPolicyKind.RELIABILITY,
    QoSPolicyKind.DURABILITY,
)


def overridden(node: Any, topic: str, entity: str) -> tuple[QoSPolicyKind, ...]:
    """Return the policies that parameters of a node override; topic: its full name.

    entity: publisher or subscription.
    """
    return tuple(
        policy
        for policy in _POLICIES
        if f'{PREFIX}{topic}.{entity}.{policy.name.lower()}' in node.given
    )


def create_with_qos(
    node: Any,
    create: Callable[..., Any],
    kind: Any,
    topic: str,
    *arguments: Any,
    qos: Any,
    **more: Any,
) -> Any:
    """Create a publisher or subscription of which parameters may override the QoS.

    Only what is overridden is declared, or else it would bury the parameters of the node.
    Raises ParameterError for an override that cannot be used.
    """
    entity = 'publisher' if create == node.create_publisher else 'subscription'
    policies = overridden(node, node.resolve_topic_name(topic), entity)
    if entity == 'publisher' and not policies and qos.reliability == ReliabilityPolicy.RELIABLE:
        # Hardly anybody asks for more, and who does says so; an executor asks each event of each
        # publisher, whatever it wakes up for.
        more = {'event_callbacks': PublisherEventCallbacks(use_default_callbacks=False), **more}
    try:
        # A copy, because rclpy changes the profile that it is given.
        return create(
            kind,
            topic,
            *arguments,
            copy(qos),
            qos_overriding_options=QoSOverridingOptions(policies),
            **more,
        )
    except RuntimeError as cause:
        if not node.context.ok():
            raise
        raise ParameterError(f'{topic}: {cause}') from cause


def qos_words(profile: Any) -> str:
    """Return reliability and durability as words of a sentence."""
    return ', '.join(
        str(policy.name).lower().replace('_', ' ')
        for policy in (profile.reliability, profile.durability)
    )
