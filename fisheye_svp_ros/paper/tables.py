"""The numbers that Kita's paper prints, as printed: mm, degree, px; NaN where a cell is empty.

Axes: lens, radius, spread or style, quantity, in the order of the names below.  Source: tables 1
to 4, the captions of figures 9 and 10, and section 5.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.scene.observations import RADII
from fisheye_svp_ros.scene.rigs import STYLES

NAMES = {'fish180': 'Fish180', 'fish214': 'Fish214'}
LENSES = tuple(NAMES)
QUANTITIES = ('x', 'y', 'z', 'axis', 'residual')
UNITS = ('mm', 'mm', 'mm', 'deg', 'px')
STYLE_NAMES = tuple(STYLES)
PANELS = tuple((radius, style) for radius in RADII for style in STYLE_NAMES)

_TABLE_1 = """
-0.0221 -0.0144 -0.1148 0.0011 0.0399
-0.0660  0.0669  0.2372 0.0035 0.0281
-0.0343 -0.0209 -1.5733 0.0037 0.0176
-0.0137  0.0136 -0.1614 0.0044 0.1642
-0.0675  0.0683  0.2363 0.0140 0.1131
-0.0246  0.0087 -1.6713 0.0122 0.0759
-0.0138  0.0136 -0.1631 0.0112 0.4136
-0.0686  0.0695  0.2369 0.0355 0.2847
-0.0245  0.0080 -1.6894 0.0308 0.1914
"""
_TABLE_2 = """
-0.0387 0.0276 -5.4709 0.0040 0.5764
-0.2616 0.2729  0.2148 0.0137 0.1052
 0.0098 0.0112 -7.1621 0.0029 0.5007
-0.0397 0.0250 -5.6004 0.0159 2.3892
-0.2654 0.2857  0.2195 0.0566 0.4237
 0.0108 0.0090 -7.3370 0.0112 2.0930
-0.0411 0.0153 -5.8982 0.0387 6.4501
-0.2727 0.2928  0.2195 0.1452 1.0735
 0.0125 0.0012 -7.7370 0.0248 5.7515
"""
_TABLE_3 = """
-0.0070 -0.0013 -0.0051 0.0005 0.0430
 0.0200 -0.0028  0.0208 0.0020 0.0429
-0.0510 -0.0025 -0.0106 0.0033 0.0430
-0.0290 -0.0008 -0.0491 0.0061 0.1428
-0.0130 -0.0014 -0.0313 0.0030 0.1418
-0.0470 -0.0007 -0.0479 0.0076 0.1463
-0.0160 -0.0157 -0.0749 0.0086 0.2696
-0.0320 -0.0041 -0.1835 0.0273 0.2518
-0.0020 -0.0025 -0.0106 0.0093 0.0430
"""
_TABLE_4 = """
nan nan nan nan nan
 0.0720  0.0410 0.2882 0.0508 0.5903
-0.0390 -0.0355 0.0550 0.0492 0.5814
 0.3630  0.0781 0.1083 0.0474 2.3258
-0.1350 -0.0436 0.0002 0.1624 2.2687
 0.6590  0.0198 0.0742 0.1062 2.3784
nan nan nan nan nan
nan nan nan nan nan
nan nan nan nan nan
"""


def _parse_tables(*tables: str) -> Array:
    values = np.array([[float(word) for word in table.split()] for table in tables])
    return values.reshape(len(tables), len(RADII), 3, len(QUANTITIES))


LOCALIZATION = _parse_tables(_TABLE_1, _TABLE_2)
CALIBRATION = _parse_tables(_TABLE_3, _TABLE_4)

# (Error2 in px, Error3 in mm) in the order in which the captions of figures 9 and 10 are printed;
# five of nine panels a lens have kept theirs.
CAPTIONS = {
    'fish180': ((0.004, 4.43), (0.017, 5.90), (0.070, 8.56), (0.070, 2.13), (0.039, 1.64)),
    'fish214': ((0.026, 6.43), (0.295, 41.97), (0.339, 43.38), (1.506, 14.20), (9.329, 13.07)),
}
# Section 5: lowest and highest average of the vertical error, px, and of the 3-D error, mm.
ERROR2_RANGE = {'fish180': (0.004, 0.61), 'fish214': (0.03, 9.3)}
ERROR3_RANGE = {'fish180': (1.6, 8.6), 'fish214': (6.4, 43.4)}
# Section 5: where along z the right camera stands, m; Fish214 alone is moved.
RIGHT_CAMERA_Z = {'fish214': -0.1}

# Fish180, Whole, 2.0 m: z is out of line with the rows below it in the paper itself.
OUT_OF_LINE = (0, 0, 0)
# Table 3, divergent at 0.2 m: y, z and residual repeat those at 2.0 m, digit by digit.
REPEATED_CELL = (0, 2, 2)


class Cell(NamedTuple):
    """One cell of tables 1 to 4: `published` is NaN where the paper has none.

    place: of the lens, radius, row and quantity.
    """

    table: int
    lens: str
    radius: float
    row: str
    quantity: str
    unit: str
    published: float
    ours: float
    place: tuple[int, ...]

    @property
    def relative(self) -> float:
        """Ours over published, minus 1."""
        return self.ours / self.published - 1


def agreeing(tables: Array, limit: float) -> int:
    """Count z and residual cells of tables 1 and 2 (2, 3, 3, 5) within a relative difference."""
    relative = np.abs(tables / LOCALIZATION - 1)[..., [QUANTITIES.index('z'), -1]]
    return int((relative <= limit).sum())


def cells(published: Array, ours: Array, first_table: int, rows: Sequence[str]) -> list[Cell]:
    """Return the cells of a pair of tables (2, 3, 3, 5), one a lens, in printed order."""
    return [
        Cell(
            first_table + lens,
            LENSES[lens],
            RADII[radius],
            rows[row],
            QUANTITIES[quantity],
            UNITS[quantity],
            float(value),
            float(ours[place]),
            place,
        )
        for place, value in np.ndenumerate(published)
        for lens, radius, row, quantity in [place]
    ]
