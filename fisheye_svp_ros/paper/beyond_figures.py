"""Pictures of what the paper did not look at: other solvers, and noise."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.ticker import LogLocator

from fisheye_svp_ros.paper.beyond import NOISES, Crossings
from fisheye_svp_ros.paper.evaluation import Evaluation
from fisheye_svp_ros.paper.figures import COLOURS, INK, NAMES
from fisheye_svp_ros.paper.tables import LENSES
from fisheye_svp_ros.reporting.plots import legend_below, picture

_ZERO = 1e-6  # below it an error is nought but rounding
_LINES = ('-', '--', ':')
_SUMMARIES: dict[str, Callable[[Evaluation], float]] = {
    'Localization: mean |z| / mm': lambda e: float(np.abs(e.localization[..., 2]).mean()),
    'Stereo calibration:\nmean position error / mm':
        lambda e: float(np.linalg.norm(e.calibration[..., :3], axis=-1).mean()),
    'Epipolar curves: mean Error2 / px': lambda e: float(e.panels('error2_px').mean()),
    'Stereo depth: mean Error3 / mm': lambda e: float(1e3 * e.panels('error3_m').mean()),
}


def draw_solvers(path: Path, found: Mapping[str, Mapping[str, Evaluation]]) -> None:
    """Draw mean errors of all solvers, a line a solver, a mark a lens."""
    place = np.arange(len(found))[::-1]
    with picture(path, 11.0, 4.2) as figure:
        axes = figure.subplots(1, len(_SUMMARIES), sharey=True)
        for axis, (title, summary) in zip(axes, _SUMMARIES.items(), strict=True):
            for k, name in enumerate(LENSES):
                values = np.array([summary(by_lens[name]) for by_lens in found.values()])
                drawn = np.where(values > _ZERO, values, np.nan)
                axis.plot(drawn, place, 'os'[k], color=COLOURS[name], label=NAMES[name])
            axis.set_title(title, fontsize=9)
            axis.set_xscale('log')
            axis.xaxis.set_major_locator(LogLocator(numticks=6))
            low = axis.get_xlim()[0]
            exact = list(found).index('ShiftVP')
            axis.annotate('none', (low, place[exact]), xytext=(4, 0), va='center', color=INK,
                          textcoords='offset points', fontsize=8)
        axes[0].set_yticks(place, list(found))
        legend_below(figure, axes[0])


def draw_crossings(path: Path, crossings: Sequence[Crossings]) -> None:
    """Draw the range at which an SVP error drops under the noise, against the noise."""
    quantities = list(dict.fromkeys(c.quantity for c in crossings))
    titles = {'position': 'z of localization', 'residual': 'residual of localization',
              'Error2': 'Error2'}
    with picture(path, 11.0, 4.2) as figure:
        axes = figure.subplots(1, len(quantities), sharey=True)
        for axis, quantity in zip(axes, quantities, strict=True):
            for name in LENSES:
                mine = [c for c in crossings if (c.lens, c.quantity) == (name, quantity)]
                for line, one in zip(_LINES, mine, strict=True):
                    axis.plot(NOISES, np.where(one.ranges > 0, one.ranges, np.nan), line,
                              color=COLOURS[name], label=f'{NAMES[name]}, {one.where}',
                              marker='o', markersize=3)
            axis.set(title=titles[quantity], xlabel='noise of u and of v / px', yscale='log')
            axis.legend(fontsize=7.5)
        axes[0].set_ylabel('SVP error is under the noise beyond / m')
        axes[0].yaxis.set_major_formatter('{x:g}')
