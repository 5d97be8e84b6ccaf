"""A lens beside the center of a dome in air: stated it is named, else it is in the class."""

import numpy as np
import pytest
from helpers.water import AIR, photographs

from fisheye_svp_ros.diagnosis import DiagnosisOptions, diagnose
from fisheye_svp_ros.diagnosis.effect_forms import effect_forms
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.effects.ray_effects import DomePortEffect
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.optics.ports import DomeGlass
from fisheye_svp_ros.reporting.wording.decisions import separation
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.lens_calibration import calibrate
from fisheye_svp_ros.solve.rig_state import Linearization, group_by_frame

DOME = DomeGlass(0.05, 1.0, 0.003, -0.008, 0.002, 0.005)
STATED = DomePortEffect(DOME.radius, DOME.thickness, DOME.glass_index)


@pytest.fixture(scope='module')
def seen():
    """Return photographs through the dome and the lens that a calibration makes of them."""
    table = photographs(AIR, DOME, 16, 0.1)
    return table, calibrate(table, 'kannala_brandt', (AIR.width, AIR.height)).adjusted.lens


def test_a_dome_is_in_the_class_of_what_it_looks_like(seen):
    (cause,) = diagnose(*seen).causes
    assert cause.effect in ('decentering', 'sensor_tilt')
    assert 'dome_port' in cause.indistinguishable_from
    assert {*cause.odds} == {cause.effect, *cause.indistinguishable_from}
    assert sum(cause.odds.values()) == pytest.approx(1) and cause.odds['dome_port'] > 0.01
    assert '--port dome:' in separation(cause) and 'a ray error of 0.0' in separation(cause)


def test_a_stated_dome_is_named_and_its_place_measured(seen):
    table, lens = seen
    found = diagnose(table, lens, options=DiagnosisOptions(stated=(STATED,)))
    (cause,) = found.causes
    assert cause.effect == 'dome_port' and cause.p_value < 1e-6 and cause.gain > 0
    assert {'decentering', 'sensor_tilt'} & set(cause.indistinguishable_from)
    for name, entry in cause.parameters.items():
        assert abs(entry['value'] - getattr(DOME, name)) < 3 * entry['stderr'] < 0.006
    assert isinstance(found.lens.port, DomeGlass)
    x = cause.parameters['x']
    assert abs(found.lens.port.x - x['value']) < x['stderr']
    with pytest.raises(LensError, match='already has a port'):
        STATED.extend(found.lens, np.zeros(2))


def test_a_look_alike_is_no_effect_to_be_tested(seen):
    assert 'dome_port' in CATALOGUE and 'dome_port' not in list(CATALOGUE)
    table, lens = seen
    data = group_by_frame(table)
    linear = Linearization(data, initial_state(data, lens), ())
    ((effect, _),) = effect_forms(linear).look_alikes
    assert effect.name == 'dome_port'
    assert not effect_forms(linear, ('dome_port',)).look_alikes
