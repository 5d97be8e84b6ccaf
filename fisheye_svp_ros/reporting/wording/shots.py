"""Wanted photographs in words: a list for the terminal and the report, and the live guide."""

from __future__ import annotations

import numpy as np

from fisheye_svp_ros.optics.lens import INTRINSICS
from fisheye_svp_ros.planning.guide import MIN_PROBABILITY, MIN_SCORE, Guide
from fisheye_svp_ros.planning.optimal_design import Shots
from fisheye_svp_ros.planning.plan import NextViews

HEADER = ('', 'board at', 'where in the image', 'tilted', 'turned clockwise', 'then')
TEXT_COLUMNS = ('where in the image', 'tilted')
_SIDES = (
    'right',
    'lower right',
    'bottom',
    'lower left',
    'left',
    'upper left',
    'top',
    'upper right',
)
_HUMAN = {'m': (1e3, 'mm'), 'rad': (180 / np.pi, 'deg')}


def rows(wanted: NextViews) -> list[tuple[str, ...]]:
    """Return the shot list's rows, under HEADER."""
    return [
        (str(i + 1), *instruction(wanted.shots, i), expected_error(wanted, i + 1))
        for i in range(len(wanted.shots.distance))
    ]


def instruction(shots: Shots, i: int) -> tuple[str, str, str, str]:
    """Return distance, place in the image, tilt and roll of a wanted view, in words."""
    angle = f'{np.degrees(shots.angle[i]):.0f} deg'
    where = 'in the middle'
    if shots.angle[i] > 0:
        where = f'{angle} off the axis, {_side(shots.azimuth[i])}'
    tilt = 'not'
    if shots.tilt[i] > 0:
        # The side of the board a quarter turn on from the axis of the tilt goes away.
        tilt = f'{np.degrees(shots.tilt[i]):.0f} deg, {_side(shots.tilt_axis[i] + np.pi / 2)} away'
    return f'{shots.distance[i]:.2f} m', where, tilt, f'{np.degrees(shots.roll[i]):.0f} deg'


def expected_error(wanted: NextViews, taken: int) -> str:
    """Return what will be known once so many of the photographs are taken."""
    value = wanted.answers[taken]
    if wanted.others:
        return f'{100 * value:.0f} % sure'
    if not wanted.unit:
        return f'errors {100 * value:.0f} %'
    factor, unit = _HUMAN.get(wanted.unit, (1.0, wanted.unit))
    return f'± {factor * value:.2g} {"" if unit == "1" else unit}'.rstrip()


def purpose(wanted: NextViews) -> str:
    """Return what the photographs are for, and where matters stand."""
    if wanted.others:
        known = (
            ''
            if wanted.answers[-1] > MIN_PROBABILITY
            else (
                '; photographs hardly separate them: exclude an absent one with '
                + ' '.join(f'--without {name}' for name in wanted.others)
            )
        )
        return (
            f'to separate {wanted.asked} from {" and ".join(wanted.others)}; now '
            f'{expected_error(wanted, 0)}{known}'
        )
    what = 'the whole lens' if wanted.asked == 'lens' else wanted.asked
    if wanted.unit:
        return f'for {what}; now {expected_error(wanted, 0)}'
    beside = 'now' if wanted.answers[0] == 1 else 'after the first'
    return f'for {what}; errors in % of those {beside}'


def _side(turn: float) -> str:
    return _SIDES[round(turn / (np.pi / 4)) % len(_SIDES)]


def guide_words(guide: Guide) -> tuple[str, str, str]:
    """Return what to do, the wanted view in words, and where matters stand."""
    stand, count = guide.stand, len(guide.session.taken)
    where = ''
    if stand is not None and guide.outline is not None:
        away, place, tilt, turn = instruction(stand.wanted.shots, guide.place)
        how = 'not tilted' if tilt == 'not' else f'tilted {tilt}'
        where = f'{away} away, {place}; {how}; turned {turn} clockwise'
    taken = f'{count} photograph{"" if count == 1 else "s"}'
    if stand is not None and stand.stderr is not None:
        taken += ', ' + _score_text(guide)
    if stand is not None and stand.settled:
        names = ' and '.join(stand.named) or 'no cause'
        if stand.alike:
            names += f', or {" or ".join(stand.alike)}: photographs cannot separate them'
        return 'settled', f'diagnosis: {names}', taken
    if guide.is_finished:
        return 'not settled', 'these photographs do not determine it', taken
    if guide.thinking:
        return 'one moment', 'choosing the next photograph', taken
    ready = guide.score >= MIN_SCORE
    return 'hold still' if ready else 'bring the board to the outline', where, taken


def _score_text(guide: Guide) -> str:
    """Return the number asked for with its standard error, and the one that is wanted."""
    stand, session = guide.stand, guide.session
    assert stand is not None and stand.stderr is not None
    factor, unit = 1.0, ''
    if session.number in INTRINSICS:
        unit = ' px'
    elif session.number == 'e0':
        factor, unit = 1e3, ' mm'
    value = f'{factor * (stand.value or 0.0):.4g} +- {factor * stand.stderr:.2g}{unit}'
    return f'{session.number} {value}, goal +- {factor * session.goal:.2g}'
