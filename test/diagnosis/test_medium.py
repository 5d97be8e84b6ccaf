"""The medium is named where there is one, and nowhere else."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.uncertain import STDERR, uncertain
from helpers.water import AIR, photographs

from fisheye_svp_ros.diagnosis import Action, DiagnosisOptions, diagnose
from fisheye_svp_ros.diagnosis.checks.medium import InAir
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.optics.ports import FlatGlass
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.reporting.wording.diagnosis import verdict_sentences
from fisheye_svp_ros.scene.observations import make_observations
from fisheye_svp_ros.solve.initial_rig import initial_state, prediction_distances
from fisheye_svp_ros.solve.lens_calibration import calibrate
from fisheye_svp_ros.solve.outliers import find_outliers
from fisheye_svp_ros.solve.port_fit import MEDIUM_INDEX, PORT_PLACE
from fisheye_svp_ros.solve.rig_state import group_by_frame
from fisheye_svp_ros.study.trust import assess_lens, with_covariance

PORT = FlatGlass(0.035, 1.34, 0.02, -0.01)
CALIBRATED = replace(AIR, calibration={'rms_px': 0.1})


def medium_of(found):
    return next((c for c in found.causes if c.form == 'flat_port(medium)'), None)


@pytest.mark.parametrize(('lens', 'others'), [(AIR, 5), (CALIBRATED, 0)], ids=['fixed', 'free'])
def test_water_is_named_and_measured(lens, others):
    seen = photographs(AIR, PORT, 12)
    other = photographs(AIR, PORT, others, seed=1) if others else None
    found = diagnose(seen, lens, held_out=other, options=DiagnosisOptions(quick=True))
    cause = medium_of(found)
    assert [c.effect for c in found.causes] == ['flat_port'] and found.verdict == 'explained'
    for name in ('medium_index', 'distance', 'tilt_x', 'tilt_y'):
        entry = cause.parameters[name]
        assert abs(entry['value'] - getattr(PORT, name)) < 4 * entry['stderr']
    assert cause.parameters['medium_index']['value'] == pytest.approx(1.34, rel=0.01)
    assert found.figures.extended.heldout_rms_px < 0.2 < found.figures.base.heldout_rms_px
    assert sum(c.share for c in found.components) == pytest.approx(1.0)
    index = cause.parameters['medium_index']  # the lens is averaged over other likely effects
    assert abs(found.lens.port.medium_index - index['value']) < 0.1 * index['stderr']
    assert found.lens.fx == AIR.fx and found.figures.gain.value > 0.9
    assert 'air or another medium behind it' in verdict_sentences(found)[0]
    assert 'in air first' not in verdict_sentences(found)[2]


def test_coarse_points_in_air_are_no_reason_to_fit_a_port(monkeypatch):
    """A free lens curve explains next to nothing of noise of 1.5 px."""

    def start_port(*_):
        raise AssertionError('a port was fitted')

    monkeypatch.setattr('fisheye_svp_ros.diagnosis.checks.medium.start_port', start_port)
    found = diagnose(
        photographs(AIR, None, 8, noise=1.5), AIR, options=DiagnosisOptions(quick=True)
    )
    assert medium_of(found) is None


def test_glass_that_stood_in_for_a_cause_is_gone_with_it():
    """The lens was off in air: so many millimetres of glass, even below none, would undo that."""
    rng = np.random.default_rng(0)
    true = replace(
        AIR,
        cx=AIR.cx + rng.normal(0, 6),
        cy=AIR.cy + rng.normal(0, 6),
        fy=AIR.fy * (1 + rng.normal(0, 0.003)),
    )
    found = diagnose(photographs(true, PORT, 12, 0.05), AIR, options=DiagnosisOptions(quick=True))
    assert {c.effect for c in found.causes} >= {'flat_port', 'principal_point', 'aspect'}
    assert 'thickness' not in medium_of(found).parameters
    assert found.lens.port.thickness == 0.0
    assert found.lens.port.medium_index == pytest.approx(1.34, rel=0.001)


def test_what_photographs_in_air_left_open_of_the_lens_is_found_under_water():
    """The curve turns back at 62 degrees where no point in air was."""
    table = photographs(AIR, None, 6, noise=0.3, seed=2, reach=0.15)
    result = calibrate(table, 'kannala_brandt', (AIR.width, AIR.height)).adjusted
    given = with_covariance(result.lens, assess_lens(table, result.lens, result.names))
    assert given.max_incidence < 1.1
    found = diagnose(
        photographs(AIR, PORT, 4, seed=12, reach=0.9), given, options=DiagnosisOptions(quick=True)
    )
    assert [c.form for c in found.causes] == ['flat_port(medium)']
    index = medium_of(found).parameters['medium_index']
    assert abs(index['value'] - 1.34) < 3 * index['stderr'] < 0.03
    theta = np.radians([20.0, 40.0, 60.0])
    heights = [one.fx * one.image_height.value_and_slope(theta)[0] for one in (found.lens, AIR)]
    assert heights[0] == pytest.approx(heights[1], rel=0.01)
    assert found.figures.extended.heldout_rms_px < 0.2
    assert Action.CALIBRATE_AIR in {advice.action for advice in found.advice}
    assert 'diagnose photographs in air first' in verdict_sentences(found)[2]


@pytest.mark.parametrize(
    'block',
    [
        {'covariance': [[1.0]]},
        {'stderr': {'fx': 1.0}, 'covariance': [[1.0, 2.0]]},
        {'stderr': {'fx': 1.0}, 'covariance': 'x'},
        {'stderr': {'fx': 1.0}, 'covariance': [[np.nan]]},
    ],
)
def test_a_covariance_that_cannot_be_is_refused(block):
    with pytest.raises(LensError, match="'air': calibration: covariance"):
        InAir.from_lens(replace(AIR, calibration=block))


def test_what_a_lens_file_tells_of_its_focal_length():
    assert InAir.from_lens(replace(AIR, calibration={'stderr': {'fx': 1.0}})) is None
    known = InAir.from_lens(
        replace(AIR, calibration={'stderr': {'f': 2.1}, 'covariance': [[4.41]]})
    )
    assert known.focal == pytest.approx(0.005) and known.reach == np.inf
    off = replace(AIR, fx=AIR.fx + 4.2, fy=AIR.fx + 4.2)
    assert known.squared_distance(off) == pytest.approx(4.0)


def test_what_a_diagnosis_in_air_found_takes_the_place_of_the_calibration():
    given = replace(uncertain(), calibration={'stderr': {'fx': 9.0}, 'covariance': [[81.0]]})
    known = InAir.from_lens(given)
    assert known.names == ('fx', 'fy', 'cx', 'cy', 'k1')
    assert known.focal == pytest.approx(STDERR[0] / given.fx)


def test_an_index_is_no_surer_than_the_focal_length_in_air():
    seen = photographs(AIR, PORT, 8)
    index = {}
    for percent in (0.0, 1.0):
        lens = replace(AIR, calibration={'stderr': {'fx': percent / 100 * AIR.fx}})
        found = diagnose(seen, lens, options=DiagnosisOptions(quick=True))
        index[percent] = medium_of(found).parameters['medium_index']
    assert index[0.0]['stderr'] < 0.005 and index[0.0]['value'] == index[1.0]['value']
    assert index[1.0]['stderr'] == pytest.approx(0.0134, rel=0.1)


@pytest.mark.parametrize(
    'true',
    [
        replace(AIR, fx=1.33 * AIR.fx, fy=1.33 * AIR.fy),
        replace(AIR, port=FlatGlass(0.03, 1.0, 0.02, 0.0, 0.01)),
    ],
    ids=['focal length', 'window in air'],
)
def test_what_is_no_medium_is_not_called_one(true):
    found = diagnose(photographs(true, true.port, 10), AIR, options=DiagnosisOptions(quick=True))
    assert found.causes and medium_of(found) is None


@pytest.mark.parametrize(
    ('true', 'near'),
    [
        (replace(AIR, port=PORT), True),
        (replace(AIR, fx=1.33 * AIR.fx, fy=1.33 * AIR.fy), False),
    ],
    ids=['water', 'focal length'],
)
def test_a_lens_moves_as_far_as_photographs_in_air_allow(true, near):
    stderr = {'fx': 0.02 * AIR.fx, 'fy': 0.02 * AIR.fy, 'cx': 2.0, 'cy': 2.0, 'k1': 0.1}
    covariance = np.diag(np.square([*stderr.values()])).tolist()
    known = InAir.from_lens(replace(AIR, calibration={'stderr': stderr, 'covariance': covariance}))
    data = group_by_frame(photographs(true, true.port, seed=20))
    wet = known.fit_behind_port(data, replace(known.lens, port=PORT), PORT_PLACE, MEDIUM_INDEX)
    assert (wet is not None) == near


def test_a_medium_can_be_ruled_out():
    found = diagnose(
        photographs(AIR, PORT, 8),
        AIR,
        options=DiagnosisOptions(left_out=('flat_port',), quick=True),
    )
    assert found.causes and all(c.effect != 'flat_port' for c in found.causes)


def test_a_jump_of_the_intrinsics_is_fitted_beside_a_port_where_it_is_known_alone():
    """Unasked for, it would stand in for a calibration in air that is off."""
    other = replace(AIR, fx=1.01 * AIR.fx, fy=1.01 * AIR.fy)
    first, second = photographs(AIR, PORT, 4), photographs(other, PORT, 4, seed=1)
    seen = make_observations(
        np.concatenate([first.frame, second.frame + 4]),
        *(
            np.concatenate([getattr(first, name), getattr(second, name)])
            for name in ('landmark', 'uv', 'xyz')
        ),
    )
    for known in ((), ('session_step',)):
        found = diagnose(seen, AIR, options=DiagnosisOptions(included=known, quick=True))
        assert medium_of(found) is not None
        assert known == tuple(c.effect for c in found.causes if c.effect == 'session_step')


def test_a_view_of_which_half_is_out_of_sight_is_posed_by_the_other_half():
    """So it may begin behind a port that is not there."""
    data = group_by_frame(photographs(AIR, None))
    state = initial_state(data, replace(AIR, port=FlatGlass(0.03, 1.333)))
    turn = np.tile(np.eye(3), (data.frames, 1, 1))
    turn[0] = rotation_from_vector(np.radians([0.0, -95.0, 0.0]))
    away = replace(state, pose=state.pose.compose(Pose(turn, np.zeros((data.frames, 3)))))
    offset = prediction_distances(away.model, away.pose, data.views)
    assert 0.5 < np.isinf(offset[0]).mean() < 0.9
    kept, _ = find_outliers(data, away)
    again, _ = find_outliers(data, state)
    np.testing.assert_array_equal(kept.views.used, again.views.used)
