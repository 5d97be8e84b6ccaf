"""Two cameras that see one bent board say the same of it, and of where they stand."""

import warnings
from dataclasses import fields, replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from benchmark.studies import two_cameras
from benchmark.studies.two_cameras import Hidden
from fisheye_svp_ros import cli
from fisheye_svp_ros.diagnosis import (
    Action,
    Comparison,
    DiagnosisOptions,
    Transfer,
    TwoCameras,
    diagnose,
    diagnose_against,
)
from fisheye_svp_ros.diagnosis.checks.two_cameras import TargetMaps
from fisheye_svp_ros.diagnosis.effect_forms import simplest_form
from fisheye_svp_ros.effects.ray_effects import ViewpointShiftEffect
from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.io.readers import write_observations
from fisheye_svp_ros.io.rig_files import load_rig
from fisheye_svp_ros.reporting.diagnosis_document import diagnosis_document
from fisheye_svp_ros.reporting.wording.diagnosis import verdict_sentences
from fisheye_svp_ros.reporting.wording.external import sections
from fisheye_svp_ros.reporting.wording.first_screen import first_screen
from fisheye_svp_ros.solve.bundle_adjustment import adjust
from fisheye_svp_ros.solve.initial_rig import initial_state, localize_frames
from fisheye_svp_ros.solve.measured_poses import posable_observations
from fisheye_svp_ros.solve.outliers import FRAME, find_outliers
from fisheye_svp_ros.solve.rig_checks import rig_is_inconsistent
from fisheye_svp_ros.solve.rig_state import Linearization, group_by_frame
from fisheye_svp_ros.study.trust import known_errors

# One process draws and calibrates each pair once.
pytestmark = pytest.mark.xdist_group('two cameras')
pair = cache(two_cameras.pair)
SMALL = Hidden(bend=1e-3, frames=14, columns=6, rows=5, reversed_frames=1)


def test_cameras_bear_each_other_out():
    seen = pair(SMALL, 1)
    found = diagnose(seen.table, seen.lenses, options=DiagnosisOptions(quick=True))
    (said,) = found.cameras
    assert said.verdict == 'agree' and said.withdrawn == ()
    assert 'target_shape' in [cause.effect for cause in found.causes]
    assert said.maps.correlation > 0.95
    assert all(one.with_px < 0.8 * one.without_px for one in said.target)
    assert {one.source for one in said.target} == {'left', 'right'}
    assert all(rig.low > 0 and rig.value > 0.3 for rig in said.rig.values())
    document = diagnosis_document(found)['external']['cameras'][0]
    assert set(document['rig']) == {'translation_m', 'rotation_rad'}
    assert 'agree' in sections(found)[0].sentence


def test_reversed_views_are_put_in_the_order_of_the_other_camera():
    seen = pair(replace(SMALL, reversed_frames=2), 3)
    found = diagnose(seen.table, seen.lenses, options=DiagnosisOptions(quick=True))
    assert [one['frame'] for one in diagnosis_document(found)['turned']] == seen.reversed_frames
    assert all(one.corrected and one.degrees == 180 for one in found.turned)
    assert [one.photograph for one in found.turned] == [
        f'frame {frame}' for frame in seen.reversed_frames
    ]
    assert not torn_frames(found) and found.figures.extended.rms_px < 0.11
    assert 'numbered from another end of the board' in verdict_sentences(found)[2]


def test_cameras_that_see_different_boards_contradict_each_other():
    seen = pair(replace(SMALL, apart=True, bend=2e-3, reversed_frames=0), 1)
    found = diagnose(seen.table, seen.lenses, options=DiagnosisOptions(quick=True))
    (said,) = found.cameras
    assert said.verdict == 'contradict' and said.withdrawn == ('target_shape',)
    assert 'target_shape' not in [cause.effect for cause in found.causes]
    assert 'withdrawn' in sections(found)[0].sentence


@pytest.mark.parametrize('seed', [4, 12])
def test_a_smooth_field_of_each_frame_is_no_rig_that_moves(seed):
    """No pose takes it up where two cameras share one."""
    seen = pair(replace(Hidden(), frames=26, rows=6, reversed_frames=0), seed)
    found = diagnose(seen.table, seen.lenses, free_intrinsics=True)
    assert not {cause.effect for cause in found.causes} & {'rig_flex', 'session_step'}


def test_reversed_frames_are_found_among_cameras_that_fit_badly():
    rough = Hidden((0.003, 0.001), 5e-4, 1e-4, 0.1, 0.1, 0.12, 0.01, 3, 25)
    seen = pair(rough, 1)
    data = group_by_frame(seen.table)
    first, *others = seen.lenses.values()
    _, gross = find_outliers(data, initial_state(data, first, others))
    torn = {
        int(data.observations.frame[row])
        for row, why in zip(gross.rows, gross.why, strict=True)
        if why == FRAME
    }
    assert torn == set(seen.reversed_frames) and len(torn) == 2


def test_a_view_of_few_points_does_not_contradict_the_other_camera():
    seen = pair(replace(SMALL, reversed_frames=0), 1)
    table = seen.table
    few = (table.camera == 0) & (table.frame == 3) & (table.landmark >= 8)
    data = group_by_frame(table.take(~few))
    first, *others = seen.lenses.values()
    _, gross = find_outliers(data, initial_state(data, first, others))
    assert FRAME not in gross.why


def test_what_the_user_knows_of_lenses_each_camera_of_a_rig_has_for_itself():
    seen = pair(replace(SMALL, reversed_frames=0), 1)
    data = group_by_frame(seen.table)
    first, *others = seen.lenses.values()
    state = initial_state(data, first, others)
    effect = simplest_form(ViewpointShiftEffect, Linearization(data, state, ()))
    assert [parameter.name for parameter in effect.parameters] == ['left.e0', 'right.e0']
    assert effect.kinds == ('left.viewpoint_shift', 'right.viewpoint_shift')


def test_a_calibrated_rig_leaves_out_frames_that_contradict_it(tmp_path, capsys):
    seen = pair(replace(SMALL, reversed_frames=0), 1)
    both = np.intersect1d(*(seen.table.frame[seen.table.camera == i] for i in (0, 1)))
    one, other = both[:2]
    swapped = {one: other, other: one}
    frame = [
        swapped.get(f, f) if camera else f
        for f, camera in zip(seen.table.frame, seen.table.camera, strict=True)
    ]
    write_observations(tmp_path / 'rig.csv', replace(seen.table, frame=np.array(frame)))
    words = ['calibrate', str(tmp_path / 'rig.csv'), '--image-size']
    assert cli.main([*words, 'left=1280x960']) == 2
    text = capsys.readouterr().err
    assert (
        'points reach 795 px to the right' in text
        and 'add --image-size right=WIDTHxHEIGHT' in text
    )
    assert cli.main([*words, 'left=1280x960,right=1024x768', '-o', str(tmp_path / 'rig')]) == 0
    said = capsys.readouterr().err
    assert f'frames {one} and {other}: its cameras contradict each other' in said
    assert [load_lens(tmp_path / 'rig' / f'{name}.yaml').width for name in ('left', 'right')] == [
        1280,
        1024,
    ]
    place = load_rig(tmp_path / 'rig' / 'rig.yaml').position
    assert np.abs(np.linalg.norm(place) - 0.1205) < 0.003


def few_shared(seen, count):
    """Return the table with the first of the frames that both saw, and which these are."""
    table = seen.table
    both = np.intersect1d(*(table.frame[table.camera == i] for i in (0, 1)))
    own = (table.camera == 1) & np.isin(table.frame, both[count:])
    return replace(table, frame=table.frame + 1000 * own), both[:count].tolist()


def reversed_in(table, frames):
    """Return the table with the right camera's points of some frames numbered from the end."""
    turned = np.isin(table.frame, frames) & (table.camera == 1)
    places = table.landmarks()
    landmark = np.where(turned, places.ids.max() - table.landmark, table.landmark)
    return replace(table, landmark=landmark, xyz=places.points[landmark])


def calibrated_rig(folder, table):
    write_observations(folder / 'rig.csv', table)
    assert (
        cli.main(
            [
                'calibrate',
                str(folder / 'rig.csv'),
                '--image-size',
                'left=1280x960,right=1024x768',
                '-o',
                str(folder / 'rig'),
            ]
        )
        == 0
    )
    return folder / 'rig' / 'rig.yaml'


def test_a_rig_that_half_of_the_frames_contradict_is_none(tmp_path, capsys):
    seen = pair(replace(SMALL, reversed_frames=0), 1)
    table, shared = few_shared(seen, 6)
    assert not calibrated_rig(tmp_path, reversed_in(table, shared[::2])).exists()
    said = capsys.readouterr().err
    assert 'no relative pose of left and right explains' in said and 'rig: frames' not in said


def test_a_calibrated_rig_says_what_it_rests_on(tmp_path, capsys):
    seen = pair(replace(SMALL, reversed_frames=0), 1)
    assert calibrated_rig(tmp_path, few_shared(seen, 3)[0]).exists()
    said = capsys.readouterr()
    assert (
        'rig: only 3 frames are shared. It is assumed that all cameras saw one target' in said.err
    )
    assert 'mm, from 3 frames, rms 0.' in said.out
    table = seen.table
    turned = replace(table, uv=table.uv + 2 * (np.sin(table.frame) * table.camera)[:, None])
    assert calibrated_rig(tmp_path, turned).exists()
    assert 'px with a rigid rig, compared with at most ' in capsys.readouterr().err


@pytest.mark.parametrize('late', [0.002, 0.0])
def test_cameras_that_were_not_photographed_together(late):
    seen = pair(replace(SMALL, reversed_frames=0, late=late), 1)
    # Of another moment altogether: with the next frame's number.
    table = seen.table if late else replace(seen.table, frame=seen.table.frame + seen.table.camera)
    found = diagnose(table, seen.lenses, options=DiagnosisOptions(quick=True))
    (said,) = found.cameras
    assert said.posed_alone and said.verdict == 'agree' and said.maps.correlation > 0.95
    assert 'each view has its own pose' in sections(found)[0].sentence
    assert 'is not constant' in verdict_sentences(found)[2].lower()
    assert found.figures.extended.heldout_rms_px < 0.15


def test_views_of_cameras_without_a_rig_are_counted_as_views():
    """A pair of four frames was told to be eight frames."""
    few, shared = few_shared(pair(replace(SMALL, reversed_frames=0), 1), 4)
    lenses = pair(replace(SMALL, reversed_frames=0), 1).lenses
    found = diagnose(
        few.take(np.isin(few.frame, shared)), lenses, options=DiagnosisOptions(quick=True)
    )
    said = 'in 8 views of 4 frames (each view with its own pose)'
    assert said in first_screen(found, 'table').facts
    facts = found.decision['photographs'].facts
    assert (facts.frames, facts.unit) == (8, 'view')


def test_a_center_that_the_rig_absorbs_is_no_gain_of_the_extended_lens():
    """The rig stayed as the extended lenses have it, and a sound lens "lost" 98 % to them."""
    seen = pair(replace(SMALL, reversed_frames=0), 1)
    right = seen.lenses['right']
    lenses = seen.lenses | {'right': replace(right, cx=right.cx + 2.0)}
    found = diagnose(
        seen.table, lenses, free_intrinsics=True, options=DiagnosisOptions(quick=True)
    )
    assert found.file.given_px < 0.25


def test_maps_along_the_board_alone_are_compared_along_it():
    """Without a height the maps of cameras that agree were told to "correlate by 0.00"."""
    maps = TargetMaps(88, 0.0, 0.57, (1e-21, 1e-21))
    carried = (Transfer('left', 'right', 0.3, 0.2, Comparison(0.3, 0.2, 0.1, 0.05, 0.15)),) * 2
    found = SimpleNamespace(
        cameras=[TwoCameras(('left', 'right'), carried, maps, {})], hand_eye=None, against=None
    )
    (section,) = sections(found)
    assert 'their maps correlate by 0.57 along the board' in section.sentence
    assert not any(row[0].startswith('height') for row in section.rows)


def test_cameras_without_a_common_frame():
    seen = pair(replace(SMALL, reversed_frames=0), 1)
    apart = replace(seen.table, frame=seen.table.frame + 100 * seen.table.camera)
    found = diagnose(apart, seen.lenses, options=DiagnosisOptions(quick=True))
    (said,) = found.cameras
    assert said.verdict == 'agree' and said.maps.correlation > 0.95 and not said.rig
    assert not said.posed_alone
    assert 'Too few frames are shared' in sections(found)[0].sentence
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        assert known_errors(found.evaluation.simulation, found.evaluation.fixed_model, ()) == {}


def test_a_wrong_lens_is_no_rig_that_moves():
    seen = pair(replace(SMALL, reversed_frames=0), 1)
    left, right = (replace(lens, calibration=None) for lens in seen.lenses.values())
    right = replace(right, fx=1.03 * right.fx, fy=1.03 * right.fy)
    data = group_by_frame(seen.table)
    base = adjust(data, initial_state(data, left, [right]), ())
    assert not rig_is_inconsistent(data, (left, right), base, ())


def torn_frames(found, where=''):
    return sorted({one['frame'] for one in found.gross if one['why'] == where + FRAME})


@pytest.mark.parametrize('seed, which', [(2, 1), (4, 0)])
def test_one_of_three_shared_frames_is_reversed(seed, which):
    # In seed 2 the pose of one view is far less certain than the others'.
    seen = pair(replace(SMALL, bend=1e-3, columns=9, rows=6, frames=24, reversed_frames=0), seed)
    table, shared = few_shared(seen, 3)
    found = diagnose(
        reversed_in(table, shared[which]), seen.lenses, options=DiagnosisOptions(quick=True)
    )
    assert torn_frames(found) == [shared[which]]
    # Two frames say too little of the rig for one to predict the other.
    assert found.figures.named.heldout_rms_px < 0.13 < found.figures.base.heldout_rms_px < 0.21
    (said,) = found.cameras
    assert said.verdict == 'agree' and not said.rig
    assert f'(frame {shared[which]})' in verdict_sentences(found)[2]


def halves(seen):
    """Return the two halves of a pair's frames as tables."""
    later = seen.table.frame >= np.median(seen.table.frames)
    return seen.table.take(~later), seen.table.take(later)


@pytest.fixture(scope='module')
def longer():
    return pair(replace(SMALL, frames=32, reversed_frames=0), 1)


def test_reversed_frames_among_those_held_out_are_named(longer):
    train, test = halves(longer)
    shared = np.intersect1d(*(test.frame[test.camera == i] for i in (0, 1)))[:2].tolist()
    found = diagnose(
        train,
        longer.lenses,
        held_out=reversed_in(test, shared),
        options=DiagnosisOptions(quick=True),
    )
    assert torn_frames(found, 'held out: ') == shared
    assert found.figures.named.heldout_rms_px < 0.16
    assert f'(frames {shared[0]} and {shared[1]})' in verdict_sentences(found)[2]


def test_lenses_before_predict_held_out_frames_with_their_own_rig(longer):
    """With that of the extended lenses they did worse than `localize` with the same files."""
    train, test = halves(longer)
    found = diagnose(train, longer.lenses, held_out=test, options=DiagnosisOptions(quick=True))
    data = found.evaluation.held_out.data
    posed = Linearization(data, localize_frames(data, found.evaluation.simulation.state), ())
    assert found.figures.base.heldout_rms_px == pytest.approx(posed.rms_px, rel=1e-3)
    trained, (left, right) = found.evaluation.simulation.data, longer.lenses.values()
    written = adjust(trained, initial_state(trained, left, [right]), ())
    posed = Linearization(data, localize_frames(data, written), ())
    assert found.evaluation.as_given_px == pytest.approx(posed.rms_px, rel=1e-3)
    said = f'Held-out error: {posed.rms_px:.3g} px with the lens as given, '
    assert said in first_screen(found, 'table').facts


def test_held_out_frames_in_which_the_rig_stands_elsewhere_are_posed_view_by_view(longer):
    train, test = halves(longer)
    late = replace(test, frame=test.frame + test.camera)
    found = diagnose(train, longer.lenses, held_out=late, options=DiagnosisOptions(quick=True))
    assert found.figures.named.heldout_rms_px < 0.16
    assert 'relative camera poses differ from the others' in verdict_sentences(found)[2]


def test_a_rig_that_was_not_seen_predicts_nothing_in_held_out_frames(longer):
    train, test = halves(longer)
    apart, _ = few_shared(longer._replace(table=train), 0)
    # The right camera's rows come first.
    test = test.take(np.argsort(-test.camera, kind='stable'))
    test = replace(test, cameras=('right', 'left'), camera=1 - test.camera)
    found = diagnose(apart, longer.lenses, held_out=test, options=DiagnosisOptions(quick=True))
    assert found.figures.named.heldout_rms_px < 0.16
    assert not {Action.CHECK_HELD_OUT_RIG, Action.CHECK_HELD_OUT_FRAMES} & {
        advice.action for advice in found.advice
    }
    with pytest.raises(ObservationError, match='cam0, right'):
        diagnose(train, longer.lenses, held_out=replace(test, cameras=('cam0', 'right')))


def test_a_frame_that_alone_shows_a_part_of_the_image_spoils_no_figure():
    seen = pair(replace(SMALL, columns=9, rows=6, frames=24, reversed_frames=0), 3)
    gone = (seen.table.camera == 1) & (seen.table.frame % 3 == 0)
    found = diagnose(seen.table.take(~gone), seen.lenses, options=DiagnosisOptions(quick=True))
    # Frame 19 is at the edge of the right camera's image; without it 2.8 px remain there.
    alone = [one for one in found.advice if one.action is Action.TAKE_MORE_LIKE_THESE]
    assert [one.frames for one in alone] == [[19]]
    assert found.figures.named.heldout_rms_px < 0.14 < found.figures.base.heldout_rms_px < 0.17
    (said,) = found.cameras
    assert said.verdict == 'agree'


def test_cameras_must_mean_the_same_place_by_a_landmark(longer):
    table = longer.table
    off = replace(table, xyz=table.xyz + 0.05 * table.camera[:, None])
    with pytest.raises(ObservationError, match='landmark 0 has two positions'):
        diagnose(off, longer.lenses)


def test_the_same_photographs_twice_are_no_witness(longer):
    train, test = halves(longer)
    again = replace(train, frame=train.frame + 100, source='again')
    with pytest.raises(ObservationError, match='again: these image points are those of pair'):
        diagnose(train, longer.lenses, held_out=again)
    left = test.take(test.camera == 0)
    with pytest.raises(ObservationError, match='image points are those of pair'):
        diagnose_against(left, replace(left, frame=left.frame + 100), longer.lenses['left'])
    right = replace(left, camera=np.ones_like(left.camera))
    both = replace(
        left,
        **{
            one.name: np.concatenate([getattr(left, one.name), getattr(right, one.name)])
            for one in fields(left)
            if one.name not in ('cameras', 'source')
        },
    )
    with pytest.raises(ObservationError, match='camera right: these image points are those of'):
        diagnose(both, longer.lenses)


def test_lenses_of_another_image_size_are_refused(longer):
    left, right = longer.lenses.values()
    with pytest.raises(ObservationError, match='outside the 1024x768 px of lens'):
        posable_observations(longer.table, {'left': right, 'right': left})
    assert len(posable_observations(longer.table, longer.lenses)[0]) == len(longer.table)
