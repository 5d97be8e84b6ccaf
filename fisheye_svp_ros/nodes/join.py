"""Joins what carries one stamp on several topics; in which order it arrives does not matter."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

# Sets waiting for their rest; the oldest is given up beyond this.
LIMIT = 2000


class _Pending(NamedTuple):
    since: float
    items: dict[str, Any]


class StampJoin:
    """Sets of items by stamp: one item a topic.

    A set is ready when every required item is there, and every optional one of a topic that has
    been coming; for those it waits `patience` seconds and then goes without.
    """

    def __init__(self, required: Sequence[str], optional: Sequence[str]) -> None:
        self._required = tuple(required)
        self._expected = dict.fromkeys(optional, True)
        self._pending: dict[int, _Pending] = {}

    def add(self, topic: str, stamp: int, item: Any, now: float) -> None:
        """Take an item in; now: s, on any steady clock."""
        if topic in self._expected:
            self._expected[topic] = True
        self._pending.setdefault(stamp, _Pending(now, {})).items[topic] = item

    def expect_no_more(self, topic: str) -> None:
        """Stop waiting for an optional topic until an item of it comes again."""
        self._expected[topic] = False

    def ready(self, now: float, patience: float) -> Iterator[tuple[int, dict[str, Any]]]:
        """Yield and forget the sets that are ready, by ascending stamp."""
        for stamp in sorted(self._pending):
            since, items = self._pending[stamp]
            if any(topic not in items for topic in self._required):
                continue
            missing = [t for t, expected in self._expected.items() if expected and t not in items]
            if missing and now - since <= patience:
                continue
            for topic in missing:
                self.expect_no_more(topic)
            del self._pending[stamp]
            yield stamp, items

    def given_up(self, now: float, patience: float) -> Iterator[tuple[int, dict[str, Any]]]:
        """Yield and forget the sets that lack a required item and are out of patience."""
        surplus = len(self._pending) - LIMIT
        for number, stamp in enumerate(sorted(self._pending)):
            since, items = self._pending[stamp]
            incomplete = any(topic not in items for topic in self._required)
            if number < surplus or (incomplete and now - since > patience):
                del self._pending[stamp]
                yield stamp, items
