"""Joining by stamp, whatever the order of arrival."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import Any

import pytest

from fisheye_svp_ros.nodes import join
from fisheye_svp_ros.nodes.join import NeighborPair, Pending, StampJoin


def told(sets: Iterable[Pending]) -> list[tuple[int, dict[str, Any]]]:
    return [(one.stamp, one.items) for one in sets]


def mono(reach: int = 0) -> StampJoin:
    """Return a join of l with the optional t."""
    sets = StampJoin(('l',), {'t': 'l'})
    sets.reaches['t'] = reach
    return sets


@pytest.mark.parametrize('order', list(itertools.permutations('lrt')))
def test_a_set_is_ready_with_its_last_item(order: tuple[str, ...]) -> None:
    sets = StampJoin(('l', 'r'), {'t': 'l'})
    for n, topic in enumerate(order):
        assert told(sets.pop_complete(0.0, 1.0)) == []
        sets.add(topic, 5, n, 0.0)
    assert told(sets.pop_complete(0.0, 1.0)) == [(5, {topic: n for n, topic in enumerate(order)})]
    assert told(sets.pop_complete(0.0, 1.0)) == []


def test_stamps_never_mix_and_come_in_the_order_of_arrival() -> None:
    sets = StampJoin(('l', 'r'), {})
    for topic, stamp in (('l', 2), ('r', 1), ('l', 1), ('r', 3), ('r', 2)):
        sets.add(topic, stamp, f'{topic}{stamp}', 0.0)
    assert told(sets.pop_complete(0.0, 1.0)) == [
        (2, {'l': 'l2', 'r': 'r2'}),
        (1, {'r': 'r1', 'l': 'l1'}),
    ], 'a clock that is set back does not make the newest sets the oldest'


def test_patience_is_lost_once_and_found_again() -> None:
    sets = mono()
    sets.add('l', 1, 'a', 0.0)
    assert told(sets.pop_complete(1.0, 1.0)) == []
    assert told(sets.pop_complete(1.1, 1.0)) == [(1, {'l': 'a'})]
    sets.add('l', 2, 'b', 2.0)
    assert told(sets.pop_complete(2.0, 1.0)) == [(2, {'l': 'b'})], 'nothing has come: do not wait'
    sets.add('t', 2, 'x', 2.5)
    sets.add('l', 4, 'c', 3.0)
    assert told(sets.pop_complete(3.0, 1.0)) == [], 'it comes, if late: wait'
    sets.add('t', 4, 'y', 3.5)
    assert told(sets.pop_complete(3.5, 1.0)) == [(4, {'l': 'c', 't': 'y'})]


@pytest.mark.parametrize('ahead', [1000, -1000])
def test_what_never_matches_is_not_waited_for(ahead: int) -> None:
    sets = mono(reach=5)
    waits = []
    for number in range(10):
        sets.add('t', 10 * number + ahead, 'x', number)
        sets.add('l', 10 * number, 'a', number)
        at_once = told(sets.pop_complete(number, 0.5))
        waits.append(not at_once)
        assert at_once or told(sets.pop_complete(number + 0.6, 0.5)) == [(10 * number, {'l': 'a'})]
    assert waits == [ahead < 0, *[False] * 9]
    assert sets.distance('t', 90 + ahead) == 0 and sets.distance('t', 93 + ahead) == 3


def test_a_set_between_two_items_is_given_both() -> None:
    sets = mono(reach=10)
    for stamp in (0, 10, 20):
        sets.add('t', stamp, f't{stamp}', 0.0)
    sets.add('l', 14, 'a', 0.0)
    sets.add('l', 23, 'b', 0.0)
    assert told(sets.pop_complete(0.0, 1.0)) == [
        (14, {'l': 'a', 't': NeighborPair('t10', 't20', 0.4)})
    ]
    sets.add('t', 30, 't30', 0.1)
    assert told(sets.pop_complete(0.1, 1.0)) == [
        (23, {'l': 'b', 't': NeighborPair('t20', 't30', 0.3)})
    ]


def test_items_too_far_apart_or_of_other_sets_are_not_given() -> None:
    sets = mono(reach=9)
    for stamp in (0, 10):
        sets.add('t', stamp, f't{stamp}', 0.0)
    sets.add('l', 5, 'a', 0.0)
    assert told(sets.pop_complete(0.0, 1.0)) == [(5, {'l': 'a'})], 'too far apart'
    sets = mono(reach=100)
    for stamp in (10, 20, 30):
        sets.add('l', stamp, f'l{stamp}', 0.0)
    for stamp in (10, 30):  # that of 20 is lost
        sets.add('t', stamp, f't{stamp}', 0.0)
    assert [(stamp, items.get('t')) for stamp, items in told(sets.pop_complete(2.0, 1.0))] == [
        (10, 't10'),
        (20, None),
        (30, 't30'),
    ]


@pytest.mark.parametrize(('own', 'free'), [(10, 40), (40, 10)])
def test_of_two_items_around_a_set_neither_may_be_of_another(own: int, free: int) -> None:
    sets = mono(reach=100)
    for stamp in sorted((own, free)):
        sets.add('t', stamp, f't{stamp}', 0.0)
    for stamp in (own, 20):
        sets.add('l', stamp, f'l{stamp}', 0.0)
    assert dict(told(sets.pop_complete(2.0, 1.0)))[20] == {'l': 'l20'}


def test_items_of_a_recording_that_starts_over_are_not_mixed() -> None:
    sets = mono(reach=100)
    for stamp in (0, 10, 20, 5):
        sets.add('t', stamp, f't{stamp}', 0.0)
    sets.add('l', 7, 'a', 0.0)
    assert told(sets.pop_complete(0.0, 1.0)) == []
    sets.add('t', 9, 't9', 0.0)
    assert told(sets.pop_complete(0.0, 1.0)) == [
        (7, {'l': 'a', 't': NeighborPair('t5', 't9', 0.5)})
    ]


@pytest.mark.parametrize('order', [('l', 'r'), ('r', 'l')])
def test_cameras_a_little_apart_are_paired_under_the_first_ones_stamp(
    order: tuple[str, str],
) -> None:
    stamps = {'l': 100, 'r': 102}
    for tolerance in (1, 2):
        sets = StampJoin(('l', 'r'), {'t': 'r'})
        sets.tolerance = tolerance
        sets.add('t', 102, 'x', 0.0)
        taken = [sets.add(topic, stamps[topic], topic, 0.0) for topic in order]
        if tolerance == 1:
            assert told(sets.pop_complete(0.0, 1.0)) == [] and taken == [True, True]
            assert sets.distance('r', 100) == 2
            continue
        assert told(sets.pop_complete(0.0, 1.0)) == [(100, {'l': 'l', 'r': 'r', 't': 'x'})]
        assert taken == [True, False]


def test_each_is_paired_with_the_nearest() -> None:
    sets = StampJoin(('l', 'r'), {})
    sets.tolerance = 5
    for topic, stamp in (('l', 100), ('l', 104), ('r', 103), ('r', 99)):
        sets.add(topic, stamp, f'{topic}{stamp}', 0.0)
    assert told(sets.pop_complete(0.0, 1.0)) == [
        (100, {'l': 'l100', 'r': 'r99'}),
        (104, {'l': 'l104', 'r': 'r103'}),
    ]


def test_what_lacks_its_counterpart_is_given_up() -> None:
    sets = StampJoin(('l', 'r'), {})
    sets.add('l', 1, 'a', 0.0)
    assert told(sets.pop_expired(1.0, 1.0)) == []
    assert told(sets.pop_expired(1.1, 1.0)) == [(1, {'l': 'a'})]
    assert told(sets.pop_expired(9.0, 1.0)) == []


def test_what_no_set_takes_is_forgotten_with_patience() -> None:
    """A large map that is sent each second, say, under stamps of its own."""
    sets = mono()
    for second in range(5):
        sets.add('t', second, bytes(1), float(second))
        assert told(sets.pop_expired(float(second), 2.0)) == []
    assert [sets.waiting('t', stamp) for stamp in range(5)] == [None, None, b'\0', b'\0', b'\0']
    assert not any(sets._tracks['t']._latest)


def test_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(join, 'LIMIT', 3)
    sets = StampJoin(('l', 'r'), {'t': 'l'})
    for stamp in range(5):
        sets.add('l', stamp, stamp, 0.0)
        sets.add('t', stamp, stamp, 0.0)
    assert [stamp for stamp, _ in told(sets.pop_expired(0.0, 1.0))] == [0, 1]
    assert [sets.waiting('t', stamp) for stamp in range(5)] == [None, None, 2, 3, 4]
