"""Pictures of the evidence."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fisheye_svp_ros.reporting import evidence_plots


@pytest.mark.parametrize('statistics', [(3.6e6, 2.2e5), (40.0, 15.0), (1e4, 1e4), (700.0,)])
def test_no_tick_label_of_the_evidence_covers_another(
    statistics: tuple[float, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    figures: list[Figure] = []

    @contextmanager
    def picture(_: Path, width: float, height: float) -> Iterator[Figure]:
        figures.append(Figure(figsize=(width, height), layout='constrained'))
        yield figures[0]

    monkeypatch.setattr(evidence_plots, 'picture', picture)
    fit = SimpleNamespace(heldout_rms_px=0.5)
    evidence_plots.draw_evidence(Path(), SimpleNamespace(  # type: ignore[arg-type]
        causes=[], base=fit, extended=fit, noise_px=0.1,
        trace=[SimpleNamespace(effect=f'effect {n}', statistic=value, accepted=True)
               for n, value in enumerate(statistics)]))
    canvas = FigureCanvasAgg(figures[0])
    canvas.draw()
    left = figures[0].axes[0]
    labels = [label.get_window_extent() for label in left.get_xticklabels(which='both')
              if label.get_text()]
    places = sorted((box.x0, box.x1) for box in labels
                    if left.bbox.x0 - 1 <= (box.x0 + box.x1) / 2 <= left.bbox.x1 + 1)
    assert places and all(end < start for (_, end), (start, _) in pairwise(places))
    assert left.get_xlim()[0] < min(statistics)
