"""`fisheye-svp calibrate`: a lens from measured observations; of several cameras, the rig too."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from fisheye_svp_ros.commands.detect import (
    add_observation_arguments,
    image_sizes,
    note_side_by_side,
    read_input,
    search_options,
)
from fisheye_svp_ros.commands.lenses import add_port_arguments, load_with_notes, port_of
from fisheye_svp_ros.commands.notes import (
    count_text,
    note_copies,
    note_gross_errors,
    note_huge,
    note_reader_limit,
    say,
)
from fisheye_svp_ros.commands.outputs import output_file, output_path
from fisheye_svp_ros.errors import FisheyeSvpError, GeometryError, ParameterError
from fisheye_svp_ros.io.files import write_json, write_text, write_together
from fisheye_svp_ros.io.lens_files import save_lens
from fisheye_svp_ros.io.lens_formats import kalibr, transforms
from fisheye_svp_ros.io.readers import (
    Sizes,
    check_size_given,
    check_sizes,
    read_poses,
    sizes_beside,
)
from fisheye_svp_ros.io.rig_files import check_camera_names, save_rig
from fisheye_svp_ros.optics.curves import IMAGE_HEIGHTS
from fisheye_svp_ros.optics.lens import Lens, parameter_values
from fisheye_svp_ros.pose import quaternion_from_rotation
from fisheye_svp_ros.reporting.calibrated_camera import (
    ROBOT_HEADER,
    CalibratedCamera,
    hand_eye_rows,
)
from fisheye_svp_ros.reporting.terminal import print_table, progress, stages
from fisheye_svp_ros.reporting.wording.calibration import (
    ANY_TARGET,
    ANY_TARGET_NOTE,
    STANDARD_ERRORS,
    calibration_warnings,
    estimate_sentence,
    hand_eye_sentence,
)
from fisheye_svp_ros.scene.observations import Observations, list_frames, rig_cameras
from fisheye_svp_ros.scene.table_checks import check_frames_differ, remove_copies
from fisheye_svp_ros.solve.lens_calibration import (
    Calibration,
    calibrate,
    calibrate_hand_eye,
    calibrate_port,
    rough_lenses,
)
from fisheye_svp_ros.solve.measured_poses import posable_observations
from fisheye_svp_ros.solve.outliers import FRAME
from fisheye_svp_ros.solve.rig_calibration import (
    RigCalibration,
    calibrate_rig,
    connected_cameras,
)
from fisheye_svp_ros.solve.rig_checks import MAX_RIG_RATIO, MIN_SHARED_FRAMES


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
        help='image size, px; if the cameras differ, left=1280x960,right=640x480; '
        'not needed for photographs and for observations from `detect`',
    )
    parser.add_argument(
        '--free',
        type=_names,
        metavar='NAME,...',
        help='parameters to fit: f (or fx,fy), cx, cy, the coefficients of the '
        'model, of a viewpoint shift (e0,e1,e2 or '
        'thickness,refractive_index), of a port (port_medium_index, ...); '
        'default: all except the viewpoint shift; of a port, only its place',
    )
    add_port_arguments(parser)
    parser.add_argument(
        '--lens',
        metavar='AIR.yaml',
        type=Path,
        help='the same camera calibrated in air; with --medium or --port, only '
        'the place of the port is fitted',
    )
    parser.add_argument(
        '--poses',
        metavar='POSES.csv',
        help='poses of the robot flange that carries the camera, in the robot '
        'base; also fits the pose of the camera in the flange',
    )
    parser.add_argument(
        '--plain',
        action='store_true',
        help='write the least-squares estimate, which bends the lens to errors of the board',
    )
    parser.add_argument(
        '-o',
        '--output',
        type=output_path,
        metavar='LENS.yaml',
        help='lens file to write; covariances are written next to it as '
        '.calibrate.json, the report as .calibrate.html; for a rig, a '
        'folder: one lens per camera, calibration.html, rig.yaml, rig.json, '
        'rig.urdf, tf_static.yaml and camchain.yaml',
    )


def run(args: argparse.Namespace) -> None:
    """Calibrate, print the parameters, write the lens, or two lenses and the rig."""
    observations, sizes = read_input(args.observations, args)
    sizes = _known_sizes(args, observations, sizes)
    if not args.board:
        note_side_by_side(observations, sizes)
    check_frames_differ(observations)
    given, (observations, again) = observations, remove_copies(observations)
    note_copies(given, again)
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
        rig = _fit_rig(found, args.plain)
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
            if rig:
                write_rig(rig, args.output)
        report = (
            args.output / 'calibration.html'
            if len(paths) > 1
            else next(iter(paths.values())).with_suffix('.calibrate.html')
        )
        write_calibration_report(report, found, _next_command(args, paths))
    for one in found.values():
        _print(one)
        for warning in calibration_warnings(one):
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
    other = [name for name in args.image_size or {} if name and name not in observations.cameras]
    if other:
        held = ', '.join(filter(None, observations.cameras)) or 'one camera without a name'
        raise ParameterError(f'--image-size {other[0]}=...: the observations hold {held}')
    sizes = args.image_size or sizes or sizes_beside(Path(args.observations))
    if args.lens:
        air = load_with_notes(args.lens)
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


def _join_tables(tables: Sequence[Observations]) -> Observations:
    """Return the rows of several tables of the same cameras."""
    rows: dict[str, Any] = {
        name: np.concatenate([getattr(table, name) for table in tables])
        for name in ('frame', 'landmark', 'uv', 'xyz', 'camera', 'board', 't', 'sigma')
    }
    return replace(tables[0], **rows)


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


def _calibrate_camera(
    table: Observations, args: argparse.Namespace, size: tuple[int, int], name: str
) -> CalibratedCamera:
    """Return the lens, the rows that it is of, without outliers, and what may be trusted."""
    from fisheye_svp_ros.solve.robust_calibration import calibrate_without_outliers

    port = port_of(args)
    note_huge(table)
    air = load_with_notes(args.lens) if args.lens else None

    def fit_rows(rows: Observations) -> Calibration:
        if air and port:
            return calibrate_port(rows, air, port, args.free)
        return calibrate(rows, args.model, size, args.free, name, port)

    with progress('calibrating'):
        starts = () if air else rough_lenses(args.model, size)
        result, kept, gross = calibrate_without_outliers(table, fit_rows, starts)
    note_gross_errors(table, gross)
    hand_eye, poses = None, read_poses(args.poses).by_frame() if args.poses else None
    if poses:
        with progress('fitting the robot'):
            result, hand_eye = calibrate_hand_eye(result, kept, poses)
    known = [*result.adjusted.lens.parameters.items()][:4]
    values = ', '.join(f'{name} {value:.6g}' for name, value in known)
    try:  # the lens is there in a second, its errors take longer
        with stages(f'{values}; computing their standard errors'):
            from fisheye_svp_ros.study.trust import assess_lens, generalize, with_covariance

            trusted = assess_lens(kept, result.adjusted.lens, result.adjusted.names)
    except np.linalg.LinAlgError as cause:
        remedy = 'check --port and --medium' if port else 'add views from other sides'
        raise GeometryError(
            f'{table.source}: the fitted lens has no rays to some of the observed '
            f'points ({cause}); {remedy}'
        ) from cause
    plain = result.adjusted.lens
    if not args.plain:
        result = generalize(result, trusted)
        if poses:  # the transforms of the lens that is written
            result, hand_eye = calibrate_hand_eye(result, kept, poses, ())
    lens = with_covariance(result.adjusted.lens, trusted)
    return CalibratedCamera(
        lens,
        with_covariance(plain, trusted),
        result,
        trusted,
        kept,
        args.model,
        hand_eye,
        gross.landmarks,
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
    print(
        f'  image points reach {np.degrees(camera.result.reached):.2f} deg of max_incidence_deg '
        f'{np.degrees(lens.max_incidence):.2f}; {STANDARD_ERRORS}'
    )
    if camera.hand_eye:
        print_table(
            hand_eye_sentence(camera.hand_eye), ROBOT_HEADER, hand_eye_rows(camera.hand_eye)
        )


def _document(camera: CalibratedCamera) -> dict[str, Any]:
    """Return what scripts may want beside the lens itself; its errors are those of the lens."""
    adjusted = camera.result.adjusted
    return {
        **(camera.lens.calibration or {}),
        'left_out': camera.result.left_out,
        'beyond': camera.result.beyond,
        'sigma_px': camera.result.sigma,
        'wrong_landmarks': [landmark.to_dict() for landmark in camera.wrong_landmarks],
        'parameters': dict(
            zip(adjusted.names, parameter_values(adjusted.lens, adjusted.names), strict=True)
        ),
        'admissible': {name: asdict(range_) for name, range_ in camera.trust.admissible.items()},
        'warnings': list(calibration_warnings(camera)),
    }


def _fit_rig(found: Mapping[str, CalibratedCamera], plain: bool) -> RigCalibration | None:
    """Fit the rig, its lenses by least squares; unless plain, again with the generalized ones."""
    table = _join_tables([camera.table for camera in found.values()])
    rig = fit_rig(table, {name: camera.least_squares for name, camera in found.items()})
    if rig is None or plain:
        return rig
    known = {
        name: found[name].generalize(lens)
        for name, lens in zip(rig.cameras, rig.lenses, strict=True)
    }
    try:
        final = calibrate_rig(posable_observations(table, known)[0], known, rig.cameras)
    except FisheyeSvpError:
        return rig
    lenses = (replace(known[name], calibration=found[name].lens.calibration) for name in known)
    return final._replace(lenses=tuple(lenses), covariance=rig.covariance)


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(','))


def check_names(table: Observations, where: str) -> None:
    """Raise LensError for names of cameras that the files of their rig cannot hold."""
    largest = max(connected_cameras(table), key=len)
    check_camera_names(table.cameras, rig_cameras(largest) or largest, where)


def fit_rig(table: Observations, lenses: Mapping[str, Lens]) -> RigCalibration | None:
    """Fit the rig of the cameras that frames hold together; None, with a note why, for none."""
    try:
        table, _ = posable_observations(table, lenses)
        groups = connected_cameras(table)
        largest = max(groups, key=len)
        for group in groups:
            if group != largest:
                say(
                    f'rig: {" and ".join(group)} cannot be related to {", ".join(largest)}: no '
                    'frame shows the target in both; photograph it where two cameras see it, or '
                    'turn the rig while each sees a board of its own, and give simultaneous '
                    'photographs the same frame number'
                )
        if len(largest) < 2:
            return None
        calibration = calibrate_rig(table, lenses, rig_cameras(largest) or largest)
    except FisheyeSvpError as cause:
        say(f'rig: {cause}')
        return None
    for warning in _warnings(calibration, table, lenses):
        say(f'rig: {warning}')
    return calibration


def _warnings(
    found: RigCalibration, table: Observations, lenses: Mapping[str, Lens]
) -> Iterator[str]:
    """Yield what there is to say against a rig."""
    if found.left_out:
        yield f'left out: {list_frames(table, found.left_out)}: {FRAME}'
    if found.reason:
        yield found.reason
    own = max((lenses[name].calibration or {}).get('rms_px', np.inf) for name in found.cameras)
    if found.total_rms_px > MAX_RIG_RATIO * own:
        yield (
            f'rms {found.total_rms_px:.2f} px with a rigid rig, at most {own:.2f} px for each '
            'camera alone: the cameras moved, their photographs were not simultaneous, or a '
            'lens is wrong'
        )
    for name, shared in zip(found.cameras, found.shared.tolist(), strict=True):
        if shared < MIN_SHARED_FRAMES:
            one = shared == 1
            what = (
                f'relate{"s" if one else ""} {name} to the others'
                if len(found.cameras) > 2
                else 'is shared'
                if one
                else 'are shared'
            )
            yield (
                f'only {count_text(shared, "frame")} {what}, and it is assumed that all '
                'cameras saw one target; take more photographs of it with two cameras at once'
            )
            if len(found.cameras) == 2:
                return


def write_rig(calibration: RigCalibration, folder: Path) -> None:
    """Write a rig as tools read it, its lenses apart."""
    save_rig(calibration.steps(), folder / 'rig.yaml', calibration.cameras)
    turns = quaternion_from_rotation(calibration.rig.rotation)
    write_json(
        folder / 'rig.json',
        {  # cameras in the first one, with covariances
            'frame': calibration.cameras[0],
            'frames': len(calibration.frame),
            'sigma_px': calibration.sigma_px,
            'left_out': list(calibration.left_out),
            'cameras': {
                name: {
                    'position': calibration.rig.position[i].tolist(),
                    'quaternion': turns[i].tolist(),
                    'covariance': calibration.covariance[i - 1].tolist() if i else None,
                    'rms_px': float(calibration.rms_px[i]),
                    'frames': int(calibration.shared[i]),
                    'board': calibration.boards[i] if calibration.boards else 0,
                }
                for i, name in enumerate(calibration.cameras)
            },
        },
    )
    write_text(folder / 'rig.urdf', transforms.urdf_text(calibration.cameras, calibration.rig))
    write_text(
        folder / 'tf_static.yaml',
        transforms.static_transforms_text(calibration.cameras, calibration.rig),
    )
    try:
        write_text(
            folder / 'camchain.yaml', kalibr.write_chain(calibration.lenses, calibration.steps())
        )
        for lens in calibration.lenses:
            note_reader_limit(lens, 'kalibr')
    except FisheyeSvpError as cause:
        say(f'camchain.yaml of Kalibr is not written: {cause}')


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
