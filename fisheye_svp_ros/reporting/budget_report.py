"""The budget of the SVP error, for people: a table, an answer, a picture; and budget.json."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.ticker import LogLocator, NullFormatter

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.reporting.plots import picture
from fisheye_svp_ros.reporting.style import OURS, PUBLISHED
from fisheye_svp_ros.study.budget import QUANTITIES, UNITS, Budget, Point

_LINEAR_AXIS_RATIO = 30.0  # times, from the least to the largest error
DISPLAY_UNITS = {'m': ('mm', 1e3), 'rad': ('deg', 180 / np.pi), 'px': ('px', 1.0)}
_LABELS = {
    'position': 'position of the camera',
    'axis': 'viewing axis',
    'residual': 'mean residual',
    'epipolar': 'epipolar distance',
    'depth': 'stereo points',
}
_YES_NO = {True: 'yes', False: 'no', None: '-'}


class BudgetRequest(NamedTuple):
    """What the user asked for: lens; spread, rad; working range, m; quantities with a limit.

    port: whether the lens is behind one, so that the question is that of its calibration in air;
    own: whether it knows its own errors.
    Where the user states no limit at all, what noise causes is the limit of every quantity.
    """

    lens: str
    spread: float
    working_range: float
    given: frozenset[str]
    port: bool = False
    own: bool = False

    @property
    def model(self) -> str:
        """What is used in place of the lens."""
        return 'the lens in air' if self.port else 'SVP'

    @property
    def header(self) -> tuple[str, ...]:
        """The heads of the table's columns."""
        names = ('its parameters', 'what remains') if self.own else ()
        return (
            'error',
            f'{self.model} causes',
            'noise causes',
            *names,
            'limit',
            'unit',
            'kept',
            'nearest range',
            'largest spread',
        )

    def relevant_points(self, points: Sequence[Point]) -> list[Point]:
        """Return the points that the answer rests on."""
        return [point for point in points if not self.given or point.quantity in self.given]


def budget_rows(points: Sequence[Point], asked: BudgetRequest) -> list[tuple[str, ...]]:
    """Return the table's rows, under the header."""
    table_rows = []
    for point in asked.relevant_points(points):
        unit, factor = DISPLAY_UNITS[UNITS[point.quantity]]
        sizes = (point.parameters, point.misfit) if asked.own else ()
        table_rows.append(
            (
                _LABELS[point.quantity],
                *(
                    f'{factor * value:.3g}' if np.isfinite(value) else '-'
                    for value in (point.error, point.noise, *sizes, point.limit)
                ),
                unit,
                _YES_NO[point.kept],
                f'{point.nearest_range:.2f} m' if np.isfinite(point.nearest_range) else 'nowhere',
                f'{np.degrees(point.largest_spread):.0f} deg'
                if np.isfinite(point.largest_spread)
                else 'nowhere',
            )
        )
    return table_rows


def answer(points: Sequence[Point], asked: BudgetRequest) -> str:
    """Return the answer to whether shift and port may be neglected, as a sentence."""
    where = (
        f'for landmarks within {np.degrees(asked.spread):.0f} degrees of the axis at '
        f'{asked.working_range:g} m'
    )
    judged = asked.relevant_points(points)
    broken = [point for point in judged if point.kept is False]
    unknown = [point for point in judged if point.kept is None]
    if not broken and not unknown:
        return f'Yes: {where} {asked.model} keeps every limit.'
    untold = ' and '.join(_LABELS[part.quantity] for part in unknown) + ' cannot be computed there'
    if not broken:
        return (
            f'Not known: {where} {asked.model} keeps {len(judged) - len(unknown)} of '
            f'{len(judged)} limits; {untold}.'
        )
    worst = max(broken, key=lambda point: point.error / point.limit)
    unit, factor = DISPLAY_UNITS[UNITS[worst.quantity]]
    limit = 'your limit' if asked.given else 'the effect of noise'
    needed = max(point.nearest_range for point in (*broken, *unknown))
    neglected = 'suffices' if asked.port else 'may be neglected'
    remedy = (
        f'it {neglected} from {needed:.2f} m on'
        if np.isfinite(needed)
        else 'it fails at every range up to the largest computed one'
    )
    return (
        f'No: {where} {asked.model} breaks {len(broken)} of {len(judged)} limits; the worst is '
        f'the {_LABELS[worst.quantity]}: {factor * worst.error:.3g} {unit}, '
        f'{worst.error / worst.limit:.1f} times {limit}; with this spread {remedy}'
        + (f'; {untold}.' if unknown else '.')
    )


def negligible(points: Sequence[Point]) -> bool | None:
    """Return whether all limits are kept; None where that cannot be computed."""
    kept = {point.kept for point in points}
    return False if False in kept else None if None in kept else True


def document(budget: Budget, points: Sequence[Point], asked: BudgetRequest) -> dict[str, Any]:
    """Return the mapping of budget.json, SI and px."""
    return {
        'lens': asked.lens,
        'spread_rad': asked.spread,
        'range_m': asked.working_range,
        'negligible': negligible(asked.relevant_points(points)),
        'answer': answer(points, asked),
        'at_point': [
            {
                **point._asdict(),
                'unit': UNITS[point.quantity],
                'limit_is': 'given' if point.quantity in asked.given else 'noise',
            }
            for point in points
        ],
        'spreads_rad': budget.spreads.tolist(),
        'ranges_m': budget.ranges.tolist(),
        'error': {name: budget.error[name].tolist() for name in QUANTITIES},
        'noise': {name: budget.noise[name].tolist() for name in QUANTITIES},
        **{
            part: {name: values.tolist() for name, values in by.items()}
            for part, by in budget.own.items()
        },
    }


def draw(path: Path, budget: Budget, points: Sequence[Point], asked: BudgetRequest) -> None:
    """Draw SVP errors over range and spread, with the line on which each limit is met."""
    with picture(path, 12.5, 6.4) as figure:
        axes = figure.subplots(2, 3)
        for axis, point in zip(axes.flat, points, strict=False):
            unit, factor = DISPLAY_UNITS[UNITS[point.quantity]]
            error = np.ma.masked_invalid(factor * budget.error[point.quantity])
            mesh = axis.pcolormesh(
                budget.ranges,
                np.degrees(budget.spreads),
                error,
                shading='nearest',
                norm=LogNorm(),
                cmap='Blues',
            )
            _label_color_bar(figure.colorbar(mesh, ax=axis, label=unit), error)
            title = f'{_LABELS[point.quantity]}: no limit'
            if point in asked.relevant_points(points):
                _draw_limit(axis, budget, point, point.quantity in asked.given)
                kept = {True: 'kept', False: 'broken', None: 'not known'}[point.kept]
                limit = f'limit {factor * point.limit:.3g} {unit}'
                title = f'{_LABELS[point.quantity]}: {limit}, {kept}'
            axis.plot(
                asked.working_range, np.degrees(asked.spread), '*', color=PUBLISHED, markersize=11
            )
            axis.set_title(title, fontsize=9.5)
            axis.set(xscale='log', xlabel='range / m', ylabel='spread / degree')
            # Limits end at the middles of the outer cells.
            axis.set(xlim=budget.ranges[[0, -1]], ylim=np.degrees(budget.spreads[[0, -1]]))
            axis.grid(visible=False)
        _explain(axes.flat[len(points)], asked)


def _label_color_bar(bar: Any, error: Array) -> None:
    """Write plain numbers beside a logarithmic color bar; 1, 2, 5 where it is short."""
    short = error.max() < _LINEAR_AXIS_RATIO * error.min()
    bar.ax.yaxis.set_minor_locator(LogLocator(subs=(2, 5)))
    bar.ax.yaxis.set_major_formatter('{x:g}')
    bar.ax.yaxis.set_minor_formatter('{x:g}' if short else NullFormatter())


def _draw_limit(axis: Any, budget: Budget, point: Point, given: bool) -> None:
    allowed: Array | float = point.limit if given else budget.noise[point.quantity]
    with np.errstate(divide='ignore', invalid='ignore'):
        excess = np.log(budget.error[point.quantity] / allowed)
    # Beyond where nothing can be solved a limit is not kept either.
    excess = np.where(np.isnan(excess), 1.0, np.maximum(excess, -50.0))
    place = (budget.ranges, np.degrees(budget.spreads))
    axis.contourf(*place, excess, levels=[0, np.inf], colors='none', hatches=['////'])
    axis.contour(*place, excess, levels=[0], colors=OURS, linewidths=1.8)


def _explain(axis: Any, asked: BudgetRequest) -> None:
    axis.axis('off')
    limits = '' if asked.given else '\nLimits: the errors caused by noise.'
    axis.text(
        0.02,
        0.95,
        f'Color: error caused by {asked.model}.\nHatched: above the limit.\nLine: at the limit.\n'
        f'Star: your range and spread.{limits}\n\nSpread: largest incidence angle of the\n'
        'landmarks, which surround the axis.',
        va='top',
        transform=axis.transAxes,
        linespacing=1.5,
        in_layout=False,
    )
