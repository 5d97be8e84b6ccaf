"""Quality of service profiles: `rclpy.qos`."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

from fisheye_svp_ros.standalone.exceptions import (
    InvalidParameterValueException,
    NotSupportedError,
)


class InvalidQoSProfileException(Exception):
    """A profile lacks history and depth."""


class HistoryPolicy(IntEnum):
    """How many messages wait for delivery."""

    SYSTEM_DEFAULT = 0
    KEEP_LAST = 1
    KEEP_ALL = 2


class ReliabilityPolicy(IntEnum):
    """Whether lost messages are sent again."""

    SYSTEM_DEFAULT = 0
    RELIABLE = 1
    BEST_EFFORT = 2


class DurabilityPolicy(IntEnum):
    """Whether late subscribers receive earlier messages."""

    SYSTEM_DEFAULT = 0
    TRANSIENT_LOCAL = 1
    VOLATILE = 2


@dataclass(init=False)
class QoSProfile:
    """History, depth, reliability and durability of a topic, with the defaults of ROS 2."""

    history: HistoryPolicy
    depth: int
    reliability: ReliabilityPolicy
    durability: DurabilityPolicy

    def __init__(
        self,
        *,
        history: HistoryPolicy | None = None,
        depth: int | None = None,
        reliability: ReliabilityPolicy = ReliabilityPolicy.RELIABLE,
        durability: DurabilityPolicy = DurabilityPolicy.VOLATILE,
        **others: object,
    ) -> None:
        if others:
            raise NotSupportedError(f'QoS policies {[*others]} need an installation of ROS 2')
        if depth is None and history in {None, HistoryPolicy.KEEP_LAST}:
            raise InvalidQoSProfileException('a QoSProfile needs a depth, or history KEEP_ALL')
        self.history = HistoryPolicy(history or HistoryPolicy.KEEP_LAST)
        self.depth = depth or 0
        self.reliability = ReliabilityPolicy(reliability)
        self.durability = DurabilityPolicy(durability)


qos_profile_sensor_data = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
qos_profile_services_default = QoSProfile(depth=10)
qos_profile_parameters = QoSProfile(depth=1000)
qos_profile_parameter_events = QoSProfile(depth=1000)
qos_profile_rosout_default = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)


_POLICIES: dict[str, type[IntEnum]] = {
    'history': HistoryPolicy, 'reliability': ReliabilityPolicy, 'durability': DurabilityPolicy,
}


class QoSPolicyKind(IntEnum):
    """Names of policies, in the numbering of rmw."""

    DURABILITY = 1
    HISTORY = 4
    RELIABILITY = 16
    DEPTH = 64


class QoSOverridingOptions(NamedTuple):
    """Which policies of a topic parameters may override: `rclpy.qos_overriding_options`."""

    policy_kinds: tuple[QoSPolicyKind, ...]
    entity_id: str | None = None


class SubscriptionEventCallbacks(NamedTuple):
    """Whether rclpy tells of its own accord what a subscription cannot hear; here nobody does."""

    use_default_callbacks: bool = True


class TopicEndpointInfo(NamedTuple):
    """Who publishes on a topic: type and profile."""

    topic_type: str
    qos_profile: QoSProfile


def policy_text(value: int) -> str | int:
    """Return a policy as a parameter holds it."""
    return value.name.lower() if isinstance(value, IntEnum) else value


def policy_value(policy: str, given: str | int, parameter: str) -> int:
    """Return the policy that a parameter names."""
    if policy not in _POLICIES:
        return int(given)
    try:
        return _POLICIES[policy][str(given).upper()]
    except KeyError:
        known = ', '.join(name.lower() for name in _POLICIES[policy].__members__)
        raise InvalidParameterValueException(parameter, given, f'one of {known}') from None


def profile(qos: QoSProfile | int) -> QoSProfile:
    """Return a profile as given, or the default one with a history of that depth."""
    return QoSProfile(depth=qos) if isinstance(qos, int) else qos
