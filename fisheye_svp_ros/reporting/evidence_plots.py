"""Pictures of the evidence for each cause, and of the target."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from fisheye_svp_ros.diagnosis import Diagnosis
from fisheye_svp_ros.effects.target_map import BoardMap
from fisheye_svp_ros.reporting.diagnosis_plots import AFTER, BEFORE, File
from fisheye_svp_ros.reporting.plots import NARROW, legend_below, panels, picture
from fisheye_svp_ros.reporting.style import INK, round_number

_REJECTED_COLOR = '#cbd5e1'
_OVER_LINES = {'facecolor': 'white', 'edgecolor': 'none', 'pad': 1}  # behind a number


def draw_evidence(file: File, diagnosis: Diagnosis, narrow: bool = False) -> None:
    """What each step of the search explains, and how well held-out data are predicted after it."""
    steps = [step for step in diagnosis.trace if step.statistic > 0]
    count = max(len(steps), len(diagnosis.causes) + 2)
    height = 1.6 + 0.3 * count
    size = (NARROW, 2 * height) if narrow else (9.2, height)
    with picture(file, *size, tight=True) as figure:
        left, right = panels(figure, 1, narrow)[0]
        left.barh(
            [step.form[:40] for step in steps],
            [step.statistic for step in steps],
            color=[AFTER if step.is_accepted else _REJECTED_COLOR for step in steps],
        )
        left.set(xlabel='score statistic', title='steps of the selection', xscale='log')
        if steps:  # bars begin at a power of ten, whose names alone have room below them
            least = min(step.statistic for step in steps)
            left.set_xlim(left=10.0 ** math.ceil(math.log10(least) - 1))
        left.xaxis.set_minor_formatter(NullFormatter())
        left.plot([], [], 's', color=AFTER, label='accepted')
        left.plot([], [], 's', color=_REJECTED_COLOR, label='refused')
        _plot_heldout_rms(right, diagnosis)
        for axis in (left, right):
            axis.invert_yaxis()
            axis.grid(visible=False, axis='y')
        legend_below(figure, left, right)


def _plot_heldout_rms(axis: Axes, diagnosis: Diagnosis) -> None:
    causes = [c for c in diagnosis.causes if math.isfinite(c.heldout_rms_px)]
    names = ['the lens as given', *(f'+ {cause.effect}' for cause in causes), '+ local offsets']
    rms = [
        diagnosis.figures.base.heldout_rms_px,
        *(cause.heldout_rms_px for cause in causes),
        diagnosis.figures.extended.heldout_rms_px,
    ]
    axis.barh(names, rms, color=[BEFORE, *[AFTER] * (len(causes) + 1)], height=0.6)
    for place, value in enumerate(rms):
        axis.annotate(
            f'{value:.3f}',
            (value, place),
            xytext=(5, 0),
            textcoords='offset points',
            va='center',
            fontsize=8.5,
            bbox=_OVER_LINES,
        )
    axis.axvline(math.sqrt(2) * diagnosis.noise_px, color=INK, ls=':', label='noise')
    axis.set(xlabel='rms residual of held-out data / px', title='prediction of held-out data')
    axis.margins(x=0.12)


def draw_target(file: File, maps: list[tuple[str, BoardMap]], narrow: bool = False) -> None:
    """Height maps of boards with their titles, and the landmarks' slides along them."""
    columns = 1 if narrow else min(len(maps), 2)
    rows = math.ceil(len(maps) / columns)
    with picture(file, 4.8 * columns, 4.3 * rows) as figure:
        axes = np.ravel(figure.subplots(rows, columns, squeeze=False))
        for axis in axes[len(maps) :]:
            axis.remove()
        for axis, (title, board) in zip(axes, maps, strict=False):
            _height_map(figure, axis, board)
            axis.set_title(
                f'board {board.board}, {title}:\n'
                f'{1e3 * board.peak_to_valley:.2f} mm from lowest to highest'
            )


def _height_map(figure: Figure, axis: Axes, board: BoardMap) -> None:
    x, y = 1e3 * board.place.T
    height = 1e3 * board.height
    limit = max(float(np.quantile(np.abs(height), 0.99)), 1e-6)
    levels = np.linspace(-limit, limit, 21)
    drawn = axis.tricontourf(x, y, height, levels, cmap='RdBu_r', extend='both')
    axis.plot(x, y, '.', color=INK, ms=2)
    figure.colorbar(drawn, ax=axis, label='height / mm', shrink=0.9, format='%.2f')
    label, longest = 'x on the board / mm', 1e3 * float(np.linalg.norm(board.slide, axis=1).max())
    if longest > 0.02 * limit:
        typical = 1e3 * float(np.quantile(np.linalg.norm(board.slide, axis=1), 0.9))
        larger = round_number(0.06 * float(np.ptp(x)) / typical)
        axis.quiver(
            x,
            y,
            *(1e3 * board.slide.T),
            angles='xy',
            scale_units='xy',
            scale=1 / larger,
            width=0.003,
            color=INK,
        )
        label += f'\narrows: along the board, {larger:g} times as large'
    axis.use_sticky_edges = False  # landmarks at the edge, and their arrows, whole
    axis.margins(0.08)
    axis.set_aspect('equal')
    axis.grid(visible=False)
    axis.set(xlabel=label, ylabel='y / mm')
