"""A robot among tags, one of which moved, is told of no wrong pose as of a right one."""

from collections import Counter

from benchmark.studies import tag_drive


def test_no_transform_is_wrong_with_ok(monkeypatch):
    monkeypatch.setattr(tag_drive, 'IMAGES', 50)
    total = Counter()
    for number in (0, 1):
        for (_, end), count in tag_drive.drive(number).counts.items():
            total[end] += count
    assert total['wrong, OK'] > 0, 'without the gate'
    assert total['wrong /tf, OK'] == 0 and total['/tf, OK'] > 0
    ends = ('weak', 'off odometry', '/tf, OK', '/tf, WARN')
    assert sum(total[end] for end in ends) == total['images'] == 100
