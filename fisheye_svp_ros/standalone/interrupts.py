"""Signals that arrive while the DDS library is at work."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any


class _Interrupts:
    """Holds signal handlers back while C code calls Python.

    cyclonedds does not expect an exception there: it takes the null pointer for an object.
    """

    def __init__(self) -> None:
        self._held = False
        self._waiting: list[Callable[[], Any]] = []

    def __enter__(self) -> None:
        # Python runs signal handlers in the main thread alone.
        self._held = threading.current_thread() is threading.main_thread() or self._held

    def __exit__(self, *_: object) -> None:
        if threading.current_thread() is threading.main_thread():
            self._held = False
            while self._waiting:
                self._waiting.pop(0)()

    def handle(self, handler: Callable[[], Any]) -> None:
        """Call a signal handler, now or as soon as it may raise."""
        if self._held:
            self._waiting.append(handler)
        else:
            handler()


INTERRUPTS = _Interrupts()
