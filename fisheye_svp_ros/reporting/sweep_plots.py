"""Pictures of tables: errors against what was swept, heat maps, residuals beside their noise."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.ticker import LogLocator

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.io.decoding import Points
from fisheye_svp_ros.io.parameters import rows
from fisheye_svp_ros.io.recording import STAMP
from fisheye_svp_ros.reporting.plots import legend_below, picture
from fisheye_svp_ros.reporting.style import OURS, PUBLISHED
from fisheye_svp_ros.reporting.terminal import draw_or_note
from fisheye_svp_ros.reporting.wording.metrics import metric_text
from fisheye_svp_ros.simulate.scenario import SCALARS, Scenario
from fisheye_svp_ros.study.dependence import (
    curves,
    grid,
    is_number,
    noise_spreads,
    swept_parameters,
    value_text,
)
from fisheye_svp_ros.study.solutions import DRAWN_METRICS
from fisheye_svp_ros.study.sweep import SCENARIO_COLUMNS, SOLVERS

if TYPE_CHECKING:
    from pandas import DataFrame

_COLORS = 'viridis'
_HUES, _LINES = 4, ('-', '--')  # what can be told apart in one picture
_COLUMNS = 4  # axes beside each other
_TICKS, _LABELS = 12, 6
_SPREAD_COLUMNS = ('noise_px', 'localizer.rms_px', 'localizer.points')
_CLOUD = 20_000  # points in a scatter plot
_UNITS = {row.name: row.unit for row in rows(Scenario)}
_NAMES = {
    'radius': 'range of the landmarks',
    'shift_scale': 'viewpoint shift, relative',
    'noise_px': 'noise',
    'vergence': 'inward turn of the left camera',
}


class PlottedMetric(NamedTuple):
    """A metric for people: column, title and the factor into the unit that the title names."""

    column: str
    title: str
    factor: float


def _plotted_metrics(table: DataFrame) -> list[PlottedMetric]:
    """Return those of the solvers of a sweep that a table has."""
    return [
        PlottedMetric(
            column, f'{node.replace("_", " ").capitalize()}: {text.title()}', text.factor
        )
        for node in SOLVERS
        for name in DRAWN_METRICS
        if (column := f'{node}.{name}') in table and (text := metric_text(name))
    ]


def is_drawn(column: str) -> bool:
    """Say whether a column is any use to `draw_table`."""
    metric = column.rpartition('.')[2]
    return (
        column in (*SCALARS, *SCENARIO_COLUMNS, STAMP, *_SPREAD_COLUMNS)
        or metric in DRAWN_METRICS
        or metric == 'views'
    )


def draw_table(table: DataFrame, folder: Path) -> list[Path]:
    """Draw whatever a table is good for; return the files."""
    drawings: list[tuple[str, Callable[..., None], tuple[Any, ...]]] = []
    metrics = _plotted_metrics(table)
    swept = swept_parameters(table)
    numbers = [name for name in swept if is_number(table, name)]
    for x in numbers if metrics else ():
        parameters = [name for name in swept if name != x]
        drawings.append((f'error_against_{x}', _draw_curves, (table, metrics, x, parameters)))
    if len(numbers) >= 2 and metrics:
        y, x = sorted(sorted(numbers, key=lambda n: -table[n].nunique())[:2], key=numbers.index)
        parameters = [name for name in swept if name not in (x, y)]
        drawings.append((f'heat_map_{y}_{x}', _draw_grids, (table, metrics, x, y, parameters)))
    if {*_SPREAD_COLUMNS} <= {*table} and table['noise_px'].any():
        parameters = [name for name in swept if name != 'noise_px']
        few = [name for name in parameters if table[name].nunique() <= 2 * _HUES]
        fewest = min(few, key=lambda name: table[name].nunique(), default=None)
        drawings.append(('residuals_and_noise', _draw_spreads, (table, fewest)))
    if runs := _compared_runs(table):
        drawings.append(('runs', _draw_runs, (table, runs)))
    return [
        path
        for name, draw, arguments in drawings
        if draw_or_note(path := folder / f'{name}.png', draw, *arguments)
    ]


@contextmanager
def _axes(path: Path, count: int, width: float, height: float) -> Iterator[Any]:
    """Yield a figure and as many axes as are needed, each of a size in inches."""
    columns, lines = min(count, _COLUMNS), -(-count // _COLUMNS)
    with picture(path, width * columns, 0.4 + height * lines) as figure:
        axes = figure.subplots(lines, columns, squeeze=False).ravel()
        yield figure, axes[:count]
        for axis in axes[count:]:
            axis.remove()


def _draw_curves(
    path: Path, table: DataFrame, metrics: Sequence[PlottedMetric], x: str, others: Sequence[str]
) -> None:
    """Draw an error over x: the color tells one other parameter, the line style a second."""
    by = sorted(others, key=lambda name: -table[name].nunique())[-2:]
    looks = [
        _pick_evenly(table[name].dropna().unique().tolist(), most)
        for name, most in zip(by, (_HUES, len(_LINES)), strict=False)
    ]
    merged = [name for name in others if name not in by]
    with _axes(path, len(metrics), 4.2, 3.6) as (figure, axes):
        for axis, metric in zip(axes, metrics, strict=True):
            error_curves = [
                curve
                for curve in curves(table, metric.column, x, by)
                if all(v in values for v, values in zip(curve.key, looks, strict=True))
            ]
            for curve in error_curves:
                place = [values.index(v) for values, v in zip(looks, curve.key, strict=True)]
                color = _hues(len(looks[0]))[place[0]] if place else OURS
                middle, low, high = (metric.factor * values for values in curve[2:])
                if not merged:
                    axis.fill_between(curve.x, low, high, color=color, alpha=0.15, linewidth=0)
                axis.plot(
                    curve.x,
                    middle,
                    _LINES[place[1]] if len(place) > 1 else '-',
                    marker='.',
                    color=color,
                    label=', '.join(
                        f'{name} {value_text(v)}' for name, v in zip(by, curve.key, strict=True)
                    ),
                )
            _scale_axis(
                axis,
                error_curves[0].x,
                metric.factor * np.concatenate([c.median for c in error_curves]),
            )
            axis.set_xlabel(_label(x))
            axis.set_title(metric.title, loc='left')
        if by:
            legend_below(figure, axes[0])
        what = f'median over all {", ".join(merged)}' if merged else 'median; band: 5 to 95 %'
        thinned = [
            f'{len(values)} of {count} values of {name}'
            for name, values in zip(by, looks, strict=True)
            if len(values) < (count := table[name].nunique())
        ]
        figure.suptitle('; '.join([what, *thinned]), x=0.01, ha='left', fontsize=8)


def _pick_evenly(values: list[Any], most: int) -> list[Any]:
    """Return the first, the last and what lies evenly between, `most` in all."""
    places = np.linspace(0, len(values) - 1, min(most, len(values))).round().astype(int)
    return [values[i] for i in places]


def _draw_grids(
    path: Path,
    table: DataFrame,
    metrics: Sequence[PlottedMetric],
    x: str,
    y: str,
    others: Sequence[str],
) -> None:
    with _axes(path, len(metrics), 4.4, 3.6) as (figure, axes):
        for axis, metric in zip(axes, metrics, strict=True):
            columns, lines, median = grid(table, metric.column, x, y)
            values = np.ma.masked_invalid(metric.factor * median)
            positive = values.compressed()[values.compressed() > 1e-6]
            wide = positive.size and positive.max() > 30 * positive.min()
            norm = LogNorm(positive.min(), positive.max()) if wide else None
            mesh = axis.imshow(values, origin='lower', aspect='auto', cmap=_COLORS, norm=norm)
            for set_ticks, cells in ((axis.set_xticks, columns), (axis.set_yticks, lines)):
                step = -(-len(cells) // _TICKS)
                set_ticks(range(0, len(cells), step), [f'{cell:g}' for cell in cells[::step]])
            axis.tick_params(axis='x', rotation=45)
            axis.grid(visible=False)
            axis.set(xlabel=_label(x), ylabel=_label(y))
            axis.set_title(metric.title, loc='left')
            figure.colorbar(mesh, ax=axis)
        over = f', over all {", ".join(others)}' if others else ''
        figure.suptitle(f'median of the magnitude{over}', x=0.01, ha='left', fontsize=8)


def _draw_spreads(path: Path, table: DataFrame, by: str | None) -> None:
    spreads = noise_spreads(table, by)
    with _axes(path, len(spreads), 4.0, 2.8) as (figure, axes):
        for axis, spread in zip(axes, spreads, strict=True):
            edges = np.linspace(0.0, spread.at[-1], 61)
            axis.hist(
                spread.ratio,
                edges,
                weights=np.full(len(spread.ratio), 1 / len(spread.ratio) / (edges[1] - edges[0])),
                color=OURS,
                label='localizations',
            )
            axis.plot(spread.at, spread.density, color=PUBLISHED, label='noise alone')
            beyond = np.mean(spread.ratio > edges[-1])
            if beyond:
                axis.annotate(
                    f'{100 * beyond:.0f} % are above {edges[-1]:g}',
                    (0.98, 0.92),
                    xycoords='axes fraction',
                    ha='right',
                )
            axis.set_title(spread.label, loc='left')
            axis.set(xlabel='rms residual / noise', yticks=[], xlim=(0.0, edges[-1]))
        legend_below(figure, axes[0])


def draw_residuals(path: Path, clouds: Sequence[Points], lenses: Sequence[str]) -> None:
    """Draw residuals (io.decoding.RESIDUALS) against the incidence angle and the range.

    lenses: of each cloud, told apart by color; '' where it is not known.
    """
    names = list(dict.fromkeys(lenses))
    count = max(1, _CLOUD // len(names))
    with picture(path, 8.4, 3.6) as figure:
        axes = figure.subplots(1, 2, sharey=True)
        nearest, farthest = np.inf, 0.0
        for name, color in zip(names, _hues(len(names)), strict=True):
            points = np.concatenate(
                [cloud for cloud, lens in zip(clouds, lenses, strict=True) if lens == name]
            )
            points = points[:: -(-len(points) // count)]
            size = np.hypot(points['du'], points['dv'])
            for axis, x in zip(axes, (np.degrees(points['theta']), points['range']), strict=True):
                axis.plot(
                    x,
                    size,
                    '.',
                    color=color,
                    alpha=0.6,
                    markersize=4,
                    markeredgewidth=0,
                    label=name,
                )
            nearest = min(nearest, points['range'].min())
            farthest = max(farthest, points['range'].max())
        if 0 < 10 * nearest <= farthest:
            axes[1].set_xscale('log')
            axes[1].xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes[1].xaxis.set_minor_formatter('')
        axes[0].set(xlabel='incidence angle, deg')
        axes[1].set(xlabel='range, m')
        axes[0].set_title('Residual of image points, px', loc='left')
        if len(names) > 1:
            legend_below(figure, axes[0])


def _hues(count: int) -> list[Any]:
    from matplotlib import colormaps

    if count == 1:
        return [OURS]
    return [colormaps[_COLORS](part) for part in np.linspace(0.0, 0.85, count)]


def _scale_axis(axis: Any, x: Sequence[float], y: Array) -> None:
    """Take logarithms where the values span a decade and more; a rounding error is no error."""
    if min(x) > 0 and max(x) >= 10 * min(x):
        axis.set_xscale('log')
        if len(x) <= _TICKS:
            shown = _pick_evenly(sorted(x), _LABELS)
            axis.set_xticks(shown, [f'{value:g}' for value in shown])
            axis.tick_params(axis='x', which='minor', bottom=False, labelbottom=False)
    positive = y[np.isfinite(y) & (y > 1e-6)]
    if positive.size and positive.max() > 30 * positive.min():
        axis.set_yscale('log')
        axis.set_ylim(positive.min() / 2, positive.max() * 2)


def _label(name: str) -> str:
    return ', '.join(filter(None, (_NAMES.get(name, name), _UNITS.get(name))))


def _compared_runs(table: DataFrame) -> dict[str, list[str]]:
    """Return the columns of each error that several localizers publish; none over no time."""
    posed = [c.rpartition('.')[0] for c in table if c.endswith('.axis_error_rad')]
    localizers = [name for name in posed if f'{name}.views' not in table]  # no calibrator
    if STAMP not in table:
        return {}
    return {
        name: found
        for name in DRAWN_METRICS
        if len(found := [c for n in localizers if (c := f'{n}.{name}') in table]) > 1
    }


def _draw_runs(path: Path, table: DataFrame, runs: Mapping[str, Sequence[str]]) -> None:
    """Draw errors over time, from a tabulated recording."""
    stamp = table[STAMP].to_numpy(float) / 1e9
    with picture(path, 9.2, 0.8 + 2.1 * len(runs)) as figure:
        axes = figure.subplots(len(runs), 1, sharex=True, squeeze=False)[:, 0]
        for axis, (name, nodes) in zip(axes, runs.items(), strict=True):
            text = metric_text(name)
            for node in nodes:
                values = text.factor * table[node].to_numpy(float, na_value=np.nan)
                mean = float(np.nanmean(values))
                axis.plot(
                    stamp - stamp.min(),
                    values,
                    'o-',
                    ms=3,
                    lw=1,
                    label=f'{node.rpartition(".")[0]}, mean {mean:.3g}',
                )
            axis.set(ylabel=text.title(' / '), ylim=(0, None))
            axis.legend(loc='lower right', bbox_to_anchor=(1, 1), ncols=len(nodes), fontsize=8)
        axes[-1].set_xlabel('time / s')
