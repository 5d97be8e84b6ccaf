"""Everything that `fisheye-svp paper` reports, computed once, and as the mapping of paper.json."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from fisheye_svp_ros.io.lens_files import lens_to_dict, load_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.paper.claims import Claim, claims
from fisheye_svp_ros.paper.extensions import (
    NOISES,
    VARIANTS,
    Crossings,
    crossings,
    evaluate_variant,
)
from fisheye_svp_ros.paper.lens_evaluation import LensEvaluation, captions_of
from fisheye_svp_ros.paper.studies import Family, Stopping, load_family, load_stopping
from fisheye_svp_ros.paper.tables import (
    CALIBRATION,
    LENSES,
    LOCALIZATION,
    PANELS,
    STYLE_NAMES,
    Cell,
    agreeing,
    cells,
)
from fisheye_svp_ros.scene.observations import RADII, SPREADS

SVP = 'SVP'


class Panel(NamedTuple):
    """One panel of figure 9 or 10; px and mm.

    error2: mean distance to the epipolar curve; vertical: the same within the column; published:
    NaN without a caption.
    """

    lens: str
    radius: float
    style: str
    points: int
    error2: float
    vertical: float
    error3: float
    published_error2: float
    published_error3: float


class Results(NamedTuple):
    """found: evaluations by variant and lens; family, stopping: results of longer studies."""

    lenses: dict[str, Lens]
    found: dict[str, dict[str, LensEvaluation]]
    claims: list[Claim]
    crossings: list[Crossings]
    family: Family
    stopping: Stopping

    @property
    def svp(self) -> dict[str, LensEvaluation]:
        """The paper's own evaluation, by lens."""
        return self.found[SVP]

    def cells(self, variant: str = SVP) -> list[Cell]:
        """Return the 180 cells of tables 1 to 4 for a variant of the solver."""
        evaluations = [self.found[variant][name] for name in LENSES]
        return [
            *cells(LOCALIZATION, np.stack([e.localization for e in evaluations]), 1, SPREADS),
            *cells(CALIBRATION, np.stack([e.calibration for e in evaluations]), 3, STYLE_NAMES),
        ]

    def panels(self) -> list[Panel]:
        """Return the 18 panels of figures 9 and 10 with the captions that belong to them."""
        return [panel for name in LENSES for panel in _panels(self.svp[name])]

    def agreeing(self, limit: float) -> int:
        """Count z and residual cells of tables 1 and 2, of 36, within a relative difference."""
        return agreeing(np.stack([self.svp[name].localization for name in LENSES]), limit)

    def verdicts(self) -> dict[str, int]:
        """Return how many statements have which verdict."""
        verdicts = [claim.verdict for claim in self.claims]
        return {verdict: verdicts.count(verdict) for verdict in sorted(set(verdicts))}

    def document(self) -> dict[str, Any]:
        """Return the mapping of paper.json; NaN stands for what the paper does not print."""
        return {
            'summary': {
                'z_and_residual_cells': 36,
                'within_10_percent': self.agreeing(0.10),
                'within_5_percent': self.agreeing(0.05),
                'claims': self.verdicts(),
            },
            'lenses': {name: lens_to_dict(lens) for name, lens in self.lenses.items()},
            'cells': [_cell_document(cell) for cell in self.cells()],
            'panels': [
                {
                    'figure': 9 + LENSES.index(panel.lens),
                    'lens': panel.lens,
                    'radius_m': panel.radius,
                    'style': panel.style,
                    'points': panel.points,
                    'error2_px': _published_and_ours(panel.published_error2, panel.error2),
                    'error2_vertical_px': _published_and_ours(np.nan, panel.vertical),
                    'error3_mm': _published_and_ours(panel.published_error3, panel.error3),
                }
                for panel in self.panels()
            ],
            'claims': [claim._asdict() for claim in self.claims],
            'other_solvers': {
                variant: [_cell_document(cell) for cell in self.cells(variant)]
                for variant in self.found
            },
            'noise': [
                {
                    'lens': c.lens,
                    'quantity': c.quantity,
                    'where': c.where,
                    'noise_px': list(NOISES),
                    'range_m': c.ranges.tolist(),
                }
                for c in self.crossings
            ],
            'out_of_line_cell': _out_of_line(self.stopping),
        }


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
    found = {
        variant: {name: evaluations[variant, name].result() for name in LENSES}
        for variant in VARIANTS
    }
    return Results(
        lenses,
        found,
        claims(found[SVP]),
        [crossing for future in ranges for crossing in future.result()],
        load_family(),
        load_stopping(),
    )


def task_count() -> int:
    """Return how many tasks `compute` hands to its executor."""
    return len(LENSES) * (len(VARIANTS) + 1)


def _panels(evaluation: LensEvaluation) -> list[Panel]:
    error2, error3 = evaluation.panels('error2_px'), 1e3 * evaluation.panels('error3_m')
    vertical, points = evaluation.panels('error2_vertical_px'), evaluation.panels('points')
    captions = captions_of(evaluation.lens.name, error2, error3)
    return [
        Panel(
            evaluation.lens.name,
            *panel,
            int(points[i]),
            float(error2[i]),
            float(vertical[i]),
            float(error3[i]),
            *captions.get(i, (np.nan, np.nan)),
        )
        for i, panel in enumerate(PANELS)
    ]


def _out_of_line(study: Stopping) -> dict[str, Any]:
    return {
        'published_minus_ours_mm': study.offset_mm.tolist(),
        'relative_excess_of_squares': study.relative_cost,
        'stopped_early': [
            {
                'lens': LENSES[k],
                'damping': study.dampings[d],
                'gain_px2': study.gains[g],
                'radius_m': RADII[r],
                'range': SPREADS[s],
                'median_off_z': float(value),
            }
            for (k, d, g, r, s), value in np.ndenumerate(study.off)
        ],
    }


def _cell_document(cell: Cell) -> dict[str, Any]:
    return {
        'table': cell.table,
        'lens': cell.lens,
        'radius_m': cell.radius,
        'row': cell.row,
        'quantity': cell.quantity,
        'unit': cell.unit,
        **_published_and_ours(cell.published, cell.ours),
        'new': bool(np.isnan(cell.published)),
    }


def _published_and_ours(published: float, ours: float) -> dict[str, float]:
    return {'published': published, 'ours': ours, 'relative_difference': ours / published - 1}
