"""`fisheye-svp localize`: a pose a frame from the image points of known landmarks.

Of one camera, of each of several, or with `--rig` of the first camera of a rig from all of them.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.commands.detect import (
    add_observation_arguments,
    note_side_by_side,
    read_input,
    seconds,
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
from fisheye_svp_ros.detect.patterns import LOOSE_TAGS, parse_pattern
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.csv_files import write_columns
from fisheye_svp_ros.io.files import write_json, write_together
from fisheye_svp_ros.io.readers import check_sizes, write_poses
from fisheye_svp_ros.io.rig_files import load_cameras
from fisheye_svp_ros.io.tag_maps import TagMap, read_tag_map
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
from fisheye_svp_ros.solve.measured_poses import rms_px
from fisheye_svp_ros.solve.outliers import FAR_POINT
from fisheye_svp_ros.solve.solved_poses import SolvedPoses
from fisheye_svp_ros.solve.table_poses import solve_rig_table, solve_table
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
        'tags:36h11:160mm. Either from `map`, or tags.yaml of apriltag_ros, or a field '
        'layout of WPILib',
    )
    parser.add_argument(
        '--readout-time',
        type=seconds,
        default=0.0,
        metavar='TIME',
        help='longest time that a rolling shutter may take from the first row to the last, such '
        'as 30ms, if the lens does not model it. Needs times of frames (t)',
    )
    parser.add_argument(
        '--model-error',
        action='store_true',
        help='include the errors stated in the lens file in the covariances: those of its '
        'parameters and, if `diagnose` wrote it, the unexplained ones. The noise is at '
        'least the measured one',
    )
    parser.add_argument(
        '--rig',
        metavar='RIG',
        help='relative poses of the cameras of a rig: rig.yaml from `calibrate`, its folder, or '
        'a camchain. All cameras then give one pose per frame, that of the first camera',
    )
    add_output_folder(
        parser,
        'folder to write localize.json, poses.csv, residuals.csv, and covariance.csv to. '
        'Several cameras without --rig have one subfolder each',
    )


def run(args: argparse.Namespace) -> None:
    """Localize every frame, print the poses, write the results."""
    tags = _tag_map_of(args)
    given = load_lenses(args.lens)
    observations, sizes = read_input(args.observations, args)
    lenses = lenses_of(observations.cameras, given)
    check_sizes(args.observations, sizes, lenses)
    if not args.board:
        note_side_by_side(
            observations, {name: (one.width, one.height) for name, one in lenses.items()}
        )
    if args.rig:
        _localize_rig(observations, lenses, tags, args)
        return
    for camera, (name, lens) in enumerate(lenses.items()):
        uncertainty = None
        table = observations.take(observations.camera == camera)
        with progress('localizing'):
            if args.model_error:
                from fisheye_svp_ros.diagnosis import LensErrors, pose_summary
                from fisheye_svp_ros.study.trust import localize_with_errors

                solved, parts = localize_with_errors(
                    LensErrors.from_lens(lens), table, tags, readout_time=args.readout_time
                )
                uncertainty = pose_summary(parts)
            else:
                solved = solve_table(
                    table, ForwardModel(lens), tags, readout_time=args.readout_time
                )
        note_extrapolated(name or 'image points', lens, solved.views.uv[solved.views.used])
        note_mirrored(name or 'image points', lens, table)
        title = ' '.join(filter(None, (args.observations, name)))
        _print(table, solved, uncertainty, title)
        note_wrong_landmarks(solved.landmarks, tags is not None)
        _note_frames(table, solved)
        if args.output:
            with write_together():
                _write(args.output / name, table, solved, uncertainty)


def _tag_map_of(args: argparse.Namespace) -> TagMap | None:
    """Return the map of loose tags, and add it to the board of photographs."""
    if not args.board:
        return read_tag_map(args.tag_map) if args.tag_map else None
    if args.tag_map:
        args.board = f'{args.board.rstrip(":")}:{args.tag_map}'
    kind, *words = args.board.split(':')
    if kind != LOOSE_TAGS:
        return None
    from fisheye_svp_ros.detect.tags import tags_of_board  # with OpenCV, seldom

    parse_pattern(args.board)  # which says what is wrong with it
    return tags_of_board(args.board, words)


def _note_frames(table: Observations, solved: SolvedPoses) -> None:
    """Say which frames are left out, and whose poses should not be relied on."""
    note_left_out(table, solved.left_out)
    note_doubtful(table, solved.frame.tolist(), solved.reasons)
    if frames := solved.frame[is_ambiguous(solved.result)].tolist():
        say(second_pose_note(list_frames(table, frames), len(frames)))


def _localize_rig(
    table: Observations,
    lenses: Mapping[str, Lens],
    tags: TagMap | None,
    args: argparse.Namespace,
) -> None:
    """Localize every frame of a rig, print the poses of its first camera, write the results."""
    cameras, places = load_cameras(args.rig)
    with progress('localizing'):
        solved = solve_rig_table(
            table, lenses, cameras, places, tags, readout_time=args.readout_time
        )
    for camera, (name, lens) in enumerate(lenses.items()):
        mine = table.take(table.camera == camera)
        note_extrapolated(name, lens, mine.uv)
        note_mirrored(name, lens, mine)
    note_wrong_landmarks(solved.landmarks, tags is not None)
    if solved.rejected is not None:
        note_gross_errors(table, solved.rejected)
    _note_frames(table, solved)
    if solved.contradicted:
        say(f'{args.rig}: the relative poses of the cameras differ; calibrate the rig again')
    if args.output:
        with write_together():
            _write_rig(args.output, cameras, table, solved)
    _print_rig(table, cameras, solved)


def _print(
    table: Observations, solved: SolvedPoses, uncertainty: _Parts | None, source: str
) -> None:
    views, residual = solved.views, solved.residual
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
        solved.pose,
        solved.covariance,
        noise_text(solved.sigma) if uncertainty is None else _parts_text(uncertainty),
    )


def _print_rig(table: Observations, cameras: tuple[str, ...], solved: SolvedPoses) -> None:
    views, kept, labels = solved.views, solved.views.used & ~solved.outliers, []
    for frame, row, used in zip(views.frame[:_MAX_ROWS].tolist(), views.row, kept, strict=False):
        names = sorted({table.cameras[i] for i in table.camera[row[used]]}, key=cameras.index)
        labels.append((str(frame), ' '.join(names), str(int(used.sum()))))
    seen = np.unique(table.camera[views.row[kept]])
    _print_poses(
        f'{table.source}: {cameras[0]} in the world, from {int(kept.sum())} points of '
        f'{len(seen)} cameras in {len(views.frame)} frames, rms '
        f'{rms_px(solved.residual):.4f} px',
        labels,
        [rms_px(one) for one in solved.residual[:_MAX_ROWS]],
        solved.pose,
        solved.covariance,
        noise_text(solved.sigma),
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
    print(f'  Standard errors are the largest over all directions. {errors}.')


def _parts_text(uncertainty: _Parts) -> str:
    by = uncertainty['position_m']
    shares = ', '.join(
        f'{1000 * by[name]:.2g} mm from {words}'
        for name, words in (
            ('noise', 'noise'),
            ('parameters', 'the parameters of the lens'),
            ('misfit', 'unexplained model error'),
        )
    )
    return f'Rms of positions: {shares}'


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
    folder: Path, table: Observations, solved: SolvedPoses, uncertainty: _Parts | None
) -> None:
    views, result = solved.views, solved.result
    _write_poses(folder, table, views.frame, result.pose, result.covariance)
    used = views.used
    frame = np.broadcast_to(views.frame[:, None], used.shape)
    theta, distance = sight(solved.model, result.pose, views)
    write_columns(
        folder / 'residuals.csv',
        {
            'frame': frame[used],
            **_residual_columns(solved, used),
            'theta': theta[used],
            'range': distance[used],
            **photograph_column(table, frame[used]),
        },
    )
    write_json(
        folder / 'localize.json',
        {
            **_summary(table, solved),
            'observations': int(used.sum()),
            'gross': [
                {
                    'frame': int(views.frame[i]),
                    **photograph_entry(table, int(views.frame[i])),
                    'landmark': int(views.landmark[i, j]),
                    'px': float(np.linalg.norm(result.residual[i, j])),
                }
                for i, j in np.argwhere(solved.outliers)
            ],
            **({} if uncertainty is None else {'uncertainty': uncertainty}),
        },
    )


def _residual_columns(solved: SolvedPoses, shown: Mask) -> dict[str, Array | Index]:
    (u, v), (du, dv) = solved.views.uv[shown].T, solved.result.residual[shown].T
    return {'landmark': solved.views.landmark[shown], 'u': u, 'v': v, 'du': du, 'dv': dv}


def _summary(table: Observations, solved: SolvedPoses) -> dict[str, Any]:
    """Return what localize.json holds of one camera and of a rig."""
    return {
        'rms_px': rms_px(solved.residual),
        'frames': len(solved.frame),
        'left_out': solved.left_out,
        'sigma_px': solved.sigma,
        'poses': [
            {
                'frame': int(frame),
                **photograph_entry(table, int(frame)),
                'ambiguous': bool(second),
                'odds': float(odds),
            }
            for frame, second, odds in zip(
                solved.frame, is_ambiguous(solved.result), pose_odds(solved.result), strict=True
            )
        ],
        'wrong_landmarks': [landmark.to_dict() for landmark in solved.landmarks],
        'doubtful': [
            {'frame': int(frame), **photograph_entry(table, int(frame)), 'reason': reason}
            for frame, reason in zip(solved.frame, solved.reasons, strict=True)
            if reason
        ],
    }


def _write_rig(
    folder: Path, cameras: tuple[str, ...], table: Observations, solved: SolvedPoses
) -> None:
    views, residual = solved.views, solved.residual
    _write_poses(folder, table, views.frame, solved.pose, solved.covariance)
    kept = views.used & ~solved.outliers
    row, names = views.row[kept], np.array(table.cameras)
    frame, camera = table.frame[row], table.camera[row]
    write_columns(
        folder / 'residuals.csv',
        {
            'frame': frame,
            'camera': names[camera],
            **_residual_columns(solved, kept),
            **photograph_column(table, frame, names[camera].tolist()),
        },
    )
    write_json(
        folder / 'localize.json',
        {
            **_summary(table, solved),
            'observations': int(kept.sum()),
            'frame_id': cameras[0],
            'rig_contradicted': solved.contradicted,
            'cameras': {
                str(names[i]): {
                    'rms_px': rms_px(residual[kept][camera == i]),
                    'frames': len(np.unique(frame[camera == i])),
                }
                for i in np.unique(camera)
            },
            'gross': [
                {
                    'frame': int(table.frame[row]),
                    **photograph_entry(table, int(table.frame[row])),
                    'camera': table.cameras[table.camera[row]],
                    'landmark': int(table.landmark[row]),
                    'px': px,
                    'why': why,
                }
                for row, px, why in _rig_outliers(solved)
            ],
        },
    )


def _rig_outliers(solved: SolvedPoses) -> Iterator[tuple[int, float, str]]:
    """Yield the rows of the outliers of a rig, how far off they are, px, and why they are some."""
    known = set[int]()
    if solved.rejected is not None:
        known |= set(solved.rejected.rows.tolist())
        rows, px, why = solved.rejected[:3]
        yield from zip(rows.tolist(), px.tolist(), why, strict=True)
    views = solved.views
    wrong = [landmark.number for landmark in solved.landmarks]
    for i, j in np.argwhere(solved.outliers & ~np.isin(views.landmark, wrong)):
        if (row := int(views.row[i, j])) not in known:
            yield row, float(np.linalg.norm(solved.result.residual[i, j])), FAR_POINT
