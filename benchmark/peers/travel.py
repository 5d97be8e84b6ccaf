"""What lenses fitted on one board predict of another: `python -m benchmark.peers.travel DATA`.

DATA holds photos/chessboard and photos/square_grid, of one camera.  Writes docs/results/travel.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

import fisheye_svp_ros as fsvp
from benchmark import study
from benchmark.peers.calibrations import PLANE_LIMIT, NotHereError, opencv_fisheye
from benchmark.peers.compare import SETS, incidence_degrees
from benchmark.peers.halves import whole
from benchmark.peers.sets import Set, grid_of
from fisheye_svp_ros.diagnosis import diagnose, predict_board
from fisheye_svp_ros.errors import FisheyeSvpError
from fisheye_svp_ros.optics.lens import INTRINSICS, monotone_limit
from fisheye_svp_ros.solve.measured_poses import posable_observations
from fisheye_svp_ros.solve.rig_state import group_by_frame

_MODEL = 'kannala_brandt'
_NAMES = ('photos/chessboard', 'photos/square_grid')
_PLAIN, _OPENCV = '`calibrate --plain`', 'OpenCV, `cv2.fisheye`'
_CALIBRATE, _EXTENDED = '`calibrate`', '`diagnose`: extended'


class Way(NamedTuple):
    """Rms on a board by lenses of another one, px, by tool; own: by a lens of that board."""

    source: str
    to: str
    points: int
    frames: int
    rms_px: dict[str, float]
    own_px: float


def travel(pair: tuple[Set, Set]) -> Way:
    """Return what lenses of the first set predict of the second."""
    one, other = pair
    lens = _calibrated(other)
    table, _ = posable_observations(other.train, lens)
    # As `cv2.fisheye` projects no points beyond, no lens is scored there.
    near = incidence_degrees(table, fsvp.localize(table, lens)) < PLANE_LIMIT
    data = group_by_frame(table.take(near))
    rms_px: dict[str, float] = {}
    for name, fitted in _lenses(one):
        try:
            error = predict_board(data, fitted).rms
        except FisheyeSvpError:
            continue
        # OpenCV's lenses are several: the best of them counts.
        rms_px[name] = float(np.fmin(error, rms_px.get(name, np.nan)))
    own = predict_board(data, lens).rms
    return Way(one.name, other.name, int(near.sum()), data.frames, rms_px, own)


def _calibrated(data: Set, plain: bool = False) -> fsvp.Lens:
    return fsvp.calibrate(data.train, _MODEL, data.size, plain=plain).lens


def _lenses(data: Set) -> Iterator[tuple[str, fsvp.Lens]]:
    """Yield the lenses of a set by tool."""
    lens, plain = _calibrated(data), _calibrated(data, plain=True)
    yield _PLAIN, plain
    yield from ((_OPENCV, one) for one in _opencv_lenses(data, plain))
    yield _CALIBRATE, lens
    table, _ = posable_observations(data.train, lens)
    yield _EXTENDED, diagnose(table, lens).lens


def _opencv_lenses(data: Set, plain: fsvp.Lens) -> Iterator[fsvp.Lens]:
    """Yield OpenCV's lenses, fitted to points within several angles, as lenses of ours."""
    try:
        found = opencv_fisheye(data, grid_of(data), plain.fx)
    except NotHereError:
        return
    names = (*INTRINSICS, *plain.image_height.coefficient_names)
    for fitted in found:
        if not np.isfinite([*fitted.intrinsics, *fitted.curve]).all():
            continue
        lens = plain.with_parameters(names, [*fitted.intrinsics, *fitted.curve])
        yield replace(lens, max_incidence=monotone_limit(lens), calibration=None)


def page(ways: list[Way]) -> list[str]:
    """Return docs/results/travel.md."""

    def figures(name: str, between: str = ' and ') -> str:
        return between.join(f'{way.rms_px.get(name, np.nan):.3f}' for way in ways)

    own = [f'{way.own_px:.3f}' for way in ways]
    boards = [f'{_board(way.source)} → {_board(way.to)}' for way in ways]
    return [
        '# A lens on another board',
        '',
        f'On a board that it was not fitted on, the extended lens of `diagnose` is off by '
        f'{figures(_EXTENDED)} px, `calibrate` by {figures(_CALIBRATE)} px, OpenCV by '
        f'{figures(_OPENCV)} px. A lens that `calibrate` fits to that very board is off by '
        f'{" and ".join(own)} px.',
        '',
        '```bash',
        'make peers NAME=travel ARGS=FOLDER',
        '```',
        '',
        '`FOLDER` holds `photos/chessboard` and `photos/square_grid` (BoofCV-Data; corners by '
        '`detect`).',
        '',
        f'| lens, rms in px | {" | ".join(boards)} |',
        f'|---|{"---:|" * len(ways)}',
        *(
            f'| {name} | {figures(name, " | ")} |'
            for name in (_PLAIN, _OPENCV, _CALIBRATE, _EXTENDED)
        ),
        f'| `calibrate`, of the board to predict | {" | ".join(own)} |',
        '',
        'Scored are ' + ', '.join(f'{w.points} points in {w.frames} frames' for w in ways) + '. '
        'The lens stays as it is. Each frame is left out one by one: the places of the landmarks '
        'are fitted to the other frames, three numbers each, and its pose to its points, by least '
        'squares with equal weights. So no error of the board counts for or against a lens. The '
        'rms is that of 2-D residuals of all points.',
        '',
        'All lenses but the extended one are Kannala-Brandt lenses with four coefficients. '
        '`cv2.fisheye` is fitted to all points and to those within 85°, 80°, ... 60°; the best on '
        'the other board counts, an advantage that the other lenses do not have. Points '
        'beyond 89° are excluded for all lenses, since its projection ends there. `--plain` is '
        'least squares, `calibrate` generalized least squares.',
        '',
        f'OpenCV {cv2.__version__}, numpy {np.__version__}.',
    ]


def _board(name: str) -> str:
    return name.removeprefix('photos, ').replace('_', ' ')


def main() -> None:
    """Measure both ways, write the page."""
    parser = study.parser('travel', __doc__, study.RESULTS / 'travel.md', room='peers')
    parser.add_argument('data', type=Path)
    asked = parser.parse_args()
    sets = [SETS[name](asked.data) for name in _NAMES]
    sets = [replace(one, train=whole(one)) for one in sets]
    pairs = [(sets[0], sets[1]), (sets[1], sets[0])]
    lines = page(study.in_processes('travel', travel, pairs, asked.workers))
    print('\n'.join(lines))
    study.write_wrapped(asked.output, lines)


if __name__ == '__main__':
    # By its full name: processes that are spawned find nothing that is in `__main__`.
    import_module('benchmark.peers.travel').main()
