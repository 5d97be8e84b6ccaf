"""Tags and cameras are solved together from the corners of tags alone."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.io.tag_maps import map_of_size, tag_covariance
from fisheye_svp_ros.optics.curves import KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.scene.observations import views_of
from fisheye_svp_ros.solve.tag_mapping import map_tags

KB = KannalaBrandt(0.03, -0.01, 0.002, -0.0005)
MODEL = ForwardModel(Lens('made', 1280, 960, 330.0, 331.0, 640.5, 479.5, KB, 1.5))
SIZE = 0.2


def walk(noise, tags=6, frames=25, seed=0):
    """Return image, id and corners of tags on a wall and a slanted one, and their true map."""
    rng = np.random.default_rng(seed)
    place = np.column_stack(
        [0.7 * np.arange(tags) - 1.5, rng.uniform(-0.4, 0.4, tags), 0.3 * rng.normal(size=tags)]
    )
    turn = rotation_from_vector(0.3 * rng.normal(size=(tags, 3)))
    true = map_of_size(10 + np.arange(tags), SIZE, Pose(turn, place))
    position = np.column_stack([np.linspace(-1.5, 1.5, frames), rng.normal(0, 0.3, (frames, 1))])
    position = np.column_stack([position, rng.uniform(1.2, 2.0, frames)])
    facing = np.diag([1.0, -1.0, -1.0]) @ rotation_from_vector(0.2 * rng.normal(size=(frames, 3)))
    points = np.tile(true.corners.reshape(-1, 3), (frames, 1, 1))
    uv = MODEL.predict(Pose(facing, position), views_of(points)).uv
    uv = uv + rng.normal(0, noise, uv.shape)
    near = np.abs(position[:, None, 0] - place[None, :, 0]) < 1.0
    image, slot = np.nonzero(near)
    corners = uv.reshape(frames, tags, 4, 2)[image, slot]
    return image, true.ids[slot], corners, true


def map_errors(found, true):
    """Return how far off each tag is, m, in the frame of the origin."""
    origin = true.poses.take(np.flatnonzero(true.ids == 10)[0])
    count = len(found.ids)
    expected = origin.inverse().broadcast_to(count).compose(true.poses)
    return np.linalg.norm(found.poses.position - expected.position, axis=1)


def test_a_walk_gives_the_map():
    image, ids, corners, true = walk(0.0)
    found = map_tags(MODEL, image, ids, corners, SIZE, origin=10)
    assert found.ids.tolist() == true.ids.tolist() and not found.missing
    assert map_errors(found, true).max() < 1e-6 and found.rms_px < 1e-5


@pytest.mark.parametrize('noise', [0.1, 1.0])  # px; the larger one is not mistaken for outliers
def test_the_covariance_is_that_of_many_maps(noise):
    squares, whole = [], []
    for seed in range(12):
        image, ids, corners, true = walk(noise, tags=4, frames=12, seed=seed)
        found = map_tags(MODEL, image, ids, corners, SIZE, origin=10)
        assert found.ids.tolist() == true.ids.tolist()
        covariance = tag_covariance(found.information)
        tags = map_of_size(found.ids, SIZE, found.poses, '', covariance)
        assert tags.stderr[0] == 0 and (tags.stderr[1:] > 0).all()
        squares += ((map_errors(found, true) / np.maximum(tags.stderr, 1e-9))[1:] ** 2).tolist()
        off = found.poses.difference(
            true.poses.take(0).inverse().broadcast_to(4).compose(true.poses)
        )
        unit = np.sqrt(np.diagonal(covariance)[6:])
        error = off[1:].ravel() / unit
        relative = covariance[6:, 6:] / np.outer(unit, unit)
        whole.append(error @ np.linalg.solve(relative, error))
    assert 0.6 < np.mean(squares) < 1.5
    # Of all tags together: chi-square of 12 x 18 degrees of freedom
    assert chi2.ppf(0.005, 216) < np.sum(whole) < chi2.ppf(0.995, 216)


def test_what_no_image_shows_together_has_no_information():
    image, ids, corners, _ = walk(0.2)
    found = map_tags(MODEL, image, ids, corners, SIZE, origin=10)
    blocks = np.abs(found.information.reshape(6, 6, 6, 6)).max(axis=(1, 3))
    seen = {number: set(image[ids == number]) for number in found.ids}
    together = [[bool(seen[one] & seen[two]) for two in found.ids[1:]] for one in found.ids[1:]]
    assert not np.all(together)
    np.testing.assert_array_equal(blocks[1:, 1:] > 0, together)
    assert not blocks[0].any()


def test_wrong_corners_and_tags_cost_little():
    image, ids, corners, true = walk(0.1)
    corners[7] += [40.0, -25.0]
    corners[20, 2] += [3.0, 0.0]
    found = map_tags(MODEL, image, ids, corners, SIZE, origin=10)
    assert map_errors(found, true).max() < 0.03 and found.rms_px < 0.2


def test_a_tag_that_only_wrong_corners_show_is_missing():
    image, ids, corners, _ = walk(0.1)
    rng = np.random.default_rng(1)
    corners[ids == 15] += rng.uniform(-30, 30, corners[ids == 15].shape)
    found = map_tags(MODEL, image, ids, corners, SIZE, origin=10)
    assert 15 in found.missing and 15 not in found.ids
    assert np.isfinite(tag_covariance(found.information)).all()


def test_tags_that_nothing_ties_are_named():
    image, ids, corners, _ = walk(0.0)
    image = np.append(image, 100)
    ids, corners = np.append(ids, 99), np.concatenate([corners, corners[:1]])
    assert map_tags(MODEL, image, ids, corners, SIZE).missing == (99,)
    with pytest.raises(GeometryError, match='together with another'):
        map_tags(MODEL, image, ids, corners, SIZE, origin=99)
    with pytest.raises(GeometryError, match='no image shows tag 5'):
        map_tags(MODEL, image, ids, corners, SIZE, origin=5)


def test_a_tag_beyond_the_field_of_view_is_left_out():
    image, ids, corners, true = walk(0.0)
    far = replace(MODEL.lens, max_incidence=0.8)
    found = map_tags(ForwardModel(far), image, ids, corners, SIZE, origin=10)
    assert 0 < found.outside < len(ids)
    assert map_errors(found, true).max() < 1e-6
    nothing = replace(MODEL.lens, max_incidence=0.01)
    with pytest.raises(GeometryError, match='no tag is in the field of view'):
        map_tags(ForwardModel(nothing), image, ids, corners, SIZE)


def test_a_wrong_focal_length_is_seen():
    image, ids, corners, _ = walk(0.1)
    lens = MODEL.lens
    change, error = map_tags(MODEL, image, ids, corners, SIZE, origin=10).focal
    assert abs(change) < 3 * error < 0.01
    wrong = ForwardModel(replace(lens, fx=lens.fx / 1.03, fy=lens.fy / 1.03))
    change, error = map_tags(wrong, image, ids, corners, SIZE, origin=10).focal
    assert change == pytest.approx(0.03, abs=0.005) and error < 0.003
