"""Metrics as people read them: what is measured, in mm and degrees."""

from __future__ import annotations

import math
from typing import NamedTuple

_UNITS = {'m': ('mm', 1e3), 'rad': ('deg', math.degrees(1.0)), 'px': ('px', 1.0)}


class MetricText(NamedTuple):
    """A metric's quantity, its unit for people ('' where it has none), and the factor into it."""

    quantity: str
    unit: str
    factor: float

    def title(self, separator: str = ', ') -> str:
        """Return words: 'position error, mm'."""
        return separator.join(filter(None, (self.quantity.replace('_', ' '), self.unit)))


def metric_text(name: str) -> MetricText:
    """Return how people read a metric; its name ends with its unit."""
    quantity, _, unit = name.rpartition('_')
    if unit not in _UNITS:
        return MetricText(name, '', 1.0)
    return MetricText(quantity, *_UNITS[unit])
