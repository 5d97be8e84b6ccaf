"""Flat targets seen small have two minima; the better one is found."""

import numpy as np
import pytest
from helpers.targets import cube, plane, poses_around

from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.optics.curves import Equidistant
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.simulate.simulation import simulate
from fisheye_svp_ros.solve import localization
from fisheye_svp_ros.solve.localization import localize, start_poses
from fisheye_svp_ros.solve.measured_poses import posable_views


@pytest.fixture
def model():
    return ForwardModel(Lens('made', 1280, 960, 1800.0, 1800.0, 639.5, 479.5, Equidistant(), 0.44))


def views_of(model, target, count, sigma):
    """Return views of a far target and their true poses."""
    rng = np.random.default_rng(3)
    poses = poses_around(target, count, rng, widest=0.3, distance=(8.0, 20.0))
    views, _ = posable_views(simulate(model, target, poses, sigma, rng))
    return views, poses.take(views.frame)


@pytest.fixture
def one_sided(monkeypatch):
    """Return a localization that tries one side alone."""

    def run(*arguments):
        with monkeypatch.context() as patch:
            patch.setattr(localization, 'PLANARITY', 0.0)
            return localize(*arguments)

    return run


def test_far_boards_are_not_left_on_the_wrong_side(model, engine, one_sided):
    views, poses = views_of(model, plane(), 150, 0.1)
    truth = localize(model, views, poses)
    start = start_poses(model, views)
    one = one_sided(model, views, start)
    both = localize(model, views, start)
    # Views carry sigma, so costs are whitened: 9 is three standard deviations.
    lost = 9.0
    assert np.mean(one.cost > truth.cost + lost) > 0.05
    assert not np.any(both.cost > truth.cost + lost)
    assert np.all(both.cost <= one.cost)


def test_solid_targets_are_solved_once(model, engine, one_sided):
    views, poses = views_of(model, cube(), 10, 0.1)
    found, want = localize(model, views, poses), one_sided(model, views, poses)
    np.testing.assert_array_equal(found.pose.position, want.pose.position)
    np.testing.assert_array_equal(found.cost, want.cost)
