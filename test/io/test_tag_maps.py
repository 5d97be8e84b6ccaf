"""Maps of tags are written, read back, and read from bundles of apriltag_ros."""

import numpy as np
import pytest
import yaml

from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.io.tag_maps import (
    CENTER_OFFSET,
    CORNERS,
    TagMap,
    map_of_size,
    read_tag_map,
    tag_covariance,
    write_tag_map,
)
from fisheye_svp_ros.pose import Pose, rotation_from_vector

TAGS = TagMap(
    np.array([7, 2]),
    np.array([0.16, 0.3]),
    Pose(rotation_from_vector(np.array([[0.1, 0.2, 0.3], [0, 0, 1.0]])), np.eye(3)[:2]),
)


def test_a_map_is_read_back(tmp_path):
    write_tag_map(TAGS, tmp_path / 'tags.yaml', 'a room')
    found = read_tag_map(tmp_path / 'tags.yaml')
    np.testing.assert_array_equal(found.ids, TAGS.ids)
    np.testing.assert_allclose(found.corners, TAGS.corners, atol=1e-12)
    assert found.covariance is None and not found.stderr.any()


def chain(count):
    """Return a map of tags, each tied to its neighbors alone, the first exact, and information."""
    rng = np.random.default_rng(count)
    information = np.zeros((6 * count, 6 * count))
    for tag in range(count - 1):
        root = rng.normal(size=(12, 12)) * np.repeat([300.0, 100.0, 300.0, 100.0], 3)
        near = slice(6 * tag, 6 * tag + 12)
        information[near, near] += root @ root.T
    information[:6] = information[:, :6] = 0.0
    turn = rotation_from_vector(rng.normal(size=(count, 3)))
    poses = Pose(turn, rng.normal(size=(count, 3)))
    covariance = tag_covariance(information)
    return map_of_size(5 + np.arange(count), 0.2, poses, '', covariance), information


def test_the_covariance_of_all_tags_is_read_back(tmp_path):
    tags, information = chain(4)
    write_tag_map(tags, tmp_path / 'tags.yaml', information=information)
    found = read_tag_map(tmp_path / 'tags.yaml')
    np.testing.assert_allclose(found.covariance, tags.covariance, atol=1e-9 * tags.stderr.max())
    assert found.stderr[0] == 0 and (found.stderr[1:] > 0).all()
    with np.load(tmp_path / 'tags.covariance.npz') as data:  # sparse: what no image shows is not
        assert len(data['information']) == 3 + 2
    # Without a tag, with one in another place, and with one that the file does not have.
    text = yaml.safe_load((tmp_path / 'tags.yaml').read_text())
    assert text['covariance'] == 'tags.covariance.npz'
    extra = {**text['tags'][0], 'id': 99, 'stderr_m': 0.003}
    text['tags'] = [text['tags'][3], extra, text['tags'][1]]
    (tmp_path / 'other.yaml').write_text(yaml.safe_dump(text))
    other = read_tag_map(tmp_path / 'other.yaml')
    assert other.stderr == pytest.approx([tags.stderr[3], 0.003, tags.stderr[1]])
    between = tags.covariance[18:24, 6:12]
    np.testing.assert_allclose(other.covariance[:6, 12:], between, atol=1e-9 * tags.stderr.max())


def test_landmarks_move_with_their_tags(tmp_path):
    tags, _ = chain(3)
    landmark = np.array([[4 * 7 + 2, CENTER_OFFSET + 6, 4 * 6]])
    rng, size = np.random.default_rng(0), 1e-4
    root = np.linalg.cholesky(tags.covariance[6:, 6:])
    drawn = np.concatenate([np.zeros((2000, 6)), rng.normal(size=(2000, 12)) @ root.T], axis=1)
    moved = tags.poses.broadcast_to(2000, 3).retract(size * drawn.reshape(-1, 3, 6))
    places = [
        map_of_size(tags.ids, 0.2, one).landmarks().lookup(landmark[0])[0]
        for one in (moved.take(i) for i in range(2000))
    ]
    sampled = np.cov(np.reshape(places, (2000, 9)).T) / size**2
    stated = tags.landmark_covariance(landmark).reshape(9, 9)
    scale = np.sqrt(np.diagonal(stated))
    np.testing.assert_allclose(
        sampled / np.outer(scale, scale), stated / np.outer(scale, scale), atol=0.1
    )


def test_standard_errors_alone_are_those_of_single_tags(tmp_path):
    path = tmp_path / 'tags.yaml'
    pose = '{position: [1, 2, 3], quaternion: [0, 0, 0, 1]}'
    path.write_text(f'tags: [{{id: 2, size: 0.2, pose: {pose}, stderr_m: 0.003}}]')
    found = read_tag_map(path)
    assert found.stderr == pytest.approx([0.003])
    corners = found.landmark_covariance(np.arange(8, 12)[None])[0]
    assert corners.reshape(12, 12) == pytest.approx(np.tile(3e-6 * np.eye(3), (4, 4)))


@pytest.mark.parametrize('content', [b'', b'not a covariance', 'wrong keys', 'not definite'])
def test_bad_covariances_are_refused(tmp_path, content):
    tags, information = chain(2)
    write_tag_map(tags, tmp_path / 'tags.yaml', information=information)
    beside = tmp_path / 'tags.covariance.npz'
    if isinstance(content, bytes):
        beside.write_bytes(content)
    elif content == 'wrong keys':
        np.savez(beside, ids=tags.ids)
    else:
        block = -np.eye(6)[None]
        np.savez(beside, ids=tags.ids, row=[1], column=[1], information=block)
    with pytest.raises(ObservationError, match=r'remove `covariance` from tags\.yaml'):
        read_tag_map(tmp_path / 'tags.yaml')
    beside.unlink()
    with pytest.raises(ObservationError, match=r'tags.covariance.npz: cannot be read'):
        read_tag_map(tmp_path / 'tags.yaml')


def test_corners_go_round_from_the_lower_left():
    straight = TagMap(np.array([3]), np.array([0.2]), Pose(np.eye(3)[None], np.zeros((1, 3))))
    expected = [[-0.1, -0.1, 0], [0.1, -0.1, 0], [0.1, 0.1, 0], [-0.1, 0.1, 0]]
    np.testing.assert_allclose(straight.corners[0], expected)
    landmarks = straight.landmarks()
    assert landmarks.ids[:CORNERS].tolist() == [12, 13, 14, 15]


def test_bundles_of_apriltag_ros_are_read(tmp_path):
    path = tmp_path / 'tags.yaml'
    path.write_text(
        'standalone_tags: []\n'
        'tag_bundles:\n- name: room\n  layout:\n'
        '  - {id: 0, size: 0.1, x: 0.0, y: 0.0, z: 0.0, qw: 1.0, qx: 0.0, qy: 0.0, qz: 0.0}\n'
        '  - {id: 5, size: 0.2, x: 1.0, y: 2.0, z: 3.0, qw: 0.0, qx: 0.0, qy: 0.0, qz: 1.0}\n'
    )
    found = read_tag_map(path)
    assert found.ids.tolist() == [0, 5] and found.sizes.tolist() == [0.1, 0.2]
    np.testing.assert_allclose(found.corners[1, 0], [1.1, 2.1, 3.0], atol=1e-12)


@pytest.mark.parametrize(
    ('text', 'reason'),
    [
        ('tags: []\n', 'it holds no tags'),
        ('tags: [{id: -1, size: 1, pose: {}}]\n', 'id is -1'),
        ('tags: [{id: 1, size: 160, pose: {}}]\n', r'id 1\): size is 160; meters'),
        ('tags: [{id: 1, size: 0.1}]\n', 'pose needs position and quaternion'),
        (
            'tags: [{id: 1, size: 0.1, pose: {position: [0, 0], quaternion: [0, 0, 0, 1]}}]\n',
            'position of 3 numbers',
        ),
        (
            'tags: [{id: 1, size: 1, pose: {position: [0, 0, 0], quaternion: [0, 0, 0, 1]}, '
            'stderr_m: -1}]\n',
            'stderr_m is -1; meters',
        ),
        (
            'tags:\n'
            + 2 * '- {id: 1, size: 1, pose: {position: [0, 0, 0], quaternion: [0, 0, 0, 1]}}\n',
            'tag id 1 is listed twice',
        ),
    ],
)
def test_bad_maps_are_refused(tmp_path, text, reason):
    (tmp_path / 'tags.yaml').write_text(text)
    with pytest.raises(ObservationError, match=reason):
        read_tag_map(tmp_path / 'tags.yaml')
