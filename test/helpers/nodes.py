"""Nodes in processes of their own, and what waits for them."""

from __future__ import annotations

import queue
import re
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from fisheye_svp_ros.nodes.executables import missing_rclpy

ROOT = Path(__file__).resolve().parents[2]
TIMEOUT = 60.0  # s; only a hang takes this long, however busy the machine is


def need_ros() -> None:
    """Skip a test, or a module of tests, where there is no rclpy to run nodes on."""
    if reason := missing_rclpy():
        pytest.skip(f'ROS 2 is not here: {reason}', allow_module_level=True)


def hears_sigint() -> None:
    """Undo, in a child, that whoever runs the tests in the background ignores SIGINT."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


class NodeProcess:
    """A node in a process of its own, and the lines it writes."""

    def __init__(self, command: list[str], env: dict[str, str]) -> None:
        self.lines: list[str] = []
        self._queue: queue.Queue[str | None] = queue.Queue()
        self.process = subprocess.Popen(
            command,
            env=env,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            preexec_fn=hears_sigint,
        )
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        assert self.process.stdout
        for line in self.process.stdout:
            self._queue.put(line.rstrip('\n'))
        self._queue.put(None)

    def wait_for(self, pattern: str, timeout: float = TIMEOUT) -> re.Match[str]:
        """Return the first new line that matches; fail when the process ends before."""
        end = time.monotonic() + timeout
        while (left := end - time.monotonic()) > 0:
            try:
                line = self._queue.get(timeout=left)
            except queue.Empty:
                break
            if line is None:
                self._queue.put(None)
                break
            self.lines.append(line)
            if match := re.search(pattern, line):
                return match
        raise AssertionError(f'no line with {pattern!r} in:\n' + '\n'.join(self.lines))

    def finish(self, number: signal.Signals | None = None, timeout: float = TIMEOUT) -> int:
        """Wait for the end, after a signal if one is given; return the exit status."""
        if number is not None:
            self.process.send_signal(number)
        status = self.process.wait(timeout)
        self._thread.join(timeout)
        while (line := self._queue.get(timeout=timeout)) is not None:
            self.lines.append(line)
        self._queue.put(None)
        return status


class Caller:
    """A service client for tests, in a context of its own."""

    def __init__(self, domain: int) -> None:
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node

        self._context = Context()
        self._context.init(domain_id=domain)
        self._node = Node('caller', context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)

    def call(self, typename: str, service: str, **request: Any) -> Any:
        """Call a service and return its response."""
        package, kind, name = typename.split('/')
        cls = getattr(import_module(f'{package}.{kind}'), name)
        client = self._node.create_client(cls, service)
        assert client.wait_for_service(TIMEOUT), service
        future = client.call_async(cls.Request(**request))
        self._executor.spin_until_future_complete(future, TIMEOUT)
        self._node.destroy_client(client)
        assert future.done(), 'no reply'
        return future.result()

    def close(self) -> None:
        """Leave the domain."""
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.shutdown()


def until(condition: Callable[[], Any], timeout: float = TIMEOUT) -> Any:
    """Return the first true answer of a function, or fail after a while."""
    end = time.monotonic() + timeout
    while time.monotonic() < end:
        if answer := condition():
            return answer
        time.sleep(0.01)
    raise AssertionError('nothing happened in time')
