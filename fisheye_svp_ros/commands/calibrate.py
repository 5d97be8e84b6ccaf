"""`fisheye-svp calibrate`: a lens from measured observations; of several cameras, the rig too."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from fisheye_svp_ros.commands.detect import (
    add_observation_arguments,
    image_sizes,
    note_side_by_side,
    read_input,
    search_options,
)
from fisheye_svp_ros.commands.lenses import add_port_arguments, load_with_notes, port_of
from fisheye_svp_ros.commands.notes import note_copies, note_gross_errors, note_huge, say
from fisheye_svp_ros.commands.outputs import output_file, output_path
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io.readers import (
    Sizes,
    check_size_given,
    check_sizes,
    read_poses,
    sizes_beside,
)
from fisheye_svp_ros.io.rig_files import check_camera_names
from fisheye_svp_ros.library.calibration import LensOptions, calibrate_cameras
from fisheye_svp_ros.optics.curves import IMAGE_HEIGHTS
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.reporting.calibrated_camera import (
    ROBOT_HEADER,
    CalibratedCamera,
    hand_eye_rows,
)
from fisheye_svp_ros.reporting.terminal import print_table, stages
from fisheye_svp_ros.reporting.wording.calibration import (
    ANY_TARGET,
    ANY_TARGET_NOTE,
    STANDARD_ERRORS,
    calibration_warnings,
    estimate_sentence,
    hand_eye_sentence,
    reached_sentence,
)
from fisheye_svp_ros.scene.observations import Observations, rig_cameras
from fisheye_svp_ros.solve.rig_calibration import RigCalibration, connected_cameras


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    add_observation_arguments(parser)
    parser.add_argument(
        '--model',
        default='kannala_brandt',
        choices=IMAGE_HEIGHTS,
        metavar='MODEL',
        help='image-height curve: ' + ', '.join(IMAGE_HEIGHTS) + '; default: kannala_brandt',
    )
    parser.add_argument(
        '--image-size',
        type=image_sizes,
        metavar='WxH',
        help='image size, px. If the cameras differ: left=1280x960,right=640x480. Not needed '
        'for photographs and for observations from `detect`',
    )
    parser.add_argument(
        '--free',
        type=_names,
        metavar='NAME,...',
        help='parameters to fit: f (or fx,fy), cx, cy, and coefficients of the model. Of a '
        'viewpoint shift: e0,e1,e2 or thickness,refractive_index. Of a port: '
        'port_medium_index, ... Default: all except the viewpoint shift; of a port, only '
        'its position',
    )
    add_port_arguments(parser)
    parser.add_argument(
        '--lens',
        metavar='AIR.yaml',
        type=Path,
        help='the lens file of the same camera calibrated in air. With --medium or --port, only '
        'the position of the port is then fitted',
    )
    parser.add_argument(
        '--poses',
        metavar='POSES.csv',
        help='poses of the robot flange that carries the camera, in the robot base. The pose of '
        'the camera in the flange is then fitted, too',
    )
    parser.add_argument(
        '--plain',
        action='store_true',
        help='write the plain least-squares estimate, which absorbs board errors into the lens',
    )
    parser.add_argument(
        '-o',
        '--output',
        type=output_path,
        metavar='LENS.yaml',
        help='lens file to write. Covariances are written next to it as .calibrate.json, and '
        'the report as .calibrate.html. For a rig, a folder: one lens per camera, '
        'calibration.html, rig.yaml, rig.json, rig.urdf, tf_static.yaml, and camchain.yaml',
    )


def run(args: argparse.Namespace) -> None:
    """Calibrate, print the parameters, write the lens, or several lenses and the rig."""
    observations, sizes = read_input(args.observations, args)
    air = load_with_notes(args.lens) if args.lens else None
    sizes = _known_sizes(args, observations, sizes, air)
    if not args.board:
        note_side_by_side(observations, sizes)
    if args.output:
        _check_output(args, observations)
    options = LensOptions(
        args.model,
        args.free,
        port_of(args),
        air,
        read_poses(args.poses).by_frame() if args.poses else None,
        args.plain,
    )
    name = args.output.stem if args.output else args.model
    note_huge(observations)
    with stages('calibrating') as show:
        found = calibrate_cameras(observations, sizes, options, {'': name}, show)
    note_copies(observations, found.copies)
    table = found.observations
    for number, camera in enumerate(found.cameras.values()):
        note_gross_errors(table.take(table.camera == number), camera.outliers)
    for note in found.notes:
        say(f'rig: {note}')
    if args.output:  # before a word is printed: nobody may be reading
        paths = found.paths(args.output)
        report, notes = found.save(args.output, _next_command(args, paths))
        for note in notes:
            say(note)
    for camera in found.cameras.values():
        _print(camera)
        for warning in calibration_warnings(camera):
            say(warning)
    if args.output:
        print(f'{", ".join(map(str, paths.values()))}; report: {report}')
    if found.rig:
        print_rig(found.rig)


def _known_sizes(
    args: argparse.Namespace, observations: Observations, sizes: Sizes, air: Lens | None
) -> Sizes:
    """Return the image size of each camera: given, of the photographs, or that of `--lens`.

    Raises ParameterError where one is unknown, or another one than `detect` found.
    """
    check_size_given(args.observations, sizes, args.image_size or {}, '--image-size')
    other = [name for name in args.image_size or {} if name and name not in observations.cameras]
    if other:
        held = ', '.join(filter(None, observations.cameras)) or 'one camera without a name'
        raise ParameterError(f'--image-size {other[0]}=...: the observations hold {held}')
    sizes = args.image_size or sizes or sizes_beside(Path(args.observations))
    if air:
        check_sizes(args.observations, sizes, {'': air})
        return {'': (air.width, air.height)}
    unknown = [name for name in observations.cameras if not {name, ''} & set(sizes)]
    if unknown:
        head = f'{unknown[0]}=' if unknown[0] and sizes else ''
        seen = observations.camera == list(observations.cameras).index(unknown[0])
        width, height = np.ceil(observations.uv[seen].max(axis=0)).astype(int)
        raise ParameterError(
            f'{args.observations}: the image size is unknown; points reach {width} px to the '
            f'right and {height} px down; add --image-size {head}WIDTHxHEIGHT, that of your images'
        )
    return sizes


def _check_output(args: argparse.Namespace, table: Observations) -> None:
    """Raise FisheyeSvpError where the lens of a camera, or those of several, cannot be written."""
    if not table.cameras[0]:
        output_file(str(args.output))
    if len(table.cameras) == 1:
        return
    if args.output.suffix in ('.yaml', '.yml'):
        raise ParameterError(
            f'-o {args.output}: the lenses of {", ".join(table.cameras)} and '
            'their rig are written to a folder; use -o '
            f'{args.output.with_suffix("")}'
        )
    check_names(table, args.observations)


def _next_command(args: argparse.Namespace, paths: Mapping[str, Path]) -> str:
    """Return the command that says what is wrong with the lenses, as a shell takes it."""
    lenses = [
        word
        for camera, path in paths.items()
        for word in ('--lens', f'{camera}={path}' if len(paths) > 1 else str(path))
    ]
    search = search_options(args) if args.board else ()
    return shlex.join(
        ['fisheye-svp', 'diagnose', args.observations, *search, *lenses, '-o', 'diagnosis']
    )


def _print(camera: CalibratedCamera) -> None:
    lens, figures = camera.lens, camera.lens.calibration or {}
    open_ones = any(row[3] for row in camera.parameter_rows())
    print_table(
        f'{lens.name}: {figures["observations"]} points in {figures["frames"]} frames, '
        f'rms {figures["rms_px"]:.4f} px',
        ('parameter', 'value', 'std. error', *([ANY_TARGET] if open_ones else []), 'unit'),
        [
            (name, value, error, *([range_] if open_ones else []), unit)
            for name, value, error, range_, unit in camera.parameter_rows()
        ],
    )
    if sentence := estimate_sentence(figures):
        print(f'  {sentence}')
    if open_ones:
        print(f'  {ANY_TARGET_NOTE}')
    print(f'  {reached_sentence(camera.result.reached, lens.max_incidence)}')
    print(f'  {STANDARD_ERRORS}')
    if camera.hand_eye:
        print_table(
            hand_eye_sentence(camera.hand_eye), ROBOT_HEADER, hand_eye_rows(camera.hand_eye)
        )


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(','))


def check_names(table: Observations, where: str) -> None:
    """Raise LensError for names of cameras that the files of their rig cannot hold."""
    largest = max(connected_cameras(table), key=len)
    check_camera_names(table.cameras, rig_cameras(largest) or largest, where)


def print_rig(calibration: RigCalibration) -> None:
    """Print a rig."""
    if len(calibration.cameras) == 2:
        x, y, z = 1000 * calibration.steps()[0].position
        print(
            f'rig: camera {calibration.cameras[0]} in {calibration.cameras[1]} at {x:.3f}, '
            f'{y:.3f}, {z:.3f} mm, from {len(calibration.frame)} frames, '
            f'rms {calibration.total_rms_px:.4f} px'
        )
    if calibration.boards:
        each = [
            ' and '.join(
                name
                for name, board in zip(calibration.cameras, calibration.boards, strict=True)
                if board == one
            )
            for one in sorted(set(calibration.boards))
        ]
        print(
            'rig: boards apart, related by the motion of the rig: one seen by '
            f'{", another by ".join(each)}'
        )
    sigma = np.sqrt(np.diagonal(calibration.covariance, axis1=1, axis2=2))
    rows = []
    for i, name in enumerate(calibration.cameras):
        place = [f'{1e3 * value:.3f}' for value in calibration.rig.position[i]]
        error = (
            (f'{1e3 * sigma[i - 1, :3].max():.3f}', f'{np.degrees(sigma[i - 1, 3:].max()):.4f}')
            if i
            else ('', '')
        )
        rows.append(
            (name, *place, *error, str(calibration.shared[i]), f'{calibration.rms_px[i]:.4f}')
        )
    print_table(
        f'rig: cameras in {calibration.cameras[0]}, from {len(calibration.frame)} frames that '
        'several cameras see',
        ('camera', 'x, mm', 'y, mm', 'z, mm', '±, mm', '±, deg', 'frames', 'rms, px'),
        rows,
    )
