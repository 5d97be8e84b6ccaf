"""`fisheye-svp calibrate`: a lens from measured observations."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from fisheye_svp_ros.commands.calibrate_rig import check_names, fit_rig, print_rig, write_rig
from fisheye_svp_ros.commands.lenses import load_with_notes
from fisheye_svp_ros.commands.notes import note_gross_errors, note_huge, say
from fisheye_svp_ros.commands.outputs import output_file, output_path
from fisheye_svp_ros.commands.photographs import (
    add_observation_arguments,
    image_sizes,
    read_input,
    search_options,
)
from fisheye_svp_ros.commands.ports import add_port_arguments, port_of
from fisheye_svp_ros.errors import GeometryError, ParameterError
from fisheye_svp_ros.io.detect_files import (
    Sizes,
    check_size_given,
    check_sizes,
    sizes_beside,
)
from fisheye_svp_ros.io.files import write_json, write_together
from fisheye_svp_ros.io.lens_files import save_lens
from fisheye_svp_ros.io.readers import read_poses
from fisheye_svp_ros.optics.curves import IMAGE_HEIGHTS
from fisheye_svp_ros.optics.lens import parameter_values
from fisheye_svp_ros.reporting.calibration_text import (
    HEADER,
    STANDARD_ERRORS,
    CalibratedCamera,
    hand_eye_rows,
    hand_eye_sentence,
)
from fisheye_svp_ros.reporting.progress import progress, stages
from fisheye_svp_ros.reporting.tables import print_table
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.solve.lens_calibration import (
    Calibration,
    calibrate,
    calibrate_hand_eye,
    calibrate_port,
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    add_observation_arguments(parser)
    parser.add_argument('--model', default='kannala_brandt', choices=IMAGE_HEIGHTS,
                        metavar='MODEL', help='image-height curve: ' + ', '.join(IMAGE_HEIGHTS)
                        + '; default: kannala_brandt')
    parser.add_argument('--image-size', type=image_sizes, metavar='WxH',
                        help='image size, px; if the cameras differ, left=1280x960,right=640x480; '
                        'not needed for photographs and for observations from `detect`')
    parser.add_argument('--free', type=_names, metavar='NAME,...',
                        help='parameters to fit: f (or fx,fy), cx, cy, the coefficients of the '
                        'model, of a viewpoint shift (e0,e1,e2 or '
                        'thickness,refractive_index), of a port (port_medium_index, ...); '
                        'default: all except the viewpoint shift; of a port, only its place')
    add_port_arguments(parser)
    parser.add_argument('--lens', metavar='AIR.yaml', type=Path,
                        help='the same camera calibrated in air; with --medium or --port, only '
                        'the place of the port is fitted')
    parser.add_argument('--poses', metavar='POSES.csv',
                        help='poses of the robot flange that carries the camera, in the robot '
                        'base; also fits the pose of the camera in the flange')
    parser.add_argument('-o', '--output', type=output_path, metavar='LENS.yaml',
                        help='lens file to write; covariances are written next to it as '
                        '.calibrate.json, the report as .calibrate.html; for a rig, a '
                        'folder: one lens per camera, calibration.html, rig.yaml, rig.json, '
                        'rig.urdf, tf_static.yaml and camchain.yaml')


def run(args: argparse.Namespace) -> None:
    """Calibrate, print the parameters, write the lens, or two lenses and the rig."""
    if args.lens and not (args.medium or args.port):
        raise ParameterError(f'--lens {args.lens} needs --medium (for example water) or --port: '
                             'what the camera looked through')
    observations, sizes = read_input(args.observations, args)
    sizes = _known_sizes(args, observations, sizes)
    if args.output:
        _check_output(args, observations)
    found: dict[str, CalibratedCamera] = {}
    for number, camera in enumerate(observations.cameras):
        table = observations.take(observations.camera == number)
        name = camera or (args.output.stem if args.output else args.model)
        size = sizes.get(camera) or sizes['']
        found[camera] = _calibrate_camera(table, args, size, name)
    rig = None
    if len(found) > 1:
        rig = fit_rig(_join_tables([one.table for one in found.values()]),
                      {camera: one.lens for camera, one in found.items()})
    if rig and not args.poses:  # the robot's transforms are those of the lenses as they are
        for camera, lens in zip(rig.cameras, rig.lenses, strict=True):
            found[camera] = found[camera].with_lens(lens)
    # Written before a word is printed: nobody may be reading.
    if args.output:
        from fisheye_svp_ros.reporting.calibration_report import write_calibration_report

        with write_together():
            paths = {}
            for camera, one in found.items():
                alone = not camera or (len(found) == 1 and args.output.suffix)
                paths[camera] = args.output if alone else args.output / f'{camera}.yaml'
                save_lens(one.lens, paths[camera])
                write_json(paths[camera].with_suffix('.calibrate.json'), _document(one))
            report = (args.output / 'calibration.html' if len(paths) > 1 else
                      next(iter(paths.values())).with_suffix('.calibrate.html'))
            write_calibration_report(report, found, _next_command(args, paths))
            if rig:
                write_rig(rig, args.output)
    for one in found.values():
        _print(one)
        for warning in one.warnings:
            say(warning)
    if args.output:
        print(f'{", ".join(map(str, paths.values()))}; report: {report}')
    if rig:
        print_rig(rig)


def _known_sizes(args: argparse.Namespace, observations: Observations, sizes: Sizes) -> Sizes:
    """Return the image size of each camera: given, of the photographs, or that of `--lens`.

    Raises ParameterError where one is unknown, or another one than `detect` found.
    """
    check_size_given(args.observations, sizes, args.image_size or {}, '--image-size')
    sizes = args.image_size or sizes or sizes_beside(Path(args.observations))
    if args.lens:
        air = load_with_notes(args.lens)
        check_sizes(args.observations, sizes, {'': air})
        return {'': (air.width, air.height)}
    unknown = [name for name in observations.cameras if not {name, ''} & set(sizes)]
    if unknown:
        head = f'{unknown[0]}=' if unknown[0] and sizes else ''
        raise ParameterError(f'{args.observations}: the image size is unknown; add --image-size '
                             f'{head}1280x800')
    return sizes


def _check_output(args: argparse.Namespace, table: Observations) -> None:
    """Raise FisheyeSvpError where the lens of a camera, or those of several, cannot be written."""
    if not table.cameras[0]:
        output_file(str(args.output))
    if len(table.cameras) == 1:
        return
    if args.output.suffix in ('.yaml', '.yml'):
        raise ParameterError(f'-o {args.output}: the lenses of {", ".join(table.cameras)} and '
                             'their rig are written to a folder; use -o '
                             f'{args.output.with_suffix("")}')
    check_names(table, args.observations)


def _join_tables(tables: Sequence[Observations]) -> Observations:
    """Return the rows of several tables of the same cameras."""
    rows: dict[str, Any] = {name: np.concatenate([getattr(table, name) for table in tables])
            for name in ('frame', 'landmark', 'uv', 'xyz', 'camera', 'board', 't', 'sigma')}
    return replace(tables[0], **rows)


def _next_command(args: argparse.Namespace, paths: Mapping[str, Path]) -> str:
    """Return the command that says what is wrong with the lenses, as a shell takes it."""
    lenses = [word for camera, path in paths.items()
              for word in ('--lens', f'{camera}={path}' if len(paths) > 1 else str(path))]
    search = search_options(args) if args.board else ()
    return shlex.join(['fisheye-svp', 'diagnose', args.observations, *search, *lenses,
                       '-o', 'diagnosis'])


def _calibrate_camera(
    table: Observations, args: argparse.Namespace, size: tuple[int, int], name: str
) -> CalibratedCamera:
    """Return the lens, the rows that it is of, without outliers, and what may be trusted."""
    from fisheye_svp_ros.study.lens_trust import (
        assess_lens,
        calibrate_without_outliers,
        with_covariance,
    )

    port = port_of(args)
    note_huge(table)
    air = load_with_notes(args.lens) if args.lens else None

    def fit_rows(rows: Observations) -> Calibration:
        if air and port:
            return calibrate_port(rows, air, port, args.free)
        return calibrate(rows, args.model, size, args.free, name, port)

    with progress('calibrating'):
        result, kept, gross = calibrate_without_outliers(table, fit_rows)
    note_gross_errors(table, gross)
    hand_eye = None
    if args.poses:
        with progress('fitting the robot'):
            result, hand_eye = calibrate_hand_eye(result, kept, read_poses(args.poses).by_frame())
    known = [*result.adjusted.lens.parameters.items()][:4]
    values = ', '.join(f'{name} {value:.6g}' for name, value in known)
    try:  # the lens is there in a second, its errors take longer
        with stages(f'{values}; computing their standard errors'):
            trusted = assess_lens(kept, result.adjusted.lens, result.adjusted.names)
    except np.linalg.LinAlgError as cause:
        raise GeometryError(f'{table.source}: the fitted lens has no rays to some of the observed '
                            f'points ({cause}); check --port and --medium') from cause
    lens = with_covariance(result.adjusted.lens, trusted)
    return CalibratedCamera(lens, result, trusted, kept, args.model, hand_eye)


def _print(found: CalibratedCamera) -> None:
    lens, figures = found.lens, found.lens.calibration or {}
    open_ones = any(row[3] for row in found.parameter_rows())
    print_table(
        f'{lens.name}: {figures["observations"]} points in {figures["frames"]} frames, '
        f'rms {figures["rms_px"]:.4f} px',
        ('parameter', 'value', 'std. error', *(['with any target'] if open_ones else []), 'unit'),
        [(name, value, error, *([range_] if open_ones else []), unit)
         for name, value, error, range_, unit in found.parameter_rows()],
    )
    if open_ones:
        print('  with any target: 95 %, with shape, scale and boards of the target estimated too')
    print(f'  max_incidence_deg {np.degrees(lens.max_incidence):.2f}, image points up to '
          f'{np.degrees(found.result.reached):.2f}; {STANDARD_ERRORS}')
    if found.hand_eye:
        print_table(hand_eye_sentence(found.hand_eye), HEADER, hand_eye_rows(found.hand_eye))


def _document(found: CalibratedCamera) -> dict[str, Any]:
    """Return what scripts may want beside the lens itself; its errors are those of the lens."""
    adjusted = found.result.adjusted
    return {
        **(found.lens.calibration or {}),
        'left_out': found.result.left_out,
        'beyond': found.result.beyond,
        'sigma_px': found.result.sigma,
        'parameters': dict(
            zip(adjusted.names, parameter_values(adjusted.lens, adjusted.names), strict=True)
        ),
        'admissible': {name: asdict(range_) for name, range_ in found.trust.admissible.items()},
        'warnings': list(found.warnings),
    }


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(','))
