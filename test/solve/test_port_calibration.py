"""A lens calibrated in air is given its port, or both come from photographs under water alone."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.water import AIR, photographs

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.optics.ports import DomeGlass, FlatGlass
from fisheye_svp_ros.solve.lens_calibration import calibrate, calibrate_port
from fisheye_svp_ros.study.trust import assess_lens

FLAT = FlatGlass(0.035, 1.333, 0.02, -0.01)
DOME = DomeGlass(0.06, 1.333, 0.004, -0.003, 0.012)


def pulls(result, port):
    """Errors of what was fitted of the port, over their standard errors."""
    errors = np.sqrt(np.diag(result.adjusted.covariance))
    return [
        (
            getattr(result.adjusted.lens.port, name.removeprefix('port_'))
            - getattr(port, name.removeprefix('port_'))
        )
        / errors[i]
        for i, name in enumerate(result.adjusted.names)
        if name.startswith('port_')
    ]


@pytest.mark.parametrize('port', [FLAT, DOME], ids=['flat', 'dome'])
def test_a_port_is_found_for_a_lens_calibrated_in_air(port):
    seen = photographs(AIR, port)
    start = port.with_values(**dict.fromkeys(port.placed, 0.0))
    result = calibrate_port(seen, AIR, start)
    assert result.adjusted.converged
    assert np.abs(pulls(result, port)).max() < 4
    assert result.adjusted.lens.svp() == replace(
        AIR, calibration=result.adjusted.lens.calibration, max_incidence=AIR.max_incidence
    )


@pytest.mark.slow
def test_a_port_is_found_in_front_of_a_lens_with_corrections():
    """As `diagnose` extends a lens in air; what is said of the port's errors is said then, too."""
    tilt = {'parameters': {'about_x': 0.02, 'about_y': -0.01}}
    air = replace(AIR, corrections={'sensor_tilt': tilt})
    seen = photographs(air, FLAT)
    result = calibrate_port(seen, air, FlatGlass(0.0, 1.333))
    assert result.adjusted.converged
    assert np.abs(pulls(result, FLAT)).max() < 4
    found = assess_lens(seen, result.adjusted.lens, result.adjusted.names)
    assert list(found.stderr) == list(result.adjusted.names)
    assert found.covariance.shape == (3, 3)
    assert min(found.stderr.values()) > 0


def test_the_index_is_fitted_on_demand():
    names = ('port_distance', 'port_tilt_x', 'port_tilt_y', 'port_medium_index')
    sea = replace(FLAT, medium_index=1.344)
    result = calibrate_port(photographs(AIR, sea), AIR, FlatGlass(0.0, 1.333), names)
    assert result.adjusted.lens.port.medium_index == pytest.approx(1.344, rel=0.002)
    assert np.abs(pulls(result, sea)).max() < 4


def test_lens_and_port_come_from_photographs_under_water_alone():
    result = calibrate(
        photographs(AIR, FLAT, 14), 'kannala_brandt', (1280, 960), port=FlatGlass(0.0, 1.333)
    )
    assert result.adjusted.converged
    assert result.adjusted.lens.calibration['rms_px'] < 0.15
    assert np.abs(pulls(result, FLAT)).max() < 4
    assert result.adjusted.lens.fx == pytest.approx(AIR.fx, rel=0.01)


def test_a_name_that_the_port_does_not_have_is_refused():
    with pytest.raises(LensError, match="no parameter 'port_radius'"):
        calibrate_port(photographs(AIR, FLAT, 3), AIR, FlatGlass(0.0, 1.333), ('port_radius',))
