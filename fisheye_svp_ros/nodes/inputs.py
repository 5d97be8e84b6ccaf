"""Messages that have come: counted, and decoded when somebody wants to know."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.serialization import deserialize_message

from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.io.decoding import nanoseconds

_MIN_BYTES = 12  # bytes: the head of CDR and a stamp


@dataclass
class Count:
    """How many messages of a topic came, were looked at, and could not be used."""

    received: int = 0
    read: int = 0
    dropped: int = 0


class Unread:
    """A message that has come and is not decoded yet."""

    def __init__(
        self, topic: str, kind: Any, data: bytes, decode: Callable[[Any, str], Any], counts: Count
    ) -> None:
        self.topic = topic
        self._kind, self._data, self._decode, self._counts = kind, data, decode, counts
        self._outcome: tuple[Any, ObservationError | None] | None = None

    @property
    def stamp(self) -> int:
        """The stamp of its header, which every message starts with that a node listens to, ns."""
        try:
            if len(self._data) < _MIN_BYTES:
                raise ObservationError(f'{self.topic}: {len(self._data)} bytes are not a message')
            order = '<' if self._data[1] & 1 else '>'
            sec, nanosec = struct.unpack_from(f'{order}iI', self._data, 4)
            return nanoseconds(sec, nanosec, self.topic)
        except ObservationError:
            self._counts.read += 1
            raise

    def read(self) -> Any:
        """Return what it holds; raise ObservationError where it cannot be used."""
        if self._outcome is None:
            self._counts.read += 1
            try:
                self._outcome = self._decode_data(), None
            except ObservationError as error:
                self._outcome = None, error
        value, refusal = self._outcome
        if refusal is not None:
            raise refusal
        return value

    def _decode_data(self) -> Any:
        try:
            message = deserialize_message(self._data, self._kind)
        except Exception as cause:
            kind = self._kind.__name__
            raise ObservationError(f'{self.topic}: not a {kind} ({cause})') from cause
        return self._decode(message, self.topic)
