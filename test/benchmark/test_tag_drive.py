"""A robot among tags, one of which moved, is told of no wrong pose as of a right one."""

from collections import Counter

import numpy as np

from benchmark.studies import tag_drive
from fisheye_svp_ros.pose import Pose


def test_no_transform_is_wrong_with_ok(monkeypatch):
    monkeypatch.setattr(tag_drive, 'IMAGES', 50)
    total = Counter()
    for number in (0, 21, 24):  # a tag that moved is absorbed in the last two
        for (_, end), count in tag_drive.drive(number).counts.items():
            total[end] += count
    assert total['wrong, OK'] > 0, 'without the gate'
    assert total['wrong /tf, OK'] == total['by noise'] == 0 and total['/tf, OK'] > 0
    ends = ('weak', 'off odometry', '/tf, OK', '/tf, WARN')
    assert sum(total[end] for end in ends) == total['images'] == 150


def test_what_is_shown_where_the_map_has_it_is_wrong_by_noise_alone():
    rng = np.random.default_rng(0)
    tags, camera = tag_drive.room(rng), tag_drive.base_at(0).compose(tag_drive.mount_at(0))
    shown = np.unique(tag_drive.see(tags, tags, 'all tags', camera, rng).board)
    shift = np.zeros((tag_drive.TAGS, 3))
    shift[shown[0]] = 0.05
    moved = tags._replace(poses=Pose(tags.poses.rotation, tags.poses.position + shift))
    for actual, holds in ((tags, True), (moved, False)):
        views = tag_drive.see(tags, actual, 'all tags', camera, np.random.default_rng(1))
        assert tag_drive.holds_map(views, camera) == holds
