"""Command and library localize by one way: the same numbers, to the last digit."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.tag_room import LEFT, LENS, TagRoom
from helpers.targets import cube, poses_around

import fisheye_svp_ros as fsvp
from fisheye_svp_ros import cli
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.csv_files import CsvTable
from fisheye_svp_ros.io.lens_files import save_lens
from fisheye_svp_ros.io.readers import read_poses, write_observations
from fisheye_svp_ros.io.rig_files import load_cameras, save_rig
from fisheye_svp_ros.io.tag_maps import write_tag_map
from fisheye_svp_ros.scene.observations import Observations, group_frames
from fisheye_svp_ros.simulate.simulation import simulate

ROOM = TagRoom(16)
AXES = ('x', 'y', 'z', 'rx', 'ry', 'rz')


def board_seen() -> Observations:
    """Return a table of unknown sigma with outliers."""
    rng = np.random.default_rng(3)
    poses = poses_around(cube(), 6, rng, widest=0.8)
    table = simulate(ForwardModel(LENS), cube(), poses, 0.3, rng)
    table.uv[[5, 40], 0] += [30.0, -25.0]
    return table


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    save_lens(LENS, tmp_path / 'lens.yaml')
    information = 4e4 * np.eye(6 * ROOM.count)
    tags = ROOM.tags._replace(covariance=np.linalg.inv(information))
    write_tag_map(tags, tmp_path / 'tags.yaml', information=information)
    save_rig(LEFT.inverse(), tmp_path / 'rig.yaml', ('front', 'side'))
    return tmp_path


@pytest.mark.parametrize('kind', ['board', 'tags', 'model error', 'rig', 'rig with tags'])
def test_command_and_library_say_the_same(kind: str, folder: Path) -> None:
    table = board_seen() if kind in ('board', 'model error') else ROOM.table(1 + ('rig' in kind))
    seconds = 0.03 if 'tags' in kind else 0.0
    table = replace(table, t=0.1 * table.frame)
    write_observations(folder / 'seen.csv', table)
    lens, tags, options = str(folder / 'lens.yaml'), None, []
    if kind == 'model error':
        block = {'rms_px': 0.3, 'stderr': {'cx': 0.2}, 'covariance': [[0.04]]}
        save_lens(replace(LENS, calibration=block), lens)
        options += ['--model-error']
    if 'tags' in kind:
        tags = str(folder / 'tags.yaml')
        options += ['--tag-map', tags, '--readout-time', '30ms']
    if 'rig' in kind:
        options += ['--rig', str(folder / 'rig.yaml')]
    command = ['localize', str(folder / 'seen.csv'), '--lens', lens, '-o', str(folder / 'out')]
    assert cli.main([*command, *options]) == 0
    if 'rig' in kind:
        names = load_cameras(folder / 'rig.yaml')[0]
        found = fsvp.localize_rig(
            folder / 'seen.csv',
            dict.fromkeys(names, lens),
            folder / 'rig.yaml',
            tag_map=tags,
            readout_time=seconds,
        )
        sigma = found.sigma
    else:
        found = fsvp.localize(
            folder / 'seen.csv',
            lens,
            model_error=kind == 'model error',
            tag_map=tags,
            readout_time=seconds,
        )
        sigma = found.sigma_px
    poses = read_poses(folder / 'out' / 'poses.csv')
    np.testing.assert_array_equal(poses.frame, found.frame)
    np.testing.assert_array_equal(poses.pose.position, found.pose.position)
    names = [f'{a}_{b}' for a in AXES for b in AXES]
    written = CsvTable(folder / 'out' / 'covariance.csv', names)
    covariance = np.stack([written.numbers(name)[:, 0] for name in names], axis=-1)
    np.testing.assert_array_equal(covariance.reshape(-1, 6, 6), found.covariance)
    document = json.loads((folder / 'out' / 'localize.json').read_text())
    assert document['sigma_px'] == sigma
    told = {one['frame']: one['reason'] for one in document['doubtful']}
    assert [told.get(frame, '') for frame in found.frame.tolist()] == list(found.reasons)
    assert 'tags' not in kind or sigma == pytest.approx(0.2, rel=0.5)


def test_a_table_of_other_landmarks_than_a_map_is_refused(folder: Path) -> None:
    table = ROOM.table()
    table = replace(table, landmark=10**7 + table.landmark)
    with pytest.raises(fsvp.FisheyeSvpError, match='no landmark is a corner of a tag of the map'):
        fsvp.localize(table, LENS, tag_map=ROOM.tags)
    with pytest.raises(fsvp.FisheyeSvpError, match='tag_map is of type int'):
        fsvp.localize(table, LENS, tag_map=7)


def test_points_of_a_frame_stand_camera_by_camera() -> None:
    table = ROOM.table(2)
    views, widths = group_frames(table)
    assert views.frame.tolist() == [0, 1, 2, 3] and sum(widths) == views.uv.shape[1]
    seen = views.row[views.used]
    assert sorted(seen.tolist()) == list(range(len(table)))
    column = np.broadcast_to(np.arange(sum(widths)), views.used.shape)[views.used]
    np.testing.assert_array_equal(table.camera[seen], column >= widths[0])
    np.testing.assert_array_equal(views.uv[views.used], table.uv[seen])
