"""Lenses and rig from one fit: the same for command and library, errors as stated, notes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import fisheye_svp_ros as fsvp
from fisheye_svp_ros import cli
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.lens_files import load_lens
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.optics.curves import Equidistant, KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.reporting.calibrated_camera import CalibratedCamera
from fisheye_svp_ros.reporting.wording.calibration import calibration_warnings
from fisheye_svp_ros.scene.observations import STEREO, Observations, make_observations
from fisheye_svp_ros.simulate.render import Print
from fisheye_svp_ros.simulate.targets import board_views

SIZE = 640, 480
LENSES = (
    Lens('left', *SIZE, 200.0, 200.4, 321.0, 236.0, KannalaBrandt(-0.01, 0.002), 1.4),
    Lens('right', *SIZE, 210.0, 209.8, 317.0, 243.0, KannalaBrandt(0.01, -0.003), 1.4),
)
RIG = Pose(rotation_from_vector(np.array([0.02, 0.15, -0.03])), np.array([0.1, 0.004, 0.01]))
PRINT = Print(7, 5, 0.04)
NOISE = 0.05


def photographs(
    seed: int, cameras: int = 2, frames: int = 14, bend: float = 0.0, noise: float = NOISE
) -> Observations:
    """Return what the cameras see of a board that is bent by so much, m, its corners displaced."""
    rng, corners = np.random.default_rng(seed), PRINT.corners
    x, y = ((corners - corners.mean(axis=0))[:, :2] / np.ptp(corners[:, :2], axis=0)).T
    way = rng.normal(size=3)
    bow = np.stack([x * x, x * y, y * y], axis=-1) @ way
    true = corners + rng.normal(0, bend / 20, corners.shape)
    true[:, 2] += bend * bow / np.ptp(bow)
    body, rows = board_views(LENSES[0], PRINT, frames, (0.15, 0.4), rng), []
    for camera, lens in enumerate(LENSES[:cameras]):
        place = Pose(np.eye(3), np.zeros(3)) if camera == 0 else RIG
        pose = body.compose(place.broadcast_to(frames))
        image = project(lens, pose.into_body(np.broadcast_to(true, (frames, *true.shape))))
        inside = image.valid & ((image.uv > 0) & (image.uv < np.array(SIZE) - 1)).all(axis=-1)
        for frame in np.flatnonzero(inside.mean(axis=1) > 0.6).tolist():
            rows += [
                (frame, i, camera, *image.uv[frame, i], *corners[i])
                for i in np.flatnonzero(inside[frame])
            ]
    table = np.array(rows)
    return make_observations(
        table[:, 0],
        table[:, 1],
        table[:, 3:5] + rng.normal(0, noise, (len(table), 2)),
        table[:, 5:],
        camera=table[:, 2],
        cameras=STEREO[:cameras] if cameras > 1 else ('',),
    )


def run_command(table: Observations, folder: Path, output: str) -> Path:
    fsvp.write_observations(folder / 'obs.csv', table)
    words = ['calibrate', str(folder / 'obs.csv'), '--image-size', '640x480']
    assert cli.main([*words, '-o', str(folder / output)]) == 0
    return folder / output


def numbers(lens: Lens) -> dict[str, object]:
    """Return all that a lens file states but its name."""
    return {**lens.parameters, 'limit': lens.max_incidence, **(lens.calibration or {})}


def test_command_and_library_state_the_same_of_one_camera(tmp_path: Path) -> None:
    path = run_command(photographs(1, cameras=1), tmp_path, 'lens.yaml')
    found = fsvp.calibrate(tmp_path / 'obs.csv', 'kannala_brandt', SIZE)
    fsvp.save_lens(found.lens, tmp_path / 'again.yaml')
    assert numbers(load_lens(path)) == numbers(load_lens(tmp_path / 'again.yaml'))
    document = json.loads(path.with_suffix('.calibrate.json').read_text())
    assert document['sigma_px'] == found.sigma_px
    assert document['covariance'] == found.covariance.tolist()


def test_command_and_library_state_the_same_of_a_rig(tmp_path: Path) -> None:
    folder = run_command(photographs(2, bend=5e-4), tmp_path, 'rig')
    found = fsvp.calibrate_cameras(tmp_path / 'obs.csv', SIZE)
    report, notes = found.save(tmp_path / 'again', 'fisheye-svp diagnose')
    assert report.name == 'calibration.html' and not [
        note for note in notes if 'Kalibr ends' not in note
    ]
    for name in ('left.yaml', 'right.yaml', 'rig.json', 'rig.yaml', 'left.calibrate.json'):
        assert (folder / name).read_text() == (tmp_path / 'again' / name).read_text()


def test_transforms_of_a_bent_board_are_as_sure_as_stated(tmp_path: Path) -> None:
    """Of least squares and by the true values: errors below, and as stated, over two boards."""
    errors, scores = [], []
    for seed in range(2):
        folder = tmp_path / f'{seed}'
        folder.mkdir()
        table = photographs(seed, bend=1.5e-3)
        document = json.loads((run_command(table, folder, 'rig') / 'rig.json').read_text())
        right = document['cameras']['right']
        found = Pose(_rotation(right['quaternion']), np.array(right['position']))
        off = found.difference(RIG)
        scores.append(off / np.sqrt(np.diag(right['covariance'])))
        plain = fsvp.calibrate_cameras(table, SIZE, plain=True).rig
        assert plain is not None
        errors.append([np.linalg.norm(off[:3]), np.linalg.norm(plain.rig.difference(RIG)[1, :3])])
    assert 0.3 < np.sqrt((np.array(scores) ** 2).mean()) < 1.7
    ours, theirs = np.sqrt((np.array(errors) ** 2).mean(axis=0))
    assert ours < theirs


def _rotation(quaternion: list[float]) -> Array:
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def test_rows_of_several_cameras_are_no_lens() -> None:
    with pytest.raises(fsvp.FisheyeSvpError, match='hold the cameras left, right; use calib'):
        fsvp.calibrate(photographs(1), 'kannala_brandt', SIZE)
    with pytest.raises(fsvp.FisheyeSvpError, match="no size of camera 'right'"):
        fsvp.calibrate_cameras(photographs(1), {'left': SIZE})
    with pytest.raises(LensError, match="model 'fish' is unknown"):
        fsvp.calibrate_cameras(photographs(1), SIZE, 'fish')


def calibrated(table: Observations) -> CalibratedCamera:
    return next(iter(fsvp.calibrate_cameras(table, SIZE).cameras.values()))


@pytest.mark.parametrize(
    ('frames', 'noise', 'said'),
    [
        (1, 0.1, ['one frame cannot separate noise from errors of the landmarks']),
        (2, 0.1, ['2 frames are too few to judge a lens; take 8 or more']),
        (14, 2.0, ['the noise in u and v is 2.1 px, far more than a detector leaves']),
        (14, 0.1, []),
    ],
)
def test_notes_of_frames_and_noise(frames: int, noise: float, said: list[str]) -> None:
    whole = photographs(4, cameras=1, frames=16, noise=noise)
    camera = calibrated(whole.take(np.isin(whole.frame, whole.frames[:frames])))
    notes = [note for note in calibration_warnings(camera) if 'extrapolated' not in note]
    assert [note[: len(text)] for note, text in zip(notes, said, strict=True)] == said


def test_a_warning_names_the_curve_of_the_lens() -> None:
    camera = calibrated(photographs(5, cameras=1))
    lens = replace(
        camera.lens,
        image_height=Equidistant(),
        calibration={**camera.lens.calibration, 'rms_px': 9.0},
    )
    (note,) = (one for one in calibration_warnings(replace(camera, lens=lens)) if '9.0 px' in one)
    assert note.startswith('equidistant leaves 9.0 px')


def test_exchanged_cameras_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = photographs(6)
    folder = run_command(replace(table, cameras=STEREO[::-1]), tmp_path, 'rig')
    assert 'right is to the left of left: the baseline is negative' in capsys.readouterr().err
    assert cli.main(['undistort', str(folder), '-o', str(tmp_path / 'maps')]) == 0
    assert 'right is to the left of left: the baseline is negative' in capsys.readouterr().err
    assert not fsvp.calibrate_cameras(table, SIZE).notes
