"""Everything that `fisheye-svp paper` reports, computed once; numbers only."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.paper.beyond import (
    VARIANTS,
    Crossings,
    crossings,
    evaluate_variant,
)
from fisheye_svp_ros.paper.claims import Claim, claims
from fisheye_svp_ros.paper.evaluation import Evaluation, captions_of, localize_spreads
from fisheye_svp_ros.paper.family import Family, load_family
from fisheye_svp_ros.paper.stopping import (
    Excess,
    excess_of_published,
    stopped_early,
)
from fisheye_svp_ros.paper.tables import (
    LENSES,
    Cell,
    calibration_cells,
    localization_cells,
)

SVP = 'SVP'


class Panel(NamedTuple):
    """One panel of figure 9 or 10, its place in PANELS; px and mm.

    error2: mean distance to the epipolar curve; vertical: the same within the column; published:
    NaN without a caption.
    """

    lens: str
    place: int
    points: int
    error2: float
    vertical: float
    error3: float
    published_error2: float
    published_error3: float


class Results(NamedTuple):
    """found: evaluations by variant and lens; stopped: by lens, `paper_stopping.stopped_early`;
    family: the fits that `paper --search` kept.
    """

    lenses: dict[str, Lens]
    found: dict[str, dict[str, Evaluation]]
    claims: list[Claim]
    crossings: list[Crossings]
    excess: Excess
    stopped: dict[str, Array]
    family: Family

    @property
    def svp(self) -> dict[str, Evaluation]:
        """The paper's own evaluation, by lens."""
        return self.found[SVP]

    def cells(self, variant: str = SVP) -> list[Cell]:
        """Return the 180 cells of tables 1 to 4 for a variant of the solver."""
        found = self.found[variant]
        return [
            *localization_cells(np.stack([found[name].localization for name in LENSES])),
            *calibration_cells(np.stack([found[name].calibration for name in LENSES])),
        ]

    def panels(self) -> list[Panel]:
        """Return the 18 panels of figures 9 and 10 with the captions that belong to them."""
        return [panel for name in LENSES for panel in _panels(self.svp[name])]


def compute(executor: Executor, done: Callable[[], None] = lambda: None) -> Results:
    """Evaluate both lenses with all solvers; `done` is called after each of `tasks()`."""
    lenses = {name: load_lens(lens_path(name)) for name in LENSES}

    def submit(function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        future = executor.submit(function, *arguments)
        future.add_done_callback(lambda _: done())
        return future

    evaluations = {
        (variant, name): submit(evaluate_variant, lenses[name], variant)
        for variant, name in product(VARIANTS, LENSES)
    }
    ranges = [submit(crossings, lens) for lens in lenses.values()]
    stops = {name: submit(_stopped, lens) for name, lens in lenses.items()}
    found = {
        variant: {name: evaluations[variant, name].result() for name in LENSES}
        for variant in VARIANTS
    }
    whole = found[SVP][LENSES[0]].localized[0]
    return Results(
        lenses, found, claims(found[SVP]),
        [crossing for future in ranges for crossing in future.result()],
        excess_of_published(whole, lenses[LENSES[0]]),
        {name: future.result() for name, future in stops.items()},
        load_family(),
    )


def tasks() -> int:
    """Return how many tasks `compute` hands to its executor."""
    return len(LENSES) * (len(VARIANTS) + 2)


def _stopped(lens: Lens) -> Array:
    return stopped_early(localize_spreads(lens), lens)


def _panels(found: Evaluation) -> list[Panel]:
    error2, error3 = found.panels('error2_px'), 1e3 * found.panels('error3_m')
    vertical, points = found.panels('error2_vertical_px'), found.panels('points')
    captions = captions_of(found.lens.name, error2, error3)
    return [
        Panel(found.lens.name, i, int(points[i]), float(error2[i]), float(vertical[i]),
              float(error3[i]), *captions.get(i, (float('nan'), float('nan'))))
        for i in range(len(error2))
    ]
