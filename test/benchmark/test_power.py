"""The benchmark of power: sets whose effect the oracle sees as clearly as wanted, and its page."""

import numpy as np
import pytest

from benchmark.studies.power import FAMILIES, Outcome, _draw_set, report


@pytest.mark.parametrize('family', FAMILIES, ids=lambda one: one.name)
def test_the_oracle_sees_what_is_hidden_as_clearly_as_wanted(family):
    table, _, z = _draw_set(family, np.random.default_rng(3))
    assert len(np.unique(table.frame)) <= family.frames[1] - 1
    assert np.isfinite(table.t).all() == family.timed
    low, high = family.clear
    assert low - 5 <= z <= high + 5  # a normal deviate, and landmarks that are a little off
    assert (z > 0) == bool(family.effect)


def test_the_page_counts_what_is_found_and_what_is_false():
    outcomes = [
        Outcome('shift, few', 6.0, (('flat_port', 'viewpoint_shift'),), True),
        Outcome('shift, few', 6.0, (('skew',),), True),
        Outcome('nothing', 0.0, (), False),
    ]
    page = report(outcomes, 'command')
    assert '| shift, few | 5.5 to 8 | 1 of 2 | 1 of 2 (skew) |' in page
    assert '| nothing | - | - | 0 of 1 |' in page and '33.3 % (1/3)' in page
