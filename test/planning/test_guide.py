"""The live guide's core: score, standstill, what is wanted next, when it is enough."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.guide import LENS, POINTS, SHEET, present, seen_from, session

from fisheye_svp_ros.detect.patterns import parse_pattern
from fisheye_svp_ros.diagnosis import diagnose
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.optics.lens import intrinsic_names
from fisheye_svp_ros.planning import guide as module
from fisheye_svp_ros.planning.guide import (
    DetectedBoard,
    Guide,
    SessionState,
    evaluate_session,
    observations_of,
)
from fisheye_svp_ros.planning.optimal_design import FlatBoard
from fisheye_svp_ros.planning.plan import next_photographs
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.solve.bundle_adjustment import Prior, adjust
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.rig_state import group_by_frame

SYMMETRIC = parse_pattern('chessboard:5x5:30mm').symmetries


@pytest.fixture(scope='module')
def first():
    stand = evaluate_session(session())
    assert isinstance(stand, SessionState)
    return stand


def guided(first, orders=None):
    guide = Guide(session(), np.arange(len(POINTS))[None] if orders is None else orders)
    assert guide.outline is None and guide.score == 0 and not guide.look(0.0, None)
    guide.adopt(first)
    return guide


def shifted(seen, t, px):
    return seen._replace(t=t, uv=seen.uv + px)


def wanted_view(guide, t=0.0):
    """Return what the outline shows, as if it were seen."""
    ids = np.arange(len(POINTS))
    return DetectedBoard(t, ids, np.array(guide.outline), np.full(len(ids), 0.03))


def test_the_score_rises_while_the_board_approaches(first):
    guide, scores = guided(first), []
    there = wanted_view(guide)
    for step, away in enumerate(np.linspace(400, 0, 30)):
        guide.look(0.1 * step, shifted(there, 0.1 * step, [away, 0]))
        scores.append(guide.score)
    assert (np.diff(scores) > 0).all() and scores[0] < 0.3 and scores[-1] == 1
    guide.look(3.1, None)
    assert guide.score == 0


def test_a_standstill_is_taken_by_itself_and_only_there(first):
    guide = guided(first)
    there, rng = wanted_view(guide), np.random.default_rng(0)
    for step in range(20):  # still, but elsewhere
        assert not guide.look(0.1 * step, shifted(there, 0.1 * step, [300, 0]))
    for step in range(20, 40):  # there, but moving
        assert not guide.look(0.1 * step, shifted(there, 0.1 * step, [step - 30, 0]))
    for step in range(40, 60):  # a hand trembles
        t = 0.1 * step
        if guide.look(t, shifted(there, t, rng.normal(scale=0.2, size=2))):
            break
    assert t == pytest.approx(4.5) and len(guide.session.taken) == 1
    assert guide.thinking and guide.outline is None
    assert not guide.look(t + 0.1, shifted(there, t + 0.1, 0.0))
    assert observations_of(guide.session.taken, POINTS).t[0] == t


def test_a_board_that_looks_the_same_when_turned_may_be_turned(first):
    points = parse_pattern('chessboard:5x5:30mm').points
    orders = np.stack([turn.source for turn in SYMMETRIC])
    guide = Guide(replace(session(), points=points), orders)
    guide.adopt(first._replace(outline=(points[:, :2] * 1e3,)))
    half = next(turn.source for turn in SYMMETRIC if turn.source[0] == 24)
    turned = DetectedBoard(0.0, np.arange(25), guide.outline[half], np.ones(25))
    guide.look(0.0, turned)
    assert guide.score == pytest.approx(1)


def test_a_view_that_cannot_be_had_is_given_up(first):
    guide = guided(first)
    ones = len(first.outline)
    for _ in range(ones):
        outline = guide.outline
        for t in np.arange(0, 23, 2.0):
            guide.look(float(t), None)
        assert guide.outline is not outline
    assert guide.thinking and len(guide.session.room.taken) == ones
    middles = [
        first.wanted.shots.camera.take(i).into_body(POINTS).mean(axis=0) for i in range(ones)
    ]
    again = evaluate_session(guide.session)
    for i in range(len(again.outline)):
        middle = again.wanted.shots.camera.take(i).into_body(POINTS).mean(axis=0)
        away = np.linalg.norm(middle - middles, axis=1)
        assert (away > 0.2 * np.linalg.norm(middle)).all()


def test_views_are_whole_with_the_squares_around_their_corners(first):
    board = FlatBoard(np.arange(len(POINTS)), POINTS, np.zeros(len(POINTS), int), np.eye(3))
    assert board.rim.min(axis=0) == pytest.approx([-0.03, -0.03, 0])
    for i in range(len(first.outline)):
        local = first.wanted.shots.camera.take(i).into_body(board.rim)
        assert np.degrees(np.arccos(local[:, 2] / np.linalg.norm(local, axis=1))).max() < (
            np.degrees(SHEET.max_incidence)
        )
        uv = ForwardModel(SHEET).project(local[None]).uv[0]
        assert (uv > 0).all() and (uv < [SHEET.width, SHEET.height]).all()


def test_one_photograph_moves_the_data_sheet_no_further_than_it_must(first):
    """Fits without a prior, or with one of the wrong sign, end far outside any lens."""
    seen = present(LENS, first, np.random.default_rng(1))
    data = group_by_frame(observations_of([seen], POINTS))
    free = intrinsic_names(SHEET)
    sheet = np.array([SHEET.parameters[name] for name in free])
    loose = np.array([30.0, 30.0, 15.0, 15.0, 0.05, 0.02, 0.01, 0.005])
    state = adjust(data, initial_state(data, SHEET), free, Prior(sheet, np.diag(1 / loose)))
    moved = np.array([state.lens.parameters[name] for name in free]) - sheet
    assert (np.abs(moved) < 2.5 * loose).all()
    held = adjust(data, initial_state(data, SHEET), free, Prior(sheet, np.diag(1e9 / loose)))
    assert [held.lens.parameters[name] for name in free] == pytest.approx(sheet, abs=1e-6)


def test_of_a_board_seen_in_part_the_whole_is_wanted(first):
    seen = present(LENS, first, np.random.default_rng(1))
    part = np.arange(18)
    seen = DetectedBoard(0.0, part, seen.uv[part], seen.sigma[part])
    stand = evaluate_session(replace(session(), taken=(seen,)))
    assert np.shape(stand.outline) == (len(stand.outline), len(POINTS), 2)
    guide = guided(stand)
    there = wanted_view(guide)
    finite = np.isfinite(there.uv).all(axis=1)
    assert finite[part].all()
    guide.look(0.0, DetectedBoard(0.0, there.ids[part], there.uv[part], there.sigma[part]))
    assert guide.score == pytest.approx(1)


def test_from_a_data_sheet_to_a_settled_shift(first):
    """Somebody presents the wanted views, a little off; the shift is 3 mm, the goal 0.3 mm."""
    guide, rng = guided(first), np.random.default_rng(5)
    while not guide.is_finished:
        assert len(guide.session.taken) < 12
        seen = present(LENS, guide.stand, rng)
        guide.session = replace(guide.session, taken=(*guide.session.taken, seen))
        stand = evaluate_session(guide.session)
        assert isinstance(stand, SessionState), stand
        guide.adopt(stand)
    assert guide.stand.settled and guide.stand.named == ('viewpoint_shift',)
    assert guide.stand.stderr <= 3e-4
    true = LENS.viewpoint_shift.e0
    assert abs(guide.stand.value - true) < 4 * guide.stand.stderr


def test_hope_to_tell_a_look_alike_ends(first, monkeypatch):
    rng, found = np.random.default_rng(5), []

    def alike(table, lens, **settings):
        assert settings['free_intrinsics']  # the data sheet's lens is a guess
        found.append(diagnose(table, lens, **settings))
        if 'wanted' not in settings:
            found[-1].causes[0].indistinguishable_from.append('flat_port')
        return found[-1]

    def hopeful(*args, **settings):
        return next_photographs(*args, **settings)._replace(answers=(0.9,) * 5)

    monkeypatch.setattr(module, 'diagnose', alike)
    monkeypatch.setattr(module, 'next_photographs', hopeful)
    taken = tuple(present(LENS, first, rng) for _ in range(10))
    few = evaluate_session(replace(session(), taken=taken[:9], goal=1.0))
    many = evaluate_session(replace(session(), taken=taken, goal=1.0))
    assert not few.settled and few.alike == many.alike == ('flat_port',)
    assert many.settled and len(found) == 3


def test_what_fails_is_left_out(first, monkeypatch):
    guide = guided(first)
    seen = seen_from(LENS, Pose(np.eye(3), np.array([0.07, 0.06, -0.2])), np.random.default_rng(0))
    nonsense = seen._replace(uv=0 * seen.uv)
    guide.session = replace(guide.session, taken=(seen, nonsense))
    guide.fail()
    assert guide.thinking and guide.session.taken == (seen,)
    nowhere = replace(session(), room=session().room._replace(near=50.0, far=60.0))
    assert isinstance(evaluate_session(nowhere), GeometryError)
    monkeypatch.setattr(module, 'MAX_PHOTOGRAPHS', 1)
    guide.adopt(first)
    assert guide.is_finished and guide.outline is None
