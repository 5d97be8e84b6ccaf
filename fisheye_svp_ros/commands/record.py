"""`fisheye-svp record`: topics of the node graph to a rosbag2 recording (MCAP)."""

from __future__ import annotations

import argparse
import re
from contextlib import suppress
from pathlib import Path
from shutil import rmtree

from fisheye_svp_ros.commands.outputs import output_path
from fisheye_svp_ros.commands.processes import prepare_ros
from fisheye_svp_ros.errors import BagError
from fisheye_svp_ros.io.share import sweep_path
from fisheye_svp_ros.nodes.executables import ending_quietly

# What the nodes tell, and what they were told; markers and diagnostics are left out.
TOPICS = (
    r'.*/(scenario|landmarks|camera_info|image_points|true_pose|pose|position_error'
    r'|rotation_error|residuals|points|rig|metrics/[^/]+|result|tf|tf_static)'
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument(
        '-o',
        '--output',
        type=output_path,
        required=True,
        metavar='BAG',
        help='folder to create; it must not exist',
    )
    parser.add_argument(
        '--topics',
        type=_pattern,
        default=TOPICS,
        metavar='REGEX',
        help='pattern of full topic names; default: all topics of the nodes '
        'except markers and diagnostics',
    )
    parser.add_argument(
        '--sweep',
        metavar='FILE',
        help='sweep file, or the name of one in config/sweeps: start the nodes, record them in '
        'lockstep through the sweep, and end',
    )
    parser.add_argument(
        '--ros-args', nargs=argparse.REMAINDER, default=[], metavar='...', help='as for `ros2 run`'
    )


def run(args: argparse.Namespace) -> None:
    """Record until interrupted, or to the end of a sweep."""
    if args.sweep:
        _sweep(args.sweep, args.output)
    else:
        _record(args)


def _sweep(name: str, bag: Path) -> None:
    from fisheye_svp_ros.commands.node_sweeps import read_sweep, record_sweep
    from fisheye_svp_ros.commands.notes import count_text, say
    from fisheye_svp_ros.io.bags import Bag
    from fisheye_svp_ros.reporting.terminal import progress

    path = sweep_path(name)
    plan = read_sweep(path)
    if bag.exists():
        raise BagError(f'{bag}: it exists; choose a new folder')
    prepare_ros()
    with progress('sweeping', len(plan.sweep)) as advance:
        record_sweep(path, plan, bag, bag.with_name(f'{bag.name}_logs'), advance)
    count = sum(1 for _ in Bag(bag).records(lambda topic, _: topic == '/scenario'))
    say(f'{count} sets of {count_text(len(plan.sweep), "scenario")} are in {bag}')


def _record(args: argparse.Namespace) -> None:
    from fisheye_svp_ros.commands.notes import say
    from fisheye_svp_ros.io.bags import BagWriter

    with ending_quietly():
        prepare_ros()
        from fisheye_svp_ros.nodes.recorder import Recorder
        from fisheye_svp_ros.nodes.session import ros_session

    with (
        ros_session(args.ros_args) as signals,
        BagWriter(args.output) as bag,
        suppress(KeyboardInterrupt),
    ):
        signals.begin()
        recorder = Recorder(bag, args.topics)
        recorder.spin(signals)
        recorder.destroy_node()
    if not bag.count:
        rmtree(args.output)
        raise BagError(
            f'{args.output}: no message arrived on a recorded topic, so nothing is '
            'kept; compare `ros2 topic list` with --topics'
        )
    say(f'{bag.count} messages on {len(recorder.topics)} topics are in {args.output}')


def _pattern(text: str) -> re.Pattern[str]:
    try:
        return re.compile(text)
    except re.error as cause:
        raise argparse.ArgumentTypeError(
            f'{text!r} is not a regular expression: {cause}'
        ) from cause
