"""Pictures, as PNG files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine, LayoutEngine
from matplotlib.ticker import AutoLocator, LogFormatter, LogFormatterSciNotation

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.io.files import write_bytes

_STYLE: Any = {
    'font.size': 9.0,
    'axes.titlesize': 10.0,
    'axes.titley': 1.0,  # or every title asks all ticks for their places, twice a picture
    'axes.spines.top': False,
    'axes.spines.right': False,
    'axes.edgecolor': '#808890',
    'axes.grid': True,
    'axes.axisbelow': True,
    'grid.color': '#e6e9ec',
    'grid.linewidth': 0.8,
    'legend.frameon': False,
    'xtick.color': '#404850',
    'ytick.color': '#404850',
}
_LEGEND_COLUMNS = 4
_INTERVALS = 6  # of an axis, at most
NARROW = 4.3  # in, width of a picture that a telephone shows without scaling
_PAD, _TICK_PAD, _LABEL_PAD, _TITLE_PAD = 4.5, 7.0, 4.0, 6.0  # points
_COMPRESSION = {'compress_level': 3}  # files 6 % larger than at 6, in a third of the time


@contextmanager
def picture(
    file: Path | BytesIO, width: float, height: float, tight: bool = False
) -> Iterator[Figure]:
    """Yield a figure of a size, in; write it when the block succeeds; tight: see `drawing`.

    file: a path, or memory for a PNG.
    """
    if isinstance(file, BytesIO):
        with drawing(file, width, height, tight=tight) as figure:
            yield figure
        return
    drawn = BytesIO()
    with drawing(drawn, width, height, file.suffix[1:], tight) as figure:
        yield figure
    write_bytes(file, drawn.getvalue())


def panels(figure: Figure, rows: int, narrow: bool, heights: Sequence[float] | None = None) -> Any:
    """Return axes (rows, 2): the two of a row side by side, or one below the other if narrow.

    heights: of the rows, relative.
    """
    if narrow:
        ratios = None if heights is None else [height for height in heights for _ in range(2)]
        return figure.subplots(2 * rows, 1, height_ratios=ratios).reshape(rows, 2)
    return figure.subplots(rows, 2, squeeze=False, height_ratios=heights)


@contextmanager
def drawing(
    file: BytesIO, width: float, height: float, form: str = 'png', tight: bool = False
) -> Iterator[Figure]:
    """Yield a figure of a size in inches; draw it into memory when the block succeeds.

    tight: the axes are of a regular grid and may have any aspect (`MarginLayout`).
    """
    layout = MarginLayout() if tight else ConstrainedLayoutEngine()
    with mpl.rc_context():
        mpl.rcdefaults()  # a user's own style, with LaTeX say, is not that of these pictures
        mpl.rcParams.update(_STYLE)
        figure = Figure(figsize=(width, height), dpi=150, layout=layout)
        FigureCanvasAgg(figure)
        yield figure
        _simplify_axes(figure)
        # Laid out once: savefig would draw everything once more for that.
        engine = figure.get_layout_engine()
        assert engine is not None
        engine.execute(figure)
        figure.set_layout_engine(None)
        options: Any = {'pil_kwargs': _COMPRESSION} if form == 'png' else {}  # a PDF takes none
        figure.savefig(file, format=form, **options)


class MarginLayout(LayoutEngine):
    """Margins around a grid of axes from the longest text of each side.

    Matplotlib's own engines ask every tick for its place several times: most of a picture's time.
    """

    _adjust_compatible, _colorbar_gridspec = True, True

    def __init__(self) -> None:
        super().__init__()
        self._reserved = {'below': 0.0, 'above': 0.0}

    def set(self, **reserved: float) -> None:
        """Keep room for legends: below, above, in inches."""
        self._reserved |= reserved

    def execute(self, fig: Any) -> None:
        """Place the axes of a figure."""
        specs = [axes.get_subplotspec() for axes in fig.axes]
        rows, columns = specs[0].get_gridspec().get_geometry()
        room = np.zeros((4, rows, columns))
        for axes, spec in zip(fig.axes, specs, strict=True):
            room[:, spec.rowspan.start, spec.colspan.start] = _text_around(axes, fig.dpi)
        left, right, bottom, top = room + _PAD * fig.dpi / 72
        below, above = (self._reserved[side] * fig.dpi for side in ('below', 'above'))
        x = left[:, 0].max(), fig.bbox.width - right[:, -1].max()
        y = below + bottom[-1].max(), fig.bbox.height - above - top[0].max()
        across = (right[:, :-1].max(axis=0) + left[:, 1:].max(axis=0)).max(initial=0.0)
        down = (bottom[:-1].max(axis=1) + top[1:].max(axis=1)).max(initial=0.0)
        fig.subplots_adjust(
            left=x[0] / fig.bbox.width,
            right=x[1] / fig.bbox.width,
            bottom=y[0] / fig.bbox.height,
            top=y[1] / fig.bbox.height,
            wspace=across * columns / (x[1] - x[0] - across * (columns - 1)),
            hspace=down * rows / (y[1] - y[0] - down * (rows - 1)),
        )


def _text_around(axes: Any, dpi: float) -> Array:
    """Return the room (4,) of the text left and right of axes, below and above them, px."""
    renderer, point = axes.figure.canvas.get_renderer(), dpi / 72
    wide, high = _tick_text(axes.xaxis, renderer), _tick_text(axes.yaxis, renderer)
    left, below = high[0], wide[1]
    left += _TICK_PAD * point if left else 0.0
    below += _TICK_PAD * point if below else 0.0
    if axes.get_ylabel():
        left += axes.yaxis.label.get_window_extent(renderer).width + _LABEL_PAD * point
    if axes.get_xlabel():
        below += axes.xaxis.label.get_window_extent(renderer).height + _LABEL_PAD * point
    above = high[1] / 2  # of the number at the end of an axis
    if axes.get_title():
        above = axes.title.get_window_extent(renderer).height + _TITLE_PAD * point
    return np.array([max(left, wide[0] / 2), wide[0] / 2, max(below, high[1] / 2), above])


def _tick_text(axis: Any, renderer: Any) -> Array:
    """Return the largest width and height (2,) of the labels of an axis, px; 0 without any."""
    label = axis.get_major_ticks(1)[0].label1
    if not label.get_visible():
        return np.zeros(2)
    low, high = sorted(axis.get_view_interval())
    font = label.get_fontproperties()
    sizes = [
        renderer.get_text_width_height_descent(text, font, ismath='$' in text)[:2]
        for places, formatter in (
            (axis.get_majorticklocs(), axis.get_major_formatter()),
            (axis.get_minorticklocs(), axis.get_minor_formatter()),
        )
        for text, place in zip(formatter.format_ticks(places), places, strict=True)
        if text and low <= place <= high
    ]
    size = np.max([(0.0, 0.0), *sizes], axis=0)
    return np.asarray(size[::-1] if label.get_rotation() == 90 else size)


def _simplify_axes(figure: Figure) -> None:
    """Have few texts on the axes, and none to be parsed: they are most of what drawing costs."""
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            locator = axis.get_major_locator()
            if isinstance(locator, AutoLocator):
                locator.set_params(nbins=_INTERVALS)
            if axis.get_scale() == 'log':
                axis.set_major_formatter('{x:g}')
                if isinstance(axis.get_minor_formatter(), LogFormatterSciNotation):
                    axis.set_minor_formatter(PlainLogFormatter(minor_thresholds=(1, 0.4)))


class PlainLogFormatter(LogFormatter):
    """Numbers between powers of ten as 0.2, not as 2 x 10^-1."""

    def __call__(self, x: float, pos: Any = None) -> str:
        """Return the label of a tick, '' for those that have none."""
        return f'{x:g}' if super().__call__(x, pos) else ''


def legend_below(figure: Figure, *axes: Any) -> None:
    """Put what axes have to explain below them, each label once."""
    entries = {
        label: handle
        for axis in axes
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)
    }
    columns = min(len(entries), _LEGEND_COLUMNS)
    lines = -(-len(entries) // columns)
    layout: Any = figure.get_layout_engine()
    if isinstance(layout, MarginLayout):
        layout.set(below=0.1 + 0.2 * lines)
    else:
        height = (0.1 + 0.2 * lines) / figure.get_figheight()
        layout.set(rect=(0.0, height, 1.0, 1.0 - height))
    figure.legend(list(entries.values()), list(entries), loc='lower center', ncols=columns)
