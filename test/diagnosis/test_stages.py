"""A cause stays confirmed only beside what the other causes may be mistaken for."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.scenes import lens, observe, scene
from helpers.water import AIR

from fisheye_svp_ros.diagnosis import EffectTests, NullModel, Reason, Rival, diagnose, stages
from fisheye_svp_ros.diagnosis.causes import selected_causes
from fisheye_svp_ros.diagnosis.effect_tests import HeldOutGain
from fisheye_svp_ros.diagnosis.findings import Doubt, find_doubt
from fisheye_svp_ros.diagnosis.posterior import EffectPosterior
from fisheye_svp_ros.diagnosis.stages import find_rival
from fisheye_svp_ros.diagnosis.stepwise import eliminate_effects
from fisheye_svp_ros.effects.base import ModelTerm
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.effects.ray_effects import ViewpointShiftEffect
from fisheye_svp_ros.effects.recording_effects import FocalDriftEffect, SessionStepEffect
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.reporting.wording.first_screen import first_screen
from fisheye_svp_ros.reporting.wording.whats_wrong import wrong
from fisheye_svp_ros.scene.observations import views_of
from fisheye_svp_ros.solve.bundle_adjustment import adjust
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.rig_state import group_by_frame

SIGMA = 0.2


def bursts(rng, frames):
    """Return poses, speeds and views of one board: bursts of four at 10 Hz, pauses of seconds."""
    x, y = np.meshgrid(np.arange(9) - 4.0, np.arange(6) - 2.5)
    board = 0.035 * np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=-1)
    burst, within = np.divmod(np.arange(frames), 4)
    count = burst[-1] + 1
    angle = rng.normal(size=(count, 3)) * [0.3, 0.6, 0.4]
    incidence, azimuth = rng.uniform(0, 0.9, count), rng.uniform(0, 2 * np.pi, count)
    way = np.stack(
        [
            np.sin(incidence) * np.cos(azimuth),
            np.sin(incidence) * np.sin(azimuth),
            np.cos(incidence),
        ],
        axis=-1,
    )
    away = np.exp(rng.uniform(np.log(0.25), np.log(0.9), count))[:, None]
    place = -(rotation_from_vector(angle) @ (away * way)[..., None])[..., 0]
    speed = rng.normal(size=(count, 6)) * [0.2, 0.2, 0.2, 0.5, 0.5, 0.5]
    move = 0.1 * within[:, None] * speed[burst]
    pose = Pose(rotation_from_vector(angle[burst] + move[:, 3:]), place[burst] + move[:, :3])
    views = views_of(board, np.zeros((frames, len(board), 2)))
    t = np.broadcast_to((3.0 * burst + 0.1 * within)[:, None], views.board.shape)
    return pose, speed[burst], views._replace(frame=np.arange(frames), t=t)


def names(found):
    return {cause.effect for cause in found.causes}


@pytest.mark.parametrize('seed', [3, 7])
def test_a_rolling_shutter_in_bursts_is_no_tilt_of_the_sensor(seed):
    """What happens in the pauses says nothing of how the camera moves."""
    rng = np.random.default_rng(seed)
    pose, speed, views = bursts(rng, 17)
    table, later = (
        observe(AIR, (), where, views, 0.0, rng) for where in (pose, pose.retract(1e-4 * speed))
    )
    exposed = 0.03 * (table.uv[:, 1:] / AIR.height - 0.5)
    uv = table.uv + exposed * (later.uv - table.uv) / 1e-4
    found = diagnose(
        replace(table, uv=uv + rng.normal(size=uv.shape) * SIGMA), AIR, free_intrinsics=True
    )
    assert names(found) == {'rolling_shutter'}
    readout = found.causes[0].parameters['readout']
    assert abs(readout['value'] - 0.03) < 3 * readout['stderr'] < 0.03


def test_a_tilt_beside_a_jump_stays_confirmed():
    rng = np.random.default_rng(1)
    pose, _, views = bursts(rng, 24)
    terms = [
        ModelTerm(SessionStepEffect((float(views.t[12, 0]),)), np.array([0.01, 6.0, -5.0])),
        ModelTerm(CATALOGUE['sensor_tilt'](), np.array([0.008, -0.008])),
    ]
    found = diagnose(observe(AIR, terms, pose, views, SIGMA, rng), AIR, free_intrinsics=True)
    assert len(names(found)) == 2
    (step,) = (cause for cause in found.causes if cause.effect == 'session_step')
    (tilt,) = (cause for cause in found.causes if cause.effect != 'session_step')
    assert 'sensor_tilt' in (tilt.effect, *tilt.indistinguishable_from)
    jump = step.parameters['step1.cx']
    assert abs(jump['value'] - 6.0) < 4 * jump['stderr']


RIVAL = Rival('session_step', 'focal_drift')


@pytest.fixture(scope='module')
def false_tilt():
    """Return the tests of a jump of the intrinsics that is fitted as a drift beside a tilt."""
    rng = np.random.default_rng(4)
    pose, views = scene(rng)
    step = ModelTerm(SessionStepEffect((float(views.t[8, 0]),)), np.array([0.004, 2.0, 1.0]))
    data = group_by_frame(observe(lens(), [step], pose, views, SIGMA, rng))
    false = (
        ModelTerm(FocalDriftEffect(2), np.zeros(2)),
        ModelTerm(CATALOGUE['sensor_tilt'](), np.zeros(2)),
    )
    state = adjust(data, replace(initial_state(data, lens()), terms=false), ())
    return EffectTests(NullModel.estimate(data, state, ()))


def confounder(tests):
    drift, tilt = tests.null.terms
    confounded = [('focal_drift', drift.columns, ['session_step'])]
    return find_rival(tests, tilt, confounded)


def test_an_effect_with_more_parameters_takes_the_place_of_another_cause(false_tilt):
    assert confounder(false_tilt) == (Reason.NEEDLESS_BESIDE_RIVAL, RIVAL)


def test_a_cause_must_predict_better_beside_what_takes_the_place_of_another(
    false_tilt, monkeypatch
):
    """Significant it is here at any p-value."""
    module = 'fisheye_svp_ros.diagnosis.stages'
    monkeypatch.setattr(f'{module}.SIGNIFICANCE', 1e9)
    gain = HeldOutGain(1.0, 0.5)
    monkeypatch.setattr(EffectTests, 'held_out_gain', lambda *_: gain)
    assert confounder(false_tilt) == (None, None)
    gain = HeldOutGain(1.0, 2.0)
    assert confounder(false_tilt) == (Reason.NO_GAIN_BESIDE_RIVAL, RIVAL)


TILT = ModelTerm(CATALOGUE['sensor_tilt'](), np.zeros(2))
FAR = ModelTerm(ViewpointShiftEffect(), np.array([0.03]))


@pytest.mark.parametrize(
    ('facts', 'reason', 'z'),
    [
        ({'frames': 1}, Reason.NO_OTHER_FRAME, 3.0),
        ({'z': -1.5, 'gains': True}, Reason.REFUTED_BY_FRAMES, -1.5),
        ({'z': -0.5, 'gains': True}, Reason.NO_GAIN, -0.5),
        ({'z': 0.5}, Reason.NO_GAIN, 0.5),
        ({'z': 0.5, 'gains': True}, None, None),
        ({'file': 0.5}, None, None),
        ({'file': -0.5}, Reason.NO_GAIN, -0.5),
        ({'file': -1.5}, Reason.REFUTED_BY_FILE, -1.5),
        ({'rival': (Reason.NEEDLESS_BESIDE_RIVAL, RIVAL)}, Reason.NEEDLESS_BESIDE_RIVAL, 3.0),
        ({'cause': FAR}, Reason.IMPLAUSIBLE, 3.0),
        ({'cause': FAR, 'z': -1.5}, Reason.REFUTED_BY_FRAMES, -1.5),
    ],
)
def test_a_cause_is_confirmed_unless_there_is_a_reason(facts, reason, z):
    given = {'cause': TILT, 'frames': 9, 'z': 3.0, 'gains': False, 'file': None, **facts}
    rival = given.get('rival', (None, None))
    evidence = SimpleNamespace(
        cause=given['cause'],
        frames=given['frames'],
        z=given['z'],
        z_of_file=lambda: given['file'],
        adds_density=lambda: given['gains'],
        find_rival=lambda: rival,
    )
    doubt = None if reason is None else Doubt(given['cause'], reason, z, rival[1])
    assert find_doubt(evidence) == doubt


def test_one_frame_confirms_nothing_and_is_not_adequate():
    """Its errors are far above the noise, and no other frame tells whose they are."""
    rng = np.random.default_rng(3)
    shifted = [ModelTerm(ViewpointShiftEffect(), np.array([0.008]))]
    table = observe(lens(), shifted, *scene(rng, frames=1), 0.01, rng)
    found = diagnose(table, lens())
    assert found.causes == [] and found.verdict == 'unexplained'
    assert found.decision['lens'].say == 'undecided'
    assert {one.reason for one in found.candidates} <= {
        Reason.NO_OTHER_FRAME,
        Reason.REFUTED_BY_FRAMES,
    }
    assert wrong(found).startswith('There are errors, but one frame')
    screen = first_screen(found, 'table')
    assert 'points in 1 frame. ' in screen.facts
    listed = screen.candidates
    assert listed.count('viewpoint_shift (') <= 1


def test_p_values_are_corrected_once(false_tilt):
    """A cause had the p-value of one test, a candidate that of all: 23 times as large and more."""
    null = false_tilt.null
    tilt = null.terms[-1]
    alone = false_tilt.test_removal(null.included_columns, tilt.columns, tilt.effect).p_value
    forms = null.fixed.forms.form_counts[tilt.name]
    corrected = min(1.0, alone * false_tilt.effect_count * forms)
    shares = {term.name: 0.1 for term in null.terms}
    errors = np.ones(null.column_count)
    posterior = EffectPosterior.of_null_model(null)
    held_out = [(0.1, 0.0)] * 2
    *_, cause = selected_causes(false_tilt, posterior, null.terms, errors, shares, held_out)
    assert cause.p_value == corrected > alone
    _, steps = eliminate_effects(false_tilt, ('focal_drift',), quick=True)
    assert all(one.p_corrected == corrected for one in steps)


def test_a_part_of_the_points_says_first_what_will_probably_be_found(monkeypatch):
    """Before the first round of all points; its thread is run at once here."""
    told, rng = [], np.random.default_rng(0)
    monkeypatch.setattr(stages, '_FIRST_LOOK', 360)
    monkeypatch.setattr(stages, 'Thread', lambda target, daemon: SimpleNamespace(start=target))
    shifted = [ModelTerm(ViewpointShiftEffect(), np.array([6e-3]))]
    points = observe(lens(), shifted, *scene(rng), 0.05, rng)
    found = diagnose(points, lens(), provisional=told.append)
    assert told == [('viewpoint_shift',)] * 2
    assert names(found) == {'viewpoint_shift'}


def test_nothing_is_known_of_the_error_of_a_lens_that_is_not_fitted():
    """It was stated as zero, with an interval of nothing, in diagnosis.json and the lens file."""
    rng = np.random.default_rng(0)
    points = observe(lens(), [], *scene(rng), 0.05, rng)
    found = diagnose(points, lens(), free_intrinsics=False)
    assert not names(found)
    assert found.ray_error_mrad() == {}
    assert 'ray_error_mrad' not in (found.lens.uncertainty or {})
