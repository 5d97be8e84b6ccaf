"""The next photographs: information, choice, what a person is told."""

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers.water import AIR, photographs

from fisheye_svp_ros.cli import main
from fisheye_svp_ros.detect.patterns import parse_pattern
from fisheye_svp_ros.diagnosis import Cause
from fisheye_svp_ros.effects.base import ModelTerm
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.effects.ray_effects import ViewpointShiftEffect
from fisheye_svp_ros.errors import GeometryError, ParameterError
from fisheye_svp_ros.io.lens_files import load_lens, save_lens
from fisheye_svp_ros.io.readers import read_poses, write_observations
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.optics.curves import Gennery
from fisheye_svp_ros.optics.lens import intrinsic_names
from fisheye_svp_ros.planning.optimal_design import (
    Design,
    FlatBoard,
    ViewLimits,
    candidate_shots,
    max_view_angle,
    richest_forms,
)
from fisheye_svp_ros.planning.plan import next_photographs, plan
from fisheye_svp_ros.pose import rotation_from_vector
from fisheye_svp_ros.reporting.wording.shots import instruction, purpose, rows
from fisheye_svp_ros.scene.observations import Landmarks, make_observations
from fisheye_svp_ros.simulate.simulation import simulate
from fisheye_svp_ros.solve.bundle_adjustment import adjust
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.rig_state import Linearization, group_by_frame

ROOM, NOISE = ViewLimits(0.25, 1.5), 0.1
SHIFTED = replace(AIR, viewpoint_shift=Gennery(e0=0.003))
FREE = intrinsic_names(AIR)


def fitted(observations, terms=()):
    data = group_by_frame(observations)
    state = replace(initial_state(data, AIR), terms=terms)
    return Linearization(data, adjust(data, state, FREE), FREE)


@pytest.fixture(scope='module')
def linear():
    return fitted(
        photographs(SHIFTED, None, 8), (ModelTerm(ViewpointShiftEffect(1), np.zeros(1)),)
    )


@pytest.fixture(scope='module')
def board(linear):
    return FlatBoard.from_observations(linear.data.observations, linear.state.pose)


@pytest.fixture(scope='module')
def shots(linear, board):
    return candidate_shots(linear.state, board, ROOM, np.random.default_rng(0))


def test_a_candidate_is_what_it_says_and_can_be_detected(linear, board, shots):
    model = ForwardModel(linear.state.lens, linear.state.terms)
    for i in range(0, len(shots.distance), 25):
        local = shots.camera.take(i).into_body(board.points)
        middle = local.mean(axis=0)
        assert np.linalg.norm(middle) == pytest.approx(shots.distance[i])
        assert np.arctan2(np.linalg.norm(middle[:2]), middle[2]) == pytest.approx(shots.angle[i])
        normal = shots.camera.rotation[i].T @ board.facing[2]
        assert normal @ middle / shots.distance[i] == pytest.approx(np.cos(shots.tilt[i]))
        uv = model.project(local[None]).uv[0]
        assert (uv > 8).all() and (uv < [AIR.width - 8, AIR.height - 8]).all()


def test_the_side_said_to_be_away_is_away(board, shots):
    """Of a board tilted in the middle of the image, about the horizontal: its top or bottom."""
    i = int(np.flatnonzero((shots.tilt > 0) & (shots.tilt_axis == 0) & (shots.angle < 0.3))[0])
    local = shots.camera.take(i).into_body(board.points)
    assert 'bottom away' in instruction(shots, i)[2]
    bottom, top = local[local[:, 1].argmax()], local[local[:, 1].argmin()]
    assert np.linalg.norm(bottom) > np.linalg.norm(top)


def test_before_any_photograph_the_lens_is_known_to_a_tenth(linear, board, shots):
    design = Design(linear, (), board, shots, NOISE, known=False)
    wide = dict(zip(design.names, 1 / np.sqrt(np.diag(design.known)), strict=True))
    assert wide['fx'] == wide['cy'] == pytest.approx(0.1 * linear.state.lens.focal)


def test_the_board_is_turned_as_said(board, shots):
    square = np.flatnonzero(shots.tilt == 0)
    assert len(set(shots.roll[square].round(6))) == 8
    for i in square:
        azimuth = shots.azimuth[i]
        aside = rotation_from_vector(
            shots.angle[i] * np.array([-np.sin(azimuth), np.cos(azimuth), 0])
        )
        right = aside.T @ shots.camera.rotation[i].T @ board.facing[0]
        said = [np.cos(shots.roll[i]), np.sin(shots.roll[i]), 0]
        np.testing.assert_allclose(right, said, atol=1e-9)


def test_predicted_errors_are_those_of_noisy_refits(linear, board, shots):
    """Choose, photograph, fit: the error of e0 scatters as was said."""
    design = Design(linear, (), board, shots, NOISE)
    chosen, answers = design.choose(design.question('e0'), 3)
    assert np.all(np.diff(answers) < 0)
    first, landmarks, pulls = linear.data.observations, Landmarks(board.landmark, board.points), []
    for seed in range(6):
        more = simulate(
            ForwardModel(SHIFTED),
            landmarks,
            shots.camera.take(chosen),
            NOISE,
            np.random.default_rng(seed),
        )
        both = make_observations(
            *(
                np.concatenate(pair)
                for pair in (
                    (first.frame, more.frame + 100),
                    (first.landmark, more.landmark),
                    (first.uv, more.uv),
                    (first.xyz, more.xyz),
                )
            )
        )
        again = fitted(both, (ModelTerm(ViewpointShiftEffect(1), np.zeros(1)),))
        pulls.append((again.state.terms[0].values[0] - 0.003) / answers[-1])
    assert np.abs(pulls).max() < 4


def test_chosen_photographs_tell_more_than_random_ones(linear, board, shots):
    design = Design(linear, (), board, shots, NOISE)
    question = design.question('e0')
    chosen, answers = design.choose(question, 4)
    assert len(set(chosen.tolist())) == 4
    rng = np.random.default_rng(0)
    by_chance = [
        question.answer(design.known + design.added[taken].sum(axis=0))
        for taken in rng.choice(len(shots.distance), (20, 4))
    ]
    assert answers[4] < min(by_chance) and answers[4] < 0.6 * np.median(by_chance)


def test_doubt_between_a_cause_and_its_look_alikes_is_settled(linear, board, shots):
    effects = richest_forms(linear, ('radial_profile', 'target_shape'))
    design = Design(linear, effects, board, shots, NOISE)
    question = design.question('viewpoint_shift', ('radial_profile', 'target_shape'))
    _, answers = design.choose(question, 4)
    assert answers[0] < answers[-1] and answers[-1] > 0.99


def cause(alike):
    return Cause('viewpoint_shift(order=1)', {}, 0.0, 1.0, True, 0.1, 0.5, alike)


def test_the_question_is_the_doubt_then_the_cause_then_the_lens(linear, board):
    doubt = next_photographs(linear, [cause(['radial_profile'])], NOISE, 2, room=ROOM)
    assert (doubt.asked, doubt.others) == ('viewpoint_shift', ('radial_profile',))
    assert [len(row) for row in rows(doubt)] == [6, 6] and 'sure' in rows(doubt)[-1][-1]
    assert '--without' not in purpose(doubt._replace(answers=(0.1, 0.5, 0.9)))
    hardly = doubt._replace(answers=(0.02, 0.03, 0.04), others=('flat_port',))
    assert purpose(hardly).endswith('exclude an absent one with --without flat_port')
    sized = next_photographs(linear, [cause([])], NOISE, 2, room=ROOM)
    assert (sized.asked, sized.unit) == ('viewpoint_shift', 'm')
    assert 'mm' in rows(sized)[0][-1]
    whole = next_photographs(fitted(photographs(AIR, None, 6)), [], NOISE, 2, room=ROOM)
    assert whole.asked == 'lens' and whole.answers[0] == 1.0 > whole.answers[-1]
    away = np.linalg.norm(board.points.mean(axis=0) - linear.state.pose.position, axis=1)
    anywhere = next_photographs(linear, [cause([])], NOISE, 2).shots.distance
    assert (0.5 * away.min() <= anywhere).all() and (anywhere <= 3 * away.max()).all()
    for name in ('landmark_scale', 'landmark_scale.relative', 'viewpoint_shift.e0'):
        named = next_photographs(linear, [], NOISE, 1, name, ROOM)
        assert named.asked == name and named.to_list()[0]['distance_m'] > 0.2


def test_what_cannot_be_planned_is_refused(linear, board):
    known = (
        r'choose from fx, fy, .*viewpoint_shift\.e0, .*landmark_survey, landmark_scale\.relative'
    )
    with pytest.raises(ParameterError, match=known):
        next_photographs(linear, [], NOISE, 1, 'colour', ROOM)
    with pytest.raises(GeometryError, match='does not see the whole board from 50 to 60 m'):
        candidate_shots(linear.state, board, ViewLimits(50.0, 60.0), np.random.default_rng(0))
    seen = linear.data.observations
    bent = replace(seen, xyz=seen.xyz + [0, 0, 1] * np.abs(seen.xyz[:, :1]))
    with pytest.raises(GeometryError, match='not one flat board'):
        FlatBoard.from_observations(bent, linear.state.pose)


@pytest.mark.parametrize(
    ('options', 'said'),
    [
        (['--next', '101'], "'101' photographs are too many; at most 100 can be planned at once"),
        (['--next', '2', '--for', 'fx'], '--for fx: fx is fixed; add --free intrinsics'),
        (
            ['--next', '2', '--for', 'zz', '--free', 'intrinsics'],
            '--for zz: not a parameter of this lens or of an effect; choose from fx, ',
        ),
    ],
)
def test_what_cannot_be_planned_is_refused_before_the_diagnosis(
    tmp_path, capsys, monkeypatch, options, said
):
    monkeypatch.setattr('fisheye_svp_ros.diagnosis.diagnose', lambda *_, **__: pytest.fail('ran'))
    save_lens(AIR, tmp_path / 'lens.yaml')
    write_observations(tmp_path / 'seen.csv', photographs(AIR, None, 3))
    try:
        code = main(
            [
                'diagnose',
                str(tmp_path / 'seen.csv'),
                '--lens',
                str(tmp_path / 'lens.yaml'),
                *options,
            ]
        )
    except SystemExit as ended:
        code = ended.code
    assert code == 2 and said in capsys.readouterr().err


def test_no_more_views_are_planned_than_there_are(board):
    """A large board in a small room: only a few places show it whole."""
    shots = plan(
        load_lens(lens_path('fish180')),
        parse_pattern('chessboard:9x6:100mm').points,
        ViewLimits(0.15, 0.2),
        100,
        None,
        NOISE,
    ).wanted.shots
    assert 1 < len(np.unique(shots.camera.position, axis=0)) <= len(shots.distance) < 100


def test_diagnose_says_which_photographs_to_take_next(tmp_path, capsys):
    save_lens(AIR, tmp_path / 'lens.yaml')
    write_observations(tmp_path / 'seen.csv', photographs(SHIFTED, None, 6))
    command = ['diagnose', str(tmp_path / 'seen.csv'), '--lens', str(tmp_path / 'lens.yaml')]
    assert (
        main(
            [
                *command,
                '--quick',
                '--next',
                '2',
                '--for',
                'e0',
                '--room',
                '0.2',
                '1.0',
                '-o',
                str(tmp_path / 'out'),
            ]
        )
        == 0
    )
    assert 'photographs to take next, for e0' in capsys.readouterr().out
    entries = json.loads((tmp_path / 'out/diagnosis.json').read_text())['next']
    assert len(entries) == 2 and entries[1]['stderr_after'] < entries[0]['stderr_before']
    assert (tmp_path / 'out/next.png').is_file()
    assert 'Photographs to take next' in (tmp_path / 'out/report.html').read_text()
    assert main([*command, '--for', 'e0']) == 2


def test_no_planned_view_needs_more_than_the_field_of_view(tmp_path):
    assert (
        main(
            [
                'plan',
                '--fov',
                '150',
                '--image-size',
                '640x480',
                '--board',
                'chessboard:6x4:25mm',
                '--room',
                '0.1',
                '0.6',
                '--count',
                '6',
                '-o',
                str(tmp_path),
            ]
        )
        == 0
    )
    camera = read_poses(tmp_path / 'poses.csv').pose
    points = camera.into_body(np.tile(parse_pattern('chessboard:6x4:25mm').points, (6, 1, 1)))
    angle = np.arccos(points[..., 2] / np.linalg.norm(points, axis=-1))
    assert 60 < np.degrees(angle).max() < 75


def test_a_board_that_never_fits_is_refused_by_its_corners(monkeypatch, capsys):
    looked_at, predict = [], ForwardModel.predict

    def counted(model, pose, views):
        looked_at.append(views.uv[..., 0].size)
        return predict(model, pose, views)

    monkeypatch.setattr(ForwardModel, 'predict', counted)
    assert (
        main(
            [
                'plan',
                '--lens',
                'fish180',
                '--board',
                'chessboard:40x30:100mm',
                '--room',
                '0.1',
                '0.5',
            ]
        )
        == 2
    )
    assert 'does not see the whole board from 0.1 to 0.5 m' in capsys.readouterr().err
    assert sum(looked_at) < 100_000


def test_no_view_lies_far_beyond_what_was_seen_or_the_nearest_edge_of_the_image(board):
    """The corners of an image may be dark; nobody has said that they are."""
    wide = replace(AIR, fx=AIR.fx / 2, fy=AIR.fy / 2, max_incidence=3.0)
    data = group_by_frame(photographs(wide, None, 6))
    linear = Linearization(data, adjust(data, initial_state(data, wide), FREE), FREE)
    wanted = next_photographs(linear, [], NOISE, 6, room=ROOM)
    limit = max_view_angle(wide, 0.0)
    assert limit == pytest.approx(wide.image_height.angle(AIR.height / AIR.fy), 0.02)
    for shots in (
        wanted.shots,
        plan(
            replace(wide, calibration={'reached_deg': 30.0}), board.points, ROOM, 6, None, NOISE
        ).wanted.shots,
    ):
        seen = shots.camera.into_body(board.points)
        assert np.arccos(seen[..., 2] / np.linalg.norm(seen, axis=-1)).max() < limit


def test_views_past_what_a_lens_was_calibrated_for_are_named(tmp_path, capsys):
    lens = {
        'name': 'narrow',
        'image': {'width': 640, 'height': 480},
        'projection': {'model': 'equidistant', 'f': 200.0, 'cx': 320.0, 'cy': 240.0},
    }
    for reached in (50, 115):
        (tmp_path / 'lens.yaml').write_text(
            json.dumps({**lens, 'calibration': {'reached_deg': reached}})
        )
        assert (
            main(
                [
                    'plan',
                    '--lens',
                    str(tmp_path / 'lens.yaml'),
                    '--board',
                    'chessboard:9x6:25mm',
                    '--room',
                    '0.15',
                    '0.8',
                    '--count',
                    '3',
                ]
            )
            == 0
        )
        noted = 'calibrated up to 50 degrees off the axis. Views ' in capsys.readouterr().err
        assert noted == (reached == 50)


def test_a_plan_before_the_first_photograph(tmp_path, capsys, drawn):
    command = [
        'plan',
        '--fov',
        '170',
        '--image-size',
        '640x480',
        '--board',
        'chessboard:9x6:25mm',
        '--room',
        '0.15',
        '0.8',
        '--count',
        '4',
    ]
    assert main([*command, '--for', 'e0', '-o', str(tmp_path)]) == 0
    assert 'photographs to take, for e0' in capsys.readouterr().out
    planned = json.loads((tmp_path / 'plan.json').read_text())
    assert len(planned['photographs']) == 4 and planned['stderr']['e0'] < 0.002
    assert (tmp_path / 'plan.pdf').read_bytes().startswith(b'%PDF')
    assert main([*command, '--lens', 'fish180']) == 2
    assert (
        main(['plan', '--lens', 'fish180', '--board', 'chessboard:9x6:25mm', '--room', '1', '0.5'])
        == 2
    )
    assert '--room 1 0.5' in capsys.readouterr().err
