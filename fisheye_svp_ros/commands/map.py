"""`fisheye-svp map`: tags and camera poses from a walk's photographs, video or recording."""

from __future__ import annotations

import argparse

import numpy as np

from fisheye_svp_ros.commands.detect import positive_count
from fisheye_svp_ros.commands.lenses import add_lens_argument, lenses_of, load_lenses
from fisheye_svp_ros.commands.notes import say
from fisheye_svp_ros.commands.outputs import output_file
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.files import write_together
from fisheye_svp_ros.io.readers import check_sizes, write_poses
from fisheye_svp_ros.reporting.terminal import print_table, progress
from fisheye_svp_ros.reporting.wording.poses import map_notes


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument(
        'recording',
        nargs='+',
        metavar='RECORDING',
        help='photographs (files, folders), a video or a rosbag2 recording of a walk; each tag '
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
        help='tag map to write; next to it the errors of all tags as .covariance.npz, the poses '
        'of the camera as .poses.csv',
    )


def run(args: argparse.Namespace) -> None:
    """Find the tags, map them, print and write the map."""
    from fisheye_svp_ros.detect.photographs import find_photographs
    from fisheye_svp_ros.detect.tags import FAMILY, find_tag_views, tag_size
    from fisheye_svp_ros.io.tag_maps import map_of_size, tag_covariance, write_tag_map
    from fisheye_svp_ros.solve.tag_mapping import map_tags

    size, lenses = tag_size(args.board), lenses_of([''], load_lenses(args.lens))
    lens = next(iter(lenses.values()))
    with progress('searching'):
        seen = find_tag_views(find_photographs(args.recording, args.every))
    check_sizes(args.recording[0], {'': seen.size}, {'': lens})
    with progress('mapping'):
        tag_map = map_tags(ForwardModel(lens), seen.image, seen.ids, seen.uv, size, args.origin)
    covariance = tag_covariance(tag_map.information)
    tags = map_of_size(tag_map.ids, size, tag_map.poses, FAMILY, covariance)
    print_table(
        f'{len(tag_map.ids)} tags from {len(tag_map.images)} of {len(seen.names)} images, '
        f'rms {tag_map.rms_px:.3f} px',
        ('tag', 'x mm', 'y mm', 'z mm', 'std. error mm'),
        [
            (str(number), *(f'{1000 * one:.1f}' for one in place), f'{1000 * error:.2f}')
            for number, place, error in zip(
                tags.ids, tags.poses.position, tags.stderr, strict=True
            )
        ],
    )
    for note in map_notes(tag_map.missing, tag_map.outside, tag_map.rms_px, tag_map.focal):
        say(note)
    if args.output:
        with write_together():
            write_tag_map(tags, args.output, 'fisheye-svp map', tag_map.information)
            write_poses(
                args.output.with_suffix('.poses.csv'),
                tag_map.images,
                tag_map.cameras,
                {'photograph': np.array(seen.names)[tag_map.images]},
            )
