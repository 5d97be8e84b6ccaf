"""Photographs straight into the commands; a rig; what is said about what does not fit."""

from __future__ import annotations

import json
import re
import shutil
from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.commands import refused
from helpers.data import DATA, NO_DATA
from helpers.kalibr import write_camchain
from helpers.photographs import BOARD, LENS, PRINTED, photograph, poses, write

import fisheye_svp_ros as fsvp
from fisheye_svp_ros import cli
from fisheye_svp_ros.commands.detect import read_input, search_options
from fisheye_svp_ros.commands.diagnose import _read as read_views
from fisheye_svp_ros.commands.lenses import lenses_of, load_lenses
from fisheye_svp_ros.errors import LensError, ParameterError
from fisheye_svp_ros.io.lens_files import load_lens, save_lens
from fisheye_svp_ros.io.readers import read_observations, read_poses, write_observations
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.scene.observations import make_observations
from fisheye_svp_ros.scene.rigs import rig

# One process renders and searches the photographs.
pytestmark = pytest.mark.xdist_group('photographs')

PHOTOS = DATA / 'photos'


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten photographs and one without a board."""
    folder = tmp_path_factory.mktemp('photographs')
    where = poses(10, 8)
    images = [photograph(where.take(i), seed=i) for i in range(10)]
    write(folder, [*images, np.full_like(images[0], 90)])
    return folder


def test_beside_photographs_a_table_is_a_table(tmp_path: Path) -> None:
    table = make_observations(
        np.zeros(4, dtype=int), np.arange(4), np.ones((4, 2)), np.ones((4, 3))
    )
    write_observations(tmp_path / 'test.csv', table)
    read, sizes = read_input(str(tmp_path / 'test.csv'), Namespace(board=BOARD))
    assert len(read) == 4 and not sizes


def test_the_next_command_has_the_options_that_were_given(folder: Path) -> None:
    """It printed "--split 1" where nobody had asked for it."""
    args = Namespace(board=BOARD, detector=None, sync=None, every=1, split=None)
    read_input(str(folder), args)
    assert search_options(args) == ('--board', BOARD)


def test_detect_then_calibrate(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / 'observations.csv'
    assert (
        cli.main(
            [
                'detect',
                str(folder),
                '--board',
                BOARD,
                '-o',
                str(out),
                '--overlays',
                str(tmp_path / 'overlays'),
            ]
        )
        == 0
    )
    said = capsys.readouterr()
    told = re.search(r'found in 10 of 11 photographs, (\d+) points', said.out)
    assert told and 290 <= int(told[1]) <= 300  # a corner at the edge may be refused
    assert '10.png: no board found' in said.err
    document = json.loads((tmp_path / 'observations.detect.json').read_text())
    assert document['image_size'] == [424, 400]
    assert [one['frame'] for one in document['photographs']] == [*range(10), -1]
    assert len(list((tmp_path / 'overlays').glob('*.png'))) == 12
    assert cv2.imread(str(tmp_path / 'overlays' / '00.png')).shape[2] == 3
    assert np.isfinite(read_observations(out).sigma).all()
    assert (
        cli.main(
            [
                'calibrate',
                str(out),
                '--free',
                'fx,fy,cx,cy,k1,k2,k3,e0',
                '-o',
                str(tmp_path / 'lens.yaml'),
            ]
        )
        == 0
    )
    lens = load_lens(tmp_path / 'lens.yaml')
    assert (lens.width, lens.calibration['frames']) == (424, 10)
    assert lens.calibration['rms_px'] < 0.1
    assert lens.parameters['e0'] == pytest.approx(0.003, abs=5e-4)


def test_a_table_of_detected_points_replaces_the_photographs(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for command in (
        f'detect {folder} --board {BOARD} -o train.csv',
        'calibrate train.csv --model kannala_brandt --image-size 424x400 -o lens.yaml',
        'diagnose train.csv --lens lens.yaml --quick -o diagnosis',
        'localize train.csv --lens diagnosis/extended_lens.yaml -o poses',
    ):
        assert cli.main(command.split()) == 0
    found = json.loads(Path('diagnosis/diagnosis.json').read_text())
    assert [cause['effect'] for cause in found['causes']] == ['viewpoint_shift']
    document = json.loads(Path('poses/localize.json').read_text())
    rms = document['rms_px']
    assert [one['photograph'] for one in document['poses']][:2] == ['00.png', '01.png']
    for table in ('poses', 'covariance', 'residuals'):
        rows = Path(f'poses/{table}.csv').read_text().splitlines()
        assert rows[0].endswith(',photograph') and rows[1].endswith(',00.png')
    assert len(read_poses('poses/poses.csv').frame) == len(document['poses'])
    assert 3 * rms < load_lens(Path('lens.yaml')).calibration['rms_px'] < 0.1


def test_files_given_one_by_one_keep_their_names(tmp_path: Path) -> None:
    """As a shell gives them for *.png."""
    where, overlays = poses(2, 8), tmp_path / 'overlays'
    write(tmp_path / 'photos', [photograph(where.take(i), seed=i) for i in range(2)])
    files = sorted(map(str, (tmp_path / 'photos').glob('*.png')))
    assert (
        cli.main(
            [
                'detect',
                *files,
                '--board',
                BOARD,
                '-o',
                str(tmp_path / 'o.csv'),
                '--overlays',
                str(overlays),
            ]
        )
        == 0
    )
    assert {path.name for path in overlays.iterdir()} >= {Path(file).name for file in files}


def test_equal_names_in_two_folders_are_different_frames(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    where = poses(5, 8)
    for name, views in (('first', (0, 1)), ('second', (2, 3))):
        write(tmp_path / name, [photograph(where.take(i), seed=i) for i in views])
    folders, out = [str(tmp_path / name) for name in ('first', 'second')], tmp_path / 'o.csv'
    assert (
        cli.main(
            [
                'detect',
                *folders,
                '--board',
                BOARD,
                '-o',
                str(out),
                '--overlays',
                str(tmp_path / 'overlays'),
            ]
        )
        == 0
    )
    assert (
        f'{folders[0]}, {folders[1]}: photographs of equal names are different frames of one '
        'camera; for the cameras of a rig give the folder above'
    ) in capsys.readouterr().err
    assert len(read_observations(out).frames) == 4  # refused, where a landmark is twice in a frame
    assert len([*(tmp_path / 'overlays').iterdir()]) == 5
    # In one folder they would be one frame.
    cv2.imwrite(str(tmp_path / 'first' / '00.bmp'), photograph(where.take(4), seed=4))
    assert cli.main(['detect', folders[0], '--board', BOARD, '-o', str(out)]) == 0
    assert '00.png: the same frame as ' in capsys.readouterr().err
    assert len(read_observations(out).frames) == 2


def test_images_in_a_subfolder_beside_photographs_are_told(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ('photographs', 'photographs/second'):
        (tmp_path / name).mkdir()
        for photo in ('00.png', '01.png'):
            shutil.copy(folder / photo, tmp_path / name)
    (tmp_path / 'photographs' / 'empty').mkdir()
    command = ['detect', '--board', BOARD, '-o', str(tmp_path / 'out.csv')]
    for paths, told in (
        (['photographs'], ['second: its 2 images are skipped']),
        (['photographs', 'photographs/second'], []),
    ):
        assert cli.main([*command, *(str(tmp_path / path) for path in paths)]) == 0
        lines = [x for x in capsys.readouterr().err.splitlines() if 'images are skipped' in x]
        assert len(lines) == len(told)
        assert all(text in line for text, line in zip(told, lines, strict=True))


def test_what_is_passed_over_is_told_where_the_others_show_no_board(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(folder, tmp_path / 'photographs')
    cv2.imwrite(str(tmp_path / 'cover.png'), np.zeros((400, 424), np.uint8))
    assert cli.main(['detect', str(tmp_path), '--board', BOARD]) == 2
    note, error = capsys.readouterr().err.splitlines()
    assert 'photographs: its 11 images are skipped' in note
    assert 'no chessboard' in error and 'inner corners: one less than squares' in error


def test_localize_photographs(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_lens(LENS, tmp_path / 'lens.yaml')
    assert (
        cli.main(
            [
                'localize',
                str(folder),
                '--board',
                BOARD,
                '--lens',
                str(tmp_path / 'lens.yaml'),
                '-o',
                str(tmp_path / 'out'),
            ]
        )
        == 0
    )
    assert json.loads((tmp_path / 'out' / 'localize.json').read_text())['rms_px'] < 0.1
    said = refused(capsys, 'localize', folder, '--lens', tmp_path / 'lens.yaml')
    assert '--board chessboard' in said


def test_a_lens_of_another_image_size_is_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_lens(replace(LENS, width=848, height=800), tmp_path / 'large.yaml')
    table = tmp_path / 'observations.csv'
    write_observations(
        table,
        make_observations(
            np.repeat(0, 8), np.arange(8), np.arange(16.0).reshape(8, 2), PRINTED.corners[:8]
        ),
    )
    (tmp_path / 'observations.detect.json').write_text('{"image_sizes": {"": [424, 400]}}')
    photographs = str(folder), '--board', BOARD
    for command, *rest in (
        ('localize', str(table)),
        ('diagnose', str(table)),
        ('calibrate', str(table), '--medium', 'water'),
        ('localize', *photographs),
    ):
        assert cli.main([command, *rest, '--lens', str(tmp_path / 'large.yaml')]) == 2
        said = capsys.readouterr().err
        assert "424x400 px, lens 'small' is for 848x800 px" in said
    for call in (
        lambda: fsvp.localize(table, tmp_path / 'large.yaml'),
        lambda: fsvp.diagnose(str(table), tmp_path / 'large.yaml'),
    ):
        with pytest.raises(LensError, match='is for 848x800 px'):
            call()
    said = refused(capsys, 'calibrate', table, '--image-size', '400x424')
    assert 'images are 424x400 px, --image-size is 400x424' in said
    with pytest.raises(ParameterError, match='424x400 px, image_size is 400x424'):
        fsvp.calibrate(table, 'equidistant', (400, 424))


def test_a_rig(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    where, left_in_right = poses(10, 3), rig('vergent', 0.05)
    columns: list[tuple[np.ndarray, ...]] = []
    for camera, pose in enumerate((where.compose(left_in_right), where)):
        image = project(LENS, pose.into_body(PRINTED.corners))
        frame, corner = np.nonzero(image.valid)
        columns.append(
            (
                frame,
                corner,
                image.uv[frame, corner],
                PRINTED.corners[corner],
                np.full(len(frame), camera),
            )
        )
    frame, corner, uv, xyz, camera = (np.concatenate(part) for part in zip(*columns, strict=True))
    table = tmp_path / 'rig.csv'
    write_observations(
        table, make_observations(frame, corner, uv, xyz, camera=camera, cameras=('left', 'right'))
    )
    out = tmp_path / 'rig'
    assert (
        cli.main(
            [
                'calibrate',
                str(table),
                '--image-size',
                '424x400',
                '--free',
                'fx,fy,cx,cy,k1,k2,k3,e0',
                '-o',
                str(out),
            ]
        )
        == 0
    )
    assert '-50.0' in capsys.readouterr().out
    assert {path.name for path in out.glob('*.yaml')} == {
        'left.yaml',
        'right.yaml',
        'rig.yaml',
        'camchain.yaml',
        'tf_static.yaml',
    }
    assert json.loads((out / 'rig.json').read_text())['cameras']['right']['covariance']
    lenses = [f'--lens={name}={out / name}.yaml' for name in ('left', 'right')]
    assert cli.main(['localize', str(table), *lenses, '-o', str(tmp_path / 'poses')]) == 0
    assert json.loads((tmp_path / 'poses' / 'right' / 'localize.json').read_text())['frames'] == 10
    assert 'camera right has no lens' in refused(capsys, 'localize', table, lenses[0])
    assert 'the observations hold left, right' in refused(
        capsys, 'localize', table, f'--lens=up={out}/left.yaml'
    )
    # Both lenses in one file: Kalibr's camchain, whose cameras are the table's in its order.
    chain = write_camchain(
        tmp_path / 'camchain.yaml', LENS, replace(LENS, fx=LENS.fx + 40), left_in_right
    )
    assert (
        cli.main(['localize', str(table), f'--lens={chain}', '-o', str(tmp_path / 'chain')]) == 0
    )
    left, right = (
        json.loads((tmp_path / 'chain' / name / 'localize.json').read_text())['rms_px']
        for name in ('left', 'right')
    )
    assert left < 1 < right


def test_lenses_of_one_file_go_by_name_or_by_order(tmp_path: Path) -> None:
    other = replace(LENS, fx=LENS.fx + 1)
    given = load_lenses(
        [str(write_camchain(tmp_path / 'two.yaml', LENS, other, rig('parallel', 0.1)))]
    )

    def focal(*cameras: str) -> list[float]:
        return [round(lens.fx - LENS.fx, 6) for lens in lenses_of(cameras, given).values()]

    assert focal('left', 'right') == [0, 1]
    assert focal('cam1', 'cam0') == [1, 0]
    assert focal('') == [0]
    with pytest.raises(LensError, match=r'holds cam0, cam1, the observations a, b, c'):
        focal('a', 'b', 'c')
    assert not load_lenses([f'{tmp_path}/two.yaml#cam1']).in_file


@pytest.mark.parametrize('file', ['{}.yaml', '{}/extended_lens.yaml'])
@pytest.mark.parametrize(
    ('folder', 'cameras'),
    [
        ('rig', ('cam#0', 'links (Süd) #1')),
        ('f=8,run#3/rig', ('cam#0', 'links (Süd) #1')),
        ('rig', ('front/left', 'front/links (Süd) #1')),
    ],
)
def test_lenses_of_a_folder_may_have_any_name(
    tmp_path: Path, folder: str, cameras: tuple[str, str], file: str
) -> None:
    for i, camera in enumerate(cameras):
        save_lens(replace(LENS, fx=LENS.fx + i), tmp_path / folder / file.format(camera))
    save_lens(LENS, tmp_path / folder / 'rig.yaml')
    for given in (f'{tmp_path}/{folder}', f'{tmp_path}/{folder}/'):
        lenses = lenses_of(cameras, load_lenses([given]))
        assert [lens.fx - LENS.fx for lens in lenses.values()] == pytest.approx([0, 1])
        one = load_lenses([f'{given}#{cameras[1]}'])['']
        assert one.fx == pytest.approx(LENS.fx + 1)


@pytest.mark.parametrize(
    ('camera', 'lens', 'note'),
    [
        ('right', 'right', ''),
        (
            '',
            'left',
            'rig/: it holds left, right, and no camera is named; the lens of left is used; '
            'use {0}#right for another',
        ),
    ],
)
def test_one_camera_of_a_rig_has_its_own_lens(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], camera: str, lens: str, note: str
) -> None:
    for i, name in enumerate(('left', 'right')):
        save_lens(replace(LENS, name=name, fx=LENS.fx - 20 * i), tmp_path / 'rig' / f'{name}.yaml')
    of_lens = load_lens(tmp_path / 'rig' / f'{lens}.yaml')
    image = project(of_lens, poses(4, 3).into_body(PRINTED.corners))
    frame, corner = np.nonzero(image.valid)
    table, rig_folder = tmp_path / 'one.csv', f'{tmp_path}/rig/'
    write_observations(
        table,
        make_observations(
            frame, corner, image.uv[frame, corner], PRINTED.corners[corner], cameras=(camera,)
        ),
    )
    out = tmp_path / 'out'
    assert cli.main(['localize', str(table), '--lens', rig_folder, '-o', str(out)]) == 0
    assert note.format(rig_folder) in capsys.readouterr().err
    assert json.loads((out / camera / 'localize.json').read_text())['rms_px'] < 1e-3
    args = Namespace(board=None)
    assert read_views(str(table), args, load_lenses([rig_folder]))[1] == of_lens
    with pytest.raises(LensError, match=r'rig/: it holds left, right, the observations top;'):
        lenses_of(('top',), load_lenses([rig_folder]))


def test_what_does_not_fit_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    where = poses(8, 3)
    image = project(LENS, where.into_body(PRINTED.corners))
    frame, corner = np.nonzero(image.valid)
    table = tmp_path / 'mm.csv'
    uv = image.uv[frame, corner] + 5 * np.random.default_rng(0).standard_normal((len(frame), 2))
    write_observations(table, make_observations(frame, corner, uv, 1000 * PRINTED.corners[corner]))
    assert 'the image size is unknown' in refused(capsys, 'calibrate', table)
    cli.main(['calibrate', str(table), '--image-size', '424x400'])
    said = capsys.readouterr().err
    assert 'not in mm' in said
    assert 'does not fit this lens' in said


@pytest.mark.skipif(not PHOTOS.exists(), reason=NO_DATA)
@pytest.mark.parametrize(
    ('folder', 'board', 'frames', 'rms'),
    [
        ('chessboard', 'chessboard:4x6:30mm', 26, 0.25),
        ('square_grid', 'squares:3x4:30mm:30mm', 22, 0.65),
    ],
)
def test_real_photographs(
    tmp_path: Path, folder: str, board: str, frames: int, rms: float
) -> None:
    out = tmp_path / 'lens.yaml'
    assert cli.main(['calibrate', str(PHOTOS / folder), '--board', board, '-o', str(out)]) == 0
    figures = load_lens(out).calibration
    assert figures['frames'] == frames
    assert figures['rms_px'] < rms


def test_few_boards_may_be_another_board(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    blank = np.full((LENS.height, LENS.width), 128, np.uint8)
    # Older OpenCV does not find every board.
    shown = [photograph(poses(3).take(i)) for i in range(3)]
    write(tmp_path, [*shown, *(blank + i for i in range(4))])
    assert cli.main(['detect', str(tmp_path), '--board', BOARD]) == 0
    said = capsys.readouterr().err
    assert f'no {BOARD} in most photographs; check kind and size (inner corners)' in said


@pytest.mark.parametrize(
    'said',
    [
        ('--seed', '-1'),
        ('--blur', 'nan'),
        ('--noise', 'inf'),
        ('--bow', 'nan'),
        ('--ranges', '0.1', 'inf'),
        ('--ranges', '1e300', '1e308'),
        ('--count', '100000000000'),
    ],
)
def test_render_with_what_is_no_size(said, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert (
        cli.main(
            [
                'render',
                '--lens',
                'fish180',
                '--board',
                BOARD,
                '-o',
                str(tmp_path / 'a'),
                '--count',
                '1',
                *said,
            ]
        )
        == 2
    )
    assert said[0].removeprefix('--') in capsys.readouterr().err
    assert not (tmp_path / 'a').exists()


@pytest.mark.parametrize(
    'said',
    [
        ('--count', '3', '--poses', 'poses.csv'),
        ('--ranges', '0.1', '0.2', '--poses', 'poses.csv'),
        ('--ranges', '0.1', '0.2', '--target', 'room'),
    ],
)
def test_render_refuses_what_has_no_effect(
    said: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        cli.main(
            ['render', '--lens', 'fish180', '--board', BOARD, '-o', str(tmp_path / 'a'), *said]
        )
        == 2
    )
    err = capsys.readouterr().err
    assert f'{said[0]} is for ' in err and 'leave ' in err and err.count('\n') == 1
    assert not (tmp_path / 'a').exists()


def test_render_and_example_are_deterministic(tmp_path: Path) -> None:
    save_lens(LENS, tmp_path / 'lens.yaml')
    for name in ('one', 'two'):
        assert (
            cli.main(
                [
                    'render',
                    '--lens',
                    str(tmp_path / 'lens.yaml'),
                    '--board',
                    BOARD,
                    '--count',
                    '2',
                    '--bow',
                    '1',
                    '-o',
                    str(tmp_path / name),
                ]
            )
            == 0
        )
    assert (tmp_path / 'one/001.png').read_bytes() == (tmp_path / 'two/001.png').read_bytes()
    assert len(read_observations(tmp_path / 'one/observations.csv').frames) == 2


def test_the_truth_about_a_room(tmp_path: Path) -> None:
    save_lens(LENS, tmp_path / 'lens.yaml')
    assert (
        cli.main(
            [
                'render',
                '--lens',
                str(tmp_path / 'lens.yaml'),
                '--board',
                BOARD,
                '--target',
                'room',
                '--count',
                '3',
                '-o',
                str(tmp_path),
            ]
        )
        == 0
    )
    assert len(set(read_observations(tmp_path / 'observations.csv').board.tolist())) > 3
    assert (
        cli.main(
            [
                'localize',
                str(tmp_path / 'observations.csv'),
                '--lens',
                str(tmp_path / 'lens.yaml'),
                '-o',
                str(tmp_path / 'found'),
            ]
        )
        == 0
    )
    found, true = (read_poses(tmp_path / name).pose for name in ('found/poses.csv', 'poses.csv'))
    assert np.abs(found.position - true.position).max() < 1e-6


def test_photographs_of_before_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_lens(LENS, tmp_path / 'lens.yaml')
    command = [
        'render',
        '--lens',
        str(tmp_path / 'lens.yaml'),
        '--board',
        BOARD,
        '-o',
        str(tmp_path / 'out'),
        '--ranges',
        '0.1',
        '0.2',
        '--count',
    ]
    assert cli.main([*command, '2']) == cli.main([*command, '2']) == 0
    assert capsys.readouterr().err == ''
    assert cli.main([*command, '1']) == 2  # its corners would be written over those of two
    assert 'observations.csv: another file is there' in capsys.readouterr().err
    shutil.copy(tmp_path / 'out' / '000.png', tmp_path / 'out' / 'mine.png')
    assert cli.main([*command, '2']) == 0
    assert 'out: 1 other photographs are in it too' in capsys.readouterr().err
