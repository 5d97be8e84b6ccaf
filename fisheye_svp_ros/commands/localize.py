"""`fisheye-svp localize`: a pose a frame from the image points of known landmarks.

Of one camera, of each of several, or with `--rig` of the first camera of a rig from all of them.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.commands.detect import (
    add_observation_arguments,
    note_side_by_side,
    read_input,
)
from fisheye_svp_ros.commands.lenses import add_lens_argument, lenses_of, load_lenses
from fisheye_svp_ros.commands.notes import (
    note_doubtful,
    note_extrapolated,
    note_gross_errors,
    note_left_out,
    note_mirrored,
    note_wrong_landmarks,
    say,
)
from fisheye_svp_ros.commands.outputs import add_output_folder
from fisheye_svp_ros.detect.patterns import LOOSE_TAGS
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.csv_files import write_columns
from fisheye_svp_ros.io.files import write_json, write_together
from fisheye_svp_ros.io.readers import check_sizes, write_poses
from fisheye_svp_ros.io.rig_files import load_cameras
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.reporting.terminal import noise_text, print_table, progress
from fisheye_svp_ros.reporting.wording.poses import second_pose_note
from fisheye_svp_ros.scene.observations import (
    Observations,
    frame_name,
    list_frames,
    photograph_column,
    photograph_entry,
)
from fisheye_svp_ros.solve.localization import sight
from fisheye_svp_ros.solve.measured_poses import MeasuredPoses, localize_measured, rms_px
from fisheye_svp_ros.solve.rig_localization import RigLocalization, localize_rig
from fisheye_svp_ros.solve.weak_geometry import is_ambiguous, pose_odds

_Parts = dict[str, dict[str, float]]  # root mean squares by quantity and part
_MAX_ROWS = 40  # frames in the table for people
_AXES = ('x', 'y', 'z', 'rx', 'ry', 'rz')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    add_observation_arguments(parser)
    add_lens_argument(parser)
    parser.add_argument(
        '--tag-map',
        metavar='TAGS.yaml',
        help='map of the loose tags in the photographs, with --board tags:36h11 or '
        'tags:36h11:160mm: from `map`, tags.yaml of apriltag_ros, or a field layout of WPILib',
    )
    parser.add_argument(
        '--model-error',
        action='store_true',
        help='include in the covariances the errors stated in the lens file: of '
        'its parameters and, by diagnose, unexplained; noise at least as measured',
    )
    parser.add_argument(
        '--rig',
        metavar='RIG',
        help='poses of the cameras of a rig: rig.yaml from `calibrate`, its '
        'folder, or a camchain; gives one pose per frame from all cameras, '
        'that of the first camera',
    )
    add_output_folder(
        parser,
        'folder to write localize.json, poses.csv, residuals.csv and '
        'covariance.csv to; for several cameras without --rig, one subfolder '
        'each',
    )


def run(args: argparse.Namespace) -> None:
    """Localize every frame, print the poses, write the results."""
    tags = _name_tag_map(args)
    given = load_lenses(args.lens)
    observations, sizes = read_input(args.observations, args)
    lenses = lenses_of(observations.cameras, given)
    check_sizes(args.observations, sizes, lenses)
    if not args.board:
        note_side_by_side(
            observations, {name: (one.width, one.height) for name, one in lenses.items()}
        )
    if args.rig:
        _localize_rig(observations, lenses, args)
        return
    for camera, (name, lens) in enumerate(lenses.items()):
        model, uncertainty = ForwardModel(lens), None
        table = observations.take(observations.camera == camera)
        with progress('localizing'):
            if args.model_error:
                from fisheye_svp_ros.diagnosis import LensErrors, pose_summary
                from fisheye_svp_ros.study.trust import localize_with_errors

                measured, parts = localize_with_errors(LensErrors.from_lens(lens), table)
                uncertainty = pose_summary(parts)
            else:
                measured = localize_measured(model, table, tags)
        note_extrapolated(name or 'image points', lens, measured.views.uv[measured.views.used])
        note_mirrored(name or 'image points', lens, table)
        title = ' '.join(filter(None, (args.observations, name)))
        _print(table, measured, uncertainty, title)
        note_wrong_landmarks(measured.landmarks)
        note_left_out(table, measured.left_out)
        note_doubtful(table, measured.views.frame.tolist(), measured.reasons)
        if frames := measured.views.frame[is_ambiguous(measured.result)].tolist():
            say(second_pose_note(list_frames(table, frames), len(frames)))
        if args.output:
            with write_together():
                _write(args.output / name, model, table, measured, uncertainty)


def _name_tag_map(args: argparse.Namespace) -> bool:
    """Add the map of tags to the board; say whether there are loose tags in photographs."""
    if args.tag_map:
        args.board = f'{args.board.rstrip(":")}:{args.tag_map}'
    return (args.board or '').startswith(f'{LOOSE_TAGS}:')


def _localize_rig(
    table: Observations, lenses: Mapping[str, Lens], args: argparse.Namespace
) -> None:
    """Localize every frame of a rig, print the poses of its first camera, write the results."""
    cameras, places = load_cameras(args.rig)
    with progress('localizing'):
        solution = localize_rig(table, lenses, cameras, places)
    for camera, (name, lens) in enumerate(lenses.items()):
        mine = table.take(table.camera == camera)
        note_extrapolated(name, lens, mine.uv)
        note_mirrored(name, lens, mine)
    note_left_out(table, solution.left_out)
    note_gross_errors(solution.table, solution.outliers)
    if solution.contradicted:
        say(f'{args.rig}: the relative poses of the cameras differ; calibrate the rig again')
    if args.output:
        with write_together():
            _write_rig(args.output, cameras, solution)
    _print_rig(table, cameras, solution)


def _print(
    table: Observations, measured: MeasuredPoses, uncertainty: _Parts | None, source: str
) -> None:
    views, residual = measured.views, measured.inlier_residual
    labels = [
        (frame_name(table, frame).removeprefix('frame '), str(count))
        for frame, count in zip(
            views.frame[:_MAX_ROWS].tolist(), views.used.sum(axis=1), strict=False
        )
    ]
    _print_poses(
        f'{source}: {int(views.used.sum())} points in {len(views.frame)} frames, '
        f'rms {rms_px(residual):.4f} px',
        labels,
        [rms_px(one) for one in residual[:_MAX_ROWS]],
        measured.result.pose,
        measured.result.covariance,
        noise_text(measured.sigma) if uncertainty is None else _parts_text(uncertainty),
    )


def _print_rig(
    table: Observations, cameras: tuple[str, ...], localization: RigLocalization
) -> None:
    data, labels, rms = localization.data, [], []
    for i, frame in enumerate(localization.frame[:_MAX_ROWS].tolist()):
        mine = data.frame_of == i
        names = [localization.table.cameras[camera] for camera in data.camera_of[mine]]
        labels.append((str(frame), ' '.join(names), str(int(data.views.used[mine].sum()))))
        rms.append(rms_px(localization.residual[mine]))
    _print_poses(
        f'{table.source}: {cameras[0]} in the world, from {int(data.views.used.sum())} points of '
        f'{len(localization.table.cameras)} cameras in {len(localization.frame)} frames, rms '
        f'{rms_px(localization.residual):.4f} px',
        labels,
        rms,
        localization.pose,
        localization.covariance,
        noise_text(localization.sigma),
    )


def _print_poses(
    title: str,
    labels: Sequence[tuple[str, ...]],
    rms: Sequence[float],
    pose: Pose,
    covariance: Array,
    errors: str,
) -> None:
    """Print poses (F,), the first with labels: frame, cameras of a rig, number of points."""
    worst = [
        np.sqrt(np.linalg.eigvalsh(covariance[:, part, part])[:, -1])
        for part in (slice(0, 3), slice(3, 6))
    ]
    rows = [
        (
            *label,
            f'{rms[i]:.4f}',
            *(f'{1000 * value:.3f}' for value in pose.position[i]),
            f'{1000 * worst[0][i]:.3f}',
            f'{np.degrees(worst[1][i]):.4f}',
        )
        for i, label in enumerate(labels)
    ]
    cameras = ('cameras',) if len(labels[0]) > 2 else ()
    print_table(
        title,
        (
            'frame',
            *cameras,
            'points',
            'rms px',
            'x mm',
            'y mm',
            'z mm',
            'std. error mm',
            'std. error deg',
        ),
        rows,
        words=cameras,
    )
    if more := len(pose.position) - len(rows):
        print(f'  and {more} more frames')
    print(f'  {errors}, largest over all directions')


def _parts_text(uncertainty: _Parts) -> str:
    by = uncertainty['position_m']
    shares = ', '.join(
        f'{words} {1000 * by[name]:.3g} mm'
        for name, words in (
            ('noise', 'noise'),
            ('parameters', 'parameters of the lens'),
            ('misfit', 'unexplained model error'),
        )
    )
    return f'standard errors with those of the lens (rms of positions: {shares})'


def _write_poses(
    folder: Path, table: Observations, frame: Index, pose: Pose, covariance: Array
) -> None:
    """Write poses (F,) and their covariances (F, 6, 6); table: whose photographs they are of."""
    photographs = photograph_column(table, frame)
    write_poses(folder / 'poses.csv', frame, pose, photographs)
    names = [f'{a}_{b}' for a in _AXES for b in _AXES]
    write_columns(
        folder / 'covariance.csv',
        {
            'frame': frame,
            **dict(zip(names, covariance.reshape(-1, 36).T, strict=True)),
            **photographs,
        },
    )


def _write(
    folder: Path,
    model: ForwardModel,
    table: Observations,
    measured: MeasuredPoses,
    uncertainty: _Parts | None,
) -> None:
    views, result = measured.views, measured.result
    _write_poses(folder, table, views.frame, result.pose, result.covariance)
    used = views.used
    frame = np.broadcast_to(views.frame[:, None], used.shape)
    theta, distance = sight(model, result.pose, views)
    write_columns(
        folder / 'residuals.csv',
        {
            'frame': frame[used],
            'landmark': views.landmark[used],
            'u': views.uv[used][:, 0],
            'v': views.uv[used][:, 1],
            'du': result.residual[used][:, 0],
            'dv': result.residual[used][:, 1],
            'theta': theta[used],
            'range': distance[used],
            **photograph_column(table, frame[used]),
        },
    )
    write_json(
        folder / 'localize.json',
        {
            'rms_px': rms_px(measured.inlier_residual),
            'frames': len(views.frame),
            'observations': int(used.sum()),
            'left_out': measured.left_out,
            'sigma_px': measured.sigma,
            'poses': [
                {
                    'frame': int(frame),
                    **photograph_entry(table, int(frame)),
                    'ambiguous': bool(second),
                    'odds': float(odds),
                }
                for frame, second, odds in zip(
                    views.frame, is_ambiguous(result), pose_odds(result), strict=True
                )
            ],
            'gross': [
                {
                    'frame': int(views.frame[i]),
                    **photograph_entry(table, int(views.frame[i])),
                    'landmark': int(views.landmark[i, j]),
                    'px': float(np.linalg.norm(result.residual[i, j])),
                }
                for i, j in np.argwhere(measured.gross)
            ],
            'wrong_landmarks': [landmark.to_dict() for landmark in measured.landmarks],
            'doubtful': [
                {'frame': int(frame), **photograph_entry(table, int(frame)), 'reason': reason}
                for frame, reason in zip(views.frame, measured.reasons, strict=True)
                if reason
            ],
            **({} if uncertainty is None else {'uncertainty': uncertainty}),
        },
    )


def _write_rig(folder: Path, cameras: tuple[str, ...], localization: RigLocalization) -> None:
    data, views, residual = localization.data, localization.data.views, localization.residual
    table, names = localization.table, localization.table.cameras
    _write_poses(folder, table, localization.frame, localization.pose, localization.covariance)
    used = views.used
    frame, camera = (
        np.broadcast_to(part[:, None], used.shape)[used] for part in (views.frame, data.camera_of)
    )
    write_columns(
        folder / 'residuals.csv',
        {
            'frame': frame,
            'camera': np.array(names)[camera],
            'landmark': views.landmark[used],
            'u': views.uv[used][:, 0],
            'v': views.uv[used][:, 1],
            'du': residual[used][:, 0],
            'dv': residual[used][:, 1],
            **photograph_column(table, frame, [names[one] for one in camera]),
        },
    )
    write_json(
        folder / 'localize.json',
        {
            'rms_px': rms_px(residual),
            'frames': len(localization.frame),
            'observations': int(used.sum()),
            'left_out': localization.left_out,
            'sigma_px': localization.sigma,
            'frame_id': cameras[0],
            'rig_contradicted': localization.contradicted,
            'cameras': {
                name: {
                    'rms_px': rms_px(residual[data.camera_of == i]),
                    'frames': int((data.camera_of == i).sum()),
                }
                for i, name in enumerate(localization.table.cameras)
            },
            'gross': [
                {
                    'frame': int(localization.table.frame[row]),
                    **photograph_entry(localization.table, int(localization.table.frame[row])),
                    'camera': localization.table.cameras[localization.table.camera[row]],
                    'landmark': int(localization.table.landmark[row]),
                    'px': float(px),
                    'why': why,
                }
                for row, px, why in zip(*localization.outliers[:3], strict=True)
            ],
            'wrong_landmarks': [
                landmark.to_dict() for landmark in localization.outliers.landmarks
            ],
        },
    )
