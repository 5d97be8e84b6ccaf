"""Frames go by the names of their photographs, where these are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fisheye_svp_ros.scene.observations import (
    Observations,
    frame_name,
    list_frames,
    make_observations,
    photograph_column,
    photograph_entry,
    photograph_names,
)


def rig(*photographs: tuple[int, str, str]) -> Observations:
    """Return two frames of two cameras, of one point each."""
    table = make_observations(
        np.array([0, 0, 1, 1]),
        np.zeros(4, dtype=int),
        np.zeros((4, 2)),
        np.zeros((4, 3)),
        camera=np.array([0, 1, 0, 1]),
        cameras=('left', 'right'),
    )
    return replace(table, photographs=photographs)


FOLDERS = rig(
    (0, 'left', 'rig/left/19.jpg'),
    (0, 'right', 'rig/right/19.jpg'),
    (1, 'left', 'rig/left/20.jpg'),
    (1, 'right', 'rig/right/20.jpg'),
)


def test_one_file_name_in_two_folders_keeps_its_folder() -> None:
    assert photograph_names(FOLDERS)[1, 'right'] == 'right/20.jpg'
    assert frame_name(FOLDERS, 0) == 'left/19.jpg and right/19.jpg'
    assert frame_name(FOLDERS, 0, 'right') == 'right/19.jpg'
    named = rig((0, 'left', 'rig/left19.jpg'), (0, 'right', 'rig/right19.jpg'))
    assert frame_name(named, 0, 'left') == 'left19.jpg'
    assert photograph_entry(named, 0, 'left') == {'photograph': 'left19.jpg'}


def test_all_keep_their_folder_where_one_needs_it() -> None:
    table = rig(
        (0, 'left', 'rig/left/19.jpg'),
        (0, 'right', 'rig/right/19.jpg'),
        (1, 'right', 'rig/right/20.jpg'),
    )
    assert frame_name(table, 1) == 'right/20.jpg'


def test_a_table_of_one_camera_names_that_camera_alone() -> None:
    left = FOLDERS.take(FOLDERS.camera == 0)
    assert list_frames(left, [0, 1, 0]) == 'left/19.jpg and left/20.jpg'


def test_frames_without_photographs_keep_their_numbers() -> None:
    bare = rig()
    assert frame_name(bare, 1) == 'frame 1'
    assert frame_name(bare, 1, 'left') == 'frame 1 of left'
    assert photograph_entry(bare, 1) == {}
    assert list_frames(bare, [3, 4, 5]) == 'frames 3, 4 and 5'
    assert list_frames(bare, range(14)) == 'frames 0, 1, 2, 3, 4, 5, 6, 7, 8, 9 and 4 more'


def test_a_column_of_photographs_is_by_frame_or_by_view() -> None:
    frames = np.array([1, 0, 1])
    assert photograph_column(FOLDERS, frames)['photograph'].tolist()[:2] == [
        'left/20.jpg and right/20.jpg',
        'left/19.jpg and right/19.jpg',
    ]
    right = photograph_column(FOLDERS, frames, ['right'] * 3)['photograph'].tolist()
    assert right == ['right/20.jpg', 'right/19.jpg', 'right/20.jpg']
    assert photograph_column(FOLDERS, np.array([9]))['photograph'].tolist() == ['']
    assert photograph_column(rig(), frames) == {}
