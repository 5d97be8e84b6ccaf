"""`fisheye-svp detect`: photographs of a board to observations."""

from __future__ import annotations

import argparse
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from fisheye_svp_ros.commands.outputs import output_file, output_folder
from fisheye_svp_ros.commands.photographs import add_board_arguments, search
from fisheye_svp_ros.io.files import write_json, write_together
from fisheye_svp_ros.io.readers import write_observations

if TYPE_CHECKING:
    from fisheye_svp_ros.detect.detection import Detection


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument('photographs', nargs='+', metavar='PHOTOS',
                        help='image files or folders (left/ and right/ for a rig), videos, '
                        'rosbag2 recordings with Image or CompressedImage')
    add_board_arguments(parser, required=True)
    parser.add_argument('-o', '--output', type=output_file, metavar='OBS.csv',
                        help='observations to write; the details by photograph are written next '
                        'to them as .detect.json')
    parser.add_argument('--overlays', type=partial(output_folder, option='--overlays'),
                        metavar='DIR',
                        help='folder to write each photograph with its corners to, and a map of '
                        'the coverage')


def run(args: argparse.Namespace) -> None:
    """Search all photographs, say what was found, write the observations."""
    from fisheye_svp_ros.detect.photographs import find_photographs

    detection = search(args.photographs, args)
    _print(detection, args.board)
    with write_together():
        if args.output:
            write_observations(args.output, detection.observations)
            write_json(args.output.with_suffix('.detect.json'), _document(detection, args.board))
        if args.overlays:
            from fisheye_svp_ros.reporting.overlays import write_coverage, write_overlays

            write_overlays(find_photographs(args.photographs, args.every), detection,
                           args.overlays)
            write_coverage(detection, args.overlays / 'coverage.png')


def _print(detection: Detection, board: str) -> None:
    table, found = detection.observations, [one for one in detection.searched if one.points]
    print(f'{board}: found in {len(found)} of {len(detection.searched)} photographs, '
          f'{len(table)} points'
          + ('' if np.isnan(table.sigma).any() else f', sigma {np.median(table.sigma):.3f} px'))
    pairing, cameras = detection.pairing, detection.observations.cameras
    if len(cameras) > 1:
        both = len({one.key for i, one in enumerate(detection.searched) if i not in pairing.alone})
        apart = f', {1e3 * pairing.apart:.3g} ms apart at most' if pairing.way == 'stamp' else ''
        print(f'  cameras {", ".join(cameras)}: {both} simultaneous pairs, matched by '
              f'{pairing.way}{apart}; {len(pairing.alone)} photographs without a partner')
    sure = detection.certainty[[one.points is not None for one in detection.searched]]
    if np.isnan(sure).any():
        print('  the board looks the same when turned; too few photographs to determine its '
              'orientation')
    elif (sure < 1).any():
        print('  the board looks the same when turned; orientations were chosen by their '
              f'residuals: {100 * sure.mean():.1f} % sure on average, {100 * sure.min():.0f} % at '
              'worst')


def _document(detection: Detection, board: str) -> dict[str, Any]:
    rows = zip(detection.searched, detection.frames.tolist(), detection.certainty.tolist(),
               strict=True)
    return {
        'board': board,
        'image_size': list(detection.image_size),
        'image_sizes': detection.image_sizes,
        'pairing': detection.pairing.way,
        'photographs': [
            {
                'name': one.name, 'camera': one.camera, 'frame': frame,
                'points': len(one.points.ids) if one.points else 0,
                'reason': one.reason, 'notes': list(one.notes),
                'blur_px': one.points.blur if one.points else None,
                'sigma_px': float(one.points.sigma.mean()) if one.points else None,
                'full_scale': one.bright, 'order_certainty': sure if one.points else None,
            }
            for one, frame, sure in rows
        ],
    }
