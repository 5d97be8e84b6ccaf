"""Maps of tags are written, read back, and read from bundles of apriltag_ros."""

import numpy as np
import pytest

from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.io.tag_maps import CORNERS, TagMap, read_tag_map, write_tag_map
from fisheye_svp_ros.pose import Pose, rotation_from_vector

TAGS = TagMap(
    np.array([7, 2]),
    np.array([0.16, 0.3]),
    Pose(rotation_from_vector(np.array([[0.1, 0.2, 0.3], [0, 0, 1.0]])), np.eye(3)[:2]),
)


def test_a_map_is_read_back(tmp_path):
    write_tag_map(TAGS, tmp_path / 'tags.yaml', np.array([0.001, 0.0]), 'a room')
    found = read_tag_map(tmp_path / 'tags.yaml')
    np.testing.assert_array_equal(found.ids, TAGS.ids)
    np.testing.assert_allclose(found.corners, TAGS.corners, atol=1e-12)


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
