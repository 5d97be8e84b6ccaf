"""`fisheye-svp render`: photographs of chessboards through a lens, and the truth about them."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.commands.lenses import load_with_notes
from fisheye_svp_ros.commands.notes import say
from fisheye_svp_ros.commands.outputs import add_output_folder
from fisheye_svp_ros.detect.patterns import parse_pattern
from fisheye_svp_ros.errors import GeometryError, LensError, ParameterError
from fisheye_svp_ros.io.files import keep_existing, write_together
from fisheye_svp_ros.io.image_files import write_png
from fisheye_svp_ros.io.lens_files import cameras_in
from fisheye_svp_ros.io.paths import visible_paths
from fisheye_svp_ros.io.readers import read_poses, write_observations, write_poses
from fisheye_svp_ros.io.rig_files import cameras_in_first, rigs_of_lenses
from fisheye_svp_ros.io.share import typed_lens_path
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, identity
from fisheye_svp_ros.reporting.terminal import progress
from fisheye_svp_ros.scene.observations import make_observations
from fisheye_svp_ros.simulate.render import BoardPose, Exposure, Field, Print, pixel_rays, render
from fisheye_svp_ros.simulate.targets import TARGETS, board, board_views, target_views, visible

Cameras = Mapping[str, tuple[Lens, Pose]]  # lens of each camera, and the camera in the first one
Ranges = tuple[float, float]  # nearest and furthest, m
_COUNT, _MAX_COUNT = 30, 100_000
_RANGES, _MAX_RANGE = (0.12, 0.35), 1e4  # m
_MIN_SIZE = 10.0  # px of the corners in sight; in millimetres, poses are a thousand times too far


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument(
        '--lens',
        required=True,
        metavar='LENS',
        help='lens file, or the name of a lens of this package; for a rig, a '
        'folder or file with its lenses and their relative poses',
    )
    parser.add_argument(
        '--board',
        required=True,
        metavar='SPEC',
        help='the board: chessboard:9x6:25mm (inner corners)',
    )
    parser.add_argument(
        '--target',
        choices=('board', 'cube', 'room'),
        default='board',
        help='one board, or six boards: on the faces of a cube, or on the walls of a room',
    )
    add_output_folder(
        parser,
        'folder to write the photographs (of a rig, one subfolder per camera), '
        'observations.csv (the true corners), and poses.csv to',
        required=True,
    )
    parser.add_argument(
        '--poses',
        metavar='POSES.csv',
        help='poses of the camera (of a rig, the first one) in the frame of the board or '
        'target. Default: random',
    )
    parser.add_argument(
        '--count',
        type=int,
        metavar='N',
        help='number of photographs from random poses; default: 30',
    )
    parser.add_argument(
        '--ranges',
        type=float,
        nargs=2,
        metavar='M',
        help='nearest and farthest distance of random poses, m (of a cube: to its center). '
        'Default: 0.12 0.35',
    )
    parser.add_argument(
        '--bow',
        type=float,
        default=0.0,
        metavar='MM',
        help='height of the middle of the board above its ends, mm',
    )
    parser.add_argument(
        '--blur', type=float, default=0.6, metavar='PX', help='blur of the lens, px; default: 0.6'
    )
    parser.add_argument(
        '--noise',
        type=float,
        default=1.5,
        metavar='LEVELS',
        help='noise of a pixel, gray levels of 255; default: 1.5',
    )
    parser.add_argument('--seed', type=int, default=0, help='seed of poses and noise; default: 0')


def run(args: argparse.Namespace) -> None:
    """Render the photographs, write them and the truth."""
    pattern = parse_pattern(args.board)
    if pattern.kind != 'chessboard':
        raise ParameterError(f'--board {args.board}: only chessboards can be rendered')
    count, ranges = _of_random_poses(args)
    if args.seed < 0 or not abs(args.bow) < np.inf:
        raise ParameterError('--seed must not be below 0, --bow finite')
    exposure = Exposure(blur=args.blur, noise=args.noise)
    cameras, rng = _cameras(args.lens), np.random.default_rng(args.seed)
    printed = Print(pattern.columns, pattern.rows, pattern.size)
    if args.bow:
        printed = Print(
            pattern.columns,
            pattern.rows,
            pattern.size,
            bow=parabola(printed.corners, 1e-3 * args.bow),
        )
    boards = TARGETS.get(args.target, board)(printed)
    if args.poses:
        poses = _read_poses(args.poses, cameras, boards)
    else:
        poses = _random_poses(cameras, boards, args.target, count, ranges, rng)
    with keep_existing(), write_together():
        count = write_photographs(
            cameras,
            boards,
            poses,
            exposure,
            args.seed,
            args.output,
            args.output,
        )
    others = (
        sum(len(visible_paths((args.output / name).glob('*.png'))) for name in cameras) - count
    )
    if others:
        say(f'{args.output}: {others} other photographs are in it too; `detect` takes them all')
    print(
        f'{args.output}: {count} photographs, observations.csv with their true corners, poses.csv'
    )


def _of_random_poses(args: argparse.Namespace) -> tuple[int, Ranges]:
    """Return number and ranges of random poses; raise ParameterError where nothing has them."""
    count = _COUNT if args.count is None else args.count
    near, far = args.ranges or _RANGES
    if not 1 <= count <= _MAX_COUNT or not 0 < near <= far <= _MAX_RANGE:
        raise ParameterError(
            f'--count must be 1 to {_MAX_COUNT}, --ranges two distances above 0, at most '
            f'{_MAX_RANGE:g} m, the nearer first'
        )
    return count, (near, far)


def _cameras(given: str) -> Cameras:
    """Return lens and place of each camera, the first being that of the poses."""
    path = typed_lens_path(given)
    names = cameras_in(path)
    rigs = rigs_of_lenses(path) if names else ()
    if not names:
        return {'': (load_with_notes(path), identity())}
    if len(rigs) + 1 != len(names):
        raise LensError(
            f'{path}: it holds {", ".join(names)} but not their relative poses; add '
            f'rig.yaml, or name one camera, {path}#{names[0]}'
        )
    places = cameras_in_first(rigs)
    return {
        name: (load_with_notes(f'{path}#{name}'), places.take(i)) for i, name in enumerate(names)
    }


def _read_poses(path: str, cameras: Cameras, boards: tuple[BoardPose, ...]) -> Pose:
    """Return poses (P,) of a file; raise GeometryError where no photograph would show a board."""
    poses = read_poses(path).pose
    for i in range(len(poses.position)):
        for lens, place in cameras.values():
            uv, seen = visible(lens, boards, poses.take(i).compose(place))
            if seen.any() and np.ptp(uv[seen], axis=0).max() > _MIN_SIZE:
                return poses
    nearest = np.linalg.norm(poses.position, axis=-1).min()
    raise GeometryError(
        f'{path}: from each of its poses, the target is smaller than {_MIN_SIZE:g} px. The '
        f'nearest pose is {nearest:.3g} m from the origin. Give poses of the camera in the frame '
        'of the target, in m'
    )


def _random_poses(
    cameras: Cameras,
    boards: tuple[BoardPose, ...],
    target: str,
    count: int,
    ranges: Ranges,
    rng: np.random.Generator,
) -> Pose:
    """Return poses (P,) of the first camera; the cameras of a rig look at the target in turn."""
    poses = identity(count)
    for number, (lens, place) in enumerate([*cameras.values()][:count]):
        mine = np.arange(number, count, len(cameras))
        if len(boards) > 1:
            own = target_views(lens, target, boards, len(mine), ranges, rng)
        else:
            own = board_views(lens, boards[0].printed, len(mine), ranges, rng)
        poses.put(mine, own.compose(place.inverse().broadcast_to(len(mine))))
    return poses


def parabola(corners: Array, height: float) -> Field:
    """Return a board's height, m: a parabola across its longer side, `height` from end to top."""
    low, high = corners[:, :2].min(axis=0), corners[:, :2].max(axis=0)
    longer = int(np.argmax(high - low))
    middle, half = (low + high)[longer] / 2, (high - low)[longer] / 2
    return lambda place: np.asarray(height * ((place[..., longer] - middle) / half) ** 2)


def write_photographs(
    cameras: Cameras,
    boards: tuple[BoardPose, ...],
    poses: Pose,
    exposure: Exposure,
    seed: int,
    folder: Path,
    truth: Path,
) -> int:
    """Write photographs from poses (P,) of the first camera, and the truth; return how many.

    Of a rig each camera has a folder; one that sees nothing of the target takes no photograph.
    truth: folder for the true corners, observations.csv, and poses.csv.
    """
    count = len(poses.position)
    uv, seen = (
        np.stack(part)
        for part in zip(
            *(
                visible(lens, boards, poses.take(frame).compose(place))
                for frame in range(count)
                for lens, place in cameras.values()
            ),
            strict=True,
        )
    )
    in_sight = np.asarray(seen.reshape(count, len(cameras), -1).any(axis=-1))
    if len(cameras) == 1:
        in_sight[:] = True
    with progress('rendering', int(in_sight.sum())) as done:
        for camera, (name, (lens, place)) in enumerate(cameras.items()):
            rays = pixel_rays(lens)
            for number in np.flatnonzero(in_sight[:, camera]).tolist():
                rng = np.random.default_rng([seed, number, *([camera] if camera else [])])
                image = render(
                    lens, boards, poses.take(number).compose(place), exposure, rng, rays=rays
                )
                write_png(folder / name / f'{number:03d}.png', image)
                done()
    view, board, corner = np.nonzero(seen)
    frame, camera_of = np.divmod(view, len(cameras))
    points = np.stack([one.pose.transform(one.printed.corners) for one in boards])
    write_observations(
        truth / 'observations.csv',
        make_observations(
            frame,
            board * points.shape[1] + corner,
            uv[view, board, corner],
            points[board, corner],
            board=board,
            camera=camera_of,
            cameras=tuple(cameras),
        ),
    )
    write_poses(truth / 'poses.csv', np.arange(count), poses)
    return int(in_sight.sum())
