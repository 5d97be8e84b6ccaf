"""Runs the callbacks of nodes, one after the other: `rclpy.executors`."""

from __future__ import annotations

import time
from collections import deque
from typing import Any

from cyclonedds.core import WaitSet

from fisheye_svp_ros.standalone.context import get_default_context
from fisheye_svp_ros.standalone.exceptions import ExternalShutdownException, NotSupportedError

__all__ = ['ExternalShutdownException', 'SingleThreadedExecutor']

# Python runs signal handlers between calls into C, so no such call may last longer than this.
_LONGEST_WAIT_NS = 100_000_000


class SingleThreadedExecutor:
    """Waits for timers, messages and requests of its nodes and runs one callback at a time."""

    def __init__(self) -> None:
        self.context = get_default_context()
        self._nodes: list[Any] = []
        self._ready: deque[Any] = deque()
        self._attached: list[Any] = []
        self._waitset: WaitSet | None = None
        self._stopped = False

    def add_node(self, node: Any) -> bool:
        """Run the callbacks of a node; False if it was added before."""
        if node in self._nodes:
            return False
        self._nodes.append(node)
        return True

    def remove_node(self, node: Any) -> None:
        """Leave a node alone from now on."""
        if node in self._nodes:
            self._nodes.remove(node)
        self._attached, self._waitset = [], None

    def shutdown(self) -> None:
        """Stop, and forget all nodes."""
        self._stopped = True
        self._nodes.clear()
        self._ready.clear()
        self._attached, self._waitset = [], None

    def spin(self) -> None:
        """Run callbacks until the context or this executor is shut down."""
        while self.context.ok() and not self._stopped:
            self.spin_once()
        # An exception that a signal raises is lost where Python was in a finalizer.
        if self.context.interrupted:
            raise KeyboardInterrupt

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Run one callback, or return after a while without any."""
        if not self._ready:
            self._wait(timeout_sec)
        while self._ready:
            entity = self._ready.popleft()
            if entity.node in self._nodes and entity.is_ready():
                entity.execute()
                return

    def _wait(self, timeout_sec: float | None) -> None:
        forever = timeout_sec is None or timeout_sec < 0
        end = None if forever else time.monotonic_ns() + int((timeout_sec or 0) * 1e9)
        while not self._stopped:
            if self.context.interrupted:
                raise KeyboardInterrupt
            if not self.context.ok():
                raise ExternalShutdownException('the context was shut down')
            entities = [e for n in self._nodes for e in (
                *n.timers, *n.subscriptions, *n.guards, *n.services)]
            self._ready.extend(entity for entity in entities if entity.is_ready())
            now = time.monotonic_ns()
            if self._ready or (end is not None and now >= end):
                return
            wake = [entity.next_call for entity in entities if entity.next_call is not None]
            until = min([*wake, now + _LONGEST_WAIT_NS, *([] if end is None else [end])])
            self._attach([e.reader for e in entities if e.reader is not None])
            if self._waitset is not None:
                self._waitset.wait(max(until - now, 0))

    def _attach(self, readers: list[Any]) -> None:
        if self._waitset is not None and readers == self._attached:
            return
        self._waitset = WaitSet(self.context.participant.entity)
        for reader in readers:
            self._waitset.attach(reader.condition)
        self._attached = readers


def __getattr__(name: str) -> Any:
    raise NotSupportedError(f'rclpy.executors.{name} needs an installation of ROS 2')
