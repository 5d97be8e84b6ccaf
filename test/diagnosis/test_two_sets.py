"""Two data sets of one camera agree about its lens, whatever their boards are like."""

import re
from dataclasses import replace

import numpy as np
import pytest
from helpers.scenes import lens, observe, scene

from fisheye_svp_ros.cli import main
from fisheye_svp_ros.diagnosis import (
    Action,
    Comparison,
    DiagnosisOptions,
    Transfer,
    TwoDatasets,
    diagnose,
    diagnose_against,
    predict_board,
)
from fisheye_svp_ros.diagnosis.checks.two_datasets import SharedParameter, measure_travel
from fisheye_svp_ros.diagnosis.cross_validation import HeldOut, gain_and_confidence, rms_reduction
from fisheye_svp_ros.effects.base import ModelTerm
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.io.lens_files import save_lens
from fisheye_svp_ros.io.readers import write_observations
from fisheye_svp_ros.optics.curves import IMAGE_HEIGHTS
from fisheye_svp_ros.reporting.diagnosis_document import diagnosis_document
from fisheye_svp_ros.reporting.wording.external import sections, travel_sentence
from fisheye_svp_ros.reporting.wording.first_screen import first_screen, terminal_lines
from fisheye_svp_ros.solve.rig_state import group_by_frame

SHIFT, SKEW = CATALOGUE['viewpoint_shift'](), CATALOGUE['skew']()
QUICK = DiagnosisOptions(quick=True)


def table(seed, *terms, bend=0.0, frames=8):
    """Return what the camera sees of boards that are bent, and said to be flat."""
    rng = np.random.default_rng(seed)
    pose, views = scene(rng, frames=frames)
    points = views.points.copy()
    for board in range(3):
        mine = views.board == board
        off = points[mine] - points[mine].mean(axis=0)
        points[mine] += np.outer(bend * (off**2).sum(axis=1) / 0.04, [0.0, 0.0, 1.0])
    seen = observe(lens(), terms, pose, views._replace(points=points), 0.1, rng)
    return replace(seen, xyz=views.points[0][seen.landmark], cameras=('',), source=f'set {seed}')


def test_what_moves_with_the_lens_holds_in_the_other_set():
    one, other = (
        table(seed, ModelTerm(SHIFT, np.array([0.02])), bend=0.002 * k, frames=14)
        for k, seed in enumerate((31, 32))
    )
    found = diagnose_against(one, other, lens(), free_intrinsics=True, options=QUICK)
    said = found.against
    assert said.verdict == 'agree' and not said.withdrawn
    assert set(said.tried[0].causes) == {'viewpoint_shift'}
    assert said.tried[0].causes['viewpoint_shift'].improves
    assert said.tried[0].target is None
    e0 = said.parameters['viewpoint_shift.e0']
    assert abs(e0.standardized_difference) < 3 and e0.value == pytest.approx(0.02, abs=0.003)
    assert 'hold in both sets' in sections(found)[0].sentence
    document = diagnosis_document(found)
    assert document['external']['sets']['against'] == 'set 32'
    # The shift moves with the lens; bent boards count for neither lens.
    assert document['travel'] == said.travel._asdict()
    assert said.travel.extended_px < 0.97 * said.travel.given_px < 0.17
    first = terminal_lines(first_screen(found, 'a.csv'))[0]
    given, extended = (f'{px:.3g} px' for px in said.travel)
    assert first.startswith(f'On set 32, the lens as given leaves {given} and the ext')
    assert f'extended lens {extended}' in first


def test_nothing_of_the_target_is_predicted_of_another_one():
    one, other = (
        table(seed, ModelTerm(SHIFT, np.array([0.02])), bend=0.004 * k, frames=14)
        for k, seed in ((1, 31), (0, 32))
    )
    found = diagnose(
        one,
        lens(),
        free_intrinsics=True,
        held_out=other,
        options=DiagnosisOptions(included=('viewpoint_shift',)),
    )
    assert {'viewpoint_shift', 'target_shape'} <= {cause.effect for cause in found.causes}
    # The first board's offsets would make the prediction of the other one worse.
    assert max(found.figures.extended.heldout_rms_px, found.figures.named.heldout_rms_px) < 0.18
    assert found.figures.base.heldout_rms_px > 0.2
    assert Action.HOLD_OUT_SAME_TARGET in {advice.action for advice in found.advice}


def test_what_the_other_set_refutes_is_withdrawn():
    one, other = table(33, ModelTerm(SKEW, np.array([0.003]))), table(34)
    shares = []
    found = diagnose_against(
        one,
        other,
        lens(),
        free_intrinsics=True,
        options=QUICK,
        progress=lambda _, share: shares.append(share),
    )
    assert shares == sorted(shares) and shares[-1] < 0.88
    assert found.against.withdrawn == ('skew',) and found.against.verdict == 'contradict'
    assert 'skew' not in [cause.effect for cause in found.causes]
    (shear,) = (said for name, said in found.against.parameters.items() if 'skew' in name)
    assert shear.value == pytest.approx(0.003, abs=4 * shear.stderr)
    assert shear.other_value == pytest.approx(0.0, abs=4 * shear.other_stderr)
    assert shear.standardized_difference > 5
    assert 'withdrawn' in sections(found)[0].sentence


def test_parameters_that_do_not_agree_are_named():
    shift = SharedParameter(2.8e-3, 8e-5, 3.5e-3, 9e-5, 'm')
    said = TwoDatasets('b.csv', (None, None), {'e0': shift})
    assert said.verdict == 'nothing'
    assert said.parameters['e0'].standardized_difference == pytest.approx(-5.8, abs=0.1)


@pytest.mark.parametrize(
    ('low', 'high', 'better', 'worse'),
    [
        (0.01, 0.05, True, False),
        (-0.01, 0.05, False, False),
        (-0.05, -0.01, False, True),
    ],
)
def test_better_and_worse_are_beyond_chance(low, high, better, worse):
    tried = Transfer('a', 'b', 0.2, 0.18, Comparison(0.2, 0.18, (low + high) / 2, low, high))
    assert (tried.improves, tried.worsens) == (better, worse)


def test_the_intervals_of_predictions_hold_95_percent():
    """Against the scatter of means: 1.96 standard errors to each side."""
    rng, count = np.random.default_rng(5), np.full(400, 20)
    before, after = rng.gamma(8.0, 5.0, 400), rng.gamma(8.0, 2.5, 400)
    spread = [np.std(squares) / np.mean(squares) / 20 for squares in (before, after)]
    less = rms_reduction(HeldOut(before, count), HeldOut(before / 4, count))
    assert (less.high - less.low) / 2 == pytest.approx(1.96 * less.value * spread[0] / 2, rel=0.15)
    found, _ = gain_and_confidence(HeldOut(before, count), HeldOut(after, count), 0.0)
    ratio = after.mean() / before.mean()
    assert (found.high - found.low) / 2 == pytest.approx(
        1.96 * ratio * np.hypot(*spread), rel=0.15
    )


def test_a_bent_board_is_no_error_of_the_lens_that_predicts_it():
    flat, bent = (predict_board(group_by_frame(table(37, bend=b)), lens()) for b in (0.0, 0.004))
    assert bent.rms == pytest.approx(flat.rms, rel=0.02) and flat.rms < 0.19


def test_a_lens_that_does_not_image_all_points_has_no_figure():
    data = group_by_frame(table(37))
    # The farthest image height of an orthographic lens is its focal length.
    blind = replace(lens(), fx=1.0, fy=1.0, image_height=IMAGE_HEIGHTS['orthographic']())
    travel = measure_travel(data, lens(), blind)
    assert travel.given_px < 0.19 and np.isnan(travel.extended_px)
    said = travel_sentence(TwoDatasets('b.csv', (None, None), {}, travel=travel))
    assert 'the extended lens some points out of sight' in said


def test_command(tmp_path, capsys):
    for name, seed in (('a', 35), ('b', 36)):
        write_observations(
            tmp_path / f'{name}.csv', table(seed, ModelTerm(SKEW, np.array([0.003])))
        )
    save_lens(lens(), tmp_path / 'lens.yaml')
    arguments = [
        'diagnose',
        str(tmp_path / 'a.csv'),
        '--lens',
        str(tmp_path / 'lens.yaml'),
        '--free',
        'intrinsics',
        '--quick',
        '--against',
        str(tmp_path / 'b.csv'),
    ]
    assert main(arguments) == 0
    printed = capsys.readouterr().out
    assert 'The causes in the lens hold in both sets' in printed
    assert 'Another data set of this camera' in printed
    assert re.match(
        r'On b\.csv, the lens as given leaves [\d.]+ px and the extended lens [\d.]+ px; ', printed
    )


def test_rigs_are_refused():
    both = replace(table(35), cameras=('left', 'right'))
    both = replace(both, camera=(np.arange(len(both)) % 2))
    with pytest.raises(ObservationError, match='one camera'):
        diagnose_against(both, both, lens())
