"""`calibrate` of three and more cameras: the rig printed, and written as tools read it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import refused
from helpers.moving_rig import moving_rig
from helpers.surround import CAMERAS, LENS, NOISE, RIG, photographs

from fisheye_svp_ros import cli
from fisheye_svp_ros.commands.calibrate import print_rig
from fisheye_svp_ros.commands.notes import note_unconnected
from fisheye_svp_ros.io.lens_files import cameras_in, load_lens, save_lens
from fisheye_svp_ros.io.readers import read_poses, write_observations
from fisheye_svp_ros.io.rig_files import (
    cameras_in_first,
    check_camera_names,
    load_cameras,
    load_rigs,
    save_rig,
)
from fisheye_svp_ros.library.calibration import write_rig
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.solve.rig_calibration import calibrate_rig


def write_fitted(table: Observations, lenses: dict[str, Lens], folder: Path) -> None:
    found = calibrate_rig(table, lenses, table.cameras)
    write_rig(found, folder)
    print_rig(found)


@pytest.fixture(scope='module')
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('rig')
    table = photographs(1, (45.0, 135.0, 225.0, 315.0))
    write_fitted(table, dict.fromkeys(CAMERAS, LENS), folder)
    return folder


@pytest.mark.parametrize('file', ['rig.yaml', 'camchain.yaml'])
def test_every_camera_is_where_it_stands(written: Path, file: str) -> None:
    found = cameras_in_first(load_rigs(written / file))
    assert found.position == pytest.approx(RIG.position, abs=1e-3)
    assert found.rotation == pytest.approx(RIG.rotation, abs=1e-3)


def test_transforms_of_a_robot_are_the_same_rig(written: Path, tmp_path: Path) -> None:
    """Read back as those of a robot, whose frames left and right are two of the cameras."""
    rig = cameras_in_first(load_rigs(written / 'rig.yaml'))
    wanted = rig.take(2).inverse().compose(rig.take(1))
    for name in ('rig.urdf', 'tf_static.yaml'):
        text = (written / name).read_text()
        assert all(f'{camera}_optical_frame' in text for camera in CAMERAS)
        path = tmp_path / name
        path.write_text(text.replace('cam1', 'left').replace('cam2', 'right'))
        (found,) = load_rigs(path)
        assert found.position == pytest.approx(wanted.position, abs=1e-9)
        assert found.rotation == pytest.approx(wanted.rotation, abs=1e-9)


def test_what_scripts_read(written: Path) -> None:
    document = json.loads((written / 'rig.json').read_text())
    assert document['frame'] == 'cam0' and document['frames'] == 40
    assert list(document['cameras']) == [*CAMERAS]
    third = document['cameras']['cam2']
    assert third['position'] == pytest.approx([0.0, 0.0, -0.2], abs=1e-3)
    deviation = np.sqrt(np.diag(third['covariance']))
    assert (deviation[:3] < 2e-4).all() and (deviation[3:] < 2e-4).all()
    assert document['cameras']['cam0']['covariance'] is None


def test_the_command_calibrates_all(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_observations(tmp_path / 'obs.csv', photographs(2, (45.0, 135.0, 225.0), 18))
    out = tmp_path / 'rig'
    assert (
        cli.main(
            ['calibrate', str(tmp_path / 'obs.csv'), '--image-size', '1280x800', '-o', str(out)]
        )
        == 0
    )
    printed = capsys.readouterr().out
    assert 'rig: cameras in cam0, from 18 frames that several cameras see' in printed
    assert cameras_in(out) == CAMERAS  # rig, camchain and tf_static are no lenses
    assert load_lens(f'{out}/#cam3').name == 'cam3'
    assert len(load_rigs(out / 'rig.yaml')) == 3


def test_cameras_that_nothing_holds_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = photographs(3, (45.0, 135.0, 225.0), 16)
    last, shared = table.camera == 3, np.isin(table.frame, table.frames[:10])
    write_observations(tmp_path / 'obs.csv', table.take(last ^ shared))
    size = ('--image-size', '1280x800')
    assert cli.main(['calibrate', str(tmp_path / 'obs.csv'), *size, '-o', str(tmp_path)]) == 0
    said = capsys.readouterr()
    assert 'rig: cam3 cannot be related to cam0, cam1, cam2: no frame shows the target' in said.err
    assert 'cam3' not in said.out.rpartition('rig: cameras in cam0')[2]
    assert len(load_rigs(tmp_path / 'rig.yaml')) == 2


def test_diagnosis_names_cameras_that_share_no_frame(capsys: pytest.CaptureFixture[str]) -> None:
    note_unconnected(photographs(3, (45.0, 225.0), 8))
    assert (
        'cam2 and cam3: no frame shared with cam0 and cam1, so their relative pose is not '
        'estimated'
    ) in capsys.readouterr().err


def test_boards_of_the_cameras_own_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table, _ = moving_rig(1, cameras=2)
    write_fitted(table, dict.fromkeys(CAMERAS[:2], LENS), tmp_path)
    assert 'related by the motion of the rig: one seen by cam0, another by cam1' in (
        capsys.readouterr().out
    )
    cameras = json.loads((tmp_path / 'rig.json').read_text())['cameras']
    assert [camera['board'] for camera in cameras.values()] == [0, 1]
    assert cameras['cam1']['position'] == pytest.approx(RIG.position[1], abs=1e-3)


def test_a_rig_file_of_many_cameras_is_a_chain(tmp_path: Path) -> None:
    steps = [Pose(np.eye(3), np.array([i, 0.0, 0.0])) for i in range(3)]
    save_rig(steps, tmp_path / 'rig.yaml', CAMERAS)
    assert [step.position[0] for step in load_rigs(tmp_path / 'rig.yaml')] == [0.0, 1.0, 2.0]
    text = (tmp_path / 'rig.yaml').read_text()
    (tmp_path / 'broken.yaml').write_text(text.replace('cam1_in_cam2', 'cam2_in_cam1'))
    assert cli.main(['lens', str(tmp_path / 'broken.yaml')]) == 2


@pytest.mark.parametrize(
    'cameras',
    [
        ('front-cam', 'front cam', 'cam.0', "d'Orsay: #2"),
        ('car_in_front', 'car_in_back', 'car_in_left'),
        ('base', 'car_in_back'),
    ],
)
def test_a_rig_file_holds_cameras_of_any_name(tmp_path: Path, cameras: tuple[str, ...]) -> None:
    check_camera_names(cameras, cameras, 'rig.csv')
    steps = [Pose(np.eye(3), np.array([i, 0.0, 0.0])) for i in range(1, len(cameras))]
    save_rig(steps, tmp_path / 'rig.yaml', cameras)
    names, places = load_cameras(tmp_path / 'rig.yaml')
    assert names == cameras
    assert places.position[:, 0].tolist() == [-i * (i + 1) / 2 for i in range(len(cameras))]


@pytest.mark.parametrize(
    ('cameras', 'said'),
    [
        (
            ('cam0', 'rig'),
            "obs.csv: camera 'rig' has the name of a file of the rig, rig.yaml; rename "
            'the camera, for example rig0',
        ),
        (
            ('camchain', 'left'),
            "camera 'camchain' has the name of a file of the rig, camchain.yaml",
        ),
        (('rig', 'camchain'), "camera 'rig' has the name of a file of the rig, rig.yaml"),
        (('front', 'car_in_back'), 'obs.csv: camera car_in_back: with _in_ in its name'),
        (
            ('car_in_back', 'car_in_front'),
            'obs.csv: camera car_in_back, car_in_front: with _in_ in '
            'its name, rig.yaml does not say which camera is in which; rename it',
        ),
    ],
)
def test_names_that_a_rig_cannot_hold_are_refused_before_the_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], cameras: tuple[str, str], said: str
) -> None:
    table = photographs(2, (45.0,), 2)
    write_observations(
        tmp_path / 'obs.csv',
        replace(table.take(table.camera < 2), cameras=(*cameras, *table.cameras[2:])),
    )
    assert said in refused(
        capsys,
        'calibrate',
        tmp_path / 'obs.csv',
        '--image-size',
        '1280x800',
        '-o',
        tmp_path / 'out',
    )
    assert not (tmp_path / 'out').exists()


def test_a_rig_of_three_is_posed_and_diagnosed_as_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the rig of the lenses that were found, a pose per frame from all cameras."""
    table = photographs(2, (45.0, 135.0), 24)
    write_observations(tmp_path / 'obs.csv', table.take(table.camera < 3))
    lens = tmp_path / 'lens.yaml'
    save_lens(LENS.svp(), lens)
    lenses = [f'--lens=cam{i}={lens}' for i in range(3)]
    out = tmp_path / 'diagnosis'
    assert (
        cli.main(['diagnose', str(tmp_path / 'obs.csv'), *lenses, '--quick', '-o', str(out)]) == 0
    )
    found = json.loads((out / 'diagnosis.json').read_text())
    (shift,) = (cause for cause in found['causes'] if cause['effect'] == 'viewpoint_shift')
    for camera in CAMERAS[:3]:
        e0 = shift['parameters'][f'{camera}.e0']
        assert abs(e0['value'] - 0.004) < 4 * e0['stderr'] < 0.012
    report = (out / 'report.html').read_text()
    assert 'with their relative poses in <code>rig.yaml</code>' in report
    capsys.readouterr()
    extended = [f'--lens=cam{i}={out}/cam{i}/extended_lens.yaml' for i in range(3)]
    assert (
        cli.main(
            [
                'localize',
                str(tmp_path / 'obs.csv'),
                *extended,
                '--rig',
                str(out / 'rig.yaml'),
                '-o',
                str(tmp_path / 'poses'),
            ]
        )
        == 0
    )
    assert 'cam0 in the world, from' in capsys.readouterr().out
    document = json.loads((tmp_path / 'poses' / 'localize.json').read_text())
    assert document['frames'] == 24 and list(document['cameras']) == list(CAMERAS[:3])
    assert document['rms_px'] < 1.1 * NOISE * 2**0.5
    assert len(read_poses(tmp_path / 'poses' / 'poses.csv').frame) == 24
