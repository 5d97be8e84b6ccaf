"""Pictures of the evidence for each cause, of the target, and of how far the lens is trusted."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.diagnosis import Diagnosis
from fisheye_svp_ros.effects.target_map import BoardMap
from fisheye_svp_ros.reporting.diagnosis_plots import AFTER, BEFORE, INK
from fisheye_svp_ros.reporting.plots import legend_below, picture, round_number

_REJECTED_COLOR = '#cbd5e1'
_OVER_LINES = {'facecolor': 'white', 'edgecolor': 'none', 'pad': 1}  # behind a number
_CELLS = 24  # over the longer side of the image
_TITLES = {
    'noise': 'noise of a point',
    'parameters': 'parameters of the lens',
    'misfit': 'unexplained model error',
}


def draw_evidence(path: Path, diagnosis: Diagnosis) -> None:
    """What each step of the search explains, and how well held-out data are predicted after it."""
    steps = [step for step in diagnosis.trace if step.statistic > 0]
    count = max(len(steps), len(diagnosis.causes) + 2)
    with picture(path, 9.2, 1.6 + 0.3 * count, tight=True) as figure:
        left, right = figure.subplots(1, 2)
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


def draw_target(path: Path, maps: list[tuple[str, BoardMap]]) -> None:
    """Height maps of boards with their titles, and the landmarks' slides along them."""
    columns = min(len(maps), 2)
    rows = math.ceil(len(maps) / columns)
    with picture(path, 4.8 * columns, 4.3 * rows) as figure:
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


def draw_uncertainty(path: Path, diagnosis: Diagnosis) -> None:
    """Draw the standard deviation of a coordinate by noise, parameters and remaining misfit."""
    linear = diagnosis.evaluation.written_model
    data, state = linear.data, linear.state
    parts = diagnosis.evaluation.model_errors.of_points(linear)._asdict()
    uv = data.blocks(data.views.uv).reshape(-1, 2)
    through = np.broadcast_to(data.camera_of[:, None, None].astype(float), data.views.uv.shape)
    camera = data.blocks(through).reshape(-1, 2)[:, 0] * (len(state.lenses) > 1)
    rows = len(state.lenses)
    with picture(path, 12.0, 3.6 * rows) as figure:
        axes = figure.subplots(rows, len(parts), squeeze=False)
        for i, (label, lens) in enumerate(zip(state.labels, state.lenses, strict=True)):
            for axis, (name, part) in zip(axes[i], parts.items(), strict=True):
                square = np.where(camera == i, part.reshape(-1, 2).mean(axis=-1), np.nan)
                image = np.sqrt(_cells(uv, square, (lens.width, lens.height)))
                shown = axis.imshow(
                    image,
                    extent=(-0.5, lens.width - 0.5, lens.height - 0.5, -0.5),
                    cmap='Blues',
                    vmin=0.0,
                    vmax=np.nanmax(image) or 1.0,
                )
                figure.colorbar(shown, ax=axis, label='px', shrink=0.8)
                rms = np.sqrt(np.nanmean(square))
                title = f'{label} {_TITLES[name]}: {rms:.3g} px'.strip()
                axis.set_title(title, fontsize=9.5)
                axis.set(xticks=[], yticks=[])
                axis.grid(visible=False)


def _cells(uv: Array, values: Array, size: tuple[int, int]) -> Array:
    """Return means of values over square cells of the image; NaN where there are none."""
    pitch = max(size) / _CELLS
    known = np.isfinite(values)
    shape = tuple(int(np.ceil(side / pitch)) for side in reversed(size))
    row, column = (
        np.clip((uv[known, i] / pitch).astype(int), 0, shape[1 - i] - 1) for i in (1, 0)
    )
    count, total = np.zeros(shape), np.zeros(shape)
    np.add.at(count, (row, column), 1.0)
    np.add.at(total, (row, column), values[known])
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
