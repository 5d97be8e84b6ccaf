"""The command line as a user meets it: results, exit codes, one line of error."""

import html
import json
import os
import re
import shlex
import signal
import subprocess
import sys
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.data import DATA, NO_DATA
from helpers.nodes import hears_sigint, until
from helpers.targets import plane, poses_around

from fisheye_svp_ros import __version__, cli, commands
from fisheye_svp_ros.commands.notes import note_doubtful, note_gross_errors
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.csv_files import CsvTable
from fisheye_svp_ros.io.lens_files import load_lens, save_lens
from fisheye_svp_ros.io.readers import read_poses, write_observations
from fisheye_svp_ros.library.functions import calibrate
from fisheye_svp_ros.optics import engines
from fisheye_svp_ros.optics.camera import back_project
from fisheye_svp_ros.optics.curves import Equidistant
from fisheye_svp_ros.optics.engines import numpy_engine
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.optics.ports import DomeGlass
from fisheye_svp_ros.simulate.simulation import simulate
from fisheye_svp_ros.solve.outliers import Outliers

ROOT = Path(__file__).resolve().parents[2]
OV_PLANE = DATA / 'ov_plane'
LENS = Lens('made', 1280, 960, 700.0, 700.0, 650.0, 470.0, Equidistant(), 1.1)


@pytest.fixture(scope='module')
def scene(tmp_path_factory):
    """Return a folder with observations.csv, lens.yaml and the true poses."""
    folder = tmp_path_factory.mktemp('scene')
    rng = np.random.default_rng(4)
    poses = poses_around(plane(), 6, rng, widest=0.5)
    table = simulate(ForwardModel(LENS), plane(), poses, 0.1, rng)
    write_observations(folder / 'given.csv', table)
    table = replace(table, sigma=np.full(len(table), np.nan))
    write_observations(folder / 'observations.csv', table)
    few = (table.frame != 2) | (table.landmark < 3)
    write_observations(folder / 'poor.csv', table.take(few & (table.frame != 3)))
    save_lens(LENS, folder / 'lens.yaml')
    return folder, poses, table


def process(*arguments, **options):
    """Start the command line in a process of its own."""
    return subprocess.Popen(
        [sys.executable, '-m', 'fisheye_svp_ros.cli', *map(str, arguments)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=hears_sigint,
        **options,
    )


def test_version(capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(['--version'])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f'fisheye-svp {__version__}\n'


def refused(capsys, *arguments):
    """Run a command that must be refused; return its one line."""
    try:
        code = cli.main([*map(str, arguments)])
    except SystemExit as end:
        code = end.code
    out, err = capsys.readouterr()
    assert code == 2
    assert out == ''
    assert err.startswith('fisheye-svp: ')
    assert err.count('\n') == 1
    return err


def printed(code):
    """Run code in an interpreter of its own and return what it prints."""
    return subprocess.run(
        [sys.executable, '-c', code], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout


class TestLocalize:
    @pytest.fixture(scope='class')
    @classmethod
    def output(cls, scene, tmp_path_factory):
        folder, _, _ = scene
        out = tmp_path_factory.mktemp('out') / 'new' / 'localize'
        arguments = [folder / 'observations.csv', '--lens', folder / 'lens.yaml', '-o', out]
        assert cli.main(['localize', *map(str, arguments)]) == 0
        return out

    def test_figures(self, output, scene):
        figures = json.loads((output / 'localize.json').read_text())
        assert figures['frames'] == 6
        assert figures['observations'] == len(scene[2])
        assert figures['rms_px'] == pytest.approx(0.1 * np.sqrt(2), rel=0.1)
        assert figures['sigma_px'] == pytest.approx(0.1, rel=0.1)
        assert figures['left_out'] == []

    def test_poses_are_the_true_ones_within_their_covariance(self, output, scene):
        frame, pose = read_poses(output / 'poses.csv')
        np.testing.assert_array_equal(frame, np.arange(6))
        table = CsvTable(output / 'covariance.csv', ['frame'])
        axes = ('x', 'y', 'z', 'rx', 'ry', 'rz')
        covariance = table.numbers(*(f'{a}_{b}' for a in axes for b in axes)).reshape(-1, 6, 6)
        off = pose.difference(scene[1])
        nees = np.einsum('si,sij,sj->s', off, np.linalg.inv(covariance), off)
        assert nees.mean() == pytest.approx(6, abs=4 * np.sqrt(12 / 6))

    def test_residuals_are_those_of_the_poses(self, output, scene):
        table = CsvTable(output / 'residuals.csv', ['frame', 'landmark'])
        np.testing.assert_array_equal(table.integers('landmark'), scene[2].landmark)
        du, dv, theta, distance = table.numbers('du', 'dv', 'theta', 'range').T
        rms = json.loads((output / 'localize.json').read_text())['rms_px']
        assert np.sqrt(np.mean(du**2 + dv**2)) == pytest.approx(rms)
        _, pose = read_poses(output / 'poses.csv')
        points = scene[2].xyz - pose.position[scene[2].frame]
        np.testing.assert_allclose(distance, np.linalg.norm(points, axis=1), rtol=1e-12)
        axis = pose.rotation[scene[2].frame][:, :, 2]
        np.testing.assert_allclose(
            np.cos(theta), np.sum(points * axis, axis=1) / distance, atol=1e-9
        )

    def test_table_for_people(self, scene, capsys):
        folder, _, table = scene
        lens = str(folder / 'lens.yaml')
        assert cli.main(['localize', str(folder / 'observations.csv'), '--lens', lens]) == 0
        out, err = capsys.readouterr()
        assert f'{len(table)} points in 6 frames' in out
        assert 'estimated from the residuals' in out
        assert err == ''
        assert cli.main(['localize', str(folder / 'given.csv'), '--lens', lens]) == 0
        assert 'the sigma of the observations' in capsys.readouterr().out

    def test_points_beyond_what_is_known_of_the_lens(self, scene, tmp_path, capsys):
        folder, _, _ = scene
        lens = load_lens(folder / 'lens.yaml')
        save_lens(replace(lens, calibration={'reached_deg': 10.0}), tmp_path / 'lens.yaml')
        arguments = [folder / 'observations.csv', '--lens', tmp_path / 'lens.yaml']
        assert cli.main(['localize', *map(str, arguments)]) == 0
        assert 'image points of the calibration reach 10 deg' in capsys.readouterr().err

    def test_numba_does_not_compile_in_silence(self, scene, capsys, monkeypatch):
        monkeypatch.setattr(engines, 'find_spec', lambda _: 'there')
        monkeypatch.setattr(engines.cache, 'is_compiled', lambda: False)
        monkeypatch.setattr(engines.cache, 'mark_filled', lambda: None)
        monkeypatch.setattr(engines, 'numba_engine', numpy_engine, raising=False)
        monkeypatch.setattr(engines, 'before_compiling', engines.before_compiling)
        monkeypatch.setattr(engines, '_engine', None)
        monkeypatch.setenv(engines.VARIABLE, 'numba')
        arguments = [scene[0] / 'observations.csv', '--lens', 'fish214']
        assert cli.main(['localize', *map(str, arguments)]) == 0
        assert capsys.readouterr().err.startswith('fisheye-svp: note: Numba compiles first')

    def test_the_standard_errors_are_those_of_the_worst_direction(self, output, scene, capsys):
        folder, _, _ = scene
        lens = str(folder / 'lens.yaml')
        assert cli.main(['localize', str(folder / 'observations.csv'), '--lens', lens]) == 0
        rows = [line.split() for line in capsys.readouterr().out.splitlines()]
        shown = np.array([row[-2:] for row in rows if row and row[0] in '012345'], dtype=float)
        axes = ('x', 'y', 'z', 'rx', 'ry', 'rz')
        table = CsvTable(output / 'covariance.csv', ['frame'])
        covariance = table.numbers(*(f'{a}_{b}' for a in axes for b in axes)).reshape(-1, 6, 6)
        worst = [
            np.sqrt(np.linalg.eigvalsh(covariance[:, p, p]).max(axis=1))
            for p in (slice(0, 3), slice(3, 6))
        ]
        np.testing.assert_allclose(shown[:, 0], 1000 * worst[0], atol=6e-4)
        np.testing.assert_allclose(shown[:, 1], np.degrees(worst[1]), atol=6e-5)

    def test_gross_errors_are_named_and_left_out(self, scene, capsys, tmp_path):
        folder, _, table = scene
        uv = table.uv.copy()
        swapped = np.flatnonzero((table.frame == 4) & np.isin(table.landmark, [7, 40]))
        uv[swapped] = uv[swapped[::-1]]
        write_observations(tmp_path / 'swapped.csv', replace(table, uv=uv))
        arguments = [tmp_path / 'swapped.csv', '--lens', folder / 'lens.yaml', '-o', tmp_path]
        assert cli.main(['localize', *map(str, arguments)]) == 0
        err = capsys.readouterr().err
        assert 'note: frame 4: outliers rejected: landmarks' in err and err.count('note') == 1
        figures = json.loads((tmp_path / 'localize.json').read_text())
        assert {(g['frame'], g['landmark']) for g in figures['gross']} == {(4, 7), (4, 40)}
        assert [frame['frame'] for frame in figures['doubtful']] == [4]
        assert figures['rms_px'] == pytest.approx(0.1 * np.sqrt(2), rel=0.1)

    def test_frames_that_cannot_be_posed_are_named(self, scene, capsys, tmp_path):
        folder, _, _ = scene
        arguments = [folder / 'poor.csv', '--lens', folder / 'lens.yaml', '-o', tmp_path]
        assert cli.main(['localize', *map(str, arguments)]) == 0
        assert 'note: left out' in capsys.readouterr().err
        figures = json.loads((tmp_path / 'localize.json').read_text())
        assert figures['left_out'] == [2]
        assert figures['frames'] == 4

    def test_a_lens_by_name(self, scene, capsys):
        folder, _, _ = scene
        assert cli.main(['localize', str(folder / 'observations.csv'), '--lens', 'fish214']) == 0
        assert 'rms' in capsys.readouterr().out

    def test_bad_input(self, scene, capsys, tmp_path):
        folder, _, _ = scene
        observations, lens = folder / 'observations.csv', folder / 'lens.yaml'
        assert '--lens' in refused(capsys, 'localize', observations)
        unknown = refused(capsys, 'localize', observations, '--lens', 'nolens')
        assert "'nolens' is neither" in unknown
        assert 'no such file' in refused(capsys, 'localize', tmp_path / 'x', '--lens', lens)

    def test_an_impossible_place_to_write(self, scene, capsys, tmp_path):
        folder, _, _ = scene
        (tmp_path / 'file').write_text('')
        arguments = [folder / 'observations.csv', '--lens', folder / 'lens.yaml']
        code = cli.main(['localize', *map(str, arguments), '-o', str(tmp_path / 'file' / 'out')])
        assert code == 2
        assert 'file is not a folder; choose another' in capsys.readouterr().err
        for command in (
            'detect {0} --board chessboard:9x6:25mm -o {0}',  # before it searches
            'calibrate {1} --image-size 1280x960 -o {0}',
            'lens fish180 -o {0}',
        ):
            said = refused(capsys, *command.format(tmp_path, folder / 'observations.csv').split())
            assert 'it is a folder; name a file' in said
        said = refused(
            capsys,
            'detect',
            tmp_path,
            '--board',
            'chessboard:9x6:25mm',
            '--overlays',
            tmp_path / 'file',
        )
        assert '--overlays' in said and 'it is a file; name a folder' in said

    @pytest.mark.parametrize(
        'command',
        [
            'localize {0}/observations.csv --lens {0}/lens.yaml -o {0}/lens.yaml',
            'calibrate {0}/observations.csv --image-size 1280x960 -o {0}/observations.csv',
            'lens {0}/lens.yaml -o {0}/lens.yaml',
            'undistort fish180 {0} -o {0}',
            'undistort fish180 {0}/a.png -o {0}',
            'detect {0} --board chessboard:9x6:25mm -o {0}/a.png',
            'calibrate {0} --board chessboard:9x6:25mm -o {0}/a.png',
            'detect {0} --board chessboard:9x6:25mm --overlays {0}',
            'detect {0}/a.png --board chessboard:9x6:25mm --overlays {0}',
            'detect {0}/.. --board chessboard:9x6:25mm --overlays {0}',
        ],
    )
    def test_no_input_is_overwritten(self, scene, capsys, tmp_path, command):
        for name in ('observations.csv', 'lens.yaml'):
            (tmp_path / name).write_bytes((scene[0] / name).read_bytes())
        (tmp_path / 'a.png').write_bytes(b'a photograph')
        before = {path: path.read_bytes() for path in tmp_path.iterdir()}
        assert cli.main(command.format(tmp_path).split()) == 2
        assert re.search(
            'would overwrite the input|is a file; name a folder', capsys.readouterr().err
        )
        assert before == {path: path.read_bytes() for path in tmp_path.iterdir()}


def test_frames_that_are_doubtful_alike_are_one_line(scene, capsys):
    _, _, table = scene
    reasons = ['off by 2 px', '', 'far', *(f'off by {i} px' for i in range(4))]
    note_doubtful(table, range(7), reasons)
    said = capsys.readouterr().err.splitlines()
    assert [line.partition('note: ')[2] for line in said] == [
        'frame 0: off by 2 px',
        'frames 3, 4, 5 and 6: likewise',
        'frame 2: far',
    ]


def test_views_that_are_set_aside_as_a_whole_are_named(scene, capsys):
    _, _, table = scene
    rows = np.flatnonzero((table.frame == 2) | (np.arange(len(table)) == 0))
    note_gross_errors(table, Outliers(rows, np.full(len(rows), 99.0), ('far',) * len(rows)))
    said = capsys.readouterr().err
    assert said.count('\n') == 1
    assert said.endswith('; all points of frame 2 are outliers: check their order\n')
    note_gross_errors(table, Outliers(rows[:1], np.full(1, 99.0), ('far',)))
    assert 'check their order' not in capsys.readouterr().err


class TestCalibrate:
    def test_the_lens_is_shown_while_its_errors_are_found(self, scene, tmp_path, monkeypatch):
        shown = []

        @contextmanager
        def stages(description):
            shown.append(description)
            yield lambda stage, done: shown.append(stage)

        monkeypatch.setattr('fisheye_svp_ros.commands.calibrate.stages', stages)
        lens = tmp_path / 'lens.yaml'
        assert (
            cli.main(
                [
                    'calibrate',
                    str(scene[0] / 'observations.csv'),
                    '--model',
                    'equidistant',
                    '--image-size',
                    '1280x960',
                    '-o',
                    str(lens),
                ]
            )
            == 0
        )
        fx = load_lens(lens).fx
        assert [line.partition(',')[0] for line in shown] == [
            'calibrating',
            'fitting the lens',
            f'fx {fx:.6g}',
        ]
        assert shown[-1].endswith('standard errors')

    def test_writes_the_lens_and_its_covariance(self, scene, capsys, tmp_path):
        folder, _, table = scene
        observations, out = str(folder / 'observations.csv'), tmp_path / 'new' / 'mine.yaml'
        assert (
            cli.main(
                [
                    'calibrate',
                    observations,
                    '--model',
                    'equidistant',
                    '--image-size',
                    '1280x960',
                    '--free',
                    'f,cx,cy',
                    '-o',
                    str(out),
                ]
            )
            == 0
        )
        shown, err = capsys.readouterr()
        assert f'{len(table)} points in 6 frames' in shown
        assert err == ''
        assert '\n  Standard errors include local errors of target, frames, and image' in shown
        assert re.search(r'\n  Image points reach \d+ deg off axis', shown)
        assert 'std. error   unit' in shown  # no column of ranges where all are settled
        lens = load_lens(out)
        assert lens.name == 'mine'
        stderr = lens.calibration.pop('stderr')
        assert set(stderr) == {'f', 'cx', 'cy'} and all(0 < error < 2 for error in stderr.values())
        covariance = np.array(lens.calibration.pop('covariance'))
        assert np.sqrt(np.diag(covariance)) == pytest.approx([*stderr.values()])
        assert lens.calibration == {
            'rms_px': pytest.approx(0.1 * np.sqrt(2), rel=0.1),
            'observations': len(table),
            'frames': 6,
            'source': observations,
            'reached_deg': pytest.approx(
                np.degrees(back_project(LENS, table.uv).theta.max()), 0.01
            ),
            'least_squares_rms_px': pytest.approx(0.1 * np.sqrt(2), rel=0.1),
        }
        document = json.loads(out.with_suffix('.calibrate.json').read_text())
        assert document['sigma_px'] == pytest.approx(0.1, rel=0.1)
        found = np.array(list(document['parameters'].values()))
        assert list(document['parameters']) == ['f', 'cx', 'cy']
        off = found - (LENS.fx, LENS.cx, LENS.cy)
        assert off @ np.linalg.solve(document['covariance'], off) < 30
        # One set of standard errors: printed, in the lens, in the JSON, in the library.
        assert document['stderr'] == pytest.approx(stderr)
        np.testing.assert_allclose(document['covariance'], covariance)
        for name, error in stderr.items():
            head = 'fx' if name == 'f' else name
            printed = re.search(rf'^ *{head} +\S+ +(\S+)', shown, re.M)
            assert float(printed[1]) == pytest.approx(error, rel=0.06)
        same = calibrate(table, 'equidistant', (1280, 960), ('f', 'cx', 'cy'))
        errors = np.sqrt(np.diag(same.covariance))
        np.testing.assert_allclose(errors, [*stderr.values()], rtol=1e-4)

    def test_the_report_says_what_comes_next_and_that_runs(
        self, scene, capsys, tmp_path, monkeypatch
    ):
        folder, _, _ = scene
        observations = str(folder / 'observations.csv')
        assert (
            cli.main(
                [
                    'calibrate',
                    observations,
                    '--model',
                    'equidistant',
                    '--image-size',
                    '1280x960',
                    '--free',
                    'f,cx,cy',
                    '-o',
                    str(tmp_path / 'mine.yaml'),
                ]
            )
            == 0
        )
        page = (tmp_path / 'mine.calibrate.html').read_text()
        assert '`' not in page and 'noise of the image points is unknown (no sigma)' in page
        for heading in ('Parameters', 'Coverage', 'Residuals', 'Uncertainty'):
            assert f'<h2>{heading}</h2>' in page
        assert page.count('<img ') == 7 and '<script' not in page
        command = html.unescape(re.search('<pre>(.*)</pre>', page)[1])
        monkeypatch.chdir(tmp_path)
        assert cli.main([*shlex.split(command)[1:], '--quick']) == 0
        assert (tmp_path / 'diagnosis' / 'report.html').exists()

    def test_a_lens_of_the_middle_of_the_image_is_called_so(self, scene, capsys, tmp_path):
        folder, _, table = scene
        out = tmp_path / 'lens.yaml'
        middle = np.linalg.norm(table.uv - (LENS.cx, LENS.cy), axis=1) < 250
        write_observations(tmp_path / 'middle.csv', table.take(middle))
        said = {}
        for path in (folder / 'observations.csv', tmp_path / 'middle.csv'):
            assert (
                cli.main(
                    [
                        'calibrate',
                        str(path),
                        '--model',
                        'equidistant',
                        '--image-size',
                        '1280x960',
                        '-o',
                        str(out),
                    ]
                )
                == 0
            )
            said[path.stem] = capsys.readouterr()
        assert said['observations'].err == ''
        assert 'Photograph the target near the edges' in said['middle'].err
        reached = json.loads(out.with_suffix('.calibrate.json').read_text())['reached_deg']
        assert reached == pytest.approx(np.degrees(250 / 700), abs=0.6)
        assert f'the curve is extrapolated beyond {reached:.0f} deg' in said['middle'].err
        assert f'Image points reach {reached:.0f} deg off axis; from there' in said['middle'].out

    def test_a_file_is_written_for_one_camera_with_a_name(self, scene, tmp_path):
        _, _, table = scene
        write_observations(tmp_path / 'left.csv', replace(table, cameras=('left',)))
        for out, lens in (('lens.yaml', 'lens.yaml'), ('rig', 'rig/left.yaml')):
            assert (
                cli.main(
                    [
                        'calibrate',
                        str(tmp_path / 'left.csv'),
                        '--model',
                        'equidistant',
                        '--image-size',
                        '1280x960',
                        '-o',
                        str(tmp_path / out),
                    ]
                )
                == 0
            )
            assert load_lens(tmp_path / lens).name == 'left'

    def test_an_image_size_that_is_too_large_is_doubted(self, scene, capsys):
        folder, _, _ = scene
        assert (
            cli.main(
                [
                    'calibrate',
                    str(folder / 'observations.csv'),
                    '--model',
                    'equidistant',
                    '--image-size',
                    '1920x1080',
                ]
            )
            == 0
        )
        assert 'the principal point is -30' in capsys.readouterr().err  # 650 - 959.5

    def test_prints_without_writing(self, scene, capsys, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        folder, _, _ = scene
        assert (
            cli.main(
                [
                    'calibrate',
                    str(folder / 'observations.csv'),
                    '--model',
                    'kannala_brandt',
                    '--image-size',
                    '1280x960',
                ]
            )
            == 0
        )
        assert 'k4' in capsys.readouterr().out
        assert list(tmp_path.iterdir()) == []

    def test_bad_input(self, scene, capsys, tmp_path):
        folder, _, _ = scene
        observations = folder / 'observations.csv'
        base = ('calibrate', observations, '--model', 'equidistant')
        assert 'check the image size' in refused(capsys, *base[:2], '--image-size', '9x9')
        assert 'add --image-size' in refused(capsys, *base[:2])
        assert 'pinhole' in refused(capsys, *base[:3], 'pinhole', '--image-size', '9x9')
        for size in ('1280', '1280x', '0x960', '1280x960x3', '-1x5', '12.5x9', 'large'):
            assert 'form 1280x800' in refused(capsys, *base, f'--image-size={size}')
        assert 'two sizes for one' in refused(capsys, *base, '--image-size', '9x9,9x9')
        assert 'check the image size' in refused(capsys, *base, '--image-size', '640x480')
        sized = (*base, '--image-size', '1280x960')
        for port in ('flat:-1mm:1.5', 'flat:1mm:9', 'dome:-1mm'):
            assert f': --port {port}: port: ' in refused(capsys, *sized, '--port', port)
        assert ': --medium 9: port: medium_index' in refused(
            capsys, *sized, '--medium', '9', '--port', 'flat:-1mm'
        )
        assert "no parameter 'k1'" in refused(capsys, *sized, '--free', 'f,k1')
        out = tmp_path / 'lens.yaml'
        assert 's0 is confounded' in refused(capsys, *sized, '--free', 'f,s0', '-o', out)
        assert not out.exists()

    def test_a_diagnosis_is_told_of_a_dome_in_air_alone(self, scene, capsys, tmp_path):
        air, wet = scene[0] / 'lens.yaml', tmp_path / 'wet.yaml'
        save_lens(replace(LENS, port=DomeGlass(0.05, 1.0)), wet)
        base = ('diagnose', scene[0] / 'observations.csv')
        for lens, options, why in (
            (air, ('--medium', 'water'), 'a flat port is always tested'),
            (air, ('--port', 'dome:60mm:4mm'), 'in air, with --medium air'),
            (air, ('--medium', 'air', '--port', 'dome:60mm'), 'of no thickness'),
            (wet, ('--medium', 'air', '--port', 'dome'), 'one lens without a port'),
        ):
            assert why in refused(capsys, *base, '--lens', lens, *options)

    def test_a_lens_without_rays_to_what_was_seen_is_one_line(self, scene, capsys, monkeypatch):
        def trust(*_):
            raise np.linalg.LinAlgError('SVD did not converge')

        monkeypatch.setattr('fisheye_svp_ros.study.trust.assess_lens', trust)
        assert 'the fitted lens has no rays to some of the observed points' in refused(
            capsys, 'calibrate', scene[0] / 'observations.csv', '--image-size', '1280x960'
        )


class TestCommandLine:
    def test_every_command_has_a_module_and_a_help(self, capsys):
        for name in cli.COMMANDS:
            with pytest.raises(SystemExit) as end:
                cli.main([name, '--help'])
            assert end.value.code == 0
            assert f'usage: fisheye-svp {name}' in capsys.readouterr().out
        modules = {path.stem for path in Path(commands.__file__).parent.glob('*.py')}
        assert set(cli.COMMANDS) <= modules

    def test_bad_command(self, capsys):
        assert 'unknown command fly' in refused(capsys, 'fly')
        assert '--fast' in refused(capsys, 'localize', 'x', '--lens', 'y', '--fast')

    def test_help_imports_nothing_heavy(self):
        code = (
            'import sys\nfrom fisheye_svp_ros.cli import main\n'
            'try:\n    main(["--help"])\nexcept SystemExit:\n    pass\n'
            'print(sorted({"numpy", "rich", "cv2", "scipy", "yaml", "matplotlib", "pandas"}'
            ' & set(sys.modules)))'
        )
        said = printed(code)
        assert said.splitlines()[-1] == '[]'
        for name in cli.COMMANDS:
            assert name in said

    def test_no_help_of_a_command_waits_for_what_draws_or_solves(self):
        code = (
            'import sys\nfrom fisheye_svp_ros.cli import COMMANDS, main\n'
            'for name in COMMANDS:\n'
            '    try:\n        main([name, "--help"])\n    except SystemExit:\n        pass\n'
            'print(sorted({"matplotlib", "scipy", "numba", "pandas"} & set(sys.modules)))'
        )
        assert printed(code).splitlines()[-1] == '[]'

    def test_interrupt_is_silent(self, tmp_path):
        (tmp_path / 'a.yaml').write_text(
            f'synthetic_camera: {{ros__parameters: {{sweep.seed: {list(range(9000))}}}}}'
        )
        running = process('sweep', tmp_path / 'a.yaml', '-o', tmp_path / 'out')
        until(lambda: (tmp_path / 'out' / 'parts' / 'sweep.txt').exists())
        running.send_signal(signal.SIGINT)
        out, err = running.communicate(timeout=60)
        assert (running.returncode, out, err) == (130, '', '')

    def test_a_name_that_no_file_can_have(self, scene, capsys):
        for name in ('a' * 5000, 'a' * 5000 + '.yaml', 'a/' * 3000):
            assert refused(capsys, 'localize', name, '--lens', scene[0] / 'lens.yaml')
            assert refused(capsys, 'localize', scene[0] / 'observations.csv', '--lens', name)

    @pytest.mark.parametrize('make', [os.mkfifo, lambda path: path.symlink_to('/dev/zero')])
    @pytest.mark.parametrize('name', ['observations.csv', 'lens.yaml'])
    def test_what_has_no_end_is_not_read(self, scene, tmp_path, capsys, make, name):
        given = {path.name: path for path in scene[0].iterdir()}
        make(tmp_path / name)
        given[name] = tmp_path / name
        line = refused(capsys, 'localize', given['observations.csv'], '--lens', given['lens.yaml'])
        assert f'{tmp_path / name}: it must be a regular file' in line

    def test_broken_pipe_is_silent(self, scene):
        folder, _, _ = scene
        running = process('localize', folder / 'observations.csv', '--lens', folder / 'lens.yaml')
        running.stdout.close()
        err = running.stderr.read()
        running.wait(timeout=60)
        running.stderr.close()
        assert err == ''
        assert running.returncode != 0

    def test_error_of_a_process(self, scene):
        folder, _, _ = scene
        running = process('localize', folder / 'none.csv', '--lens', folder / 'lens.yaml')
        out, err = running.communicate(timeout=60)
        assert running.returncode == 2
        assert out == ''
        assert err.startswith('fisheye-svp: ') and err.count('\n') == 1


@pytest.mark.skipif(not OV_PLANE.exists(), reason=NO_DATA)
def test_measured_data(tmp_path):
    lens = tmp_path / 'lens.yaml'
    assert (
        cli.main(
            [
                'calibrate',
                str(OV_PLANE / 'train.csv'),
                '--model',
                'kannala_brandt',
                '--image-size',
                '1280x800',
                '-o',
                str(lens),
            ]
        )
        == 0
    )
    figures = load_lens(lens).calibration
    assert figures['least_squares_rms_px'] <= 0.482 < figures['rms_px'] < 0.56
    test = str(OV_PLANE / 'test.csv')
    assert cli.main(['localize', test, '--lens', str(lens), '-o', str(tmp_path)]) == 0
    assert json.loads((tmp_path / 'localize.json').read_text())['rms_px'] < 0.56


@pytest.mark.parametrize(
    ('words', 'said'),
    [
        (
            ['localize', 'o.csv', '--lens', 'fish21'],
            "'fish21' is neither a file nor one of the lenses of this package: fish180, fish214",
        ),
        (
            ['localize', 'o.csv', '--lens', '/dev/zero'],
            "'/dev/zero' is neither a file nor one of the lenses of this package: "
            'fish180, fish214',
        ),
        (['sweep', 'nois'], "'nois' is neither a file nor one of the sweeps of this package: env"),
        (
            ['diagnose', 'o.csv', '--lens', 'fish214', '--held_out', 'x'],
            'unknown argument --held_out; did you mean --held-out? (see fisheye-svp '
            'diagnose --help)',
        ),
        (['plot', 'x', '--foo'], 'unknown argument --foo (see fisheye-svp plot --help)'),
        (
            ['calibrte', 'x'],
            'unknown command calibrte; did you mean calibrate? (see fisheye-svp --help)',
        ),
        *(
            (words, 'an argument is empty; a variable of the shell may be unset')
            for words in (
                ['example', '-o', ''],
                ['localize', '', '--lens', 'fish214'],
                ['localize', 'o.csv', '--lens', ''],
            )
        ),
        *(
            (
                ['undistort', 'fish214', '--as', f'perspective:{angles}', '-o', 'u'],
                f"argument --as: 'perspective:{angles}' is unknown",
            )
            for angles in ('1e300,0,90', '0,361,90', 'nan,0,90')
        ),
    ],
)
def test_a_slip_is_answered_with_what_there_is(words, said, capsys):
    assert said in refused(capsys, *words)
