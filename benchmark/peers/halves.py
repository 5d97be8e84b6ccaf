"""Stated errors beside those that are there: between halves of frames, of simulated lenses."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from benchmark.peers.calibrations import Fit, NotHereError, opencv_rational
from benchmark.peers.python_calibrations import calibsense_fisheye, installed
from benchmark.peers.sets import BOARDS, Set, grid_of, one_board_a_frame
from benchmark.studies.local_errors import draw_set
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.errors import FisheyeSvpError
from fisheye_svp_ros.optics.lens import INTRINSICS, parameter_values
from fisheye_svp_ros.scene.observations import Observations, make_observations
from fisheye_svp_ros.solve.lens_calibration import calibrate
from fisheye_svp_ros.solve.robust_calibration import calibrate_without_outliers
from fisheye_svp_ros.study.trust import assess_lens

DEALS = 10  # random halves of each set
WITHIN = 1.959964  # standard errors, 95 %
SIMULATED = 45  # sets
_ANGLE = 70.0  # degrees: `cv2.fisheye` fits all sets to the points within it


class Difference(NamedTuple):
    """How far fx, fy, cx, cy (4,) of a tool are from others, and the stated error (4,), px."""

    tool: str
    apart: Array
    error: Array


class Stated(NamedTuple):
    """fx, fy, cx, cy (4,), px, and their standard errors (4,) by kind."""

    intrinsics: Array
    errors: dict[str, Array]


def whole(data: Set) -> Observations:
    """Return all frames of a set as one table, numbered in the order of time, equal weights."""
    parts = data.train, replace(data.test, frame=data.test.frame // BOARDS)
    keys = [
        np.stack([np.nan_to_num(part.t), part.frame, np.full(len(part), i)], axis=-1)
        for i, part in enumerate(parts)
    ]
    frame = np.unique(np.concatenate(keys), axis=0, return_inverse=True)[1]
    landmark, uv, xyz, board = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ('landmark', 'uv', 'xyz', 'board')
    )
    return make_observations(frame, landmark, uv, xyz, board=board, source=data.name)


def fixed_halves(frames: Array) -> dict[str, tuple[Array, Array]]:
    """Return every other frame, and the first and the last half."""
    first, last = np.array_split(frames, 2)
    return {'every other frame': (frames[::2], frames[1::2]), 'first and last': (first, last)}


def half_sets(data: Set) -> Iterator[Set]:
    """Yield sets whose held-out frames are the other half, each half once."""
    table = whole(data)
    for name, pair in fixed_halves(table.frames).items():
        for mine, other in (pair, pair[::-1]):
            train, test = (table.take(np.isin(table.frame, half)) for half in (mine, other))
            yield Set(f'{data.name}, {name}', train, one_board_a_frame(test), data.size)


def all_pairs(data: Set) -> list[tuple[Set, Set]]:
    """Return the fixed halves and random ones, each as two sets without held-out frames."""
    table = whole(data)
    shuffled = [
        np.random.default_rng([7, deal]).permutation(table.frames) for deal in range(DEALS)
    ]
    pairs = [
        *fixed_halves(table.frames).values(),
        *((order[::2], order[1::2]) for order in shuffled),
    ]
    return [
        tuple(replace(data, train=table.take(np.isin(table.frame, half))) for half in pair)
        for pair in pairs
    ]


def intrinsics_of(data: Set) -> dict[str, Stated]:
    """Return what tools state of fx, fy, cx, cy; a tool that finds no lens is left out."""
    found, kept, _ = calibrate_without_outliers(
        data.train, lambda rows: calibrate(rows, 'kannala_brandt', data.size)
    )
    lens, names = found.adjusted.lens, found.adjusted.names
    trusted = assess_lens(kept, lens, names)
    mine = [names.index(name) for name in INTRINSICS]
    stated = {
        'ours, `calibrate`': Stated(
            np.array(parameter_values(lens, INTRINSICS)),
            {
                'target exact': np.array([trusted.stderr[name] for name in INTRINSICS]),
                'any target': np.sqrt(np.diag(trusted.covariance))[mine],
            },
        )
    }
    fits: dict[str, Fit] = {
        'OpenCV, rational': opencv_rational,
        'calibsense, fisheye': installed(
            lambda *asked: calibsense_fisheye(*asked, angles=(_ANGLE,))
        ),
    }
    for name, fit in fits.items():
        try:
            one = fit(data, grid_of(data), lens.fx)[0]
        except NotHereError:
            continue
        stated[name] = Stated(one.intrinsics, one.errors)
    return stated


def differences(pair: tuple[Set, Set]) -> list[Difference]:
    """Return how far the intrinsics of two halves are apart, by tool and kind of error."""
    try:
        first, second = map(intrinsics_of, pair)
    except FisheyeSvpError:
        return []
    return [
        Difference(
            f'{tool}, {kind}' if kind else tool,
            one.intrinsics - second[tool].intrinsics,
            np.hypot(error, second[tool].errors[kind]),
        )
        for tool, one in first.items()
        if tool in second
        for kind, error in one.errors.items()
        if kind in second[tool].errors
    ]


def simulated_errors(number: int) -> dict[str, list[Difference]]:
    """Return how far intrinsics are from those of a simulated lens, by what is wrong with it."""
    table, shift, bend, lens = draw_set(number)
    true = np.array(parameter_values(lens, INTRINSICS))
    kind = 'moving viewpoint' if shift else f'bend of {1e3 * bend:g} mm'
    try:
        stated = intrinsics_of(Set('simulated', table, table, (lens.width, lens.height)))
    except FisheyeSvpError:
        return {kind: []}
    return {
        kind: [
            Difference(f'{tool}, {name}' if name else tool, one.intrinsics - true, error)
            for tool, one in stated.items()
            for name, error in one.errors.items()
        ]
    }


def honesty_table(found: dict[str, list[Difference]]) -> list[str]:
    """Return how many differences lie within their 95 % intervals, by tool; found: by kind."""
    tools = dict.fromkeys(one.tool for many in found.values() for one in many)
    lines = [
        f'| tool | differences | within 95 % | {" | ".join(found)} | difference / stated error, '
        'rms | its stated error for fx, px |',
        f'|---|{"---:|" * (len(found) + 4)}',
    ]
    for tool in tools:
        by_set = [[one for one in many if one.tool == tool] for many in found.values()]
        every = [one for many in by_set for one in many]
        ratio = _ratios(every)
        stated = ' / '.join(map(_stated, by_set))
        lines.append(
            f'| {tool} | {ratio.size} | {_share(every)} | {" | ".join(map(_share, by_set))} | '
            f'{np.sqrt((ratio**2).mean()):.2f} | {stated} |'
        )
    return lines


def _ratios(many: Iterable[Difference]) -> Array:
    ratio = np.array([one.apart / one.error for one in many]).ravel()
    return ratio[np.isfinite(ratio)]


def _share(many: list[Difference]) -> str:
    return f'{(np.abs(_ratios(many)) < WITHIN).mean():.0%}'.replace('%', ' %') if many else '-'


def _stated(many: list[Difference]) -> str:
    return f'{np.nanmedian([one.error[0] for one in many]):.2f}' if many else '-'
