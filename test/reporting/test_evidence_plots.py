"""Pictures of the evidence."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fisheye_svp_ros.effects.target_map import BoardMap
from fisheye_svp_ros.reporting import evidence_plots
from fisheye_svp_ros.reporting.plots import drawing

pytestmark = pytest.mark.usefixtures('drawn')


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Figures as they are drawn, kept in place of files."""
    kept: list[Figure] = []

    @contextmanager
    def picture(_: Path, width: float, height: float, tight: bool = False) -> Iterator[Figure]:
        with drawing(BytesIO(), width, height, tight=tight) as figure:
            kept.append(figure)
            yield figure

    monkeypatch.setattr(evidence_plots, 'picture', picture)
    return kept


@pytest.mark.parametrize(('across', 'along'), [(10, 7), (6, 9), (5, 5)])
def test_the_map_of_a_target_shows_all_of_it_and_says_how_large_arrows_are(
    across: int, along: int, figures: list[Figure]
) -> None:
    grid = np.meshgrid(np.arange(across), np.arange(along))
    place = 0.03 * np.stack(grid, axis=-1).reshape(-1, 2)
    offset = np.random.default_rng(1).normal(size=(len(place), 3)) * 1e-4
    board = BoardMap(0, place, offset[:, 2], offset[:, :2])
    evidence_plots.draw_target(Path(), [('found', board)])
    FigureCanvasAgg(figures[0]).draw()
    axis = figures[0].axes[0]
    assert 'times as large' in axis.get_xlabel()
    ends = axis.transData.transform(1e3 * place)
    inside = [axis.bbox.x0, axis.bbox.y0], [axis.bbox.x1, axis.bbox.y1]
    assert (ends > inside[0]).all() and (ends < inside[1]).all()
    label, ticks = axis.xaxis.label.get_window_extent(), axis.get_xticklabels()
    assert all(label.y1 < tick.get_window_extent().y0 for tick in ticks)


@pytest.mark.parametrize('statistics', [(3.6e6, 2.2e5), (40.0, 15.0), (1e4, 1e4), (700.0,)])
def test_no_tick_label_of_the_evidence_covers_another(
    statistics: tuple[float, ...], figures: list[Figure]
) -> None:
    fit = SimpleNamespace(heldout_rms_px=0.5)
    evidence_plots.draw_evidence(
        Path(),
        SimpleNamespace(  # type: ignore[arg-type]
            causes=[],
            figures=SimpleNamespace(base=fit, extended=fit),
            noise_px=0.1,
            trace=[
                SimpleNamespace(form=f'effect {n}', statistic=value, is_accepted=True)
                for n, value in enumerate(statistics)
            ],
        ),
    )
    canvas = FigureCanvasAgg(figures[0])
    canvas.draw()
    left, right = figures[0].axes
    labels = [
        label.get_window_extent()
        for label in left.get_xticklabels(which='both')
        if label.get_text()
    ]
    places = sorted(
        (box.x0, box.x1)
        for box in labels
        if left.bbox.x0 - 1 <= (box.x0 + box.x1) / 2 <= left.bbox.x1 + 1
    )
    assert places and all(end < start for (_, end), (start, _) in pairwise(places))
    assert left.get_xlim()[0] < min(statistics)
    (line,) = right.lines
    for number in right.texts:  # the line of the noise does not run through them
        box = number.get_bbox_patch()
        assert box is not None and number.get_zorder() > line.get_zorder()
    (legend,) = figures[0].legends
    assert not any(
        axis.get_tightbbox().overlaps(legend.get_window_extent()) for axis in (left, right)
    )
