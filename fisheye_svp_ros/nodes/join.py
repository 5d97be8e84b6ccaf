"""Joins what carries one stamp on several topics; in which order it arrives does not matter."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

# Sets waiting for their rest; the oldest is given up beyond this.
LIMIT = 2000


class Pending(NamedTuple):
    """A set: when its first item came, s, and its items by topic."""

    stamp: int
    since: float
    items: dict[str, Any]


class StampJoin:
    """Sets of items by stamp: one item a topic.

    A set is ready when every required item is there, and every optional one of a topic that has
    been coming; for those it waits `patience` seconds and then goes without.  Sets come out in the
    order in which they began.
    """

    def __init__(self, required: Sequence[str], optional: Sequence[str]) -> None:
        self._required = tuple(required)
        self._expected = dict.fromkeys(optional, True)
        self._pending: dict[int, Pending] = {}

    def __len__(self) -> int:
        """Return how many sets with a required item are waiting for their rest."""
        return sum(self._holds_required(one.items) for one in self._pending.values())

    def add(self, topic: str, stamp: int, item: Any, now: float) -> bool:
        """Take an item in; say whether it is the first required one of its set.

        now: s, on any steady clock.
        """
        if topic in self._expected:
            self._expected[topic] = True
        items = self._pending.setdefault(stamp, Pending(stamp, now, {})).items
        first = topic in self._required and not self._holds_required(items)
        items[topic] = item
        return first

    def items(self, stamp: int) -> dict[str, Any]:
        """Return the items of a set that is waiting, to be changed in place; empty for none."""
        one = self._pending.get(stamp)
        return one.items if one else {}

    def forget(self, stamp: int) -> None:
        """Forget a set."""
        self._pending.pop(stamp, None)

    def expect_no_more(self, topic: str) -> None:
        """Stop waiting for an optional topic until an item of it comes again."""
        self._expected[topic] = False

    def expect(self, topic: str) -> None:
        """Wait for an optional topic, for the patience of one set."""
        self._expected[topic] = True

    def ready(self, now: float, patience: float) -> Iterator[Pending]:
        """Yield and forget the sets that are ready."""
        for one in list(self._pending.values()):
            if any(topic not in one.items for topic in self._required):
                continue
            missing = [t for t, expected in self._expected.items()
                       if expected and t not in one.items]
            if missing and now - one.since <= patience:
                continue
            for topic in missing:
                self.expect_no_more(topic)
            del self._pending[one.stamp]
            yield one

    def given_up(self, now: float, patience: float) -> Iterator[Pending]:
        """Yield and forget the sets that lack a required item and are out of patience."""
        surplus = len(self._pending) - LIMIT
        for number, one in enumerate(list(self._pending.values())):
            incomplete = any(topic not in one.items for topic in self._required)
            if number < surplus or (incomplete and now - one.since > patience):
                del self._pending[one.stamp]
                yield one

    def _holds_required(self, items: dict[str, Any]) -> bool:
        return any(topic in items for topic in self._required)
