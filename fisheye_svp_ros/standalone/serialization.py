"""Messages to and from bytes: `rclpy.serialization`."""

from __future__ import annotations

from fisheye_svp_ros.standalone.messages import Message, deserialize


def deserialize_message(serialized_message: bytes, message_type: type[Message]) -> Message:
    """Return the message that CDR bytes hold, as a raw subscription delivers them."""
    return deserialize(serialized_message, message_type)
