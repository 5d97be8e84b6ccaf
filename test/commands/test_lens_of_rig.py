"""`lens` keeps a rig a rig where the format holds one, and says so where it does not."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.robot import LENS

from fisheye_svp_ros import cli
from fisheye_svp_ros.commands.lenses import load_lenses
from fisheye_svp_ros.io.lens_files import read_lens_file, save_lens
from fisheye_svp_ros.io.lens_formats import RIG_WRITABLE, WRITABLE
from fisheye_svp_ros.io.rig_files import save_rig
from fisheye_svp_ros.pose import Pose, rotation_from_vector


def folder_of_rig(folder: Path, names: tuple[str, ...]) -> list[Pose]:
    """Write a rig of cameras, in the order of their names, to a folder; return its steps."""
    rng = np.random.default_rng(len(names))
    for i, name in enumerate(names):
        folder.mkdir(exist_ok=True)
        save_lens(replace(LENS, name=name, fx=LENS.fx + i), folder / f'{name}.yaml')
    steps = [
        Pose(rotation_from_vector(rng.normal(size=3)), 0.1 * rng.normal(size=3)) for _ in names[1:]
    ]
    save_rig(steps, folder / 'rig.yaml', names)
    return steps


@pytest.mark.parametrize('form', RIG_WRITABLE)
@pytest.mark.parametrize('names', [('b', 'a'), ('z', 'm', 'a'), ('cam3', 'cam0', 'cam1', 'cam2')])
def test_all_cameras_and_their_transforms_are_written(form, names, tmp_path, capsys):
    steps = folder_of_rig(tmp_path / 'rig', names)
    out, again = tmp_path / 'out.file', tmp_path / 'again.file'
    assert cli.main(['lens', f'{tmp_path}/rig', '-o', str(out), '--format', form]) == 0
    assert 'is written' not in capsys.readouterr().err
    other = RIG_WRITABLE[1 - RIG_WRITABLE.index(form)]
    assert cli.main(['lens', str(out), '-o', str(again), '--format', other]) == 0
    for path in (out, again):
        written = read_lens_file(path)
        assert written is not None
        focal = [lens.fx for lens in written.lenses.values()]
        np.testing.assert_allclose(focal, LENS.fx + np.arange(len(names)))
        off = [one.difference(two) for one, two in zip(written.rigs, steps, strict=True)]
        np.testing.assert_allclose(off, 0, atol=1e-9)


@pytest.mark.parametrize('form', [None, *(one for one in WRITABLE if one not in RIG_WRITABLE)])
def test_other_formats_say_that_one_camera_is_written(form, tmp_path, capsys):
    folder_of_rig(tmp_path / 'rig', ('a', 'b', 'c'))
    out = tmp_path / 'out.yaml'
    choice = ['--format', form] if form else []
    assert cli.main(['lens', f'{tmp_path}/rig', '-o', str(out), *choice]) == 0
    said = capsys.readouterr().err
    assert 'and only a is written' in said and '--format kalibr or basalt for the rig' in said


def test_a_folder_needs_no_slash(tmp_path, monkeypatch):
    folder_of_rig(tmp_path / 'rig', ('left', 'right'))
    folder_of_rig(tmp_path / 'fish180', ('left', 'right'))
    monkeypatch.chdir(tmp_path)
    assert load_lenses(['rig']).names == ('left', 'right')
    assert load_lenses(['rig#right'])[''].name == 'right'
    assert not load_lenses(['fish180']).names  # hides no lens of the package
