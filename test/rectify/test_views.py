"""Views of one lens, as COLMAP and nerfstudio are told of them, against its projection."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.photographs import LENS, photograph, poses

import fisheye_svp_ros as fsvp
from fisheye_svp_ros import cli
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io.lens_files import load_lens, save_lens
from fisheye_svp_ros.optics.curves import Equidistant, Gennery
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import rotation_from_quaternion

WIDE = Lens('wide', 600, 600, 145.0, 145.0, 300.2, 298.9, Equidistant(), np.radians(115.0))
MOVING = replace(WIDE, viewpoint_shift=Gennery(0.0, 0.006))
TILTED = replace(WIDE, corrections={'decentering': {'parameters': {'p1': 0.003, 'p2': -0.002}}})


@pytest.mark.parametrize('lens', [WIDE, MOVING, TILTED], ids=['svp', 'moving', 'decentered'])
def test_pixels_of_every_view_are_those_of_the_projection(lens: Lens) -> None:
    """There by the maps, and back: at their range both are exact."""
    range_m = 0.4
    sides = fsvp.undistort_views(lens, size=(80, 80), range_m=range_m)
    assert [*sides] == ['front', 'right', 'left', 'up', 'down']
    for side in sides.values():
        v, u = np.nonzero(side.maps.mask)
        rays = np.stack([(u - 39.5) / 40, (v - 39.5) / 40, np.ones(len(u))], axis=-1)
        points = rays / np.linalg.norm(rays, axis=1, keepdims=True) * range_m
        image = fsvp.project(lens, points @ side.rotation)  # a view's rows, in the camera
        mapped = np.stack([side.maps.u[v, u], side.maps.v[v, u]], axis=-1)
        assert np.abs(mapped - image.uv).max() < 1e-4  # of float32
        back = side.rectified_points(image.uv)
        assert np.abs(back - np.stack([u, v], axis=-1)).max() < 1e-4


def test_yaw_turns_to_the_right_and_pitch_upwards() -> None:
    angles = np.radians([[30.0, 0.0, 90.0], [0.0, 20.0, 90.0], [40.0, -25.0, 90.0]])
    sides = fsvp.undistort_views(WIDE, angles, size=(60, 60))
    assert [*sides] == ['yaw30_pitch0', 'yaw0_pitch20', 'yaw40_pitch-25']
    for (yaw, pitch, _), side in zip(angles, sides.values(), strict=True):
        along = [np.cos(pitch) * np.sin(yaw), -np.sin(pitch), np.cos(pitch) * np.cos(yaw)]
        np.testing.assert_allclose(side.rotation[2], along, atol=1e-12)
        assert side.rotation[0, 1] == pytest.approx(0)  # no roll: rows stay level


def test_a_cube_sees_every_direction_once() -> None:
    sides = [
        *fsvp.undistort_views(replace(WIDE, max_incidence=np.pi * 0.99), size=(90, 90)).values()
    ]
    rng = np.random.default_rng(0)
    rays = rng.normal(size=(400, 3))
    seen = np.zeros(len(rays), dtype=int)
    for side in sides:
        x, y, z = side.rotation @ rays.T
        seen += (z > 0) & (np.abs(x) < z) & (np.abs(y) < z)
    assert (seen == 1).all() and len(sides) == 6


def run(*arguments: object) -> None:
    assert cli.main(['undistort', *map(str, arguments)]) == 0


def test_cameras_of_colmap_and_nerfstudio_project_as_the_images_do(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_lens(WIDE, tmp_path / 'lens.yaml')
    image = np.random.default_rng(1).integers(0, 255, (600, 600)).astype(np.uint8)
    (tmp_path / 'photos').mkdir()
    cv2.imwrite(str(tmp_path / 'photos' / 'a.png'), cv2.GaussianBlur(image, (0, 0), 3))
    out = tmp_path / 'out'
    run(tmp_path / 'lens.yaml', tmp_path / 'photos', '-o', out, '--as', 'cubemap', '--fov', 100)
    said = capsys.readouterr()
    assert 'wide: no pixel of back is in its field of view' in said.err
    assert '5 images, maps for cv2.remap' in said.out
    points = np.random.default_rng(2).normal(size=(500, 3))
    uv = fsvp.project(WIDE, points).uv
    raw = cv2.imread(str(tmp_path / 'photos' / 'a.png'), cv2.IMREAD_GRAYSCALE).astype(np.float32)
    (rig,) = json.loads((out / 'rig_config.json').read_text())
    frames = json.loads((out / 'transforms.json').read_text())['frames']
    assert len(frames) == len(rig['cameras']) == 5
    lines = (out / 'cameras.txt').read_text().splitlines()[1:]
    checked = 0
    for camera, frame, line in zip(rig['cameras'], frames, lines, strict=True):
        name = camera['image_prefix']
        assert frame['file_path'] == f'images/{name}a.png' and (out / frame['mask_path']).exists()
        w, x, y, z = camera.get('cam_from_rig_rotation', [1, 0, 0, 0])
        turned = points @ rotation_from_quaternion(np.array([x, y, z, w])).T
        fx, fy, cx, cy = camera['camera_params']
        assert line.split()[1:4] == ['PINHOLE', str(frame['w']), str(frame['h'])]
        assert [*map(float, line.split()[4:])] == camera['camera_params']
        pixel = turned[:, :2] / turned[:, 2:] * [fx, fy] + [cx, cy]  # the image begins at 0
        # The same by nerfstudio: camera to world, y up and z backwards in both.
        flip = np.diag([1.0, -1, -1])
        local = (points @ flip) @ np.array(frame['transform_matrix'])[:3, :3]
        other = local[:, :2] / -local[:, 2:] * [frame['fl_x'], -frame['fl_y']]
        other += [frame['cx'], frame['cy']]
        inside = (turned[:, 2] > 0.1) & ((pixel > 2) & (pixel < frame['w'] - 2)).all(axis=1)
        np.testing.assert_allclose(other[inside], pixel[inside], atol=1e-9)
        view = cv2.imread(str(out / frame['file_path']), cv2.IMREAD_GRAYSCALE).astype(np.float32)
        inside &= ((uv > 2) & (uv < 597)).all(axis=1)
        sampled = [
            cv2.remap(source, *(part[None].astype(np.float32) for part in at[inside].T), 1)
            for source, at in ((view, pixel - 0.5), (raw, uv))
        ]
        assert np.abs(sampled[0] - sampled[1]).mean() < 1.5  # of 255
        checked += int(inside.sum())
    assert checked > 300
    assert load_lens(f'{out}/cameras.txt').width == load_lens(f'{out}/transforms.json').width


def test_views_of_two_cameras_have_a_folder_each(tmp_path: Path) -> None:
    grey = photograph(poses(1, 3).take(0))
    sides = []
    for name in ('left', 'right'):
        save_lens(LENS, tmp_path / f'{name}.yaml')
        (tmp_path / 'photos' / name).mkdir(parents=True)
        cv2.imwrite(str(tmp_path / 'photos' / name / 'a.png'), grey)
        sides += ['--lens', f'{name}={tmp_path}/{name}.yaml']
    out = tmp_path / 'out'
    run(
        tmp_path / 'photos', *sides, '-o', out, '--size', '60x40', '--as', 'perspective:30,0,80',
        '--as', 'perspective:-30,10,80',
    )  # fmt: skip
    document = json.loads((out / 'undistort.json').read_text())
    assert document['as'] == ['perspective:30,0,80', 'perspective:-30,10,80']
    assert [*document['cameras']] == [
        f'{name}/{view}'
        for name in ('left', 'right')
        for view in ('yaw30_pitch0', 'yaw-30_pitch10')
    ]
    frames = json.loads((out / 'left' / 'transforms.json').read_text())['frames']
    for frame in frames:
        assert (out / 'left' / frame['file_path']).exists()
        assert (out / 'left' / frame['mask_path']).exists()


@pytest.mark.parametrize(
    ('options', 'said'),
    [
        (['--as', 'perspective:30,0'], "'perspective:30,0' is unknown; choose from pinhole, "),
        (['--as', 'cube'], 'perspective:YAW,PITCH,FOV in degrees'),
        (['--as', 'perspective:0,0,180'], 'field of view is 180 deg; above 0 and at most 175'),
        (['--as', 'perspective:180,0,60'], 'and nothing of yaw180_pitch0'),
        (['--as', 'cubemap', '--as', 'pinhole'], 'one projection, or several perspectives'),
        (['--as', 'perspective:1,0,60', '--as', 'perspective:1,0,50'], 'two views are called'),
        (['--as', 'perspective:1,0,60', '--fov', '60'], '--fov has no effect on --as perspective'),
        (['--as', 'cubemap', '--size', '60x40'], 'faces of a cube are square'),
        (['--as', 'cubemap', '--rig', 'rig.yaml'], '--rig has no effect on views'),
    ],
)
def test_what_is_no_view_is_refused(
    options: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_lens(WIDE, tmp_path / 'lens.yaml')
    try:
        code = cli.main(
            ['undistort', str(tmp_path / 'lens.yaml'), '-o', f'{tmp_path}/o', *options]
        )
    except SystemExit as exit_:
        code = exit_.code
    assert code == 2 and said in capsys.readouterr().err
    assert not (tmp_path / 'o').exists()


def test_the_library_refuses_what_is_no_view() -> None:
    with pytest.raises(ParameterError, match=r'views has the shape \(2,\)'):
        fsvp.undistort_views(WIDE, [0.1, 0.2])
