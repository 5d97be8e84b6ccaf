"""`fisheye-svp plan`: which photographs to take, before the first one."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from fisheye_svp_ros.commands.detect import image_size, positive_count
from fisheye_svp_ros.commands.lenses import load_with_notes
from fisheye_svp_ros.commands.notes import say
from fisheye_svp_ros.commands.outputs import add_output_folder
from fisheye_svp_ros.detect.patterns import parse_pattern
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io.files import write_json, write_together
from fisheye_svp_ros.io.readers import write_poses
from fisheye_svp_ros.io.share import typed_lens_path
from fisheye_svp_ros.optics.camera import incidence
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.planning import MAX_VIEWS

if TYPE_CHECKING:
    from fisheye_svp_ros.planning.optimal_design import ViewLimits
    from fisheye_svp_ros.planning.plan import NextViews


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument(
        '--lens',
        metavar='LENS',
        help='a lens of the same type: lens file, or the name of a lens of this package',
    )
    parser.add_argument(
        '--fov',
        type=float,
        metavar='DEG',
        help='instead of --lens: horizontal field of view. No corner is planned beyond it',
    )
    parser.add_argument('--image-size', metavar='WxH', help='with --fov: 1280x800')
    parser.add_argument(
        '--board',
        required=True,
        metavar='SPEC',
        help='the board: chessboard:9x6:25mm, charuco:..., aprilgrid:FILE, ...',
    )
    parser.add_argument(
        '--room',
        type=float,
        nargs=2,
        required=True,
        metavar='M',
        help='nearest and farthest distance at which the board is sharp and fits into the room',
    )
    parser.add_argument(
        '--count',
        type=view_count,
        default=12,
        metavar='N',
        help='number of photographs; default: 12',
    )
    parser.add_argument(
        '--for',
        dest='number',
        metavar='NAME',
        help='parameter to determine best: e0, fx, cx, k1, ...; default: the whole lens',
    )
    parser.add_argument(
        '--noise',
        type=float,
        default=0.1,
        metavar='PX',
        help='standard deviation of u and of v of a corner; default: 0.1',
    )
    add_output_folder(
        parser,
        'folder to write plan.pdf (to print), plan.json and poses.csv (for `render`) to',
    )


def run(args: argparse.Namespace) -> None:
    """Choose, print, draw."""
    from fisheye_svp_ros.planning.plan import plan
    from fisheye_svp_ros.reporting.shot_plots import draw_shots
    from fisheye_svp_ros.reporting.terminal import UNITS, draw_or_note, print_table
    from fisheye_svp_ros.reporting.wording import shots

    lens, pattern = _lens(args), parse_pattern(args.board)
    planned = plan(
        lens, pattern.points, view_limits(args.room), args.count, args.number, args.noise
    )
    wanted = planned.wanted
    if args.output:
        with write_together():
            write_poses(
                args.output / 'poses.csv',
                np.arange(len(wanted.shots.distance)),
                wanted.shots.camera,
            )
            write_json(
                args.output / 'plan.json',
                {'photographs': wanted.to_list(), 'stderr': planned.stderr},
            )
        draw_or_note(args.output / 'plan.pdf', draw_shots, ForwardModel(lens), wanted)
    print_table(
        f'{lens.name}, {pattern.spec}: photographs to take, {shots.purpose(wanted)}',
        shots.HEADER,
        shots.rows(wanted),
        words=shots.TEXT_COLUMNS,
    )
    print(
        '  expected standard errors: '
        + ', '.join(
            f'{name} {error:.2g} {UNITS.get(name, "")}'.rstrip()
            for name, error in planned.stderr.items()
        )
    )
    _note_guessed(lens, wanted)
    if args.output:
        print(f'{args.output}: plan.pdf, plan.json, poses.csv')


def view_count(text: str) -> int:
    """Return the number of views to plan, of a text."""
    count = positive_count(text)
    if count > MAX_VIEWS:
        raise argparse.ArgumentTypeError(
            f'{text!r} photographs are too many; at most {MAX_VIEWS} can be planned at once'
        )
    return count


def view_limits(given: Sequence[float]) -> ViewLimits:
    """Return the room of --room.  Raises ParameterError for an impossible one."""
    from fisheye_svp_ros.planning.optimal_design import ViewLimits

    near, far = given
    if not 0 < near < far < float('inf'):
        raise ParameterError(
            f'--room {near:g} {far:g}: give two distances above 0, m, the nearer first'
        )
    return ViewLimits(near, far)


def _note_guessed(lens: Lens, wanted: NextViews) -> None:
    """Name the views that need more of a lens than it was calibrated for."""
    if lens.calibrated_angle is None:
        return
    seen = wanted.shots.camera.into_body(wanted.board.points)
    angle = incidence(lens, seen).theta.max(axis=-1)
    further = [str(i + 1) for i in np.flatnonzero(angle > lens.calibrated_angle)]
    if further:
        edge = np.degrees(lens.calibrated_angle)
        say(
            f'lens {lens.name!r} was calibrated up to {edge:.0f} degrees off the axis. Views '
            f'{", ".join(further)} reach up to {np.degrees(angle.max()):.0f}, where the drawn '
            'place of the board may be wrong'
        )


def _lens(args: argparse.Namespace) -> Lens:
    from fisheye_svp_ros.planning.plan import nominal_lens

    if (args.lens is None) == (args.fov is None) or bool(args.fov) != bool(args.image_size):
        raise ParameterError('give --lens LENS, or --fov and --image-size')
    if args.lens is not None:
        return load_with_notes(typed_lens_path(args.lens))
    if not 0 < args.fov < 360:
        raise ParameterError(f'--fov {args.fov:g}: it must be between 0 and 360 degrees')
    try:
        size = image_size(args.image_size)
    except argparse.ArgumentTypeError as cause:
        raise ParameterError(f'--image-size {cause}') from cause
    return nominal_lens(size, float(np.radians(args.fov)))
