"""Which camera of a rig a photograph is of, and which moment, by its name, number or stamp.

Names of cameras: left01.png, cam1_0001.png, video_right.mp4.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index

_MAX_CAMERAS = 16  # of more names each counts a photograph
_SIDES = {'l': 'left', 'r': 'right'}
# A word of its own, in CamelCase too; a letter alone stands between separators.
_CAMERA = re.compile(
    r'(?:(?<![A-Za-z])|(?<=[a-z])(?=[A-Z]))'
    r'((?:[Ll]eft|LEFT|[Rr]ight|RIGHT)(?![a-z])|(?:cam(?:era)?|CAM(?:ERA)?|Cam(?:era)?)[_-]?\d+)'
    r'|(?<![A-Za-z0-9])([LRlr])(?=[_\-\d]|$)'
)
_NAME_PARTS = re.compile(r'\d+|[A-Za-z]+')
_MIN_SHARED = 3  # names of two kinds that go on alike, before they look like two cameras'
SYNC = 0.005  # s between stamps of one moment, at most
_FORBIDDEN = 1e3  # times that, which no pair is worth
# Stamps since 1970 from 2001 on, in s with a fraction, ms, us or ns
_STAMP = re.compile(r'(?<!\d)(?:(1\d{9})[._](\d{3,9})|(1\d{12})|(1\d{15})|(1\d{18}))(?!\d)')
_NUMBER = re.compile(r'\d+')
_DIGITS = 9  # of a number that counts photographs, at most


def split_names(names: Sequence[str], rest_needed: bool = True) -> list[tuple[str, str]] | None:
    """Return camera and rest of each name; None unless all name one of two cameras or more.

    rest_needed: what is left of a name must tell the photographs of a camera apart.
    """
    found = [_split(name) for name in names]
    parts = [one for one in found if one is not None]
    cameras = {camera for camera, _ in parts}
    if len(parts) < len(names) or not 2 <= len(cameras) <= _MAX_CAMERAS:
        return None
    return None if rest_needed and not all(rest for _, rest in parts) else parts


def names_a_camera(name: str) -> bool:
    """Say whether a name names a camera."""
    return _split(name) is not None


def alike_series(names: Sequence[str]) -> tuple[str, ...]:
    """Return words by which names fall into series with the same numbers: infra1_ and infra2_.

    Files of two cameras may be called so, and others, too; empty for one series.
    """
    series: dict[str, set[str]] = {}
    for name in names:
        words = [*_NAME_PARTS.finditer(name)]
        if not words or not words[-1][0].isdigit():
            return ()
        series.setdefault(name[: words[-1].start()], set()).add(words[-1][0])
    if len(series) < 2 or len(series) > _MAX_CAMERAS:
        return ()
    first, *others = series.values()
    alike = all(len(first & one) >= max(_MIN_SHARED, 0.9 * len(first | one)) for one in others)
    return tuple(series) if alike else ()


def _split(name: str) -> tuple[str, str] | None:
    match = _CAMERA.search(name)
    if match is None:
        return None
    word = (match[1] or match[2]).lower()
    before, after = name[: match.start()].rstrip('_-. '), name[match.end() :].lstrip('_-. ')
    camera = re.sub('[_-]', '', _SIDES.get(word, word))
    return camera, '_'.join(filter(None, (before, after)))


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
