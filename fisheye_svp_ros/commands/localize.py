"""`fisheye-svp localize`: a pose a frame from the image points of known landmarks."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from fisheye_svp_ros.commands.lenses import add_lens_argument, lenses_of, load_lenses
from fisheye_svp_ros.commands.localize_rig import AXES, MAX_TABLE_ROWS, localize_cameras
from fisheye_svp_ros.commands.notes import note_doubtful, note_left_out
from fisheye_svp_ros.commands.outputs import output_folder
from fisheye_svp_ros.commands.photographs import add_observation_arguments
from fisheye_svp_ros.commands.photographs import read_input as read
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io.csv_table import write_table
from fisheye_svp_ros.io.detect_files import check_sizes
from fisheye_svp_ros.io.files import write_json, write_together
from fisheye_svp_ros.io.readers import write_poses
from fisheye_svp_ros.reporting.progress import progress
from fisheye_svp_ros.reporting.tables import noise_text, print_table
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.scene.photograph_names import frame_name, photograph_entry
from fisheye_svp_ros.solve.localization import sight
from fisheye_svp_ros.solve.measured_poses import MeasuredPoses, localize_measured, rms_px

_Parts = dict[str, dict[str, float]]  # root mean squares by quantity and part


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    add_observation_arguments(parser)
    add_lens_argument(parser)
    parser.add_argument('--model-error', action='store_true',
                        help='include in the covariances the errors stated in the lens file: of '
                        'its parameters, and unexplained (extended_lens.yaml)')
    parser.add_argument('--rig', metavar='RIG',
                        help='poses of the cameras of a rig: rig.yaml from `calibrate`, its '
                        'folder, or a camchain; gives one pose per frame from all cameras, '
                        'that of the first camera')
    parser.add_argument('-o', '--output', type=output_folder, metavar='DIR',
                        help='folder to write localize.json, poses.csv, residuals.csv and '
                        'covariance.csv to; for several cameras without --rig, one subfolder '
                        'each')


def run(args: argparse.Namespace) -> None:
    """Localize every frame, print the poses, write the results."""
    if args.rig and args.model_error:
        raise ParameterError('--model-error works for one camera at a time; leave --rig out')
    given = load_lenses(args.lens)
    observations, sizes = read(args.observations, args)
    lenses = lenses_of(observations.cameras, given)
    check_sizes(args.observations, sizes, lenses)
    if args.rig:
        localize_cameras(observations, lenses, args.rig, args.output)
        return
    for camera, (name, lens) in enumerate(lenses.items()):
        model, uncertainty = ForwardModel(lens), None
        table = observations.take(observations.camera == camera)
        with progress('localizing'):
            if args.model_error:
                from fisheye_svp_ros.diagnosis import LensErrors, pose_summary
                from fisheye_svp_ros.study.pose_errors import localize_with_errors

                measured, parts = localize_with_errors(LensErrors.from_lens(lens), table)
                uncertainty = pose_summary(parts)
            else:
                measured = localize_measured(model, table)
        title = ' '.join(filter(None, (args.observations, name)))
        _print(table, measured, uncertainty, title)
        note_left_out(table, measured.left_out)
        note_doubtful(table, measured.views.frame.tolist(), measured.reasons)
        if args.output:
            with write_together():
                _write(args.output / name, model, table, measured, uncertainty)


def _print(
    table: Observations, measured: MeasuredPoses, uncertainty: _Parts | None, source: str
) -> None:
    views, result = measured.views, measured.result
    worst = [
        np.sqrt(np.linalg.eigvalsh(result.covariance[:, part, part])[:, -1])
        for part in (slice(0, 3), slice(3, 6))
    ]
    rows = []
    for i, frame in enumerate(views.frame[:MAX_TABLE_ROWS]):
        place = (f'{1000 * value:.3f}' for value in result.pose.position[i])
        rows.append((
            _frame_label(table, int(frame)), str(int(views.used[i].sum())),
            f'{rms_px(measured.inlier_residual[i]):.4f}', *place,
            f'{1000 * worst[0][i]:.3f}', f'{np.degrees(worst[1][i]):.4f}',
        ))
    header = ('frame', 'points', 'rms px', 'x mm', 'y mm', 'z mm', 'std. error mm',
              'std. error deg')
    print_table(
        f'{source}: {int(views.used.sum())} points in {len(views.frame)} frames, '
        f'rms {rms_px(measured.inlier_residual):.4f} px',
        header, rows,
    )
    if len(views.frame) > MAX_TABLE_ROWS:
        print(f'  and {len(views.frame) - MAX_TABLE_ROWS} more frames')
    said = noise_text(measured.sigma) if uncertainty is None else _parts_text(uncertainty)
    print(f'  {said}, largest over all directions')


def _frame_label(table: Observations, frame: int) -> str:
    """Return the photograph's name, or the number of a frame without one."""
    return frame_name(table, frame).removeprefix('frame ')


def _parts_text(uncertainty: _Parts) -> str:
    by = uncertainty['position_m']
    shares = ', '.join(f'{words} {1000 * by[name]:.3g} mm' for name, words in (
        ('noise', 'noise'), ('parameters', 'parameters of the lens'),
        ('misfit', 'unexplained model error')))
    return f'standard errors with those of the lens (rms of positions: {shares})'


def _write(
    folder: Path, model: ForwardModel, table: Observations, measured: MeasuredPoses,
    uncertainty: _Parts | None,
) -> None:
    views, result = measured.views, measured.result
    write_poses(folder / 'poses.csv', views.frame, result.pose)
    used = views.used
    frame = np.broadcast_to(views.frame[:, None], used.shape)
    theta, distance = sight(model, result.pose, views)
    write_table(folder / 'residuals.csv', {
        'frame': frame[used], 'landmark': views.landmark[used],
        'u': views.uv[used][:, 0], 'v': views.uv[used][:, 1],
        'du': result.residual[used][:, 0], 'dv': result.residual[used][:, 1],
        'theta': theta[used], 'range': distance[used],
    })
    names = [f'{a}_{b}' for a in AXES for b in AXES]
    entries = result.covariance.reshape(-1, 36).T
    write_table(
        folder / 'covariance.csv',
        {'frame': views.frame, **dict(zip(names, entries, strict=True))},
    )
    write_json(folder / 'localize.json', {
        'rms_px': rms_px(measured.inlier_residual),
        'frames': len(views.frame),
        'observations': int(used.sum()),
        'left_out': measured.left_out,
        'sigma_px': measured.sigma,
        'gross': [
            {'frame': int(views.frame[i]), **photograph_entry(table, int(views.frame[i])),
             'landmark': int(views.landmark[i, j]),
             'px': float(np.linalg.norm(result.residual[i, j]))}
            for i, j in np.argwhere(measured.gross)
        ],
        'doubtful': [
            {'frame': int(frame), **photograph_entry(table, int(frame)), 'reason': reason}
            for frame, reason in zip(views.frame, measured.reasons, strict=True) if reason
        ],
        **({} if uncertainty is None else {'uncertainty': uncertainty}),
    })
