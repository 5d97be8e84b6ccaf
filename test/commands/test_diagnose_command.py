"""`fisheye-svp diagnose` as a user meets it: verdict, files, report."""

import json
import re
from collections import namedtuple
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.diagnoses import with_changes
from helpers.targets import plane, poses_around
from matplotlib.figure import Figure

from fisheye_svp_ros import cli
from fisheye_svp_ros.commands.diagnose import effects_left_out
from fisheye_svp_ros.diagnosis import (
    Action,
    Advice,
    Comparison,
    DiagnosisOptions,
    Reason,
    diagnose,
)
from fisheye_svp_ros.diagnosis.variance_budget import Structure
from fisheye_svp_ros.effects.base import NO_TIME, ModelTerm
from fisheye_svp_ros.effects.catalogue import load_effects
from fisheye_svp_ros.effects.extension import extend_lens
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.effects.pose_effects import StereoTimeOffsetEffect
from fisheye_svp_ros.effects.target_effects import TargetShapeEffect
from fisheye_svp_ros.effects.target_map import board_maps
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.io.csv_files import CsvTable
from fisheye_svp_ros.io.lens_files import cameras_in, load_lens, save_lens
from fisheye_svp_ros.io.readers import read_observations, write_observations, write_poses
from fisheye_svp_ros.io.rig_files import load_rig
from fisheye_svp_ros.optics.curves import KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.reporting import diagnosis_plots, ray_plots
from fisheye_svp_ros.reporting.diagnosis_plots import PlotData, residual_pictures
from fisheye_svp_ros.reporting.wording.causes import cause_rows, intrinsic_rows
from fisheye_svp_ros.reporting.wording.diagnosis import advice_text, verdict_sentences
from fisheye_svp_ros.reporting.wording.whats_wrong import wrong as what_is_wrong
from fisheye_svp_ros.scene.observations import Landmarks
from fisheye_svp_ros.simulate.scenario import true_lens
from fisheye_svp_ros.simulate.simulation import simulate, simulate_stereo
from fisheye_svp_ros.solve.ray_errors import RayMap
from fisheye_svp_ros.solve.rig_state import Linearization, with_effect
from fisheye_svp_ros.study.trust import known_errors

# Rays beyond 90 degrees: no plane window can be mistaken for a viewpoint shift.
LENS = Lens('made', 1280, 960, 300.0, 300.0, 650.0, 470.0, KannalaBrandt(-0.03), 2.0)
SHIFT = {'viewpoint_shift': {'order': 1, 'parameters': {'e0': 0.002}}}
FRAMES = 14


def landmarks():
    """Return 40 landmarks at 0.2 to 0.6 m from the middle."""
    rng = np.random.default_rng(8)
    direction = rng.normal(size=(40, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return Landmarks(np.arange(40), direction * rng.uniform(0.2, 0.6, (40, 1)))


def seen(effects, seed=3, frames=FRAMES):
    """Return observations and poses of a camera with hidden effects."""
    rng = np.random.default_rng(seed)
    poses = poses_around(landmarks(), frames, rng, widest=1.4, distance=(0.8, 1.3), tilt=60)
    model = ForwardModel(extend_lens(LENS, load_effects(effects, LENS.name)))
    table = simulate(model, landmarks(), poses, 0.05, rng, t=np.arange(frames) / 10)
    return replace(table, sigma=np.full(len(table), np.nan)), poses


@pytest.fixture(scope='module')
def scene(tmp_path_factory):
    """Return a folder with the data of a camera whose viewpoint moves, and of one without."""
    folder = tmp_path_factory.mktemp('scene')
    table, poses = seen(SHIFT)
    write_observations(folder / 'shift.csv', table)
    write_poses(folder / 'poses.csv', np.arange(FRAMES), poses)
    write_poses(folder / 'few.csv', np.arange(3), poses.take(slice(3)))
    poor = (table.frame != 2) | (table.landmark < 3)
    write_observations(folder / 'poor.csv', table.take(poor))
    write_observations(folder / 'test.csv', seen(SHIFT, seed=4, frames=6)[0])
    write_observations(folder / 'clean.csv', seen({})[0])
    save_lens(LENS, folder / 'lens.yaml')
    return folder


@pytest.fixture(scope='module')
def output(scene):
    """Run the command once; return the folder of its results."""
    out = scene / 'new' / 'out'
    assert run('shift.csv', scene, '-o', out) == 0
    return out


def run(name, scene, *more):
    arguments = ['diagnose', scene / name, '--lens', scene / 'lens.yaml', *more]
    return cli.main([*map(str, arguments)])


def document(folder):
    def refuse(word):
        raise ValueError(f'{word} is no JSON')

    return json.loads((folder / 'diagnosis.json').read_text(), parse_constant=refuse)


@pytest.mark.xdist_group('output')  # made once
class TestFiles:
    def test_diagnosis_has_the_agreed_keys(self, output):
        found = document(output)
        assert found['verdict'] == 'explained'
        assert found['frames'] == FRAMES
        assert found['noise_px'] == pytest.approx(0.05, rel=0.1)
        fit = {'rms_px', 'heldout_rms_px', 'chi2_per_dof'}
        assert set(found['base']) == set(found['extended']) == fit
        # Both beside the noise, though the table says nothing of it.
        assert found['base']['chi2_per_dof'] > 1.2
        assert found['extended']['chi2_per_dof'] == pytest.approx(1.0, abs=0.2)
        (cause,) = found['causes']
        assert {
            'effect',
            'parameters',
            'p_value',
            'heldout_rms_px',
            'gain',
            'indistinguishable_from',
            'to_separate',
        } <= set(cause)
        assert cause['effect'] == 'viewpoint_shift'
        e0 = cause['parameters']['e0']
        assert e0['unit'] == 'm'
        assert e0['value'] == pytest.approx(0.002, abs=5 * e0['stderr'])
        assert cause['survives'] is True and 0 < cause['share'] < 1
        assert isinstance(found['remaining']['structure'], list)
        parts = {part['name']: part for part in found['components']}
        assert all(
            set(part) == {'name', 'stage', 'sd_px', 'share', 'named_share', 'p_value'}
            for part in parts.values()
        )
        assert {part['stage'] for part in parts.values()} <= {'lens', 'target', 'frame', 'noise'}
        assert sum(part['share'] for part in parts.values()) == pytest.approx(1)
        assert parts['named_lens']['named_share'] == pytest.approx(cause['share'])
        assert parts['noise']['sd_px'] == pytest.approx(0.05, rel=0.1)
        assert set(found['named']) == {'rms_px', 'heldout_rms_px'}
        assert set(found['lens']) == {'rms_px', 'heldout_rms_px', 'ray_error_mrad'}
        for side in ('given', 'extended'):
            rows = found['lens']['ray_error_mrad'][side]
            assert [row['range_m'] for row in rows] == [0.3, 1.0, 5.0]
            assert all(row['low'] < row['value'] < row['high'] for row in rows)
        assert set(found['file']) == {'given_px', 'extended_px', 'gain', 'low', 'high', 'sure'}
        assert found['file']['extended_px'] < found['file']['given_px']
        assert found['candidates'] == []
        assert {name: one['say'] for name, one in found['decision'].items()} == {
            'lens': 'use_extended',
            'target': 'keep',
            'photographs': 'enough',
        }
        assert all(
            {'say', 'why', 'figure', 'confidence'} <= set(one)
            for one in found['decision'].values()
        )
        assert found['advice'][0]['gain'] > 0.5 and found['gross'] == []
        assert {tuple(entry) for entry in found['untestable']} == {('effect', 'why')}
        assert found['extended']['heldout_rms_px'] < 0.9 * found['base']['heldout_rms_px']

    def test_the_extended_lens_solves_better(self, scene, output, tmp_path):
        lens = load_lens(output / 'extended_lens.yaml')
        assert lens.viewpoint_shift.e0 == pytest.approx(0.002, rel=0.05)
        assert lens.corrections == {}
        figures = []
        for path in (scene / 'lens.yaml', output / 'extended_lens.yaml'):
            assert (
                cli.main(
                    [
                        'localize',
                        str(scene / 'shift.csv'),
                        '--lens',
                        str(path),
                        '-o',
                        str(tmp_path),
                    ]
                )
                == 0
            )
            figures.append(json.loads((tmp_path / 'localize.json').read_text())['rms_px'])
        found = document(output)
        assert figures[0] == pytest.approx(found['base']['rms_px'], rel=1e-3)
        assert figures[1] == pytest.approx(found['named']['rms_px'], rel=5e-3)
        assert figures[1] < 0.9 * figures[0]

    def test_everything_means_the_extended_lens(self, output, tmp_path):
        path = str(output / 'extended_lens.yaml')
        lens = load_lens(path)
        assert lens.svp().viewpoint_shift is None
        assert true_lens(path, 0.5).viewpoint_shift.e0 == lens.viewpoint_shift.e0 / 2
        assert cli.main(['budget', '--lens', path, '-o', str(tmp_path)]) == 0
        found = json.loads((tmp_path / 'budget.json').read_text())
        assert found['at_point'][0]['error'] > 1e-5

    def test_residuals_of_every_point(self, scene, output):
        names = ['frame', 'landmark', 'u', 'v', 'theta', 'range']
        table = CsvTable(output / 'residuals.csv', names)
        given = CsvTable(scene / 'shift.csv', ['frame', 'landmark', 'u', 'v'])
        np.testing.assert_array_equal(
            table.numbers('frame', 'landmark', 'u', 'v'),
            given.numbers('frame', 'landmark', 'u', 'v'),
        )
        assert not table.integers('outlier').any()
        found = document(output)
        for side, fit in (('before', 'base'), ('after', 'named')):
            squares = (table.numbers(f'du_{side}', f'dv_{side}') ** 2).sum(axis=1)
            assert np.sqrt(squares.mean()) == pytest.approx(found[fit]['rms_px'])
        theta, distance = table.numbers('theta', 'range').T
        assert theta.min() > 0 and np.pi / 2 < theta.max() < 2.0
        assert distance.min() > 0.05 and distance.max() < 2.0

    def test_the_report_is_one_page(self, output):
        page = (output / 'report.html').read_text(encoding='utf-8')
        sources = re.findall(r'(?:src|href)="([^"]{1,30})', page)
        assert sources and all(s.startswith(('data:image/png;base64,', '#')) for s in sources)
        assert '@import' not in page and '<script' not in page
        for word in ('Explained', 'viewpoint_shift', 'mm', 'extended_lens.yaml', 'untestable'):
            assert word in page
        assert re.search(
            r'lens \(stays in the image\): \d+ % \(\d+ identified: viewpoint_shift\)', page
        )
        pictures = {path.stem for path in output.glob('*.png')}
        assert pictures == {
            'field',
            'theta',
            'range',
            'landmark',
            'frame',
            'phase',
            'histogram',
            'evidence',
            'uncertainty',
        }
        assert all(path.read_bytes().startswith(b'\x89PNG') for path in output.glob('*.png'))
        assert not [path for path in output.iterdir() if path.name.startswith('.')]


def test_the_report_of_a_quick_answer_has_few_pictures(scene, tmp_path):
    assert run('shift.csv', scene, '--quick', '-o', tmp_path) == 0
    pictures = {path.stem for path in tmp_path.glob('*.png')}
    assert pictures == {'field', 'theta', 'range', 'uncertainty'}
    page = (tmp_path / 'report.html').read_text(encoding='utf-8')
    sources = re.findall(r'<img [^>]*src="(.{0,30})', page)
    assert len(sources) == len(pictures)
    assert all(source.startswith('data:image/png;base64,') for source in sources)


class TestTerminal:
    def test_known_poses(self, scene, capsys):
        assert run('shift.csv', scene, '--poses', scene / 'poses.csv') == 0
        out, err = capsys.readouterr()
        assert all(line.startswith('diagnosing: ') for line in err.splitlines())
        said = re.search(r'position error ([\d.]+) mm → ([\d.]+) mm', ' '.join(out.split()))
        assert float(said[2]) < 0.5 * float(said[1])

    def test_next_photographs_that_cannot_be_planned_take_nothing_away(self, scene, capsys):
        """The target is not flat; what was found in a minute was lost with the refusal."""
        assert run('shift.csv', scene, '--quick', '--next', '2', '-o', scene / 'found') == 2
        said = capsys.readouterr()
        assert 'not one flat board' in said.err and 'viewpoint_shift' in said.out
        assert (scene / 'found' / 'report.html').stat().st_size > 1000

    def test_a_rig_has_a_lens_a_camera(self, scene, capsys):
        table, _ = seen({})
        other = replace(table, camera=np.ones_like(table.camera), uv=table.uv + 0.1)
        both = {
            name: np.concatenate([getattr(table, name), getattr(other, name)])
            for name in ('frame', 'landmark', 'board', 'camera', 'uv', 'xyz', 't', 'sigma')
        }
        write_observations(scene / 'rig.csv', replace(table, cameras=('left', 'right'), **both))
        lens = scene / 'lens.yaml'
        given = ['diagnose', scene / 'rig.csv', '--lens', f'left={lens}']
        assert cli.main([*map(str, given)]) == 2
        assert 'camera right has no lens' in capsys.readouterr().err
        given += ['--lens', f'right={lens}', '--quick', '-o', scene / 'rig']
        assert cli.main([*map(str, given)]) == 0
        out = capsys.readouterr().out
        assert 'left/extended_lens.yaml, right/extended_lens.yaml, rig.yaml' in out
        assert np.abs(load_rig(scene / 'rig' / 'rig.yaml').position).max() < 1e-3
        assert cameras_in(scene / 'rig') == ('left', 'right')
        page = (scene / 'rig' / 'report.html').read_text()
        assert 'Cross-camera validation' in page
        assert f'--lens right={scene}/rig/right/extended_lens.yaml' in page
        document = json.loads((scene / 'rig' / 'diagnosis.json').read_text())
        assert document['external']['cameras'][0]['cameras'] == ['left', 'right']
        assert load_lens(scene / 'rig' / 'right' / 'extended_lens.yaml').fx == pytest.approx(
            LENS.fx, rel=0.01
        )

    def test_held_out_file(self, scene, capsys, tmp_path):
        assert run('shift.csv', scene, '--held-out', scene / 'test.csv') == 0
        assert 'viewpoint_shift' in capsys.readouterr().out

    def test_nothing_wrong(self, scene, capsys):
        assert run('clean.csv', scene) == 0
        out = ' '.join(capsys.readouterr().out.split())
        assert out.startswith('Use this lens')
        assert ' Wrong: No model error is visible in these data. ' in out
        assert 'Not excluded: viewpoint_shift up to' in out and 'px' in out

    def test_intrinsics_of_another_day_are_told(self, scene, capsys, tmp_path):
        """They are fitted to these data, which must not hide that the lens has others."""
        lens = load_lens(scene / 'lens.yaml')
        for name, scale in (('same.yaml', 1.0), ('other.yaml', 1.01)):
            save_lens(replace(lens, fx=scale * lens.fx, fy=scale * lens.fy), tmp_path / name)
            assert (
                cli.main(
                    [
                        'diagnose',
                        str(scene / 'clean.csv'),
                        '--lens',
                        str(tmp_path / name),
                        '--free',
                        'intrinsics',
                        '--quick',
                        '-o',
                        str(tmp_path),
                    ]
                )
                == 0
            )
            out = ' '.join(capsys.readouterr().out.split())
            assert ('Do not use this lens' in out) == (scale != 1)
            assert ('Use this lens' in out) == (scale == 1)
            document = json.loads((tmp_path / 'diagnosis.json').read_text())
            say = document['decision']['lens']['say']
            assert say == ('keep' if scale == 1 else 'recalibrate')
            assert (document['verdict'] == 'adequate') == (scale == 1)
        fx = json.loads((tmp_path / 'diagnosis.json').read_text())['intrinsics']['fx']
        assert (fx['given'], fx['given_stderr']) == (pytest.approx(1.01 * lens.fx), 0.0)

    def test_intrinsics_that_are_no_better_known_are_not(self, scene, capsys, tmp_path):
        lens, names = load_lens(scene / 'lens.yaml'), ('fx', 'fy')
        known = {'stderr': dict.fromkeys(names, 3.0), 'covariance': [[9.0, 8.0], [8.0, 9.0]]}
        save_lens(
            replace(
                lens.with_parameters(names, [1.01 * lens.fx, 1.01 * lens.fy]), calibration=known
            ),
            tmp_path / 'rough.yaml',
        )
        assert (
            cli.main(
                [
                    'diagnose',
                    str(scene / 'clean.csv'),
                    '--quick',
                    '--lens',
                    str(tmp_path / 'rough.yaml'),
                ]
            )
            == 0
        )
        out = capsys.readouterr().out
        assert 'Do not use the lens as given' not in out and 'Use extended_lens.yaml' in out

    def test_a_frame_that_is_there_twice_counts_once(self, scene, capsys, tmp_path):
        table = read_observations(scene / 'clean.csv')
        again = table.take(table.frame == 3)
        more = {
            name: np.concatenate([getattr(table, name), getattr(again, name)])
            for name in ('landmark', 'uv', 'xyz', 'camera', 'board', 't', 'sigma')
        }
        frame = np.concatenate([table.frame, np.full(len(again), 99)])
        write_observations(tmp_path / 'twice.csv', replace(table, frame=frame, **more))
        command = ['--lens', scene / 'lens.yaml', '--quick']
        assert cli.main([*map(str, ['diagnose', tmp_path / 'twice.csv', *command])]) == 0
        twice = capsys.readouterr()
        assert cli.main([*map(str, ['diagnose', scene / 'clean.csv', *command])]) == 0
        once = capsys.readouterr().out
        name = str(scene / 'clean.csv')
        assert ' '.join(twice.out.replace(str(tmp_path / 'twice.csv'), name).split()) == (
            ' '.join(once.split())
        )
        assert 'image points repeat those of an earlier frame: frame 99' in twice.err

    def test_options_that_cannot_be(self, scene, capsys):
        name = 'viewpoint_shift'
        assert run('shift.csv', scene, '--with', name, '--without', name) == 2
        assert f'--with {name} and --without {name} contradict' in capsys.readouterr().err
        for count in ('-1', '0'):
            with pytest.raises(SystemExit):
                run('shift.csv', scene, '--next', count)
            assert f"'{count}' is not a whole number above 0" in capsys.readouterr().err

    def test_frames_that_cannot_be_posed_are_named(self, scene, capsys):
        assert run('poor.csv', scene) == 0
        out, err = capsys.readouterr()
        assert 'left out' in err and 'frame 2' in err
        assert f'in {FRAMES - 1} frames' in out

    @pytest.mark.parametrize(
        ('more', 'said'),
        [
            (['--poses', 'few.csv'], 'frame 3 of'),
            (['--poses', 'lens.yaml'], "columns 'frame', "),
            (['--held-out', 'nothing.csv'], 'nothing.csv'),
            (['--lens', 'nothing.yaml'], 'nothing.yaml'),
        ],
    )
    def test_bad_input(self, scene, capsys, more, said):
        assert run('shift.csv', scene, more[0], scene / more[1]) == 2
        out, err = capsys.readouterr()
        assert out == '' and err.startswith('fisheye-svp: ') and err.count('\n') == 1
        assert said in err


@pytest.mark.xdist_group('words')
class TestWords:
    @pytest.fixture(scope='class')
    @classmethod
    def found(cls):
        return diagnose(seen(SHIFT)[0], LENS)

    def test_three_sentences(self, found):
        wrong, gained, following = verdict_sentences(found)
        assert re.search(r'\(viewpoint_shift: e0 = [12]\.\d+ ± 0\.\d+ mm; p < 1e-12\)', wrong)
        assert 'of the error above the noise' in gained
        assert following == 'Use extended_lens.yaml.'

    def test_local_offsets_that_held_out_data_refute_gain_nothing(self, found):
        base = found.figures.base
        worse = replace(found.figures.extended, heldout_rms_px=2 * base.heldout_rms_px)
        gain = found.figures.gain._replace(value=-1.0, low=-1.0)
        refuted = with_changes(found, extended=worse, gain=gain)
        _, gained, _ = verdict_sentences(refuted)
        assert 'correction removes' not in gained and '-100 %' not in gained
        assert (
            f'do not transfer to it: with them, the error is {worse.heldout_rms_px:.3g} px'
            in gained
        )

    def test_a_class_is_named_with_what_would_separate_it(self, found):
        cause = replace(
            found.causes[0],
            indistinguishable_from=['flat_port', 'radial_profile'],
        )
        wrong, _, following = verdict_sentences(with_changes(found, causes=[cause]))
        assert 'viewpoint_shift, confounded with flat_port or radial_profile' in wrong
        assert 'to separate viewpoint_shift from flat_port and radial_profile: ' in (following)

    def test_unexplained(self, found):
        left = [
            Structure('outliers', 0.0, 0.5),
            Structure('theta', 1e-9, 0.1),
            Structure('range', 1e-9, 0.3),
        ]
        wrong, gained, following = verdict_sentences(
            with_changes(found, causes=[], advice=[], remaining=left)
        )
        assert 'depend on the distance of the landmark and the incidence angle' in wrong
        assert 'a few points are outliers' in wrong
        assert 'no extension improves on that' in gained
        assert 'look for the cause' in following
        *_, following = verdict_sentences(
            with_changes(
                found,
                remaining=[Structure('frame', 0.0, 0.5)],
                untestable={'rolling_shutter': NO_TIME},
            )
        )
        assert 'give the time of each frame (a column t, s)' in following

    def test_frames_that_do_not_predict_each_other_leave_more_than_noise(self, found):
        for times, said in ((1.1, 'that is the noise'), (3.0, '3.0 times the noise')):
            error = replace(found.figures.base, heldout_rms_px=times * 2**0.5 * found.noise_px)
            _, gained, _ = verdict_sentences(
                with_changes(found, causes=[], base=error, named=error, extended=error)
            )
            assert said in gained

    def test_what_was_almost_named_is_told(self, found):
        step = replace(found.trace[0], p_corrected=3e-6, reason=Reason.NO_CONVINCING_GAIN)
        left = [Structure('range', 1e-9, 0.3)]
        wrong, _, _ = verdict_sentences(
            with_changes(found, causes=[], advice=[], remaining=left, trace=[step])
        )
        assert (
            '. viewpoint_shift is significant (p = 3e-06), but it does not significantly improve'
            in wrong
        )

    def test_what_remains_is_told_in_numbers(self, found):
        gross = [{'frame': 4, 'landmark': 17, 'px': 12.3456, 'why': 'far off'}] * 2
        left = [Structure('outliers', 0.0, 0.5), Structure('size', 0.0, 0.0)]
        extended = replace(found.figures.extended, chi2_per_dof=9.0)
        wrong, _, _ = verdict_sentences(
            with_changes(
                found, causes=[], advice=[], remaining=left, gross=gross, extended=extended
            )
        )
        assert '2 points are outliers; the largest is frame 4 landmark 17 (12.3 px)' in wrong
        assert 'the residuals are 3 times as large as sigma' in wrong

    def test_the_headline_names_a_cause_in_lens_and_target(self, found):
        """Of several parameters of one board, how far it is off with all of them."""
        first = found.causes[0]
        entry = next(iter(first.parameters.values()))
        board = replace(
            first,
            form='board_pose',
            share=2 * first.share,
            parameters={
                f'board1.{name}': entry | {'value': 1e-3 * value, 'stderr': 1e-4, 'unit': 'm'}
                for name, value in zip('xyz', (0.1, 0.2, 0.6), strict=True)
            },
        )
        words = what_is_wrong(with_changes(found, causes=[first, board]))
        assert re.match(
            r'The relative poses of the boards are wrong \(0.64 mm\); (the viewpoint of the lens '
            r'moves by [\d.]+ mm from the axis to \d+ deg|viewpoint movement [\d.]+ mm)',
            words,
        )

    def test_points_that_are_set_aside_are_no_riddle(self, found):
        gross = [{'frame': 4, 'landmark': 17, 'px': 12.3456, 'why': 'far off'}] * 2
        left = [Structure('outliers', 0.0, 0.5)]
        clean = with_changes(found, causes=[], advice=[], remaining=left, gross=gross)
        assert what_is_wrong(clean).startswith(
            '2 image points are outliers; nothing else is wrong'
        )
        *_, following = verdict_sentences(clean)
        partly = with_changes(found, remaining=left, gross=gross)
        assert what_is_wrong(partly).startswith('The viewpoint of the lens moves by ')
        more = [*left, Structure('range', 1e-9, 0.3)]
        assert what_is_wrong(with_changes(clean, remaining=more)).endswith(
            ' px; no effect of the catalog explains the rest'
        )
        *_, following = verdict_sentences(with_changes(clean, remaining=more))
        assert 'look for the cause' in following

    def test_what_happened_to_the_frames_is_no_reason_to_keep_the_lens(self, found):
        cause = replace(found.causes[0], form='rolling_shutter')
        how = cause.effect_class.to_separate.replace(';', ',')
        shutter = replace(found.lens, corrections={'rolling_shutter': {}})
        told = [
            verdict_sentences(with_changes(found, causes=[cause], advice=[], lenses={'': lens}))[2]
            for lens in (found.lens, shutter)
        ]
        assert told[0] == f'Use extended_lens.yaml; to confirm rolling_shutter: {how}.'
        assert told[1].startswith('Use extended_lens.yaml; it includes rolling_shutter; to')
        following = verdict_sentences(
            with_changes(found, causes=[*found.causes, cause], lenses={'': shutter})
        )[2]
        assert following.count('extended_lens.yaml') == 1
        worse = replace(found.figures.named, heldout_rms_px=2 * found.figures.base.heldout_rms_px)
        refuted = verdict_sentences(
            with_changes(found, causes=[cause], advice=[], lenses={'': shutter}, named=worse)
        )
        assert 'Do not correct' in refuted[1]

    def test_a_frame_that_several_cameras_saw_is_named_once(self):
        assert advice_text(Advice(Action.RETAKE, frames=[4, 1, 4])).endswith('(frames 4 and 1)')

    def test_errors_against_the_truth_go_or_stay(self, found):
        _, gained, _ = verdict_sentences(
            found,
            {
                'position_error_m': Comparison(0.002, 0.001, 0.5, 0.3, 0.6),
                'depth_error_m': Comparison(0.0021, 0.002, 0.05, -0.1, 0.2),
            },
        )
        assert 'The position error goes from 2 mm to 1 mm' in gained
        assert 'The stereo error stays at 2 mm' in gained

    def test_many_causes_are_counted(self, found):
        wrong, *_ = verdict_sentences(with_changes(found, causes=5 * found.causes))
        assert wrong.count('viewpoint_shift') == 3
        assert 'the table lists 2 more causes' in wrong

    def test_parameters_that_the_data_leave_open_are_not_shown(self, found):
        entry = {'value': 0.1, 'stderr': 1e20, 'unit': '1'}
        cause = replace(
            found.causes[0],
            parameters={
                **found.causes[0].parameters,
                'open': entry,
                'nothing': {'value': 0.0, 'stderr': float('nan'), 'unit': '1'},
            },
        )
        (row,) = cause_rows(with_changes(found, causes=[cause]))
        assert row[1].startswith('e0 = ') and 'open' not in row[1] and 'nothing' not in row[1]


@pytest.fixture(
    params=[
        np.linalg.LinAlgError('SVD did not converge'),
        GeometryError('frame 3 has 0 usable points in it'),
    ],
    ids=repr,
)
def without_solution(monkeypatch, request):
    """Have the equations of a diagnosis no solution."""

    def singular(*_, **__):
        raise request.param

    monkeypatch.setattr('fisheye_svp_ros.diagnosis.diagnose', singular)


def test_views_that_cannot_be_fitted_are_one_line(scene, without_solution, capsys):
    assert run('shift.csv', scene) == 2
    (said,) = capsys.readouterr().err.strip().splitlines()
    assert 'shift.csv: its views cannot be fitted with this lens: ' in said
    assert 'camera in the world' not in said
    assert run('shift.csv', scene, '--poses', scene / 'poses.csv') == 2
    assert 'poses.csv are those of the camera in the world.' in capsys.readouterr().err


def test_landmarks_in_millimetres_are_asked_about(scene, without_solution, capsys):
    table = read_observations(scene / 'shift.csv')
    write_observations(scene / 'mm.csv', replace(table, xyz=1000 * table.xyz))
    assert run('mm.csv', scene) == 2
    assert 'x, y, z must be in m, not in mm' in capsys.readouterr().err


def test_intrinsics_are_told_with_their_unit():
    values = namedtuple('Values', 'before before_stderr after after_stderr')(1.0, 0.1, 2.0, 0.1)
    fitted = SimpleNamespace(intrinsics={'left.fx': values, 'k1': values})
    diagnosis = SimpleNamespace(evaluation=fitted)
    assert [row[0] for row in intrinsic_rows(diagnosis)] == ['left.fx, px', 'k1']


def test_a_single_frame_is_drawn(tmp_path):
    table, _ = seen({})
    found = diagnose(table.take((table.frame == 0) & (table.landmark < 6)), LENS)
    for name, draw, arguments in residual_pictures(PlotData.from_evaluation(found.evaluation)):
        draw(tmp_path / f'{name}.png', *arguments)
    assert len(list(tmp_path.glob('*.png'))) == 7


def test_each_camera_of_a_rig_has_pictures_of_its_own_image(tmp_path, monkeypatch):
    figures = []

    @contextmanager
    def kept(path, width, height):
        figures.append(Figure((width, height)))
        yield figures[-1]

    for module in (diagnosis_plots, ray_plots):
        monkeypatch.setattr(module, 'picture', kept)
    table, _ = seen({})
    step = np.array([LENS.width, 100.0])  # the other image lies beside the first
    other = replace(table, camera=np.ones_like(table.camera), uv=table.uv + step)
    both = {
        name: np.concatenate([getattr(table, name), getattr(other, name)])
        for name in ('frame', 'landmark', 'board', 'camera', 'uv', 'xyz', 't', 'sigma')
    }
    larger = replace(LENS, width=2 * LENS.width, cx=LENS.cx + step[0], cy=LENS.cy + step[1])
    found = diagnose(
        replace(table, cameras=('left', 'right'), **both),
        {'left': LENS, 'right': larger},
        options=DiagnosisOptions(quick=True),
    )
    shown = PlotData.from_evaluation(found.evaluation)
    named = {name: (draw, arguments) for name, draw, arguments in residual_pictures(shown)}
    draw, arguments = named['field']
    draw(tmp_path / 'field.png', *arguments)
    axes = figures[-1].axes
    assert [axis.get_xlim()[1] for axis in axes] == 4 * [LENS.width] + 4 * [larger.width]
    assert [axis.get_title().split(':')[0] for axis in axes if axis.get_title()] == [
        'left before',
        'left after',
        'right before',
        'right after',
    ]
    for axis in axes:
        u = axis.collections[0].get_offsets()[:, 0]
        assert len(u) and ((u >= LENS.width) == (axis in axes[4:])).all()
    radial, across = diagnosis_plots._polar(
        shown, shown.points.uv - (shown.points.camera == 1)[:, None] * step - [LENS.cx, LENS.cy]
    ).T
    assert np.abs(across).max() < 1e-9 and radial.min() > 0
    maps = {}
    for name, lens in (('left', LENS), ('right', larger)):
        u, v = np.linspace(0, lens.width - 1, 9), np.linspace(0, lens.height - 1, 7)
        maps[name] = RayMap(u, v, np.full((2, 7, 9), 1e-3), (0.3, 5.0), table.uv)
    ray_plots.draw_uncertainty(tmp_path / 'uncertainty.png', maps)
    titled = {axis.get_title(): axis.get_xlim()[1] for axis in figures[-1].axes}
    for name, lens in (('left', LENS), ('right', larger)):
        for range_m in (0.3, 5):
            assert titled[f'{name} at {range_m:g} m'] == lens.width - 1


def test_the_bow_of_a_board_is_measured_between_its_extremes():
    rng = np.random.default_rng(1)
    board = plane()
    poses = poses_around(board, 6, rng, widest=0.5)
    found = diagnose(simulate(ForwardModel(LENS), board, poses, 0.1, rng), LENS)
    effect = TargetShapeEffect.candidates(found.evaluation.fixed_model.scene)[0]
    bow = np.array([0.002, 0.0, 0.0])
    state = replace(found.evaluation.fixed_model.state, terms=(ModelTerm(effect, bow),))
    (one,) = board_maps(found.evaluation.fixed_model.data.views, state.terms, state.lens)
    assert len(one.height) == len(board.ids)
    x = one.place[:, 0] / np.abs(one.place[:, 0]).max()
    expected = 0.002 * x**2
    np.testing.assert_allclose(one.height, expected - expected.mean(), atol=1e-9)
    assert one.peak_to_valley == pytest.approx(0.002)
    np.testing.assert_allclose(one.slide, np.zeros_like(one.place), atol=1e-12)
    assert one.spans_plane
    for few in (one.place * [1.0, 0.0], one.place[:2], one.place[:1]):
        assert not one._replace(place=few).spans_plane


def test_the_depth_of_a_rig_gains_too():
    rng = np.random.default_rng(5)
    model = ForwardModel(extend_lens(LENS, load_effects(SHIFT, LENS.name)))
    rig = Pose(rotation_from_vector(np.array([0.0, 0.1, 0.0])), np.array([-0.15, 0.0, 0.0]))
    poses = poses_around(landmarks(), 8, rng, widest=1.2, distance=(0.8, 1.3), tilt=60)
    table = simulate_stereo(model, model, landmarks(), rig, poses, 0.05, rng)
    found = diagnose(table, LENS)
    assert [cause.effect for cause in found.causes] == ['viewpoint_shift']
    before, after = found.evaluation.simulation, found.evaluation.fixed_model
    known = known_errors(before, after, ())
    assert set(known) == {'depth_error_m'}
    depth = known['depth_error_m']
    assert 0 < depth.after < depth.before
    assert depth.low <= depth.value <= depth.high
    # With cameras that stand elsewhere by the time the second exposes, a rig alone says nothing.
    late = with_effect(after.state, StereoTimeOffsetEffect(), np.array([0.01]))
    assert known_errors(before, Linearization(after.data, late, ()), ()) == {}


@pytest.mark.parametrize(
    ('board', 'included', 'found'),
    [
        ('chessboard:9x6:25mm', [], ('skew', 'dot_centroid')),
        ('circles:7x5:20mm', [], ('skew',)),
        ('', [], ('skew',)),
        ('chessboard:9x6:25mm', ['dot_centroid'], ('skew',)),
    ],
)
def test_corners_have_no_dots(board, included, found):
    asked = SimpleNamespace(board=board, included=included, left_out=['skew'])
    assert effects_left_out(asked) == found


def test_a_terminal_shows_a_provisional_answer(scene, capsys, monkeypatch):
    monkeypatch.setattr('sys.stderr.isatty', lambda: True, raising=False)
    shown = []
    monkeypatch.setattr(
        'fisheye_svp_ros.reporting.terminal._bar',
        lambda *_: nullcontext(lambda **told: shown.append(told['description'])),
    )
    assert run('shift.csv', scene, '--quick') == 0
    printed = capsys.readouterr()
    words = 'Provisional: The viewpoint of the lens shifts with the angle'
    assert shown[-1] == f'{words}\ndiagnosing: errors of poses and depth'
    assert 'rovisional' not in printed.out + printed.err  # nothing has changed
