"""`fisheye-svp diagnose`: what a lens's simulation gets wrong about measured observations."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fisheye_svp_ros.commands.detect import (
    add_observation_arguments,
    note_side_by_side,
    read_input,
    search_options,
)
from fisheye_svp_ros.commands.lenses import (
    Lenses,
    add_dome_arguments,
    add_lens_argument,
    dome_of,
    lenses_of,
    load_lenses,
)
from fisheye_svp_ros.commands.notes import (
    note_copies,
    note_huge,
    note_left_out,
    note_unconnected,
    note_upwards,
    note_wrong_landmarks,
)
from fisheye_svp_ros.commands.outputs import add_output_folder
from fisheye_svp_ros.commands.plan import view_count, view_limits
from fisheye_svp_ros.errors import FisheyeSvpError, GeometryError, LensError, ParameterError
from fisheye_svp_ros.io.csv_files import write_columns
from fisheye_svp_ros.io.files import write_json, write_together
from fisheye_svp_ros.io.lens_files import save_lens
from fisheye_svp_ros.io.readers import check_sizes, read_poses
from fisheye_svp_ros.io.rig_files import save_rig
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.scene.observations import Observations, photograph_column

if TYPE_CHECKING:
    from fisheye_svp_ros.diagnosis import Comparison, Diagnosis
    from fisheye_svp_ros.planning.plan import NextViews
    from fisheye_svp_ros.reporting.diagnosis_plots import PointResiduals
    from fisheye_svp_ros.reporting.wording.next_steps import ReportInputs

_OF_DOTS = 'dot_centroid'  # corners have none


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    add_observation_arguments(parser)
    add_lens_argument(parser, 'the simulation: ')
    parser.add_argument(
        '--poses',
        metavar='POSES.csv',
        help='poses of the camera (of a rig: the right one), or of the robot flange that '
        'carries it. The data show which of the two. Default: unknown, and fitted',
    )
    parser.add_argument(
        '--free',
        choices=['intrinsics'],
        help='fit the intrinsics, too. Those of a lens from `calibrate` are always fitted',
    )
    parser.add_argument(
        '--held-out',
        metavar='TEST',
        help='other observations of the same camera and target, to measure the '
        'gain on; default: cross-validation on OBS',
    )
    parser.add_argument(
        '--against',
        metavar='OTHER',
        help='other observations of the same camera, with another target or from another day. '
        'Causes in the lens must hold there, too',
    )
    parser.add_argument(
        '--with',
        dest='included',
        action='append',
        default=[],
        metavar='NAME',
        help='an effect that is known to be present: fit it without a test',
    )
    parser.add_argument(
        '--without',
        dest='left_out',
        action='append',
        default=[],
        metavar='NAME',
        help='an effect that is known to be absent: do not test it',
    )
    add_dome_arguments(parser)
    parser.add_argument(
        '--quick',
        action='store_true',
        help='a first answer in less time: one round on 1500 to 3000 points, selection without '
        'held-out frames',
    )
    parser.add_argument(
        '--range',
        type=float,
        metavar='M',
        dest='range_m',
        help='also state the ray errors at this distance, m, in addition to 0.3, 1, and 5 m',
    )
    parser.add_argument(
        '--next',
        type=view_count,
        default=0,
        metavar='N',
        dest='count',
        help='list the N photographs to take next: those that separate the confounded causes best',
    )
    parser.add_argument(
        '--for',
        dest='number',
        metavar='NAME',
        help='with --next: minimize the error of one number (e0, fx, ...)',
    )
    parser.add_argument(
        '--room',
        type=float,
        nargs=2,
        metavar='M',
        help='with --next: nearest and farthest distance at which the board is sharp. Default: '
        'slightly more than the distances in OBS',
    )
    add_output_folder(
        parser,
        'folder to write report.html and its pictures, diagnosis.json, extended_lens.yaml, and '
        'residuals.csv to. For a rig, also rig.yaml and a subfolder for the lens of each camera',
    )


def run(args: argparse.Namespace) -> None:
    """Diagnose, say what is wrong, write report and extended lens."""
    from fisheye_svp_ros.diagnosis import DiagnosisOptions, diagnose, diagnose_against
    from fisheye_svp_ros.planning.plan import check_parameter_name
    from fisheye_svp_ros.reporting.terminal import stages
    from fisheye_svp_ros.reporting.wording.headline import headline_changes, provisional_headline
    from fisheye_svp_ros.solve.measured_poses import poses_by_frame, rig_lenses
    from fisheye_svp_ros.solve.rig_state import free_parameters
    from fisheye_svp_ros.study.trust import known_errors

    _check_options(args)
    given = load_lenses(args.lens)
    if args.count and len(given) > 1:
        raise ParameterError('--next plans the photographs of one camera; give one lens')
    stated = dome_of(args, given)
    free = True if args.free == 'intrinsics' else None
    observations, lens = _read(args.observations, args, given)
    held_out = _read(args.held_out, args, given)[0] if args.held_out else None
    poses = None
    if args.poses:
        poses = poses_by_frame(observations, read_poses(args.poses).by_frame(), args.poses)
    other = _read(args.against, args, given)[0] if args.against else None
    if args.number and isinstance(lens, Lens):
        fitted = free_parameters(rig_lenses(observations, lens), free)
        check_parameter_name(args.number, observations, lens, fitted)
    told: list[tuple[str, ...]] = []
    with stages('diagnosing') as progress:

        def show_provisional(names: tuple[str, ...]) -> None:
            """Show what a first look, and then the first round, has found."""
            told[:] = [names]
            progress.announce(provisional_headline(names))

        settings: dict[str, Any] = {
            'free_intrinsics': free,
            'poses': poses,
            'held_out': held_out,
            'options': DiagnosisOptions(
                tuple(args.included), effects_left_out(args), args.quick, args.range_m, stated
            ),
            'progress': progress,
        }
        if sys.stderr.isatty():
            settings['provisional'] = show_provisional
        try:
            if other is None:
                diagnosis = diagnose(observations, lens, **settings)
            else:
                diagnosis = diagnose_against(observations, other, lens, **settings)
            progress('errors of poses and depth', 0.88)
            evaluation = diagnosis.evaluation
            fitted = evaluation.problem.free
            known = known_errors(evaluation.simulation, evaluation.fixed_model, fitted)
        except (GeometryError, np.linalg.LinAlgError) as cause:
            raise _fit_error(args, cause) from cause
        wanted, impossible = _plan_next_views(args, diagnosis) if args.count else (None, None)
        if args.output:
            from fisheye_svp_ros.reporting.diagnosis_report import write_report

            progress('report', 0.9)
            with write_together():
                _write(args, diagnosis, known, wanted)
            with write_together():
                write_report(diagnosis, known, _inputs(args, bool(fitted)), wanted)
    _print(diagnosis, known, args, wanted)
    for names in told:
        print(*headline_changes(names, diagnosis), sep='\n', end='', file=sys.stderr)
    note_wrong_landmarks(diagnosis.evaluation.selection.revision.outliers.landmarks)
    if not args.poses:
        note_unconnected(observations)
    if impossible is not None:
        raise impossible


def _check_options(args: argparse.Namespace) -> None:
    """Raise ParameterError for options that contradict each other."""
    for name in args.included:
        if name in args.left_out:
            raise ParameterError(
                f'--with {name} and --without {name} contradict each other; remove one of them'
            )


def _fit_error(args: argparse.Namespace, cause: Exception) -> GeometryError:
    """Return what says that views cannot be fitted, and what to check."""
    poses_too = (
        f' Check that the poses of {args.poses} are those of the camera in the world.'
        if args.poses
        else ''
    )
    return GeometryError(
        f'{args.observations}: its views cannot be fitted with this lens: {cause}; check camera '
        f'and image size of the lens; `localize` lists the residual of each view.{poses_too}'
    )


def _plan_next_views(
    args: argparse.Namespace, diagnosis: Diagnosis
) -> tuple[NextViews | None, FisheyeSvpError | None]:
    """Return the photographs to take next, or why there are none: what was found comes first."""
    from fisheye_svp_ros.planning.plan import next_photographs

    room = None if args.room is None else view_limits(args.room)
    try:
        return next_photographs(
            diagnosis.evaluation.fixed_model,
            diagnosis.causes,
            diagnosis.noise_px,
            args.count,
            args.number,
            room,
        ), None
    except FisheyeSvpError as why:
        return None, why


def effects_left_out(args: argparse.Namespace) -> tuple[str, ...]:
    """Return the effects that are not tested: the user's, and what this board cannot have."""
    named = tuple(args.left_out)
    dots = not args.board or args.board.startswith('circles')
    return named if dots or _OF_DOTS in args.included else (*named, _OF_DOTS)


def _read(
    path: str, args: argparse.Namespace, given: Lenses
) -> tuple[Observations, Lens | dict[str, Lens]]:
    """Return the views that can be posed, and the lens of all cameras or that of each."""
    from fisheye_svp_ros.solve.measured_poses import usable_observations

    table, sizes = read_input(path, args)
    note_huge(table)
    try:
        lenses = lenses_of(table.cameras, given)
    except LensError as cause:
        raise LensError(f'{path}: {cause}') from cause
    check_sizes(path, sizes, lenses)
    if not args.board:
        note_side_by_side(table, {name: (one.width, one.height) for name, one in lenses.items()})
    one = set(given) == {''} and not (given.in_file and len(table.cameras) > 1)
    lens = next(iter(lenses.values())) if one else lenses
    usable = usable_observations(table, lens)
    note_left_out(table, usable.not_posable)
    note_copies(table, usable.copies)
    note_upwards(usable.observations, lenses)
    return usable.observations, lens


def _print(
    diagnosis: Diagnosis,
    known: Mapping[str, Comparison],
    args: argparse.Namespace,
    wanted: NextViews | None,
) -> None:
    """Print what the first screen of the report says, and the photographs to take next."""
    from fisheye_svp_ros.reporting.terminal import print_lines, print_table
    from fisheye_svp_ros.reporting.wording.diagnosis import LENS_FILE
    from fisheye_svp_ros.reporting.wording.external import sections
    from fisheye_svp_ros.reporting.wording.first_screen import first_screen, terminal_lines
    from fisheye_svp_ros.reporting.wording.next_steps import next_step

    step = next_step(diagnosis, _inputs(args, bool(diagnosis.evaluation.intrinsics)))
    print_lines(
        [
            *terminal_lines(
                first_screen(diagnosis, args.observations, known), step if args.output else None
            ),
            *(f'{section.title}: {section.sentence}' for section in sections(diagnosis)),
        ]
    )
    if wanted:
        from fisheye_svp_ros.reporting.wording import shots

        print_table(
            f'photographs to take next, {shots.purpose(wanted)}',
            shots.HEADER,
            shots.rows(wanted),
            words=shots.TEXT_COLUMNS,
        )
    if args.output:
        files = ['report.html', 'diagnosis.json']
        if diagnosis.offers_extended:
            files += [str(Path(camera) / LENS_FILE) for camera in diagnosis.lenses]
        files += ['rig.yaml'] * bool(diagnosis.rig_chain)
        print(f'{args.output}: {", ".join(files)}, residuals.csv')


def _inputs(args: argparse.Namespace, free: bool) -> ReportInputs:
    from fisheye_svp_ros.reporting.wording.next_steps import ReportInputs

    return ReportInputs(
        args.observations,
        tuple(args.lens),
        args.poses,
        args.held_out,
        args.output or Path(),
        free,
        search_options(args) if args.board else (),
        _settings(args),
        bool(args.count),
    )


def _settings(args: argparse.Namespace) -> tuple[str, ...]:
    """Return the options with which another diagnosis solves the same problem."""
    named = [
        ('--poses', args.poses),
        ('--free', args.free),
        ('--medium', args.medium),
        ('--port', args.port),
        *(('--with', name) for name in args.included),
        *(('--without', name) for name in args.left_out),
    ]
    return tuple(word for option, value in named if value for word in (option, value))


def _write(
    args: argparse.Namespace,
    diagnosis: Diagnosis,
    known: Mapping[str, Comparison],
    wanted: NextViews | None,
) -> None:
    """Write what the pictures are made of, and are not needed for."""
    from fisheye_svp_ros.reporting.diagnosis_document import diagnosis_document
    from fisheye_svp_ros.reporting.diagnosis_plots import point_residuals
    from fisheye_svp_ros.reporting.wording.diagnosis import LENS_FILE, refusal_reason

    folder, points = args.output, point_residuals(diagnosis.evaluation)
    truth = {name: compared.to_dict() for name, compared in known.items()}
    document = {**diagnosis_document(diagnosis), 'known_truth': truth}
    if wanted:
        document['next'] = wanted.to_list()
    write_json(folder / 'diagnosis.json', document)
    for camera, lens in diagnosis.lenses.items():
        save_lens(lens, folder / camera / LENS_FILE, refusal_reason(diagnosis))
    if diagnosis.rig_chain:
        cameras, rig = diagnosis.rig_chain
        save_rig(rig, folder / 'rig.yaml', cameras)
    _write_residuals(
        folder / 'residuals.csv', points, diagnosis.evaluation.fixed_model.data.observations
    )


def _write_residuals(path: Path, points: PointResiduals, table: Observations) -> None:
    cameras = np.array(table.cameras)[points.camera]
    named = {'camera': cameras} if len(table.cameras) > 1 else {}
    write_columns(
        path,
        {
            'frame': points.frame,
            **named,
            'landmark': points.landmark,
            'u': points.uv[:, 0],
            'v': points.uv[:, 1],
            'du_before': points.before[:, 0],
            'dv_before': points.before[:, 1],
            'du_after': points.after[:, 0],
            'dv_after': points.after[:, 1],
            'theta': points.theta,
            'range': points.range,
            'outlier': points.outlier.astype(int),
            **photograph_column(table, points.frame, cameras.tolist()),
        },
    )
