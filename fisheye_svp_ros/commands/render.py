"""`fisheye-svp render`: photographs of chessboards through a lens, and the truth about them."""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.commands.lenses import load_with_notes
from fisheye_svp_ros.commands.notes import say
from fisheye_svp_ros.detect.patterns import parse_pattern
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io.files import together, write_bytes
from fisheye_svp_ros.io.readers import read_poses, write_observations, write_poses
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.reporting.progress import progress
from fisheye_svp_ros.scene.observations import make_observations
from fisheye_svp_ros.simulate.render import Exposure, Field, Placed, Print, render
from fisheye_svp_ros.simulate.targets import TARGETS, board, board_views, target_views, visible


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument('--lens', required=True, metavar='LENS',
                        help='a lens file, or the name of one that comes with the package')
    parser.add_argument('--board', required=True, metavar='SPEC',
                        help='the board: chessboard:9x6:25mm (inner corners)')
    parser.add_argument('--target', choices=('board', 'cube', 'room'), default='board',
                        help='one board, or six: on the faces of a cube, on the walls of a room')
    parser.add_argument('-o', '--output', type=Path, required=True, metavar='DIR',
                        help='folder for the photographs, observations.csv (the true corners) and '
                        'poses.csv')
    parser.add_argument('--poses', metavar='POSES.csv',
                        help="poses of the camera in the frame of the board, or of the target's "
                        'middle; at random by default')
    parser.add_argument('--count', type=int, default=30, metavar='N',
                        help='how many photographs from random poses (30)')
    parser.add_argument('--ranges', type=float, nargs=2, default=(0.12, 0.35), metavar='M',
                        help='nearest and furthest, m, of random poses (0.12 0.35), to the middle '
                        'of a cube')
    parser.add_argument('--bow', type=float, default=0.0, metavar='MM',
                        help='how far the middle of the board stands out from its ends, mm')
    parser.add_argument('--blur', type=float, default=0.6, metavar='PX',
                        help='blur of the lens, px (0.6)')
    parser.add_argument('--noise', type=float, default=1.5, metavar='LEVELS',
                        help='noise of a pixel, grey levels of 255 (1.5)')
    parser.add_argument('--seed', type=int, default=0, help='of poses and noise (0)')


def run(args: argparse.Namespace) -> None:
    """Render the photographs, write them and the truth."""
    pattern = parse_pattern(args.board)
    if pattern.kind != 'chessboard':
        raise ParameterError(f'--board {args.board}: chessboards alone can be rendered')
    if args.count < 1 or not 0 < args.ranges[0] <= args.ranges[1] < np.inf:
        raise ParameterError('--count must be above 0, --ranges two distances above 0 in order')
    if not all(0 <= value < np.inf for value in (args.blur, args.noise, args.seed, abs(args.bow))):
        raise ParameterError('--blur, --noise and --seed must be finite and not below 0, --bow '
                             'finite')
    lens, rng = load_with_notes(lens_path(args.lens)), np.random.default_rng(args.seed)
    printed = Print(pattern.columns, pattern.rows, pattern.size)
    if args.bow:
        printed = Print(pattern.columns, pattern.rows, pattern.size,
                        bow=parabola(printed.corners, 1e-3 * args.bow))
    boards = TARGETS.get(args.target, board)(printed)
    if args.poses:
        poses = read_poses(args.poses).pose
    elif len(boards) > 1:
        poses = target_views(lens, args.target, boards, args.count, tuple(args.ranges), rng)
    else:
        poses = board_views(lens, printed, args.count, tuple(args.ranges), rng)
    with together():
        write_photographs(lens, boards, poses, Exposure(blur=args.blur, noise=args.noise),
                          args.seed, args.output, args.output)
    others = len(list(args.output.glob('*.png'))) - len(poses.position)
    if others:
        say(f'{args.output}: {others} other photographs are in it, too; `detect` takes them all')
    print(f'{args.output}: {len(poses.position)} photographs, observations.csv with their true '
          'corners, poses.csv')


def parabola(corners: Array, height: float) -> Field:
    """Return a board's height, m: a parabola across its longer side, `height` from end to top."""
    low, high = corners[:, :2].min(axis=0), corners[:, :2].max(axis=0)
    longer = int(np.argmax(high - low))
    middle, half = (low + high)[longer] / 2, (high - low)[longer] / 2
    return lambda place: np.asarray(height * ((place[..., longer] - middle) / half) ** 2)


def write_photographs(
    lens: Lens, boards: tuple[Placed, ...], poses: Pose, exposure: Exposure, seed: int,
    folder: Path, truth: Path,
) -> None:
    """Write a photograph a pose (P,); the true corners, observations.csv, poses.csv to `truth`."""
    count = len(poses.position)
    uv: list[Array] = []
    seen: list[Array] = []
    with progress('rendering', count) as done:
        for number in range(count):
            rng, pose = np.random.default_rng([seed, number]), poses.take(number)
            image = render(lens, boards, pose, exposure, rng)
            write_bytes(folder / f'{number:03d}.png', cv2.imencode('.png', image)[1].tobytes())
            for kept, part in zip((uv, seen), visible(lens, boards, pose), strict=True):
                kept.append(part)
            done()
    frame, board, corner = np.nonzero(seen)
    points = np.stack([one.pose.transform(one.printed.corners) for one in boards])
    write_observations(truth / 'observations.csv', make_observations(
        frame, board * points.shape[1] + corner, np.stack(uv)[frame, board, corner],
        points[board, corner], board=board))
    write_poses(truth / 'poses.csv', np.arange(count), poses)
