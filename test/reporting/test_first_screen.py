"""The first screen of a report warns of errors that rise, and of no other."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.diagnoses import with_changes
from helpers.scenes import lens, observe, scene

from fisheye_svp_ros.diagnosis import Diagnosis, DiagnosisOptions, diagnose
from fisheye_svp_ros.reporting.first_screen import first_screen


@pytest.fixture(scope='module')
def found() -> Diagnosis:
    rng = np.random.default_rng(8)
    return diagnose(observe(lens(), (), *scene(rng, frames=8), 0.2, rng), lens(),
                    options=DiagnosisOptions(quick=True))


@pytest.mark.parametrize(('ratio', 'warned'), [(0.9, False), (1.003, False), (1.05, True)])
def test_a_rise_is_warned_of_where_it_is_one(
    found: Diagnosis, ratio: float, warned: bool
) -> None:
    """Half a percent more is what another weighting of the same points makes."""
    named = found.figures.named
    risen = with_changes(found, named=type(named)(
        ratio * found.figures.base.rms_px, named.heldout_rms_px, named.chi2_per_dof))
    said = first_screen(risen, 'table').warning
    assert ('rms on the fitted frames, with the causes' in said) == warned
