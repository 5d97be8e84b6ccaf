"""The library on boards and photographs; what it prints of itself is short."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.photographs import BOARD, LENS, photograph, poses, true_corners, write

import fisheye_svp_ros as fsvp
from fisheye_svp_ros import cli
from fisheye_svp_ros.commands import notes
from fisheye_svp_ros.library.results import Budgeted


def test_photographs_are_searched_as_by_the_command(tmp_path: Path) -> None:
    write(tmp_path, [photograph(poses(4).take(i)) for i in range(2)])
    seen = fsvp.detect(tmp_path, BOARD)
    assert len(seen.observations.frames) == 2
    assert len(repr(seen)) < 200
    assert 'board in 2 of 2 photographs' in repr(seen)


def test_a_table_from_image_points_and_landmarks_alone() -> None:
    pose = poses(4).take(0)
    u, v = true_corners(pose).T
    table = fsvp.observations(u, v, np.arange(30), BOARD)
    assert repr(table) == 'Observations(30 points in 1 frames, of observations)'
    found = fsvp.localize(table, LENS)
    assert np.abs(found.pose.position[0] - pose.position).max() < 1e-6
    assert len(repr(found)) < 600
    assert 'covariance=array(1, 6, 6)' in repr(found)
    for wrong in ((u[:3], v, np.arange(30)), (u, v, np.arange(1, 31))):
        with pytest.raises(fsvp.FisheyeSvpError, match=r'one length|landmarks are 0 to 29'):
            fsvp.observations(*wrong, BOARD)


def test_pictures_are_figures_with_units() -> None:
    height, shift = fsvp.plot_lens('fish214', LENS).axes
    assert height.get_ylabel() == 'image height / px'
    assert [len(axis.lines) for axis in (height, shift)] == [2, 2]
    # 12.7 mm to 88 degrees, as README has it.
    degrees, moved = shift.lines[0].get_data()
    assert np.interp(88, degrees, moved) - moved[0] == pytest.approx(12.7, abs=0.1)
    u, v = true_corners(poses(4).take(0)).T
    table = fsvp.observations(u, v + 0.1 * (-1) ** np.arange(30), np.arange(30), BOARD)
    (axis,) = fsvp.plot_residuals(table, LENS).axes
    assert axis.get_title(loc='left') == f'{LENS.name}: 0.0977 px rms'
    budget = Budgeted(
        np.radians([30, 80]),
        np.array([0.5, 1, 2]),
        {'position': np.ones((2, 3))},
        {'position': np.ones((2, 3))},
        {},
    )
    (axis,) = fsvp.plot_budget(budget).axes
    assert axis.get_ylabel() == 'position error / mm' and len(axis.lines) == 4
    with pytest.raises(fsvp.FisheyeSvpError, match='choose from position'):
        fsvp.plot_budget(budget, 'depht')


def test_what_is_printed_is_short() -> None:
    assert repr(poses(4)) == 'Pose(4,)'
    assert repr(fsvp.Pose(np.eye(3), np.array([0.1, 0, 2]))) == (
        'Pose(0.1, 0, 2 m; rotation vector 0, 0, 0 degree)'
    )
    assert repr(fsvp.undistort_maps('fish214')) == (
        "Rectification('fish214' to pinhole 1536x1536 px, at 2 m)"
    )
    assert repr(fsvp.plan('fish180', BOARD, (0.1, 0.3), count=1)).startswith(
        'PhotographPlan(1 views; fx '
    )


def test_render_plan_and_lens_files(tmp_path: Path) -> None:
    image = fsvp.render(LENS, BOARD, poses(4).take(0))
    assert image.shape == (LENS.height, LENS.width)
    shots = fsvp.plan(LENS, BOARD, (0.1, 0.3), count=2)
    assert len(shots.wanted.to_list()) == 2
    fsvp.write_lens(LENS, tmp_path / 'cameras.txt', 'colmap')
    assert fsvp.load_lens(tmp_path / 'cameras.txt').cx == pytest.approx(LENS.cx)


def test_a_scenario_of_a_lens() -> None:
    seen = fsvp.simulate_scenario(lens=LENS, radius=0.5)
    assert seen.lens == LENS
    assert fsvp.simulate_scenario(lens=LENS, shift_scale=0.0).lens == replace(
        LENS, viewpoint_shift=None
    )


def test_the_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(['--version'])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f'fisheye-svp {fsvp.__version__}\n'


def test_lenses_of_a_rig_do_not_go_into_a_folder_called_yaml(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    seen = fsvp.simulate_scenario(lens=LENS, radius=0.5, style='parallel')
    fsvp.write_observations(tmp_path / 'o.csv', seen.observations)
    assert (
        cli.main(
            [
                'calibrate',
                str(tmp_path / 'o.csv'),
                '--image-size',
                '424x400',
                '-o',
                str(tmp_path / 'lens.yaml'),
            ]
        )
        == 2
    )
    assert 'left, right and their rig are written to a folder' in capsys.readouterr().err
    assert not (tmp_path / 'lens.yaml').exists()


def test_the_note_on_formats_comes_once_a_day(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path))
    monkeypatch.setattr('fisheye_svp_ros.io.columns.arrow', lambda: (None, 'no Parquet'))
    notes.note_formats()
    notes.note_formats()
    assert capsys.readouterr().err.count('no Parquet') == 1
