"""paper.json: every number of the paper's evaluation, for scripts."""

from __future__ import annotations

from typing import Any

import numpy as np

from fisheye_svp_ros.io.lens_files import lens_to_dict
from fisheye_svp_ros.paper.beyond import NOISES
from fisheye_svp_ros.paper.results import Results
from fisheye_svp_ros.paper.stopping import DAMPINGS, GAINS
from fisheye_svp_ros.paper.tables import (
    LENSES,
    PANELS,
    Cell,
    agreeing,
)
from fisheye_svp_ros.scene.landmarks import RADII, SPREADS


def document(results: Results) -> dict[str, Any]:
    """Return the mapping of paper.json; NaN stands for what the paper does not print."""
    tables = np.stack([results.svp[name].localization for name in LENSES])
    return {
        'summary': {
            'z_and_residual_cells': 36,
            'within_10_percent': agreeing(tables, 0.10),
            'within_5_percent': agreeing(tables, 0.05),
            'claims': {c: sum(one.verdict == c for one in results.claims)
                       for c in sorted({one.verdict for one in results.claims})},
        },
        'lenses': {name: lens_to_dict(lens) for name, lens in results.lenses.items()},
        'cells': [_cell(cell) for cell in results.cells()],
        'panels': [
            {
                'figure': 9 + LENSES.index(panel.lens),
                'lens': panel.lens,
                'radius_m': PANELS[panel.place][0],
                'style': PANELS[panel.place][1],
                'points': panel.points,
                'error2_px': _pair(panel.published_error2, panel.error2),
                'error2_vertical_px': _pair(np.nan, panel.vertical),
                'error3_mm': _pair(panel.published_error3, panel.error3),
            }
            for panel in results.panels()
        ],
        'claims': [claim._asdict() for claim in results.claims],
        'other_solvers': {
            variant: [_cell(cell) for cell in results.cells(variant)] for variant in results.found
        },
        'noise': [
            {'lens': c.lens, 'quantity': c.quantity, 'where': c.where, 'noise_px': list(NOISES),
             'range_m': c.ranges.tolist()}
            for c in results.crossings
        ],
        'out_of_line_cell': {
            'published_minus_ours_mm': results.excess.offset_mm.tolist(),
            'relative_excess_of_squares': results.excess.relative_cost,
            'stopped_early': [
                {'lens': name, 'damping': DAMPINGS[d], 'gain_px2': GAINS[g],
                 'radius_m': RADII[r], 'range': SPREADS[s], 'median_off_z': float(value)}
                for name, off in results.stopped.items()
                for (d, g, r, s), value in np.ndenumerate(off)
            ],
        },
    }


def _cell(cell: Cell) -> dict[str, Any]:
    return {
        'table': cell.table, 'lens': cell.lens, 'radius_m': cell.radius, 'row': cell.row,
        'quantity': cell.quantity, 'unit': cell.unit,
        **_pair(cell.published, cell.ours), 'new': bool(np.isnan(cell.published)),
    }


def _pair(published: float, ours: float) -> dict[str, float]:
    return {'published': published, 'ours': ours, 'relative_difference': ours / published - 1}
