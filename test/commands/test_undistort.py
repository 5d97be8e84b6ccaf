"""`undistort`: photographs, maps, cameras and what is left; `lens --range`."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.commands import refused
from helpers.photographs import LENS, PRINTED, photograph, poses
from numpy.typing import NDArray

import fisheye_svp_ros as fsvp
from fisheye_svp_ros import cli
from fisheye_svp_ros.io.lens_files import load_lens, save_lens
from fisheye_svp_ros.io.readers import write_poses
from fisheye_svp_ros.io.rig_files import save_rig
from fisheye_svp_ros.optics.curves import KannalaBrandt
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.simulate.render import Exposure, render

# One process renders the photographs.
pytestmark = pytest.mark.xdist_group('undistort')
RIG = Pose(rotation_from_vector(np.array([0.02, 0.05, -0.03])), np.array([-0.06, 0.003, 0.004]))
RIGHT = replace(LENS, name='other', fx=144.0, fy=144.0)


def run(*arguments: object) -> None:
    assert cli.main(['undistort', *map(str, arguments)]) == 0


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photographs of a rig, its lenses and rig.yaml; color/ holds one in color."""
    folder = tmp_path_factory.mktemp('rig')
    for name, lens, rig in (('left', LENS, None), ('right', RIGHT, RIG)):
        save_lens(lens, folder / 'lenses' / f'{name}.yaml')
        (folder / 'photos' / name).mkdir(parents=True)
        for number in range(2):
            camera = poses(2, 3).take(number)
            camera = camera if rig is None else camera.compose(rig.inverse())
            image = render(lens, PRINTED, camera, Exposure(), np.random.default_rng(number))
            cv2.imwrite(str(folder / 'photos' / name / f'{number:02d}.png'), image)
    save_rig(RIG, folder / 'lenses' / 'rig.yaml')
    (folder / 'color').mkdir()
    grey = photograph(poses(1, 3).take(0))
    cv2.imwrite(str(folder / 'color' / 'a.jpg'), np.stack([grey, grey // 2, 255 - grey], axis=-1))
    return folder


def matrix(document: dict[str, object], name: str) -> NDArray[np.float64]:
    return np.array(document[name])


def test_one_camera(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], drawn: None
) -> None:
    lens = folder / 'lenses' / 'left.yaml'
    run(
        lens,
        folder / 'photos' / 'left' / '00.png',
        '-o',
        tmp_path,
        '--fov',
        100,
        '--size',
        '500x300',
        '--range',
        0.3,
    )
    out = capsys.readouterr().out
    assert 'pinhole 500x300 px, f 209.77 px, 100.0 deg wide' in out
    for text in ('the maps are exact at 0.3 m', 'below 0.5 px from', 'infinity'):
        assert text in out
    side = fsvp.undistort_maps(lens, size=(500, 300), field_of_view=np.radians(100.0), range_m=0.3)
    raw = cv2.imread(str(folder / 'photos' / 'left' / '00.png'), cv2.IMREAD_GRAYSCALE)
    image = cv2.imread(str(tmp_path / '00.png'), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(image, cv2.remap(raw, side.maps.u, side.maps.v, 1))
    with np.load(tmp_path / 'maps.npz') as file:
        arrays = dict(file)
    storage = cv2.FileStorage(str(tmp_path / 'maps.yml'), cv2.FILE_STORAGE_READ)
    for name, expected in zip(
        ('map1', 'map2', 'mask', 'K', 'R', 'P'),
        (*side.maps, side.k, side.rotation, side.p),
        strict=True,
    ):
        np.testing.assert_array_equal(arrays[name], expected)
        np.testing.assert_array_equal(storage.getNode(name).mat(), expected)
    assert arrays['map1'].dtype == np.float32
    mask = cv2.imread(str(tmp_path / 'mask.png'), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(mask, np.where(side.maps.mask, 255, 0))
    document = json.loads((tmp_path / 'undistort.json').read_text())
    camera = document['cameras']['small']
    assert camera['k'] == side.k.tolist() and camera['photographs'] == 1
    shift = camera['shift']
    assert shift['ranges_m'] == [0.3, 0.5, 1.0, 2.0, 5.0, None]
    assert shift['worst_px'][0] < 1e-6 < 0.5 < shift['worst_px'][-1]
    assert shift['below_m'][0] < 0.3 < shift['below_m'][1]
    picture = cv2.imread(str(tmp_path / 'shift.png'))
    # The map is of one piece: white lines ran between its cells.
    blue = (picture[..., 0].astype(int) - picture[..., 2] > 40)[:, picture.shape[1] // 2 : -250]
    filled = cv2.morphologyEx(blue.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5)))
    assert filled.sum() > 10_000 and (filled > blue).mean() < 0.01
    ideal = load_lens(tmp_path / 'camera_info.yaml')  # 9 decimals of a pixel from the ideal one
    assert (ideal.width, ideal.height) == (500, 300)
    point = np.array([[0.3, -0.2, 0.5]])
    assert fsvp.project(ideal, point).uv == pytest.approx(side.camera.project(point), abs=0.05)


def test_a_lens_of_one_viewpoint_and_maps_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_lens(LENS.svp(), tmp_path / 'svp.yaml')
    run(tmp_path / 'svp.yaml', '-o', tmp_path / 'out', '--as', 'fisheye')
    out = capsys.readouterr().out
    assert 'the lens has one viewpoint: the maps are exact at every range' in out
    assert (
        json.loads((tmp_path / 'out' / 'undistort.json').read_text())['cameras']['small']['shift']
        is None
    )
    assert not (tmp_path / 'out' / 'shift.png').exists()
    ideal = load_lens(tmp_path / 'out' / 'camera_info.yaml')
    assert ideal.image_height == KannalaBrandt()  # equidistant, all coefficients 0


def test_rows_of_a_pair_without_a_shift_agree_at_every_range(folder: Path, tmp_path: Path) -> None:
    for name, lens in (('left', LENS), ('right', RIGHT)):
        save_lens(lens.svp(), tmp_path / 'lenses' / f'{name}.yaml')
    save_rig(RIG, tmp_path / 'lenses' / 'rig.yaml')
    run(f'{tmp_path / "lenses"}/', '-o', tmp_path / 'out')
    document = json.loads((tmp_path / 'out' / 'undistort.json').read_text())
    assert document['rows'] is None and document['baseline_m'] == pytest.approx(0.0602, abs=1e-4)
    assert not (tmp_path / 'out' / 'rows.png').exists()


def test_color_stays(folder: Path, tmp_path: Path) -> None:
    run(folder / 'lenses' / 'left.yaml', folder / 'color', '-o', tmp_path, '--as', 'cylindrical')
    image = cv2.imread(str(tmp_path / 'a.png'), cv2.IMREAD_UNCHANGED)
    assert image.shape == (LENS.height, LENS.width, 3)
    assert np.ptp(image.astype(int), axis=-1).max() > 60
    # No camera_info says what a cylinder is.
    assert not (tmp_path / 'camera_info.yaml').exists()


@pytest.mark.parametrize('way', ['folder', 'options'])
def test_a_rig(
    folder: Path, tmp_path: Path, way: str, capsys: pytest.CaptureFixture[str], drawn: None
) -> None:
    lenses = folder / 'lenses'
    given: list[object] = (
        [f'{lenses}/']
        if way == 'folder'
        else [
            '--lens',
            f'left={lenses / "left.yaml"}',
            '--lens',
            f'right={lenses / "right.yaml"}',
            '--rig',
            lenses / 'rig.yaml',
        ]
    )
    run(*given, folder / 'photos', '-o', tmp_path, '--range', 0.2)
    out = capsys.readouterr().out
    assert 'baseline 60.21 mm; row difference between left and right' in out
    assert f'{tmp_path}: 4 photographs, maps for cv2.remap' in out
    pair = fsvp.rectify_maps(LENS, RIGHT, RIG, range_m=0.2)
    for name, side in (('left', pair.left), ('right', pair.right)):
        with np.load(tmp_path / name / 'maps.npz') as file:
            np.testing.assert_array_equal(file['map2'], side.maps.v)
            assert file['P'] == pytest.approx(side.p)
        assert {path.name for path in (tmp_path / name).iterdir()} == {
            '00.png',
            '01.png',
            'camera_info.yaml',
            'maps.npz',
            'maps.yml',
            'mask.png',
            'shift.png',
        }
    document = json.loads((tmp_path / 'undistort.json').read_text())
    assert document['baseline_m'] == pytest.approx(pair.baseline)
    rows = document['rows']
    assert rows['worst_px'][rows['ranges_m'].index(0.2)] < 1e-6
    assert rows['below_m'] == [pytest.approx(0.1, abs=0.03), None]  # null: infinity
    assert document['cameras']['right']['p'][0][3] == pytest.approx(-pair.baseline * 212, rel=1e-3)
    for name in ('pair.png', 'rows.png'):
        assert cv2.imread(str(tmp_path / name)) is not None


def lenses_by_name(folder: Path, *names: str) -> list[str]:
    return [f'--lens={name}={folder / "lenses" / name}.yaml' for name in names]


@pytest.mark.parametrize(
    ('names', 'said'),
    [
        (
            ('left', 'right'),
            'note: left and right are not rectified as a pair, because no rig is named; '
            'add --rig FILE\n',
        ),
        (
            ('left', 'right', 'rear'),
            'note: 3 cameras are not rectified as a pair; name two of them '
            'and their rig: --lens left=LENS --lens right=LENS --rig FILE\n',
        ),
    ],
)
def test_lenses_without_a_rig_are_undistorted_each_by_itself(
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    names: tuple[str, ...],
    said: str,
) -> None:
    lens = folder / 'lenses' / 'left.yaml'
    run(*(f'--lens={name}={lens}' for name in names), '-o', tmp_path, '--size', '64x48')
    assert capsys.readouterr().err.endswith(said)
    document = json.loads((tmp_path / 'undistort.json').read_text())
    assert 'rows' not in document
    assert all(camera['r'] == np.eye(3).tolist() for camera in document['cameras'].values())


def test_two_cameras_of_a_larger_rig_go_by_name_and_need_no_photographs(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The rig is named by its folder, as for `localize --rig`."""
    steps = [Pose(np.eye(3), np.array([-0.2, 0.0, 0.0])), RIG]
    save_rig(steps, tmp_path / 'rig' / 'rig.yaml', ('top', 'left', 'right'))
    end = '--rig', tmp_path / 'rig', '-o', tmp_path / 'out', '--size', '64x48'
    run(*lenses_by_name(folder, 'left', 'right'), *end)
    out = capsys.readouterr().out
    assert 'baseline 60.21 mm' in out and 'out: 0 photographs' in out
    lens = folder / 'lenses' / 'left.yaml'
    said = refused(capsys, 'undistort', f'--lens=cam0={lens}', f'--lens=left={lens}', *end)
    assert 'a rig of top, left, right, without cam0; give the lenses of two of these' in said
    assert 'no lens is named; give LENS' in refused(capsys, 'undistort', *end)
    assert fsvp.load_rig(tmp_path / 'rig').position[0] == -0.2


@pytest.mark.parametrize('name', ['mask', 'shift'])
def test_no_photograph_is_lost_to_a_result_of_its_name(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    photograph = tmp_path / f'{name}.jpg'
    photograph.write_bytes((folder / 'color' / 'a.jpg').read_bytes())
    said = refused(
        capsys, 'undistort', folder / 'lenses' / 'left.yaml', photograph, '-o', tmp_path / 'out'
    )
    assert f'{photograph}: {name}.png is a result of this command too; rename the photo' in said
    assert not (tmp_path / 'out').exists()


def test_what_cannot_be_done_is_said_in_a_line(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lens, photos, out = folder / 'lenses' / 'left.yaml', folder / 'photos', tmp_path / 'out'
    end = '-o', out
    assert '--fov' not in refused(capsys, 'undistort', lens, photos / 'left', '--fov', 190, *end)
    said = refused(capsys, 'undistort', f'{folder / "lenses"}/', photos, '--as', 'fisheye', *end)
    assert "'fisheye' has no straight epipolar rows" in said
    said = refused(capsys, 'undistort', lens, photos / 'left', '--range', 0.001, *end)
    assert 'range is 0.001 m' in said
    said = refused(
        capsys, 'undistort', lens, photos / 'left', '--rig', folder / 'lenses' / 'rig.yaml', *end
    )
    assert 'a rig of two cameras needs two lenses, got 1' in said
    small = tmp_path / 'small'
    small.mkdir()
    cv2.imwrite(str(small / 'x.png'), np.zeros((40, 42), np.uint8))
    assert cli.main(['undistort', str(lens), str(small), '-o', str(out)]) == 2
    said = capsys.readouterr().err
    assert "x.png: the image is 42x40 px, lens 'small' is for 424x400 px" in said
    assert 'small: no photograph can be used: the image is 42x40 px' in said
    twice = [photos / 'left' / '00.png', tmp_path / 'other' / '00.png']
    (tmp_path / 'other').mkdir()
    shutil.copy(photos / 'right' / '00.png', twice[1])
    (tmp_path / 'a.csv').write_text('frame')
    assert cli.main(['undistort', str(lens), str(tmp_path / 'a.csv'), '-o', str(out)]) == 2
    assert 'no photograph can be used: the image cannot be read' in capsys.readouterr().err
    assert 'another photograph is also called 00' in refused(
        capsys, 'undistort', lens, *twice, *end
    )
    assert not out.exists() or not [*out.rglob('*.*')]


def test_a_photograph_of_another_size_is_skipped(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(folder / 'photos' / 'left', tmp_path / 'photos')
    cv2.imwrite(str(tmp_path / 'photos' / 'x.png'), np.zeros((40, 42), np.uint8))
    (tmp_path / 'photos' / 'y.png').write_text('no image')
    lens, out = folder / 'lenses' / 'left.yaml', tmp_path / 'out'
    assert cli.main(['undistort', str(lens), str(tmp_path / 'photos'), '-o', str(out)]) == 0
    said = capsys.readouterr().err
    assert "x.png: the image is 42x40 px, lens 'small' is for 424x400 px" in said
    assert 'y.png: the image cannot be read' in said
    assert (out / '00.png').exists() and not (out / 'x.png').exists()


def test_images_side_by_side_are_undistorted_apart(folder: Path, tmp_path: Path) -> None:
    pair = [cv2.imread(str(folder / 'photos' / name / '00.png'), 0) for name in ('left', 'right')]
    cv2.imwrite(str(tmp_path / '00.png'), np.hstack(pair))
    lenses = f'{folder / "lenses"}/'
    for paths, out in ((folder / 'photos', 'apart'), (tmp_path / '00.png', 'joined')):
        split = ['--split', '2'] if out == 'joined' else []
        command = ['undistort', lenses, str(paths), *split, '-o', str(tmp_path / out)]
        assert cli.main(command) == 0
    for name in ('left', 'right'):
        apart, joined = (tmp_path / out / name / '00.png' for out in ('apart', 'joined'))
        assert apart.read_bytes() == joined.read_bytes()


def test_a_broken_photograph_is_named_and_the_rest_goes_on(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photos = tmp_path / 'photos'
    photos.mkdir()
    cv2.imwrite(str(photos / 'a.png'), photograph(poses(1, 3).take(0)))
    (photos / 'b.png').write_bytes((photos / 'a.png').read_bytes()[:2000])
    run(folder / 'lenses' / 'left.yaml', photos, '-o', tmp_path / 'out')
    said = capsys.readouterr()
    assert 'b.png: the PNG is incomplete' in said.err
    assert ': 1 photographs' in said.out


class TestLensForOneViewpoint:
    """`lens --format ... --range`."""

    def points(self, range_m: float) -> NDArray[np.float64]:
        theta = np.linspace(0.05, 1.4, 30)
        return range_m * np.stack([np.sin(theta), 0 * theta, np.cos(theta)], axis=-1)

    @pytest.mark.parametrize('form', ['ros', 'kalibr', 'opencv', 'basalt'])
    def test_the_curve_is_fitted_at_the_range(
        self, folder: Path, tmp_path: Path, form: str, capsys: pytest.CaptureFixture[str]
    ) -> None:
        lens = folder / 'lenses' / 'left.yaml'
        end = 'lens', str(lens), '-o', str(tmp_path / 'there'), '--format', form
        assert cli.main([*end, '--range', '0.4']) == 0
        out = capsys.readouterr().out
        assert 'one viewpoint, fitted at 0.4 m:' in out and '0.4 m' in out
        assert 'left out: the viewpoint shift' in out
        points = self.points(0.4)
        true = fsvp.project(LENS, points).uv
        off = np.abs(fsvp.project(tmp_path / 'there', points).uv - true).max()
        assert cli.main([*end]) == 0
        assert '--range M fits the curve' in capsys.readouterr().out
        dropped = np.abs(fsvp.project(tmp_path / 'there', points).uv - true).max()
        assert off < 0.01 < 0.3 < dropped

    def test_a_range_changes_nothing_where_the_viewpoint_does_not_move(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        skew = {'skew': {'parameters': {'shear': 0.001}}}
        save_lens(replace(LENS.svp(), corrections=skew), tmp_path / 'lens.yaml')
        end = 'lens', str(tmp_path / 'lens.yaml'), '--format', 'ros', '-o'
        assert cli.main([*end, str(tmp_path / 'a')]) == 0
        assert cli.main([*end, str(tmp_path / 'b'), '--range', '1']) == 0
        assert '--range 1 changes nothing' in capsys.readouterr().err
        assert (tmp_path / 'a').read_text() == (tmp_path / 'b').read_text()

    def test_what_it_needs(
        self, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        lens = folder / 'lenses' / 'left.yaml'
        said = refused(capsys, 'lens', lens, '-o', tmp_path / 'x.yaml', '--range', 1)
        assert '--range needs --format, for example ros' in said
        said = refused(
            capsys, 'lens', lens, '-o', tmp_path / 'x', '--format', 'ros', '--range', -1
        )
        assert "range is -1 m; lens 'small' needs more than" in said


def test_a_rendered_rig_has_its_truth(folder: Path, tmp_path: Path) -> None:
    """Each camera sees the corners from where the rig file says that it stands."""
    assert (
        cli.main(
            [
                'render',
                '--lens',
                f'{folder / "lenses"}/',
                '--board',
                'chessboard:6x5:30mm',
                '--count',
                '3',
                '--ranges',
                '0.15',
                '0.2',
                '-o',
                str(tmp_path),
            ]
        )
        == 0
    )
    table, poses_of = (
        fsvp.read_observations(tmp_path / 'observations.csv'),
        fsvp.read_poses(tmp_path / 'poses.csv'),
    )
    assert table.cameras == ('left', 'right') and len(poses_of.pose.position) == 3
    both = {'left': (LENS, Pose(np.eye(3), np.zeros(3))), 'right': (RIGHT, RIG.inverse())}
    for number, (name, (lens, place)) in enumerate(both.items()):
        mine = table.take(table.camera == number)
        camera = poses_of.pose.take(mine.frame).compose(place.broadcast_to(len(mine)))
        seen = fsvp.project(lens, camera.inverse().transform(mine.xyz)).uv
        assert np.abs(seen - mine.uv).max() < 1e-5
        assert {path.name for path in (tmp_path / name).iterdir()} == {
            f'{frame:03d}.png' for frame in np.unique(mine.frame)
        }
    run(f'{folder / "lenses"}/', tmp_path, '-o', tmp_path / 'out', '--range', 0.2)
    assert (tmp_path / 'out' / 'pair.png').exists()


@pytest.mark.parametrize('more', [(), ('--target', 'cube')])
def test_a_rig_of_more_cameras_than_photographs_is_rendered(
    folder: Path, tmp_path: Path, more: tuple[str, ...]
) -> None:
    assert (
        cli.main(
            [
                'render',
                '--lens',
                f'{folder / "lenses"}/',
                '--board',
                'chessboard:6x5:20mm',
                '--count',
                '1',
                *more,
                '--ranges',
                '0.15',
                '0.2',
                '-o',
                str(tmp_path),
            ]
        )
        == 0
    )
    assert len(fsvp.read_poses(tmp_path / 'poses.csv').frame) == 1


def test_what_cannot_be_rendered_is_said_in_a_line(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    away = Pose.stack(
        [
            Pose(pose.rotation, 1000 * pose.position)
            for pose in (poses(2).take(i) for i in range(2))
        ]
    )
    write_poses(tmp_path / 'mm.csv', np.arange(2), away)
    end = '--board', 'chessboard:6x5:30mm', '-o', tmp_path / 'out'
    said = refused(capsys, 'render', '--lens', 'fish180', '--poses', tmp_path / 'mm.csv', *end)
    assert 'mm.csv: from each of its poses, the target is smaller' in said and 'in m' in said
    for name in ('left', 'right'):
        shutil.copy(folder / 'lenses' / f'{name}.yaml', tmp_path)
    said = refused(capsys, 'render', '--lens', f'{tmp_path}/', '--count', 1, *end)
    assert 'it holds left, right but not their relative poses; add rig.yaml' in said
    assert not (tmp_path / 'out').exists()


def test_pixels_beyond_what_is_known_of_the_lens_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_lens(replace(LENS, calibration={'reached_deg': 30.0}), tmp_path / 'lens.yaml')
    run(tmp_path / 'lens.yaml', '--fov', 100, '-o', tmp_path / 'out')
    assert 'but image points of the calibration reach 30 deg' in capsys.readouterr().err
