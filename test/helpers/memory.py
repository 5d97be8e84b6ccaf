"""What memory costs that comes and goes."""

from __future__ import annotations

import resource

import numpy as np


def page_faults(rounds: int) -> int:
    """Return how many pages are asked for where arrays of 24 MB in all come and go."""
    before = 0
    for i in range(rounds + 1):
        if i == 1:
            before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        arrays = [np.ones(3_000_000, np.uint8) for _ in range(8)]
        del arrays
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
