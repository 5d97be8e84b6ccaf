"""Pictures of tables: errors against what was swept, heat maps, residuals beside their noise."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.colors import LogNorm

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.io.clouds import Points
from fisheye_svp_ros.reporting.plots import OURS, PUBLISHED, legend_below, picture
from fisheye_svp_ros.reporting.runs_plot import draw_runs
from fisheye_svp_ros.study.dependence import (
    Table,
    curves,
    grid,
    is_number,
    noise_spreads,
    swept_parameters,
)

_COLOURS = 'viridis'
_HUES, _LINES = 8, ('-', '--', ':', '-.')  # colours and lines that can be told apart
_TICKS = 12
_CLOUD = 20_000  # points in a scatter plot
_UNITS = {'radius': 'm', 'baseline': 'm', 'vergence': 'rad', 'noise_px': 'px'}
_NAMES = {'radius': 'range of the landmarks', 'shift_scale': 'viewpoint shift, relative',
          'noise_px': 'noise', 'vergence': 'inward turn of the left camera'}


class Shown(NamedTuple):
    """A metric for people: column, title and the factor into the unit that the title names."""

    column: str
    title: str
    factor: float


_METRICS = (
    Shown('localizer.position_error_m', 'Localization: position error, mm', 1e3),
    Shown('localizer.axis_error_rad', 'Localization: axis error, deg', np.degrees(1.0)),
    Shown('localizer.rms_px', 'Localization: rms residual, px', 1.0),
    Shown('stereo_calibrator.position_error_m', 'Calibration: position error, mm', 1e3),
    Shown('stereo_calibrator.axis_error_rad', 'Calibration: axis error, deg', np.degrees(1.0)),
    Shown('stereo_depth.error3_m', 'Depth: mean error (Error3), mm', 1e3),
    Shown('stereo_depth.error2_px', 'Depth: epipolar distance (Error2), px', 1.0),
)


def draw_table(table: Table, folder: Path) -> list[Path]:
    """Draw whatever a table is good for; return the files."""
    files = []
    shown = [m for m in _METRICS if m.column in table]
    swept = swept_parameters(table)
    numbers = [name for name in swept if is_number(table, name)]
    for x in numbers if shown else ():
        files.append(folder / f'error_against_{x}.png')
        _draw_curves(table, shown, x, [name for name in swept if name != x], files[-1])
    if len(numbers) >= 2 and shown:
        y, x = sorted(sorted(numbers, key=lambda n: -len(set(table[n])))[:2], key=numbers.index)
        files.append(folder / f'heat_map_{y}_{x}.png')
        others = [name for name in swept if name not in (x, y)]
        _draw_grids(table, shown, x, y, others, files[-1])
    if 'localizer.rms_px' in table and any(table.get('noise_px', ())):
        files.append(folder / 'residuals_and_noise.png')
        _draw_spreads(table, _hue(table, [name for name in swept if name != 'noise_px']),
                      files[-1])
    return files + draw_runs(table, folder / 'runs.png')


def _hue(table: Table, names: Sequence[str]) -> str | None:
    """Return the parameter with fewest values to tell curves apart by."""
    few = [name for name in names if len(set(table[name])) <= _HUES]
    return min(few, key=lambda name: len(set(table[name])), default=None)


def _draw_curves(
    table: Table, shown: Sequence[Shown], x: str, others: Sequence[str], path: Path
) -> None:
    """Draw an error over x: the colour tells one other parameter, the line style a second."""
    by = _told_apart(table, others)
    merged = [name for name in others if name not in by]
    with picture(path, 4.2 * min(len(shown), 4), 0.5 + 3.6 * -(-len(shown) // 4)) as figure:
        axes = figure.subplots(-(-len(shown) // 4), min(len(shown), 4), squeeze=False).ravel()
        for axis, metric in zip(axes, shown, strict=False):
            found = curves(table, metric.column, x, by)
            looks = [list(dict.fromkeys(c.key[i] for c in found)) for i in range(len(by))]
            for curve in found:
                place = [values.index(v) for values, v in zip(looks, curve.key, strict=True)]
                colour = _hues(len(looks[0]))[place[0]] if place else OURS
                style = _LINES[place[1]] if len(place) > 1 else '-'
                middle, low, high = (metric.factor * values for values in curve[2:])
                if not merged:
                    axis.fill_between(curve.x, low, high, color=colour, alpha=0.15, linewidth=0)
                axis.plot(curve.x, middle, style, marker='.', color=colour, label=', '.join(
                    f'{name} {_text(value)}' for name, value in zip(by, curve.key, strict=True)
                ))
            _scale(axis, found[0].x, metric.factor * np.concatenate([c.median for c in found]))
            axis.set_xlabel(_label(x))
            axis.set_title(metric.title, loc='left')
        for axis in axes[len(shown):]:
            axis.remove()
        if by:
            legend_below(figure, axes[0])
        what = f'median over all {", ".join(merged)}' if merged else 'median; band: 5 to 95 %'
        figure.suptitle(what, x=0.01, ha='left', fontsize=8)


def _told_apart(table: Table, names: Sequence[str]) -> list[str]:
    """Return up to two parameters that colours and line styles can tell apart."""
    few = sorted((name for name in names if len(set(table[name])) <= _HUES),
                 key=lambda name: -len(set(table[name])))[:2]
    return few if len(few) < 2 or len(set(table[few[1]])) <= len(_LINES) else few[:1]


def _text(value: Any) -> str:
    return f'{value:g}' if isinstance(value, float) else str(value)


def _draw_grids(
    table: Table, shown: Sequence[Shown], x: str, y: str, others: Sequence[str], path: Path
) -> None:
    with picture(path, 4.4 * min(len(shown), 4), 3.8 * -(-len(shown) // 4)) as figure:
        axes = figure.subplots(-(-len(shown) // 4), min(len(shown), 4), squeeze=False).ravel()
        for axis, metric in zip(axes, shown, strict=False):
            found = grid(table, metric.column, x, y)
            values = np.ma.masked_invalid(metric.factor * found.median)
            positive = values.compressed()[values.compressed() > 1e-6]
            wide = positive.size and positive.max() > 30 * positive.min()
            norm = LogNorm(positive.min(), positive.max()) if wide else None
            mesh = axis.imshow(values, origin='lower', aspect='auto', cmap=_COLOURS, norm=norm)
            for set_ticks, cells in ((axis.set_xticks, found.x), (axis.set_yticks, found.y)):
                step = -(-len(cells) // _TICKS)
                set_ticks(range(0, len(cells), step), [f'{cell:g}' for cell in cells[::step]])
            axis.tick_params(axis='x', rotation=45)
            axis.grid(visible=False)
            axis.set(xlabel=_label(x), ylabel=_label(y))
            axis.set_title(metric.title, loc='left')
            figure.colorbar(mesh, ax=axis)
        for axis in axes[len(shown):]:
            axis.remove()
        over = f', over all {", ".join(others)}' if others else ''
        figure.suptitle(f'median of the magnitude{over}', x=0.01, ha='left', fontsize=8)


def _draw_spreads(table: Table, by: str | None, path: Path) -> None:
    spreads = noise_spreads(table, by)
    with picture(path, 4.0 * min(len(spreads), 4), 3.2 * -(-len(spreads) // 4)) as figure:
        axes = figure.subplots(-(-len(spreads) // 4), min(len(spreads), 4), squeeze=False).ravel()
        for axis, spread in zip(axes, spreads, strict=False):
            edges = np.linspace(0.0, spread.at[-1], 61)
            beyond = np.mean(spread.ratio > edges[-1])
            axis.hist(spread.ratio, edges, weights=np.full(len(spread.ratio), 1 / len(spread.ratio)
                      / (edges[1] - edges[0])), color=OURS, label='localizations')
            axis.plot(spread.at, spread.density, color=PUBLISHED, label='noise alone')
            more = f', {beyond:.0%} farther right' if beyond else ''
            axis.set_title(f'{spread.label}{more}', loc='left')
            axis.set(xlabel='rms residual / noise', yticks=[], xlim=(0.0, edges[-1]))
        for axis in axes[len(spreads):]:
            axis.remove()
        legend_below(figure, axes[0])


def draw_residuals(clouds: Sequence[Points], path: Path) -> None:
    """Draw residuals (clouds.RESIDUALS) against the incidence angle and the range."""
    points = np.concatenate(clouds)
    points = points[::-(-len(points) // _CLOUD)]
    size = np.hypot(points['du'], points['dv'])
    with picture(path, 8.4, 3.6) as figure:
        axes = figure.subplots(1, 2, sharey=True)
        for axis, x, label in (
            (axes[0], np.degrees(points['theta']), 'incidence angle, deg'),
            (axes[1], points['range'], 'range, m'),
        ):
            axis.plot(x, size, '.', color=OURS, alpha=0.4, markersize=4, markeredgewidth=0)
            axis.set_xlabel(label)
        if points['range'].min() > 0 and np.ptp(np.log10(points['range'])) >= 1:
            axes[1].set_xscale('log')
            axes[1].tick_params(axis='x', which='minor', labelbottom=False)
        axes[0].set_title('Residual of image points, px', loc='left')


def _hues(count: int) -> list[Any]:
    from matplotlib import colormaps

    if count == 1:
        return [OURS]
    return [colormaps[_COLOURS](part) for part in np.linspace(0.0, 0.85, count)]


def _scale(axis: Any, x: Sequence[float], y: Array) -> None:
    """Take logarithms where the values span a decade and more; a rounding error is no error."""
    if min(x) > 0 and max(x) >= 10 * min(x):
        axis.set_xscale('log')
        if len(x) <= _TICKS:
            axis.set_xticks(x, [f'{value:g}' for value in x])
            axis.tick_params(axis='x', which='minor', bottom=False, labelbottom=False)
    known = y[np.isfinite(y) & (y > 1e-6)]
    if known.size and known.max() > 30 * known.min():
        axis.set_yscale('log')
        axis.set_ylim(known.min() / 2, known.max() * 2)


def _label(name: str) -> str:
    unit = _UNITS.get(name)
    return _NAMES.get(name, name) + (f', {unit}' if unit else '')
