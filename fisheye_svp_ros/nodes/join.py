"""Joins what belongs together on several topics; in which order it arrives does not matter."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.io.decoding import LandmarkSet
from fisheye_svp_ros.nodes.subscriptions import Unread
from fisheye_svp_ros.reporting.wording import inputs as wording

# Sets waiting for their rest, and items waiting for their set; the oldest is given up beyond this.
LIMIT = 2000
_MAX_MISSED = 20  # sets that went without an item which may only be late


class NeighborPair(NamedTuple):
    """Two items of a topic, and how far from the first to the second a set is: 0 to 1."""

    first: Any
    second: Any
    fraction: float


class Pending(NamedTuple):
    """A set: when its first item came, s; its items, and the stamps of these, ns, by topic."""

    stamp: int
    since: float
    items: dict[str, Any]
    stamps: dict[str, int]


class _Track:
    """What has come on an optional topic, by stamp."""

    def __init__(self) -> None:
        self.items: dict[int, Any] = {}  # that no set has taken yet, in the order of arrival
        self._arrivals: dict[int, float] = {}  # of these, s
        self.expected, self.matched = True, False
        self.missed: deque[int] = deque(maxlen=_MAX_MISSED)  # stamps of sets that went without
        self._stamps: list[int] = []  # of the latest items in ascending order
        self._latest: list[Any] = []

    def add(self, stamp: int, item: Any, now: float, keep: bool) -> None:
        """Take an item in; keep: also for sets between it and another."""
        self.take(stamp)
        self.items[stamp], self._arrivals[stamp] = item, now
        if len(self.items) > LIMIT:
            self.take(next(iter(self.items)))
        if self._stamps and stamp <= self._stamps[-1]:  # a recording that starts over, say
            self._stamps, self._latest = [], []
        self._stamps.append(stamp)
        self._latest.append(item if keep else None)
        if len(self._stamps) > LIMIT:
            del self._stamps[0], self._latest[0]

    def take(self, stamp: int) -> Any:
        """Return the item of a stamp, which is nobody else's from now on; None for none."""
        self._arrivals.pop(stamp, None)
        return self.items.pop(stamp, None)

    def expire(self, before: float) -> None:
        """Forget what came before a time, s, and what no set has taken."""
        while self._arrivals and next(iter(self._arrivals.values())) < before:
            self.take(next(iter(self._arrivals)))

    def find(self, stamp: int, reach: int, taken: Mapping[int, None]) -> Any:
        """Return the item of a stamp, or of the two around it, or None."""
        if stamp in self.items:
            return self.items[stamp]
        after = bisect_left(self._stamps, stamp)
        if not 0 < after < len(self._stamps):
            return None
        first, second = self._stamps[after - 1 : after + 1]
        # What has the stamp of another set belongs to that one.
        if second - first > reach or first in taken or second in taken:
            return None
        before, behind = self._latest[after - 1 : after + 1]
        if before is None or behind is None:
            return None
        return NeighborPair(before, behind, (stamp - first) / (second - first))

    def is_past(self, stamp: int) -> bool:
        """Say whether nothing for a stamp can come: others have passed it, and never match."""
        return not self.matched and bool(self._stamps) and self._stamps[-1] > stamp

    def distance(self, stamp: int) -> int | None:
        """Return how far the nearest stamp is, ns; None where nothing has come."""
        after = bisect_left(self._stamps, stamp)
        near = self._stamps[max(after - 1, 0) : after + 1]
        return min((abs(stamp - one) for one in near), default=None)


class StampJoin:
    """Sets of items by stamp: one item a topic.

    A set is ready when every required item is there, and every optional one of a topic that has
    been matching; for those it waits `patience` seconds and then goes without.  Sets come out in
    the order in which they began, under the stamp of their first required topic.

    optional: by topic the required one whose stamp it shares.  reaches: ns, of optional topics of
    which a set may be given the two items around its stamp, and how far apart those may be.
    tolerance: ns, by which required items of a set may differ.
    """

    def __init__(self, required: Sequence[str], optional: Mapping[str, str]) -> None:
        self.reaches: dict[str, int] = {}
        self.tolerance = 0
        self._required = tuple(required)
        self._shares = dict(optional)
        self._tracks = {topic: _Track() for topic in optional}
        self._pending: dict[int, Pending] = {}
        self._recent = {topic: deque[int](maxlen=LIMIT) for topic in required}
        self._taken: dict[int, None] = {}  # stamps of sets, ready or not

    def __len__(self) -> int:
        """Return how many sets are waiting for their rest."""
        return len(self._pending)

    def add(self, topic: str, stamp: int, item: Any, now: float) -> bool:
        """Take an item in; say whether it is the first required one of its set.

        now: s, on any steady clock.
        """
        track = self._tracks.get(topic)
        if track is not None:
            track.add(stamp, item, now, bool(self.reaches.get(topic)))
            if any(self._find(topic, missed) is not None for missed in track.missed):
                track.expected = True
                track.missed.clear()
            return False
        self._recent[topic].append(stamp)
        self._taken[stamp] = None
        if len(self._taken) > LIMIT:
            del self._taken[next(iter(self._taken))]
        one = self._find_set(topic, stamp)
        first = one is None
        if one is None:
            one = self._pending[stamp] = Pending(stamp, now, {}, {})
        one.items[topic], one.stamps[topic] = item, stamp
        return first

    def waiting(self, topic: str, stamp: int) -> Any:
        """Return an item that no set has taken yet; None where there is none."""
        if topic in self._tracks:
            return self._tracks[topic].items.get(stamp)
        one = self._holding(topic, stamp)
        return one and one.items[topic]

    def forget(self, topic: str, stamp: int) -> None:
        """Forget an item; of a required one its set."""
        if topic in self._tracks:
            self._tracks[topic].take(stamp)
        elif one := self._holding(topic, stamp):
            del self._pending[one.stamp]

    def expect_no_more(self, topic: str) -> None:
        """Stop waiting for an optional topic until it matches a set again."""
        self._tracks[topic].expected = False

    def expects(self, topic: str) -> bool:
        """Say whether sets wait for an optional topic."""
        return self._tracks[topic].expected

    def expect(self, topic: str) -> None:
        """Wait for an optional topic, for the patience of one set."""
        self._shares.setdefault(topic, self._required[0])
        self._tracks.setdefault(topic, _Track()).expected = True

    def distance(self, topic: str, stamp: int) -> int | None:
        """Return how far the nearest stamp on a topic is, ns; None where nothing has come."""
        if topic in self._tracks:
            return self._tracks[topic].distance(stamp)
        return min((abs(stamp - one) for one in self._recent[topic]), default=None)

    def pop_complete(self, now: float, patience: float) -> Iterator[Pending]:
        """Yield and forget the sets that are ready."""
        for one in list(self._pending.values()):
            if any(topic not in one.items for topic in self._required):
                continue
            found = {
                topic: self._find(topic, one.stamps[shared])
                for topic, shared in self._shares.items()
            }
            awaited = [
                topic
                for topic, item in found.items()
                if item is None
                and self._tracks[topic].expected
                and not self._tracks[topic].is_past(one.stamps[self._shares[topic]])
            ]
            if awaited and now - one.since <= patience:
                continue
            for topic, item in found.items():
                self._settle(topic, one, item)
            del self._pending[one.stamp]
            yield one._replace(stamp=one.stamps[self._required[0]])

    def pop_expired(self, now: float, patience: float) -> Iterator[Pending]:
        """Yield and forget the sets that lack a required item and are out of patience."""
        for track in self._tracks.values():
            track.expire(now - patience)
        surplus = len(self._pending) - LIMIT
        for number, one in enumerate(list(self._pending.values())):
            incomplete = any(topic not in one.items for topic in self._required)
            if number < surplus or (incomplete and now - one.since > patience):
                del self._pending[one.stamp]
                yield one

    def _find(self, topic: str, stamp: int) -> Any:
        return self._tracks[topic].find(stamp, self.reaches.get(topic, 0), self._taken)

    def _settle(self, topic: str, pending: Pending, item: Any) -> None:
        """Give a set what there is of an optional topic; wait for that topic as it matches."""
        track, stamp = self._tracks[topic], pending.stamps[self._shares[topic]]
        track.expected = item is not None
        if item is None:
            track.missed.append(stamp)
            return
        pending.items[topic] = item
        if track.take(stamp) is not None:
            track.matched = True

    def _find_set(self, topic: str, stamp: int) -> Pending | None:
        """Return the set that an item belongs to, if it is there: of those that lack it."""
        if not self.tolerance:
            return self._pending.get(stamp)
        near = [
            one
            for one in self._pending.values()
            if topic not in one.items and abs(one.stamp - stamp) <= self.tolerance
        ]
        return min(near, key=lambda one: abs(one.stamp - stamp), default=self._pending.get(stamp))

    def _holding(self, topic: str, stamp: int) -> Pending | None:
        own = [self._pending[stamp]] if stamp in self._pending else []
        others = self._pending.values() if self.tolerance else ()
        return next((one for one in (*own, *others) if one.stamps.get(topic) == stamp), None)


class LatchedLandmarks:
    """The landmarks of sets without any of their stamp: the latest, unless they come set by set.

    They do where they differ from message to message and most of the latest sets had some of
    their own stamp: those of one set must not stand in for those of another.  A map with stamps
    of its own meets those of few sets, by chance.  Sets count once another message has come:
    landmarks that stop are no map.  Stamp 0 says that landmarks hold.
    """

    def __init__(self) -> None:
        self.trouble = ''  # with the latest message, until another comes
        self._latest: LandmarkSet | None = None
        self._content: int | None = None  # a hash
        self._vary = False
        self._matched = deque[bool](maxlen=_MAX_MISSED)  # of the sets before the latest message
        self._misses = 0  # sets since then without their own

    def hear(self, stamp: int, unread: Unread) -> None:
        """Take note of landmarks; raise ObservationError where they cannot be used."""
        if stamp:
            content, before = unread.content, self._content
            self._vary = self._vary or before not in (None, content)
            self._content = content
            self._matched.extend([False] * min(self._misses, _MAX_MISSED))
        else:
            self._content, self._vary = None, False
            self._matched.clear()
        self._misses = 0
        self.trouble = ''
        if not self._is_series:
            self._read(unread)

    def hold(self, landmarks: LandmarkSet) -> None:
        """Take landmarks for all sets."""
        self._latest = landmarks

    def _read(self, unread: Unread) -> None:
        try:
            self._latest = latest = unread.read()
        except ObservationError as error:
            self.trouble = wording.landmarks_refused(str(error)) if self._latest else ''
            raise
        if latest.rejected:
            count = len(latest.landmarks.ids) + latest.rejected
            self.trouble = wording.landmarks_left_out(latest.rejected, count)

    def find_for_set(self, own: LandmarkSet | None, distance: int | None) -> LandmarkSet:
        """Return the landmarks of a set; raise ObservationError where there are none.

        own: those of its stamp; distance: of the nearest stamp there was, ns.
        """
        if own is not None:
            self._matched.append(True)
            return own
        self._misses += 1
        if self._is_series:
            raise ObservationError(
                f'no landmarks of its stamp, the nearest is {1e-6 * (distance or 0):.1f} ms '
                'off: they were late, lost, or never sent. Publish landmarks that hold for all '
                'sets with stamp 0'
            )
        if self._latest is None:
            raise ObservationError('no landmarks; publish them on `landmarks`')
        return self._latest

    @property
    def _is_series(self) -> bool:
        return self._vary and 2 * sum(self._matched) >= max(len(self._matched), 1)
