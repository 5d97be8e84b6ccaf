"""Commands as processes of their own: with ROS 2, started together, ended in order."""

from __future__ import annotations

import ctypes
import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from fisheye_svp_ros.errors import GraphError
from fisheye_svp_ros.nodes.executables import missing_rclpy, ros_needed

_RANGE, _LOCALHOST = 'ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST'
# Of a ROS 2 that is sourced, or of a user who has said how far its nodes are to be seen.
_ENVIRONMENT = {'ROS_DISTRO', _RANGE, 'ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS'}
_POLL = 0.05  # s
_PARENT_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG of <sys/prctl.h>
_END = 4000  # bytes
_GRACE = 10.0  # s to end after a signal


def prepare_ros() -> None:
    """Keep nodes on this machine where no environment of ROS says otherwise.

    Raises GraphError, with the ways to get it, where rclpy cannot be imported.
    """
    if reason := missing_rclpy():
        raise GraphError(ros_needed(reason))
    if not _ENVIRONMENT & os.environ.keys():
        os.environ[_RANGE] = _LOCALHOST


class Processes:
    """A context manager that leaves no process behind; each writes DIR/NAME.log."""

    def __init__(self, logs: Path) -> None:
        self._logs = logs
        self._environment = {**os.environ, 'ROS_DOMAIN_ID': domain(), 'PYTHONUNBUFFERED': '1'}
        self._environment.setdefault(_RANGE, _LOCALHOST)
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Processes:
        self._logs.mkdir(parents=True, exist_ok=True)
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._running.values():
            process.terminate()
        for process in self._running.values():
            try:
                process.wait(_GRACE)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def start(self, name: str, arguments: Sequence[str]) -> None:
        """Start `fisheye-svp ARGUMENTS`."""
        command = [sys.executable, '-m', 'fisheye_svp_ros.cli', *arguments]
        with self._log(name).open('wb') as log:
            self._running[name] = subprocess.Popen(
                command,
                env=self._environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                preexec_fn=_end_with_parent,
            )

    def wait(
        self, names: Sequence[str], patience: float, look: Callable[[], None] = lambda: None
    ) -> None:
        """Wait until some end well, and `look` meanwhile; raise GraphError for one too late."""
        end = time.monotonic() + patience
        waiting = set(names)
        while waiting:
            for name, process in list(self._running.items()):
                status = process.poll()
                if status is None:
                    continue
                if status or name not in waiting:
                    raise GraphError(f'{name} ended with status {status}: {self._last_line(name)}')
                waiting.discard(name)
                del self._running[name]
            if time.monotonic() > end:
                raise GraphError(
                    f'{", ".join(sorted(waiting))} took more than '
                    f'{patience:g} s: {self._last_line(min(waiting))}'
                )
            look()
            time.sleep(_POLL)

    def stop(self, name: str) -> None:
        """End one with SIGINT; raise GraphError unless it ends well."""
        self._running[name].send_signal(signal.SIGINT)
        self.wait([name], _GRACE * 6)

    def log_tail(self, name: str) -> str:
        """Return the end of what one has said."""
        with self._log(name).open('rb') as log:
            log.seek(max(0, log.seek(0, os.SEEK_END) - _END))
            return log.read().decode('utf-8', 'replace')

    def _log(self, name: str) -> Path:
        return self._logs / f'{name}.log'

    def _last_line(self, name: str) -> str:
        lines = self.log_tail(name).splitlines()
        return f'{lines[-1] if lines else "it logged nothing"} ({self._log(name)})'


def _end_with_parent() -> None:
    """Have the kernel end this new process when its parent dies, however that happens."""
    with suppress(OSError, AttributeError):  # of Linux
        ctypes.CDLL(None).prctl(_PARENT_DEATH_SIGNAL, signal.SIGTERM)


def domain() -> str:
    """Return the user's ROS domain, or one that nobody on this machine is on."""
    given = os.environ.get('ROS_DOMAIN_ID')
    if given:
        return given
    for number in random.sample(range(1, 102), 101):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                # The port of the first participant of a domain (DDS-RTPS, section 9.6.1.1).
                probe.bind(('127.0.0.1', 7400 + 250 * number + 10))
            except OSError:
                continue
        return str(number)
    raise GraphError('all ROS domains from 1 to 101 are in use; set ROS_DOMAIN_ID')
