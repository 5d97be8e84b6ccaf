"""Readers: every form gives the same table, and bad input one clear line."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from helpers.data import DATA, NO_DATA

from fisheye_svp_ros.errors import ObservationError, OutputError
from fisheye_svp_ros.io.readers import (
    read_observations,
    read_poses,
    write_observations,
    write_poses,
)
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.scene.observations import make_observations

OV_PLANE = DATA / 'ov_plane'
HEADER = 'frame,landmark,u,v,x,y,z'
ROWS = '0,4,10.5,20.25,0.1,0.2,0.3\n0,5,11,21,0.4,0.5,0.6\n2,4,12,22,0.1,0.2,0.3\n'


@pytest.fixture
def csv(tmp_path):
    """Return a function that writes a file and gives its path."""

    def write(text, name='observations.csv'):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


def fails(path, *says, read=read_observations):
    """Check that reading gives one line that names the file and says all this."""
    with pytest.raises(ObservationError) as caught:
        read(path)
    message = str(caught.value)
    assert '\n' not in message
    for text in (str(path), *says):
        assert text in message


def same(a, b):
    """Say whether two tables hold the same rows."""
    return all(
        np.array_equal(getattr(a, f.name), getattr(b, f.name), equal_nan=f.name in ('t', 'sigma'))
        for f in fields(a)
        if f.name not in ('cameras', 'source')
    )


class TestObservationsCsv:
    def test_reads_the_required_columns(self, csv):
        table = read_observations(csv(f'{HEADER}\n{ROWS}'))
        np.testing.assert_array_equal(table.frame, [0, 0, 2])
        np.testing.assert_array_equal(table.landmark, [4, 5, 4])
        np.testing.assert_array_equal(table.uv[0], [10.5, 20.25])
        np.testing.assert_array_equal(table.xyz[1], [0.4, 0.5, 0.6])
        assert np.isnan(table.t).all() and np.isnan(table.sigma).all()
        assert not table.camera.any() and not table.board.any()
        assert table.cameras == ('',)

    def test_columns_in_any_order_more_ignored(self, csv):
        path = csv(
            '\ufeffz, sigma,comment,board,camera,t,v,u,landmark,frame,y,x\r\n'
            '0.3,0.5,"a, b",1,right,7.5,20,10,4,3,0.2,0.1\r\n\r\n'
            '0.3,0.25,,0,left,7.5,21,11,4,3.0,0.2,0.1\r\n'
        )
        table = read_observations(path)
        assert table.cameras == ('right', 'left')
        np.testing.assert_array_equal(table.camera, [0, 1])
        np.testing.assert_array_equal(table.board, [1, 0])
        np.testing.assert_array_equal(table.frame, [3, 3])
        np.testing.assert_array_equal(table.sigma, [0.5, 0.25])
        np.testing.assert_array_equal(table.t, [7.5, 7.5])
        np.testing.assert_array_equal(table.xyz, [[0.1, 0.2, 0.3]] * 2)
        assert table.source == str(path)

    @pytest.mark.parametrize('separator', [';', '\t'])
    def test_semicolons_and_tabs(self, csv, separator):
        text = f'{HEADER}\r\n{ROWS}'.replace(',', separator)
        path = csv(f'\ufeff{text}', 'OBSERVATIONS.CSV')
        assert same(read_observations(path), read_observations(csv(f'{HEADER}\n{ROWS}')))

    @pytest.mark.parametrize('above', ['# of a tool\n# 2 of "them\n', '# ', '# a tool\n#'])
    def test_comments_above_the_header(self, csv, above):
        table = read_observations(csv(f'{above}{HEADER}\n{ROWS}'))
        assert len(table) == len(read_observations(csv(f'{HEADER}\n{ROWS}')))

    def test_lines_are_counted_with_comments(self, csv):
        with pytest.raises(ObservationError, match='line 4: u is'):
            read_observations(csv(f'# a\n\n{HEADER}\n0,0,?,0,0,0,0\n'))

    def test_written_tables_read_back_to_the_same_bits(self, tmp_path):
        rng = np.random.default_rng(1)
        table = make_observations(
            np.repeat([0, 3], 5),
            np.tile(np.arange(5), 2),
            rng.normal(size=(10, 2)) * 1e3,
            rng.normal(size=(10, 3)),
            camera=np.repeat([1, 0], 5),
            board=np.arange(10) % 2,
            t=rng.normal(size=10),
            sigma=rng.uniform(0.1, 1, 10),
            cameras=('left', 'right'),
        )
        write_observations(tmp_path / 'all.csv', table)
        back = read_observations(tmp_path / 'all.csv')
        assert [back.cameras[i] for i in back.camera] == [table.cameras[i] for i in table.camera]
        assert same(replace(back, camera=table.camera), table)

    def test_unknown_columns_are_not_written(self, tmp_path, csv):
        table = read_observations(csv(f'{HEADER}\n{ROWS}'))
        write_observations(tmp_path / 'few.csv', table)
        assert (tmp_path / 'few.csv').read_text().splitlines()[0] == HEADER
        assert same(read_observations(tmp_path / 'few.csv'), table)

    def test_half_known_sigma_is_an_empty_cell(self, tmp_path, csv):
        table = read_observations(csv(f'{HEADER}\n{ROWS}'))
        table = replace(table, sigma=np.array([0.1, np.nan, 0.1]))
        write_observations(tmp_path / 'half.csv', table)
        assert same(read_observations(tmp_path / 'half.csv'), table)
        text = (tmp_path / 'half.csv').read_text()
        assert len([line for line in text.splitlines() if line.endswith(',')]) == 1
        (tmp_path / 'half.csv').write_text(text.replace('0.1\n', '-1\n', 1))
        with pytest.raises(ObservationError, match=r'line 2: sigma is .-1.; a number above 0'):
            read_observations(tmp_path / 'half.csv')

    def test_half_known_times_are_not_written(self, tmp_path, csv):
        table = read_observations(csv(f'{HEADER}\n{ROWS}'))
        with pytest.raises(ObservationError, match='t is known for some rows only'):
            write_observations(
                tmp_path / 'half.csv', replace(table, t=np.array([0.1, np.nan, 0.1]))
            )
        assert not (tmp_path / 'half.csv').exists()

    def test_an_impossible_place_to_write(self, tmp_path, csv):
        table = read_observations(csv(f'{HEADER}\n{ROWS}'))
        with pytest.raises(OutputError, match='cannot be written'):
            write_observations(csv('', 'a_file') / 'out.csv', table)

    @pytest.mark.parametrize('name', HEADER.split(','))
    def test_missing_column(self, csv, name):
        header = HEADER.split(',')
        header[header.index(name)] = 'other'
        fails(csv(','.join(header) + '\n' + ROWS), f"column '{name}' is missing", HEADER)

    @pytest.mark.parametrize(
        ('row', 'says'),
        [
            ('0,6,nan,20,0,0,0', "u is 'nan'; a finite number"),
            ('0,6,10,20,inf,0,0', "x is 'inf'; a finite number"),
            ('0,6,10,20,-1e308,0,0', "x is '-1e308'; a number of at most 1e+12"),
            ('0,6,10,abc,0,0,0', "v is 'abc'; a number"),
            ('0,6,10,,0,0,0', "v is ''; a number"),
            ('0,1.5,10,20,0,0,0', "landmark is '1.5'; a whole number"),
            ('0,-1,10,20,0,0,0', "landmark is '-1'; a whole number from 0"),
            ('1e30,4,10,20,0,0,0', "frame is '1e30'; a whole number"),
            ('0,4294967296,10,20,0,0,0', "landmark is '4294967296'; a whole number from 0"),
            ('first,4,10,20,0,0,0', "frame is 'first'; a number"),
            ('0,4,10,20,0,0', '6 fields where the header has 7'),
            ('0,4,10,20,0,0,0,0', '8 fields where the header has 7'),
            ('0,4,10,20,0,0,0', 'the same frame, camera and landmark as in line 2'),
        ],
    )
    def test_bad_row(self, csv, row, says):
        text = f'{HEADER}\n0,4,1,2,3,4,5\n\n0,5,1,2,3,4,5\n{row}\n'
        fails(csv(text), 'line 5', says)
        fails(csv(text + f'2{row}\n'), 'line 5', says)  # the first of several

    def test_the_largest_numbers(self, csv):
        table = read_observations(csv(f'{HEADER}\n{2**53},{2**32 - 1},1,2,-1e8,4,1e8\n'))
        assert (table.frame[0], table.landmark[0]) == (2**53, 2**32 - 1)
        assert table.xyz[0].tolist() == [-1e8, 4.0, 1e8]

    @pytest.mark.parametrize(
        ('name', 'cell', 'says'),
        [
            *(
                ('camera', cell, f'camera is {cell!r}; a printable name of at most 100 bytes')
                for cell in (
                    '../left',
                    '/left',
                    'a/b',
                    'a\\b',
                    '.left',
                    '\x1b[31mred',
                    'l\u202eft',
                )
            ),
            ('camera', 'c' * 300, "camera is 'ccc"),
            *(
                ('sigma', cell, f'sigma is {cell!r}; a number')
                for cell in ('1_00.0', '_1', '1__0', '1_0e2', '١٢', '１')
            ),
            ('camera', '', "camera is ''; a name, as '1' elsewhere, is needed"),
            ('sigma', '0', "sigma is '0'; a number above 0"),
            ('sigma', '-0.1', "sigma is '-0.1'; a number above 0"),
            ('t', 'noon', "t is 'noon'; a number"),
            ('t', 'nan', "t is 'nan'; a finite number"),
            ('board', '0.5', "board is '0.5'; a whole number"),
        ],
    )
    def test_bad_optional_cell(self, csv, name, cell, says):
        text = f'{HEADER},{name}\n0,4,1,2,3,4,5,1\n0,5,1,2,3,4,5,{cell}\n'
        fails(csv(text), 'line 3', says)

    @pytest.mark.parametrize('name', ['x', 'y', 'z'])
    def test_a_place_that_is_not_on_earth(self, csv, name):
        """Its frame was left out, as one whose points are near one line."""
        cells = {'x': '3', 'y': '4', 'z': '5'} | {name: '-1e9'}
        text = f'{HEADER}\n0,4,1,2,3,4,5\n0,5,1,2,{",".join(cells.values())}\n'
        fails(csv(text), 'line 3', f"{name} is '-1e9'; a place in meters, up to 1e+08, is needed")

    @pytest.mark.parametrize('unseen', ['-1,-1', '0,0', '-9999,-9999'])
    def test_rows_of_points_that_were_not_seen(self, csv, unseen):
        rows = [
            f'{i // 9},{i % 9},{unseen if i % 4 == 1 else f"{i},{i + 0.5}"},{i % 9},0,0'
            for i in range(27)
        ]
        place = unseen.replace(',', ', ')
        fails(
            csv('\n'.join([HEADER, *rows])),
            'line 3',
            f'u, v are {place} here and in 6 more',
            'leave out the rows of points that were not seen',
        )

    def test_points_at_one_place_now_and_then(self, csv):
        """A static scene, and neighbors in whole pixels."""
        still = [f'{i // 4},{i % 4},{i % 4 // 2},7,{i % 4},0,0' for i in range(400)]
        assert len(read_observations(csv('\n'.join([HEADER, *still])))) == 400

    def test_same_landmark_in_two_cameras_is_no_repeat(self, csv):
        text = f'{HEADER},camera\n0,4,1,2,3,4,5,left\n0,4,1,2,3,4,5,right\n'
        assert len(read_observations(csv(text))) == 2

    @pytest.mark.parametrize(
        ('text', 'says'),
        [
            ('', 'it is empty'),
            ('\n\n', 'it is empty'),
            (HEADER, 'no row below the header'),
            (f'{HEADER}\n\n', 'no row below the header'),
            (f'{HEADER},u\n{ROWS}', "its header has 'u' twice"),
            (HEADER.replace(',', ';'), 'no row below the header'),
            (
                HEADER.replace(',', ' '),
                "columns 'frame', 'landmark', 'u', 'v', 'x', 'y', 'z' are missing from "
                'its header, '
                "'frame landmark u v x y z'",
            ),
            (ROWS, f'its first line holds numbers; a header with {HEADER} is needed'),
            (
                f'{HEADER}\n{ROWS}'.replace(',', ';').replace('.', ','),
                "line 2: u is '10,5'; a number, with a decimal point, is needed",
            ),
            (b'\xff\xfe\x00\x01', 'not a text file'),
            (f'{HEADER}\n0,"4,1,2,3,4,5\n', 'fields where the header has 7'),
        ],
    )
    def test_bad_file(self, csv, text, says):
        fails(csv(text), says)

    def test_no_such_file(self, tmp_path):
        fails(tmp_path / 'none.csv', 'cannot be read')
        fails(tmp_path / 'none', 'no such file or folder')

    def test_unknown_form(self, csv):
        fails(csv(ROWS, 'observations.xlsx'), 'known form', 'a .csv file', 'ORPC'.lower())

    def test_folder_in_place_of_a_file(self, tmp_path):
        (tmp_path / 'folder.csv').mkdir()
        fails(tmp_path / 'folder.csv', 'cannot be read')


class TestPosesCsv:
    def test_round_trip(self, tmp_path):
        rng = np.random.default_rng(2)
        pose = Pose(rotation_from_vector(rng.normal(size=(4, 3))), rng.normal(size=(4, 3)))
        write_poses(tmp_path / 'poses.csv', np.array([3, 0, 7, 1]), pose)
        back = read_poses(tmp_path / 'poses.csv')
        np.testing.assert_array_equal(back.frame, [0, 1, 3, 7])
        want = pose.take([1, 3, 0, 2])
        np.testing.assert_array_equal(back.pose.position, want.position)
        np.testing.assert_allclose(back.pose.rotation, want.rotation, atol=1e-15)
        header = (tmp_path / 'poses.csv').read_text().splitlines()[0]
        assert header == 'frame,x,y,z,qx,qy,qz,qw'

    @pytest.mark.parametrize(
        ('text', 'says'),
        [
            ('', 'it is empty'),
            ('frame,x,y,z,qx,qy,qz\n', "column 'qw' is missing"),
            ('frame,x,y,z,qx,qy,qz,qw\n', 'no row below the header'),
            (
                'frame,x,y,z,qx,qy,qz,qw\n0,1,2,3,0,0,0,0\n',
                "line 2: qw is '0'; a quaternion of norm 1",
            ),
            ('frame,x,y,z,qx,qy,qz,qw\n0,1,2,3,0,0,0,2\n', 'a quaternion of norm 1'),
            (
                'frame,x,y,z,qx,qy,qz,qw\n0,1,2,nan,0,0,0,1\n',
                "line 2: z is 'nan'; a finite number",
            ),
            ('frame,x,y,z,qx,qy,qz,qw\n0,1,2,?,0,0,0,1\n', "line 2: z is '?'; a number"),
            ('frame,x,y,z,qx,qy,qz,qw\n.5,1,2,3,0,0,0,1\n', "frame is '.5'; a whole number"),
            (
                'frame,x,y,z,qx,qy,qz,qw\n1,0,0,0,0,0,0,1\n1,0,0,0,0,0,0,1\n',
                'line 3: the same frame as in line 2',
            ),
        ],
    )
    def test_bad_file(self, csv, text, says):
        fails(csv(text, 'poses.csv'), says, read=read_poses)

    def test_no_such_file(self, tmp_path):
        fails(tmp_path / 'none.csv', 'cannot be read', read=read_poses)


DSC = '0,3,3,10\nt25h7,2\n' + ''.join(
    f'-1,{i % 2},{i // 2},{i % 2},{i // 2},0\n' for i in range(4)
)
DSC_TWO = DSC + DSC.replace('0,3,3,10', '7,3,3,10')
TP_TWO = '#calibrated\n0\n1 0 0 0\n0 1 0 0\n0 0 1 0\n7\n0 -0.9999999 0 500\n1 0 0 0\n0 0 1 20\n'
ORPC = (
    'filename: a.png\nwidth: 9\nheight: 9\nnum_corners: 2\nencoding: ascii\n'
    '0,1,1,10.5,20.5\n0,2,1,11.5,21.5\n'
)


class TestOrpc:
    @pytest.fixture
    def data(self, csv, tmp_path):
        """Return a function that writes a data set of two images and gives the images' folder."""

        def write(orpc=ORPC, dsc=DSC, tp=None):
            csv(dsc, 'set/target.dsc')
            if tp is not None:
                csv(tp, 'set/target.tp')
            csv(ORPC, 'set/corners/train/cam-2020-05-07-13-08-27.orpc')
            csv(orpc, 'set/corners/train/cam-2020-05-07-13-09-28.orpc')
            csv(ORPC, 'set/corners/test/cam-2020-05-07-13-08-26.orpc')
            return tmp_path / 'set' / 'corners' / 'train'

        return write

    def test_reads_a_folder(self, data):
        table = read_observations(data(ORPC.replace('\n', '\r\n')))
        np.testing.assert_array_equal(table.frame, [0, 0, 1, 1])
        np.testing.assert_array_equal(table.landmark, [1, 2, 1, 2])
        np.testing.assert_array_equal(table.uv[:2], [[10.5, 20.5], [11.5, 21.5]])
        np.testing.assert_allclose(table.xyz[:2], [[0.01, 0, 0], [0, 0.01, 0]])
        np.testing.assert_array_equal(table.t, [1, 1, 62, 62])

    def test_reads_one_image(self, data):
        table = read_observations(data() / 'cam-2020-05-07-13-09-28.orpc')
        np.testing.assert_array_equal(table.frame, [0, 0])
        np.testing.assert_array_equal(table.t, [62, 62])

    def test_boards_stand_where_the_tp_says(self, data):
        table = read_observations(data(ORPC.replace('0,2,1', '7,2,1'), DSC_TWO, TP_TWO))
        np.testing.assert_array_equal(table.board, [0, 0, 0, 7])
        np.testing.assert_array_equal(table.landmark, [1, 2, 1, 6])
        np.testing.assert_allclose(table.xyz[3], [0.5 - 0.01, 0, 0.02])

    def test_images_without_corners_count_as_frames(self, data):
        folder = data()
        empty = ORPC[: ORPC.index('0,1,1')].replace('num_corners: 2', 'num_corners: 0')
        (folder / 'cam-2020-05-07-13-08-59.orpc').write_text(empty)
        np.testing.assert_array_equal(read_observations(folder).frame, [0, 0, 2, 2])

    def test_names_without_a_time(self, data):
        folder = data()
        (folder / 'zzz.orpc').write_text(ORPC)
        (folder / 'zzz-2020-99-07-13-09-28.orpc').write_text(ORPC)
        assert np.isnan(read_observations(folder).t).all()

    @pytest.mark.parametrize(
        ('orpc', 'says'),
        [
            (ORPC.replace('11.5,21.5', '11.5'), 'line 7: board, corner, 1, u, v'),
            (ORPC.replace('11.5', 'x'), 'line 7'),
            (ORPC.replace('11.5', 'nan'), 'line 7: finite numbers'),
            (ORPC.replace('0,2,1', '0,4,1'), 'line 7: board 0, corner 4 is not on the target'),
            (ORPC.replace('0,2,1', '3,2,1'), 'line 7: board 3, corner 2 is not on the target'),
            (ORPC.replace('0,2,1', '0,1,1'), 'a corner twice'),
            (ORPC.replace('num_corners: 2', 'num_corners: 3'), 'num_corners is 3, but 2'),
            (ORPC[: ORPC.index('0,2,1')], 'num_corners is 2, but 1'),
            (ORPC.replace('0,2,1', '0,1.5,1'), "line 7: '1.5' is not a whole number"),
            (ORPC.replace('0,2,1', '0,-2,1'), "line 7: '-2' is not a whole number"),
            (ORPC.replace('0,2,1', '1e300,2,1'), "line 7: '1e300' is not a whole number"),
            ('', 'num_corners is None, but 0'),
            (b'\xff\x00', 'not a text file'),
        ],
    )
    def test_bad_corners(self, data, orpc, says):
        with pytest.raises(ObservationError) as caught:
            read_observations(data(orpc))
        assert 'cam-2020-05-07-13-09-28.orpc' in str(caught.value)
        assert says in str(caught.value)

    @pytest.mark.parametrize(
        ('dsc', 'tp', 'says'),
        [
            ('', None, 'no board in it'),
            ('1,2,3\n', None, 'line 1: not a board'),
            (DSC.replace('t25h7,2\n', 't25h7,2\n-1,0,0,a,0,0\n'), None, 'line 3'),
            (DSC_TWO, None, 'target.tp: cannot be read'),
            (DSC_TWO, '0\n1 0 0\n', 'target.tp: a board number and 3 x 4 numbers'),
            (DSC_TWO, '0\n1 0 0 x\n', 'target.tp, line 2'),
            (DSC_TWO, '', 'target.tp: a board number'),
            (
                DSC_TWO,
                TP_TWO.replace('0\n1 0', '5\n1 0', 1),
                'board 0, corner 1 is not on the target',
            ),
            (DSC_TWO, TP_TWO.replace('1 0', '1.1 0', 1), 'holds no rotation'),
            (DSC_TWO, '0\n1 0 0 0\n0 1 0 0\n0 0 -1 0\n', 'board 0 holds no rotation'),
            (DSC_TWO, TP_TWO + TP_TWO, 'a board is listed twice'),
            (DSC + DSC, None, 'board 0 is listed twice'),
            (DSC + DSC.splitlines()[-1], None, 'this corner is listed twice'),
        ],
    )
    def test_bad_target(self, data, dsc, tp, says):
        with pytest.raises(ObservationError) as caught:
            read_observations(data(dsc=dsc, tp=tp))
        assert says in str(caught.value)

    def test_no_target(self, csv, tmp_path):
        csv(ORPC, 'a/b/c/d/image.orpc')
        fails(tmp_path / 'a' / 'b' / 'c' / 'd', 'no .dsc file')

    def test_two_targets(self, csv, data):
        folder = data()
        csv(DSC, 'set/other.dsc')
        with pytest.raises(ObservationError, match=r'several \.dsc files'):
            read_observations(folder)

    def test_images_without_any_corner(self, csv, tmp_path):
        csv(DSC, 'set/target.dsc')
        csv('num_corners: 0\n', 'set/image.orpc')
        fails(tmp_path / 'set', 'hold no corner')

    @pytest.mark.skipif(not OV_PLANE.exists(), reason=NO_DATA)
    @pytest.mark.parametrize('part', ['train', 'test'])
    def test_gives_the_same_table_as_the_csv(self, part):
        orpc = read_observations(OV_PLANE / 'raw' / part)
        table = read_observations(OV_PLANE / f'{part}.csv')
        rounded = replace(orpc, uv=np.round(orpc.uv, 5), xyz=np.round(orpc.xyz, 7))
        assert same(rounded, table)


@pytest.mark.parametrize(
    ('frame', 't', 'said'),
    [
        (0, 1.7e18, 'a time in seconds (these are nanoseconds: divide by 1e+09) is needed'),
        (1_700_000_000_123_456_789, 0.5, '(stamps in nanoseconds belong in t, in seconds)'),
    ],
)
def test_stamps_in_nanoseconds_are_told_that_seconds_are_meant(
    tmp_path: Path, frame: int, t: float, said: str
) -> None:
    path = tmp_path / 'o.csv'
    path.write_text(
        f'frame,landmark,u,v,x,y,z,t\n{frame},1,10,20,0.1,0.2,0,{t}\n', encoding='utf-8'
    )
    with pytest.raises(ObservationError) as caught:
        read_observations(path)
    assert said in str(caught.value) and 'o.csv' in str(caught.value)
