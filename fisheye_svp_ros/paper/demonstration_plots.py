"""Pictures of the demonstration: its errors beside the published ones, its residuals."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.patches import Circle, Rectangle
from matplotlib.ticker import LogLocator

from fisheye_svp_ros.io.decoding import columns
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.recording import ResidualSet
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.paper.demonstration import DemoRow
from fisheye_svp_ros.reporting.plots import legend_below, picture
from fisheye_svp_ros.reporting.style import FAINT, OURS, PUBLISHED, round_number

_TITLES = {
    'localization': 'Localization: error along the axis',
    'calibration': 'Stereo calibration: error of the left camera',
    'depth': 'Stereo depth: mean error (Error3)',
}


def draw_comparison(path: Path, rows: Sequence[DemoRow]) -> None:
    """Draw the errors of the demo beside the published ones: a column a task, a row a lens."""
    lenses = list(dict.fromkeys(row.lens for row in rows))
    with picture(path, 11.0, 1.2 + 2.6 * len(lenses)) as figure:
        axes = figure.subplots(len(lenses), len(_TITLES), squeeze=False)
        for line, lens in zip(axes, lenses, strict=True):
            for axis, (task, title) in zip(line, _TITLES.items(), strict=True):
                lens_rows = [row for row in rows if (row.lens, row.task) == (lens, task)]
                _draw_errors(axis, lens_rows)
                axis.set_title(f'{title}\n{lens}' if lens == lenses[0] else lens, loc='left')
                if lens == lenses[-1]:
                    axis.set_xlabel('mm')
        legend_below(figure, *axes[0])


def _draw_errors(axis: Any, rows: Sequence[DemoRow]) -> None:
    place = np.arange(len(rows))[::-1]
    ours = 1e3 * np.array([row.error for row in rows])
    low, high = 1e3 * np.array([row.published_error for row in rows]).T
    if rows[0].task == 'depth':
        axis.axvspan(
            low[0], high[0], color=PUBLISHED, alpha=0.15, linewidth=0, label='published range'
        )
        axis.set_xscale('log')
        axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.xaxis.set_minor_formatter('')
    else:
        axis.hlines(place, ours, low, color=FAINT, linewidth=1.5)
        axis.plot(low, place, 'o', color=PUBLISHED, label='published', fillstyle='none')
        axis.axvline(0.0, color='#808890', linewidth=0.8)
    axis.plot(ours, place, 'o', color=OURS, label='this package', markersize=5)
    axis.set_yticks(place, [f'{row.where} {row.radius:g} m' for row in rows])
    axis.grid(visible=False, axis='y')


def draw_residual_fields(path: Path, fields: Sequence[ResidualSet]) -> None:
    """Draw the residuals of localization over the image, magnified (figure 6): a row a lens.

    The scenarios of all of them name lens and radius.
    """
    names = list(dict.fromkeys(field.tags['lens'] for field in fields))
    count = max(sum(field.tags['lens'] == name for field in fields) for name in names)
    with picture(path, 3.4 * count, 0.3 + 3.7 * len(names)) as figure:
        axes = figure.subplots(len(names), count, squeeze=False)
        for line, name in zip(axes, names, strict=True):
            lens, lens_fields = (
                load_lens(lens_path(name)),
                [f for f in fields if f.tags['lens'] == name],
            )
            for axis, field in zip(line, lens_fields, strict=False):
                _draw_residuals(axis, field, lens)


def _draw_residuals(axis: Any, field: ResidualSet, lens: Lens) -> None:
    uv, residual = columns(field.points, ('u', 'v')), columns(field.points, ('du', 'dv'))
    edge, _ = lens.image_height.value_and_slope(np.array(lens.max_incidence))
    axis.add_patch(Circle((lens.cx, lens.cy), lens.fx * float(edge), fill=False, color=FAINT))
    size = np.linalg.norm(residual, axis=-1)
    # The longest residual takes an eighth of the image, whatever it is.
    factor = round_number(lens.width / 8 / size.max())
    axis.quiver(
        *uv.T,
        *(factor * residual.T),
        angles='xy',
        scale_units='xy',
        scale=1,
        color=OURS,
        width=0.005,
    )
    axis.plot(*uv.T, 'o', markersize=3, color='#404850')
    corner, margin = (-0.5, -0.5), 0.1 * lens.width
    axis.add_patch(Rectangle(corner, lens.width, lens.height, fill=False, color=FAINT))
    axis.set(xlim=(-margin, lens.width + margin), ylim=(lens.height + margin, -margin))
    axis.set_aspect('equal')
    axis.axis('off')
    axis.set_title(
        f'{field.tags["lens"]}, landmarks at {float(field.tags["radius"]):g} m\n'
        f'residual {size.mean():.2g} px on average, x {factor:g}',
        loc='left',
    )
