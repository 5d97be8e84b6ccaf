"""Bags of ROS 1: images of two cameras are searched, broken bags and odd images are told."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.commands import refused
from helpers.photographs import BOARD, photograph, poses
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from fisheye_svp_ros import cli
from fisheye_svp_ros.io.bags import Bag
from fisheye_svp_ros.io.readers import read_observations

IMAGE, PACKED = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage'


def write_bag(path: Path, topics: dict[str, str], compression: bool) -> None:
    """Write two images on each topic, of an encoding or packed as png."""
    store = get_typestore(Stores.ROS1_NOETIC)
    make = store.types
    writer = Writer(path)
    if compression:
        writer.set_compression(Writer.CompressionFormat.BZ2)
    with writer as bag:
        for topic, encoding in topics.items():
            kind = PACKED if encoding == 'png' else IMAGE
            connection = bag.add_connection(topic, kind, typestore=store)
            for number in range(2):
                stamp = make['builtin_interfaces/msg/Time'](100 + number, 5)
                header = make['std_msgs/msg/Header'](number, stamp, 'camera')
                grey = photograph(poses(4, 4).take(number))
                height, width = grey.shape
                if encoding == 'png':
                    data = np.frombuffer(cv2.imencode('.png', grey)[1], np.uint8)
                    message = make[kind](header, 'png', data)
                else:
                    bytes_ = grey if encoding == 'mono8' else grey.astype(np.float32)
                    rows = np.ascontiguousarray(bytes_).view(np.uint8).reshape(height, -1)
                    step = rows.shape[1]
                    message = make[kind](header, height, width, encoding, 0, step, rows.ravel())
                when = 10**9 * (100 + number)
                bag.write(connection, when, store.serialize_ros1(message, kind))


@pytest.mark.parametrize(
    ('topics', 'compression', 'cameras'),
    [
        ({'/left/image_raw': 'mono8', '/right/image_raw': 'mono8'}, False, ('left', 'right')),
        ({'/camera/image_raw/compressed': 'png'}, True, ('',)),
        # Depth has no brightness, and does not end the search.
        ({'/color/image': 'mono8', '/depth/image': '32FC1'}, False, ('color',)),
    ],
)
def test_images_of_a_bag_are_searched(
    topics: dict[str, str], compression: bool, cameras: tuple[str, ...], tmp_path: Path
) -> None:
    write_bag(tmp_path / 'a.bag', topics, compression)
    out = tmp_path / 'o.csv'
    assert cli.main(['detect', str(tmp_path / 'a.bag'), '--board', BOARD, '-o', str(out)]) == 0
    table = read_observations(out)
    assert table.cameras == cameras and len(table.frames) == 2
    assert np.unique(table.t) == pytest.approx([100.0, 101.0])


def test_a_bag_lists_its_topics(tmp_path: Path) -> None:
    write_bag(tmp_path / 'a.bag', {'/image': 'mono8'}, False)
    assert Bag(tmp_path / 'a.bag').topics() == {('/image', IMAGE)}


def test_a_broken_bag_is_told_in_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_bag(tmp_path / 'a.bag', {'/image': 'mono8'}, False)
    whole = (tmp_path / 'a.bag').read_bytes()
    for name, data in (
        ('cut', whole[: len(whole) // 2]),
        ('head', b'#ROSBAG V2.0\n' + bytes(500)),
    ):
        path = tmp_path / f'{name}.bag'
        path.write_bytes(data)
        said = refused(capsys, 'detect', path, '--board', BOARD)
        assert 'not a whole ROS 1 bag' in said and 'rosbag reindex' in said
    folder = tmp_path / 'bags'
    folder.mkdir()
    (tmp_path / 'cut.bag').rename(folder / 'cut.bag')
    assert 'bags of ROS 1 are given as files' in refused(
        capsys, 'detect', folder, '--board', BOARD
    )
