"""Pictures: what is laid out in one pass is neither cut nor drawn over something else."""

from __future__ import annotations

from io import BytesIO

import numpy as np
import pytest
from matplotlib.figure import Figure

from fisheye_svp_ros.reporting.plots import drawing, legend_below


def draw(tight: bool, below: bool) -> Figure:
    with drawing(BytesIO(), 6.0, 4.0, tight=tight) as figure:
        axes = figure.subplots(2, 2)
        for number, axis in enumerate(axes.ravel()):
            axis.plot(np.arange(100.0, 200.0), np.geomspace(1e3, 1e9, 100), label='long ' * number)
            axis.set(xlabel='x', ylabel='two\nlines', title='a title\nof two', yscale='log')
        if below:
            legend_below(figure, axes[1, 1])
    return figure


@pytest.mark.parametrize('below', [False, True])
@pytest.mark.parametrize('tight', [False, True])
def test_nothing_is_cut_or_covered(tight: bool, below: bool) -> None:
    figure = draw(tight, below)
    boxes = [axes.get_tightbbox() for axes in figure.axes]
    boxes += [legend.get_window_extent() for legend in figure.legends]
    whole = figure.bbox.padded(3)  # a constrained layout of Matplotlib 3.6 is not exact
    for box in boxes:
        assert whole.x0 <= box.x0 and box.x1 <= whole.x1
        assert whole.y0 <= box.y0 and box.y1 <= whole.y1
    apart = [(one, other) for i, one in enumerate(boxes) for other in boxes[:i]]
    assert apart and not any(one.overlaps(other) for one, other in apart)


def test_numbers_between_powers_of_ten_have_room_above_the_label() -> None:
    with drawing(BytesIO(), 6.0, 4.0, tight=True) as figure:
        axes = figure.subplots()
        axes.plot([0.17, 0.6], [0.0, 1.0])
        axes.set(xscale='log', xlabel='distance of the landmark / m')
    label = axes.xaxis.label.get_window_extent()
    numbers = [tick for tick in axes.get_xticklabels(which='both') if tick.get_text()]
    assert label.y0 >= figure.bbox.y0 and numbers
    assert all(label.y1 <= tick.get_window_extent().y0 for tick in numbers)


def test_axes_have_few_texts_and_none_to_be_parsed() -> None:
    axes = draw(tight=True, below=False).axes[0]
    low, high = axes.get_xlim()
    assert sum(low <= tick <= high for tick in axes.get_xticks()) <= 7
    texts = [label.get_text() for label in axes.get_yticklabels()]
    assert texts and not any('$' in text for text in texts)
