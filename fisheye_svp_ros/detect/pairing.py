"""Which photographs of a rig's cameras are of one moment: by name, by number or by stamp."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index

SYNC = 0.005  # s between stamps of one moment, at most
_FORBIDDEN = 1e3  # times that, which no pair is worth
# Stamps since 1970 from 2001 on, in s with a fraction, ms, us or ns
_STAMP = re.compile(r'(?<!\d)(?:(1\d{9})[._](\d{3,9})|(1\d{12})|(1\d{15})|(1\d{18}))(?!\d)')
_NUMBER = re.compile(r'\d+')
_DIGITS = 9  # of a number that counts photographs, at most


class Pairing(NamedTuple):
    """keys (S,) of photographs, equal for those of one moment.

    way: name, number or stamp, '' for one camera; apart: s between the stamps of a moment, at
    most; alone: which photographs (K,) have no partner of another camera.
    """

    keys: tuple[str, ...]
    way: str = ''
    apart: float = 0.0
    alone: tuple[int, ...] = ()


def stamp_of(name: str) -> int | None:
    """Return the stamp in a file's name, ns; None where there is none."""
    match = _STAMP.search(name)
    if match is None:
        return None
    seconds, fraction, *others = match.groups()
    if seconds is not None:
        return int(seconds + fraction.ljust(9, '0'))
    return next(
        int(digits) * scale
        for digits, scale in zip(others, (10**6, 10**3, 1), strict=True)
        if digits is not None
    )


def pair_photographs(
    keys: Sequence[str], cameras: Sequence[str], t: Array, sync: float | None = None
) -> Pairing:
    """Return which photographs (S,) are of one moment.

    keys: names without folder and camera, after PATH/ where an earlier path has such a name; t
    (S,), s, NaN unknown; sync: largest difference of stamps, s; None: stamps are compared, to
    within SYNC, where all are known, or else names, or else the last numbers in these.
    """
    own, names = tuple(keys), np.array(cameras)
    if len(set(cameras)) < 2:
        return Pairing(own)
    if np.isfinite(t).all():
        joined, apart = _pair_by_stamp(names, t, SYNC if sync is None else sync)
        return Pairing(joined, 'stamp', apart, _count_unpaired(joined, names))
    way, alone = 'name', _count_unpaired(own, names)
    if len(alone) == len(own):
        parts = [key.rpartition('/') for key in own]
        numbers = [['', *_NUMBER.findall(name)][-1] for _, _, name in parts]
        counted = tuple(
            f'{path}{slash}{number.lstrip("0") or "0"}'
            for (path, slash, _), number in zip(parts, numbers, strict=True)
        )
        each = list(zip(cameras, counted, strict=True))
        if (
            all(0 < len(one) <= _DIGITS for one in numbers)
            and len({*each}) == len(each)
            and (len(_count_unpaired(counted, names)) < len(own))
        ):
            own, way, alone = counted, 'number', _count_unpaired(counted, names)
    return Pairing(own, way, 0.0, alone)


def _pair_by_stamp(cameras: Index, t: Array, sync: float) -> tuple[tuple[str, ...], float]:
    """Return the keys of moments, and how far, s, the stamps of one are apart at most."""
    from scipy import optimize  # not while a process that searches photographs starts

    moment, apart = np.arange(len(t)), 0.0  # by the photograph that stands for it
    leaders = moment[:0]
    for camera in sorted(set(cameras.tolist())):
        mine = np.flatnonzero(cameras == camera)
        for theirs, own in _runs_of_stamps(t, leaders, mine, sync):
            away = np.abs(t[own, None] - t[theirs])
            # Squares keep the order where many are within reach of one another.
            cost = np.where(away > sync, _FORBIDDEN, away / sync) ** 2
            rows, columns = optimize.linear_sum_assignment(cost)
            close = away[rows, columns] <= sync
            moment[own[rows[close]]] = theirs[columns[close]]
            apart = max(apart, float(away[rows, columns][close].max(initial=0.0)))
        leaders = np.append(leaders, mine[moment[mine] == mine])
    return tuple(map(str, moment.tolist())), apart


def _runs_of_stamps(
    t: Array, one: Index, other: Index, sync: float
) -> Iterator[tuple[Index, Index]]:
    """Yield photographs of both cameras in runs whose stamps follow within `sync`, s."""
    both = np.concatenate([one, other])
    order = np.argsort(t[both], kind='stable')
    for run in np.split(order, np.flatnonzero(np.diff(t[both[order]]) > sync) + 1):
        first = run < len(one)
        if first.any() and not first.all():
            yield both[run[first]], both[run[~first]]


def _count_unpaired(keys: Sequence[str], cameras: Index) -> tuple[int, ...]:
    of_key: dict[str, set[str]] = {}
    for key, camera in zip(keys, cameras.tolist(), strict=True):
        of_key.setdefault(key, set()).add(camera)
    return tuple(i for i, key in enumerate(keys) if len(of_key[key]) < 2)
