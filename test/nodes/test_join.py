"""Joining by stamp, whatever the order of arrival."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import Any

import pytest

from fisheye_svp_ros.nodes import join
from fisheye_svp_ros.nodes.join import Pending, StampJoin


def told(sets: Iterable[Pending]) -> list[tuple[int, dict[str, Any]]]:
    return [(one.stamp, one.items) for one in sets]


@pytest.mark.parametrize('order', list(itertools.permutations('lrt')))
def test_a_set_is_ready_with_its_last_item(order: tuple[str, ...]) -> None:
    sets = StampJoin(('l', 'r'), ('t',))
    for n, topic in enumerate(order):
        assert told(sets.ready(0.0, 1.0)) == []
        sets.add(topic, 5, n, 0.0)
    assert told(sets.ready(0.0, 1.0)) == [(5, {topic: n for n, topic in enumerate(order)})]
    assert told(sets.ready(0.0, 1.0)) == []


def test_stamps_never_mix_and_come_in_the_order_of_arrival() -> None:
    sets = StampJoin(('l', 'r'), ())
    for topic, stamp in (('l', 2), ('r', 1), ('l', 1), ('r', 3), ('r', 2)):
        sets.add(topic, stamp, f'{topic}{stamp}', 0.0)
    assert told(sets.ready(0.0, 1.0)) == [
        (2, {'l': 'l2', 'r': 'r2'}), (1, {'r': 'r1', 'l': 'l1'})
    ], 'a clock that is set back does not make the newest sets the oldest'


def test_patience_is_lost_once_and_found_again() -> None:
    sets = StampJoin(('l',), ('t',))
    sets.add('l', 1, 'a', 0.0)
    assert told(sets.ready(1.0, 1.0)) == []
    assert told(sets.ready(1.1, 1.0)) == [(1, {'l': 'a'})]
    sets.add('l', 2, 'b', 2.0)
    assert told(sets.ready(2.0, 1.0)) == [(2, {'l': 'b'})], 'nothing has come: do not wait'
    sets.add('t', 3, 'x', 3.0)
    sets.add('l', 4, 'c', 3.0)
    assert told(sets.ready(3.0, 1.0)) == [], 'it comes again: wait'
    sets.add('t', 4, 'y', 3.5)
    assert told(sets.ready(3.5, 1.0)) == [(4, {'l': 'c', 't': 'y'})]


def test_what_lacks_its_counterpart_is_given_up() -> None:
    sets = StampJoin(('l', 'r'), ())
    sets.add('l', 1, 'a', 0.0)
    assert told(sets.given_up(1.0, 1.0)) == []
    assert told(sets.given_up(1.1, 1.0)) == [(1, {'l': 'a'})]
    assert told(sets.given_up(9.0, 1.0)) == []


def test_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(join, 'LIMIT', 3)
    sets = StampJoin(('l', 'r'), ())
    for stamp in range(5):
        sets.add('l', stamp, stamp, 0.0)
    assert [stamp for stamp, _ in told(sets.given_up(0.0, 1.0))] == [0, 1]
