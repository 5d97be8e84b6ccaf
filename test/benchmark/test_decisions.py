"""The benchmark of decisions: a sound lens is kept, and what a page says of the outcomes."""

import numpy as np
import pytest

from benchmark.studies.decisions import KINDS, Outcome, report, run


def test_a_sound_lens_is_kept():
    """Also where landmarks are a little off: that is no rise of the error with causes."""
    found = run(('sound', 0))
    assert found.decision == 'keep' and found.shift == 0 < found.bound


@pytest.mark.parametrize('kind', KINDS)
def test_the_page_counts_what_was_decided(kind):
    one = Outcome(kind, 'keep', 'keep', (), 1e-3, 5e-4, 0.0, 0.1, -0.5, 'focal length')
    others = [
        Outcome(other, 'undecided', 'keep', (), np.nan, 0.0, 0.1, 0.2, 0.2) for other in KINDS
    ]
    lines = report([one, one, *others], 'command').splitlines()
    row = next(line for line in lines if line.startswith(f'| {kind} '))
    assert row.endswith('| 2 | 0 | 0 | 1 |')
    assert any('covers the truth in 100 %' in line for line in lines)
    off = [line for line in lines if 'Off in the focal length' in line]
    assert bool(off) == (kind == 'off') and all('err 1.67 times' in line for line in off)
    assert any('offered: none' in line for line in lines)
    assert any('of the same data, all: 40 %' in line for line in lines)
