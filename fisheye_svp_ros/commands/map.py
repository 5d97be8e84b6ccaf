"""`fisheye-svp map`: tags and camera poses from a walk's photographs, video or recording."""

from __future__ import annotations

import argparse

from fisheye_svp_ros.commands.detect import positive_count
from fisheye_svp_ros.commands.lenses import add_lens_argument, lenses_of, load_lenses
from fisheye_svp_ros.commands.notes import say
from fisheye_svp_ros.commands.outputs import output_file
from fisheye_svp_ros.reporting.terminal import print_table, stages


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument(
        'recording',
        nargs='+',
        metavar='RECORDING',
        help='photographs (files, folders), a video, or a rosbag2 recording of a walk. Each tag '
        'must share an image with another one',
    )
    parser.add_argument(
        '--board',
        required=True,
        metavar='SPEC',
        help='the tags: tags:36h11:160mm (family, side of the black square, which sets the scale)',
    )
    add_lens_argument(parser)
    parser.add_argument(
        '--origin',
        type=int,
        metavar='ID',
        help='tag whose frame is that of the map; default: the one that most images show',
    )
    parser.add_argument(
        '--every', type=positive_count, default=1, metavar='N', help='use every Nth image'
    )
    parser.add_argument(
        '-o',
        '--output',
        type=output_file,
        metavar='TAGS.yaml',
        help='tag map to write. The errors of all tags are written next to it as '
        '.covariance.npz, and the poses of the camera as .poses.csv',
    )


def run(args: argparse.Namespace) -> None:
    """Find the tags, map them, print and write the map."""
    from fisheye_svp_ros.library.tag_maps import map as map_walk

    lens = lenses_of([''], load_lenses(args.lens))['']
    with stages('tags') as show:
        found = map_walk(
            args.recording, args.board, lens, origin=args.origin, every=args.every, progress=show
        )
    if args.output:  # before a word is printed: nobody may be reading
        found.save(args.output)
    print_table(
        f'{len(found.tags.ids)} tags from {len(found.pose.position)} of '
        f'{len(found.photographs)} images, rms {found.mapping.rms_px:.3f} px',
        ('tag', 'x mm', 'y mm', 'z mm', 'std. error mm'),
        [
            (str(number), *(f'{1000 * one:.1f}' for one in place), f'{1000 * error:.2f}')
            for number, *place, error in found.table().rows()
        ],
    )
    for note in found.notes:
        say(note)
