"""Wanted photographs, for people: in words, and drawn as the camera will see them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull

from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.planning.guide import MIN_PROBABILITY
from fisheye_svp_ros.planning.optimal_design import Shots
from fisheye_svp_ros.planning.plan import NextViews
from fisheye_svp_ros.reporting.plots import FAINT, OURS, PUBLISHED, picture
from fisheye_svp_ros.simulate.simulation import blank_views

HEADER = ('', 'board at', 'where in the image', 'tilted', 'turned clockwise', 'then')
TEXT_COLUMNS = ('where in the image', 'tilted')
_SIDES = ('right', 'lower right', 'bottom', 'lower left', 'left', 'upper left', 'top',
          'upper right')
_COLUMNS, _PANEL = 3, 3.4  # inches
_HUMAN = {'m': (1e3, 'mm'), 'rad': (180 / np.pi, 'deg')}


def rows(wanted: NextViews) -> list[tuple[str, ...]]:
    """Return the shot list's rows, under HEADER."""
    return [(str(i + 1), *instruction(wanted.shots, i), expected_error(wanted, i + 1))
            for i in range(len(wanted.shots.distance))]


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
        known = '' if wanted.answers[-1] > MIN_PROBABILITY else (
            '; photographs hardly separate them: exclude an absent one with '
            + ' '.join(f'--without {name}' for name in wanted.others))
        return (f'to separate {wanted.asked} from {" and ".join(wanted.others)}; now '
                f'{expected_error(wanted, 0)}{known}')
    what = 'the whole lens' if wanted.asked == 'lens' else wanted.asked
    if wanted.unit:
        return f'for {what}; now {expected_error(wanted, 0)}'
    beside = 'now' if wanted.answers[0] == 1 else 'after the first'
    return f'for {what}; errors in % of those {beside}'


def draw_shots(path: Path, model: ForwardModel, wanted: NextViews) -> None:
    """Draw each wanted view through the present lens: PNG, or PDF to be printed."""
    board, shots = wanted.board, wanted.shots
    count, first = len(shots.distance), int(np.argmin(board.landmark))
    views = blank_views(board.landmark, board.points, count, board=board.board)
    uv = model.predict(shots.camera, views).uv
    lines = -(-count // _COLUMNS)
    with picture(path, _COLUMNS * _PANEL, lines * _PANEL + 0.3) as figure:
        axes = np.ravel(figure.subplots(lines, _COLUMNS, squeeze=False))
        for axis in axes[count:]:
            axis.axis('off')
        for i, axis in enumerate(axes[:count]):
            _frame(axis, model.lens)
            hull = uv[i][ConvexHull(uv[i]).vertices]
            axis.fill(*hull.T, facecolor=FAINT, edgecolor=OURS, alpha=0.5)
            axis.plot(*uv[i].T, '.', color=OURS, markersize=2.5)
            axis.plot(*uv[i][first], 'o', color=PUBLISHED, markersize=6, fillstyle='none')
            away, where, tilt, roll = instruction(shots, i)
            axis.set_title(f'{i + 1}: {away}, {where}\ntilt {tilt}, turn {roll}; '
                           f'{expected_error(wanted, i + 1)}', fontsize=7.5)
        figure.suptitle(purpose(wanted), fontsize=9)


def _frame(axis: Any, lens: Lens) -> None:
    """Draw the border of the image and the edge of the field."""
    turn = np.linspace(0, 2 * np.pi, 181)
    edge = float(lens.image_height.value_and_slope(np.array(lens.max_incidence))[0])
    axis.plot(lens.cx + lens.fx * edge * np.cos(turn), lens.cy + lens.fy * edge * np.sin(turn),
              ':', color=FAINT)
    axis.set(xlim=(-0.5, lens.width - 0.5), ylim=(lens.height - 0.5, -0.5), aspect='equal',
             xticks=[], yticks=[])
    axis.grid(visible=False)
    for side in axis.spines.values():
        side.set_visible(True)


def _side(turn: float) -> str:
    return _SIDES[round(turn / (np.pi / 4)) % len(_SIDES)]
