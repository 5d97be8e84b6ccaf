"""Messages to and from bytes: `rclpy.serialization`."""

from __future__ import annotations

from fisheye_svp_ros.standalone.messages import Message, deserialize, serialize


def serialize_message(message: Message) -> bytes:
    """Return a message as the CDR bytes in which it travels."""
    return serialize(message)


def deserialize_message(serialized_message: bytes, message_type: type[Message]) -> Message:
    """Return the message that CDR bytes hold, as a raw subscription delivers them."""
    return deserialize(serialized_message, message_type)
