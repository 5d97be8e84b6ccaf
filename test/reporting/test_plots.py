"""Pictures: what is laid out in one pass is neither cut nor drawn over something else."""

from __future__ import annotations

from io import BytesIO
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.quiver import QuiverKey

from fisheye_svp_ros import reporting
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.reporting.diagnosis_plots import draw_arrows
from fisheye_svp_ros.reporting.plots import NARROW, drawing, legend_below, panels
from fisheye_svp_ros.reporting.ray_plots import draw_ray_map
from fisheye_svp_ros.solve.ray_errors import RayMap

pytestmark = pytest.mark.usefixtures('drawn')
TEMPLATES = Path(reporting.__file__).parent / 'templates'


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


@pytest.mark.parametrize('typical', [1e-4, 0.17, 123.0])
def test_the_key_of_arrows_lies_whole_inside_the_picture(typical: float) -> None:
    """Half of "0.2 px" was cut by the upper edge: arrows had no scale."""
    with drawing(BytesIO(), 9.2, 3.6) as figure:
        axis = figure.subplots(1, 2)[0]
        uv = np.random.default_rng(1).uniform((0, 0), (640, 480), (50, 2))
        draw_arrows(axis, uv, typical * np.ones((50, 2)), typical, 19.0, 'C0')
        axis.set(xlim=(0, 640), ylim=(480, 0), aspect='equal')
        axis.set_title('residuals', loc='left')
    (key,) = axis.findobj(QuiverKey)
    box = key.text.get_window_extent()
    assert key.text.get_text().endswith(' px') and box.width > 0
    assert figure.bbox.x0 <= box.x0 and box.x1 <= figure.bbox.x1
    assert figure.bbox.y0 <= box.y0 and box.y1 <= figure.bbox.y1


@pytest.mark.parametrize('name', ['diagnosis', 'calibration', 'blocks'])
def test_on_a_telephone_tables_scroll_and_pictures_are_as_wide_as_it(name: str) -> None:
    """A column was one letter wide, and the text of pictures 3 px high."""
    page = (TEMPLATES / f'{name}.html').read_text()
    narrow = page.partition('@media (max-width: 600px)')[2].partition('\n')[0]
    if name == 'blocks':  # its pictures have no narrow form
        assert 'figure { overflow-x: auto; }' in narrow
        assert 'figure img { max-width: none; width: 760px; }' in narrow
    elif name == 'calibration':  # panels as wide as a telephone; the one that is not scrolls
        assert '.panels img { flex-basis: 100%; }' in narrow
        assert '.panels.one { overflow-x: auto;' in page
    else:
        assert page.count('<img') - page.count('<img alt="{{ photo.name }}"') == page.count(
            '<source media="(max-width: 600px)"'
        )
    if 'table { display: block;' in page:
        assert 'max-width: 100%; overflow-x: auto; overflow-wrap: normal; }' in page
        assert 'td { min-width: 8em; }' in narrow and 'th.n { white-space: normal;' in narrow
    else:
        assert '.wide { overflow-x: auto; }' in page
        assert page.count('<table') == page.count('<div class="wide"><table')
        assert 'overflow-wrap: anywhere' not in page.partition('body {')[2].partition('}')[0]


def test_the_two_panels_of_a_row_lie_below_each_other_in_a_narrow_picture() -> None:
    with drawing(BytesIO(), NARROW, 6.0) as figure:
        axes = panels(figure, 2, narrow=True, heights=[1.0, 3.0])
    boxes = [axis.bbox for axis in axes.ravel()]
    assert axes.shape == (2, 2) and len({round(box.x0) for box in boxes}) == 1
    assert all(upper.y0 > lower.y1 for upper, lower in pairwise(boxes))
    assert boxes[3].height == pytest.approx(3 * boxes[0].height, rel=0.1)


def uncertain_rays(sd: Array) -> RayMap:
    u, v = np.linspace(0, 639, 33), np.linspace(0, 479, 25)
    return RayMap(u, v, sd, (0.3, 5.0), np.random.default_rng(1).uniform(100, 300, (40, 2)))


@pytest.mark.parametrize(('low', 'high'), [(1e-5, 1e-5), (2e-4, 0.3), (1e-9, 1.0)])
def test_a_map_of_rays_shows_the_whole_image_and_its_points(low: float, high: float) -> None:
    sd = np.geomspace(low, high, 2 * 25 * 33).reshape(2, 25, 33)
    sd[:, 0, 0] = np.nan  # a corner without rays
    with drawing(BytesIO(), NARROW, 6.6) as figure:
        draw_ray_map(figure, panels(figure, 1, narrow=True)[0], uncertain_rays(sd), 'left')
    near, far, bar = figure.axes
    for axis, title in ((near, 'left at 0.3 m'), (far, 'left at 5 m')):
        assert axis.get_title() == title
        assert axis.get_xlim() == (0, 639) and axis.get_ylim() == (479, 0)
        assert len(axis.lines[0].get_xdata()) == 40
    levels = [float(tick.get_text().replace('\u2212', '-')) for tick in bar.get_yticklabels()]
    assert 2 <= len(levels) <= 9 and levels[0] <= max(1e3 * low, 1e-6)
    assert all(1.9 < b / a < 2.6 for a, b in pairwise(levels))


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
