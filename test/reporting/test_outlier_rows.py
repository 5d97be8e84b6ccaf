"""Outliers for people: one row a view and reason, with photograph and camera."""

from __future__ import annotations

from fisheye_svp_ros.reporting.wording.causes import outlier_rows


def test_many_outliers_of_one_view_are_one_row() -> None:
    gross = [
        {
            'frame': 4,
            'camera': 'left',
            'photograph': 'left19.jpg',
            'landmark': n,
            'px': 10.0 + n,
            'why': 'all points of the view are off',
        }
        for n in range(40)
    ]
    gross += [{'frame': 7, 'landmark': 3, 'px': 99.0, 'why': 'far from its prediction'}]
    view, point = outlier_rows(gross)
    assert (view.where, view.camera, view.points, view.px) == ('left19.jpg', 'left', 40, 49.0)
    assert view.landmarks == '0, 1, 2, 3, 4, 5 and 34 more'
    assert (point.where, point.camera, point.landmarks) == ('frame 7', '', '3')
