"""`fisheye-svp budget`: at which range and angle the SVP error passes what the user allows."""

from __future__ import annotations

import argparse

from fisheye_svp_ros.commands.lenses import load_with_notes
from fisheye_svp_ros.commands.outputs import add_output_folder

# Limits by quantity: option, unit, factor from the unit to SI.
_LIMITS = {
    'position': ('--max-position', 'MM', 1e-3, 'position error of a localized camera'),
    'axis': ('--max-axis', 'DEG', 3.141592653589793 / 180, 'error of its viewing axis'),
    'residual': ('--max-residual', 'PX', 1.0, 'mean residual of localization'),
    'epipolar': ('--max-epipolar', 'PX', 1.0, 'mean distance from the epipolar curve'),
    'depth': ('--max-depth', 'MM', 1e-3, 'mean error of stereo points'),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument(
        '--lens',
        required=True,
        metavar='LENS',
        help='lens file with a viewpoint_shift or a port, or the name of a lens of this package',
    )
    parser.add_argument(
        '--range',
        type=float,
        default=0.5,
        metavar='M',
        dest='working_range',
        help='nearest range of the landmarks or targets; default: 0.5',
    )
    parser.add_argument(
        '--spread',
        type=float,
        metavar='DEG',
        help='largest angle of the landmarks from the axis. Default: the largest angle of the '
        'image points of a lens from `calibrate`, otherwise 1 degree less than its field '
        'of view',
    )
    parser.add_argument(
        '--noise',
        type=float,
        default=0.3,
        metavar='PX',
        help='standard deviation of u and of v; default: 0.3',
    )
    parser.add_argument(
        '--baseline',
        type=float,
        default=0.15,
        metavar='M',
        help='baseline of the stereo rig; default: 0.15',
    )
    parser.add_argument(
        '--style',
        default='parallel',
        metavar='STYLE',
        help='style of the stereo rig: parallel, vergent or divergent; default: parallel',
    )
    for option, unit, _, what in _LIMITS.values():
        parser.add_argument(
            option,
            type=float,
            metavar=unit,
            help=f'largest {what} that you allow; default: unlimited, or, without '
            'any limit, what noise alone causes',
        )
    add_output_folder(
        parser,
        'folder to write budget.json and budget.png to',
    )


def run(args: argparse.Namespace) -> None:
    """Tabulate, answer, draw."""
    import numpy as np

    from fisheye_svp_ros.io.files import write_json
    from fisheye_svp_ros.io.share import typed_lens_path
    from fisheye_svp_ros.reporting.budget_report import (
        BudgetRequest,
        answer,
        budget_rows,
        document,
        draw,
    )
    from fisheye_svp_ros.reporting.terminal import draw_or_note, print_table, progress
    from fisheye_svp_ros.scene.rigs import rig
    from fisheye_svp_ros.study.budget import Setup, at_point, default_spread, make_budget

    lens = load_with_notes(typed_lens_path(args.lens))
    spread = default_spread(lens) if args.spread is None else np.radians(args.spread).item()
    limits = {
        name: (value := getattr(args, option[2:].replace('-', '_'))) and factor * value
        for name, (option, _, factor, _) in _LIMITS.items()
    }
    with progress('solving'):
        budget = make_budget(Setup(lens, rig(args.style, args.baseline), args.noise))
    points = at_point(budget, spread, args.working_range, limits)
    given = frozenset(name for name, value in limits.items() if value is not None)
    asked = BudgetRequest(
        lens.name, spread, args.working_range, given, lens.port is not None, bool(budget.own)
    )
    print_table(
        f'{lens.name}: landmarks within {np.degrees(spread):.0f} degrees of the axis, at '
        f'{args.working_range:g} m, {args.noise:g} px of noise',
        asked.header,
        budget_rows(points, asked),
    )
    print(f'  {answer(points, asked)}')
    if args.output:
        write_json(args.output / 'budget.json', document(budget, points, asked))
        draw_or_note(args.output / 'budget.png', draw, budget, points, asked)
