"""Tags stand or fall as wholes; what one image cannot tell, the covariance covers."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.tag_room import LENS, TagRoom, oval

from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.solve import localization
from fisheye_svp_ros.solve.poses import solve_poses
from fisheye_svp_ros.solve.tag_units import MOVED
from fisheye_svp_ros.solve.weak_geometry import CHI2_999, is_ambiguous

MODEL, ROOM = ForwardModel(LENS), TagRoom(16)


def solve(moved, count, rng, place, sigma=0.2):
    """Return what comes of an image of some tags, and how far off it is (Mahalanobis squared)."""
    camera = oval(place)
    seen = rng.permutation(ROOM.visible(camera))
    rooms = (ROOM if moved is None else ROOM.move(tag, moved) for tag in seen.tolist())
    first, room = next(
        (i, room) for i, room in enumerate(rooms) if seen[i] in room.visible(camera)
    )
    seen = np.append(seen[first], np.delete(seen, first)[: count - 1])
    views = ROOM.views(camera, room.project(camera, seen), seen, sigma, rng)
    solved = solve_poses(MODEL, views, tags=True)
    change = solved.pose.difference(camera.take(None))[0]
    return solved, change @ np.linalg.solve(solved.covariance[0], change), seen


def test_a_moved_tag_is_rejected_as_a_whole_and_named():
    rng, named = np.random.default_rng(1), 0
    for place in np.linspace(0, 1, 8):
        solved, off, seen = solve([0.1, 0.05, -0.1], 5, rng, place)
        (reason,) = solved.reasons
        assert off < CHI2_999
        if reason.startswith(f'outliers rejected: tag {seen[0]} (') and reason.endswith(' px)'):
            named += 1
            assert np.isfinite(solved.residual[0, :, 0]).sum() == 16
        else:
            assert f'tag {seen[0]} or' in reason or f'or {seen[0]} the others' in reason
    assert named > 5


def test_where_two_choices_fit_the_covariance_covers_both():
    rng, off = np.random.default_rng(2), []
    for place in np.linspace(0, 1, 30):
        solved, squared, seen = solve(rng.normal(0, 0.2, 3), 2, rng, place)
        if 'contradict' in solved.reasons[0]:
            off.append(squared)
            first, second = seen.tolist()
            both = f'without tag {first} or {second},', f'without tag {second} or {first},'
            assert any(text in solved.reasons[0] for text in both)
            assert is_ambiguous(solved.result).all()
    assert len(off) > 12 and np.mean(np.array(off) > CHI2_999) < 0.1


def test_all_corners_of_a_tag_are_tried_from_two_sides_alone(monkeypatch):
    monkeypatch.setattr(localization, 'candidate_poses', None)
    rng = np.random.default_rng(3)
    for place in np.linspace(0, 1, 10):
        _, off, _ = solve(None, 1, rng, place)
        assert off < CHI2_999


@pytest.mark.parametrize('count', [1, 2, 3, 6])
def test_of_tags_where_the_map_has_them_none_is_rejected(count):
    rng = np.random.default_rng(count)
    solved = [solve(None, count, rng, place) for place in np.linspace(0, 1, 40)]
    assert sum(bool(one.reasons[0]) for one, _, _ in solved) <= 1


def test_a_tag_that_alone_fixes_a_pose_is_doubtful():
    rng = np.random.default_rng(5)
    for place in np.linspace(0, 1, 10):
        solved, _, (tag,) = solve(None, 1, rng, place)
        assert list(solved.suspects[0]) == [tag]
        assert solved.suspects[0][tag] == pytest.approx(MOVED / (1 + MOVED), rel=1e-3)


def test_tags_of_which_many_agree_are_not_doubtful():
    rng = np.random.default_rng(6)
    suspect = [len(solve(None, 9, rng, place)[0].suspects[0]) for place in np.linspace(0, 1, 30)]
    assert sum(map(bool, suspect)) <= 3


def test_a_tag_that_moved_less_than_residuals_show_is_doubtful():
    """Where all that is shown is allowed by the test of the residuals, and the pose is wrong."""
    rng, wrong = np.random.default_rng(7), 0
    for place in np.linspace(0, 1, 60):
        for count in (2, 3, 5):
            solved, off, seen = solve(rng.normal(0, 0.05, 3), count, rng, place)
            if off > 2 * CHI2_999 and not solved.reasons[0]:
                wrong += 1
                assert seen[0] in solved.suspects[0], (place, count)
    assert wrong > 5
