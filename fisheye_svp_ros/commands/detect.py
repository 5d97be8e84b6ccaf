"""`fisheye-svp detect`: photographs of a board to observations.

Other commands take photographs in place of observations: the arguments for it, the search.
"""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fisheye_svp_ros.commands.notes import say
from fisheye_svp_ros.commands.outputs import output_file, output_folder
from fisheye_svp_ros.detect.finders import DETECTORS
from fisheye_svp_ros.detect.patterns import LOOSE_TAGS, Pattern, parse_pattern
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io.files import keep_existing, write_json, write_together
from fisheye_svp_ros.io.readers import (
    Sizes,
    photographs_beside,
    read_observations,
    write_observations,
)
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.scene.table_checks import looks_side_by_side

if TYPE_CHECKING:
    from fisheye_svp_ros.detect.detection import Detection

_MAX_LISTED = 12
_UNCERTAIN = 0.9
_MIN_LARGER_SHARE = 0.2  # of all boards: a wrong count shows where the next squares are visible
_MIN_BEYOND_SHARE = 0.05  # of all tags: another board in the background has few
_TIME = re.compile(r'([\d.]+) *(s|ms|us|ns)')
_UNITS = {'s': 1.0, 'ms': 1e-3, 'us': 1e-6, 'ns': 1e-9}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument(
        'photographs',
        nargs='+',
        metavar='PHOTOS',
        help='image files, folders or videos (left and right in their names for a rig), '
        'recordings (rosbag2, ROS 1 bags) with Image or CompressedImage',
    )
    add_board_arguments(parser, required=True)
    parser.add_argument(
        '-o',
        '--output',
        type=output_file,
        metavar='OBS.csv',
        help='observations to write. The details of each photograph are written next to them as '
        '.detect.json',
    )
    parser.add_argument(
        '--overlays',
        type=partial(output_folder, option='--overlays'),
        metavar='DIR',
        help='folder to write each photograph with its corners to, and a map of the coverage',
    )


def run(args: argparse.Namespace) -> None:
    """Search all photographs, say what was found, write the observations."""
    from fisheye_svp_ros.detect.photographs import find_photographs

    detection = search(args.photographs, args)
    _print(detection, args.board)
    if args.output:
        with write_together():
            write_observations(args.output, detection.observations)
            write_json(args.output.with_suffix('.detect.json'), _document(detection, args.board))
    if args.overlays:
        from fisheye_svp_ros.reporting.overlays import write_coverage, write_overlays
        from fisheye_svp_ros.reporting.terminal import draw_or_note

        coverage = args.overlays / 'coverage.png'
        # Photographs may be there, but no earlier overlays.
        with keep_existing(not coverage.exists()), write_together():
            write_overlays(
                find_photographs(args.photographs, args.every, args.split or 1),
                detection,
                args.overlays,
            )
            draw_or_note(coverage, write_coverage, detection)


def _print(detection: Detection, board: str) -> None:
    table, found = detection.observations, [one for one in detection.searched if one.points]
    print(
        f'{board}: found in {len(found)} of {len(detection.searched)} photographs, '
        f'{len(table)} points'
        + (f', sigma {np.nanmedian(table.sigma):.3f} px' if np.isfinite(table.sigma).any() else '')
    )
    pairing, cameras = detection.pairing, detection.observations.cameras
    if len(cameras) > 1:
        both = len({one.key for i, one in enumerate(detection.searched) if i not in pairing.alone})
        apart = f', {1e3 * pairing.apart:.3g} ms apart at most' if pairing.way == 'stamp' else ''
        print(
            f'  cameras {", ".join(cameras)}: {both} simultaneous pairs, matched by '
            f'{pairing.way}{apart}; {len(pairing.alone)} photographs without a partner'
        )
    sure = detection.certainty[[one.points is not None for one in detection.searched]]
    if np.isnan(sure).any():
        print(
            '  the board looks the same when turned, and the photographs are too few to '
            'determine its orientation'
        )
    elif (sure < 1).any():
        print(
            '  the board looks the same when turned; orientations were chosen by their '
            f'residuals: {100 * sure.mean():.1f} % sure on average, {100 * sure.min():.0f} % at '
            'worst'
        )


def _document(detection: Detection, board: str) -> dict[str, Any]:
    rows = zip(
        detection.searched, detection.frames.tolist(), detection.certainty.tolist(), strict=True
    )
    return {
        'board': board,
        'image_size': list(detection.image_size),
        'image_sizes': detection.image_sizes,
        'pairing': detection.pairing.way,
        'photographs': [
            {
                'name': one.name,
                'camera': one.camera,
                'frame': frame,
                'points': len(one.points.ids) if one.points else 0,
                'reason': one.reason,
                'notes': list(one.notes),
                'blur_px': one.points.blur if one.points else None,
                'sigma_px': float(one.points.sigma.mean()) if one.points else None,
                'full_scale': one.bright,
                'order_certainty': sure if one.points else None,
            }
            for one, frame, sure in rows
        ],
    }


def add_board_arguments(parser: argparse.ArgumentParser, required: bool = False) -> None:
    """Declare what a search for a board in photographs needs."""
    parser.add_argument(
        '--board',
        required=required,
        metavar='SPEC',
        help='the board in the photographs: chessboard:9x6:24.23mm (inner corners), '
        'charuco:7x5:30mm:22mm:DICT_5X5_100 (:17 at the end: the id of its first marker), '
        'aprilgrid:target.yaml, circles:7x5:20mm[:asymmetric], squares:3x4:30mm:30mm '
        '(side, gap). Loose tags of a map: tags:tags.yaml',
    )
    parser.add_argument(
        '--detector',
        choices=DETECTORS,
        default='',
        help='detector; default: the most accurate one for the board',
    )
    parser.add_argument(
        '--every',
        type=positive_count,
        default=1,
        metavar='N',
        help='use every Nth photograph or video frame',
    )
    parser.add_argument(
        '--sync',
        type=seconds,
        metavar='TIME',
        help='for a rig: largest difference between the stamps of simultaneous images, in '
        'messages or in file names; default: 5ms',
    )
    add_split_argument(parser)


def add_split_argument(
    parser: argparse.ArgumentParser, default: str = '2 if both halves show the board'
) -> None:
    """Declare --split, of photographs in which several cameras lie side by side."""
    parser.add_argument(
        '--split',
        type=positive_count,
        metavar='N',
        help='number of cameras side by side in each image. The image is cut into N parts of '
        f'equal width: left and right, or cam0, cam1, ...; default: {default}',
    )


def search_options(args: argparse.Namespace) -> tuple[str, ...]:
    """Return the options with which another command finds the same board in photographs."""
    options = ['--board', args.board]
    options += ['--detector', args.detector] if args.detector else []
    options += ['--sync', f'{args.sync}s'] if args.sync else []
    options += ['--split', str(args.split)] if args.split else []
    return (*options, *(['--every', str(args.every)] if args.every > 1 else []))


def add_observation_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare OBS, and what a search needs where these are photographs."""
    parser.add_argument(
        'observations',
        metavar='OBS',
        help='observations (CSV file, folder of ORPC files, recording), or '
        'photographs, with --board',
    )
    add_board_arguments(parser)


def read_input(path: str, args: argparse.Namespace) -> tuple[Observations, Sizes]:
    """Return observations from a file, or from photographs, with the image size of each camera.

    Raises ObservationError for anything missing or malformed, ParameterError for photographs
    without a board.
    """
    from fisheye_svp_ros.detect.photographs import is_photographs

    # Beside photographs other observations (held out, of another day) may be a table already.
    if args.board and Path(path).suffix.lower() != '.csv':
        detection = search([path], args)
        return detection.observations, detection.image_sizes
    if is_photographs(Path(path)):
        raise ParameterError(
            f'{path}: these are photographs; name their board, for example '
            '--board chessboard:9x6:24mm'
        )
    table = read_observations(path)
    return replace(table, photographs=photographs_beside(Path(path), table.cameras)), {}


def image_sizes(text: str) -> Sizes:
    """Return the image size of each camera, or of all under '', of a text such as 1280x800."""
    parts = [part.rpartition('=') for part in text.split(',')]
    sizes = {camera.strip(): image_size(size) for camera, _, size in parts}
    if len(sizes) < len(parts):
        raise argparse.ArgumentTypeError(
            f'{text!r} has two sizes for one camera; use left=1280x960,right=640x480'
        )
    return sizes


def image_size(text: str) -> tuple[int, int]:
    """Return width and height, px, of a text such as 1280x800."""
    width, _, height = text.lower().partition('x')
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise argparse.ArgumentTypeError(f'{text!r} is not of the form 1280x800')
    return int(width), int(height)


def search(paths: Sequence[str], args: argparse.Namespace) -> Detection:
    """Search photographs for the board; say which have none, and which are odd."""
    from fisheye_svp_ros.detect.detection import LARGER_BOARD, detect
    from fisheye_svp_ros.detect.photographs import (
        count_photographs,
        doubtful_folders,
        find_photographs,
    )
    from fisheye_svp_ros.detect.side_by_side import count_cameras
    from fisheye_svp_ros.reporting.terminal import progress

    pattern = parse_pattern(args.board)
    if pattern.note:
        say(pattern.note)
    if args.detector and pattern.kind not in DETECTORS[args.detector][0]:
        raise ParameterError(f'--detector {args.detector} does not find {args.board}')
    for line in doubtful_folders(paths):
        say(line)
    if args.split is None:
        cameras = count_cameras(find_photographs(paths, args.every), pattern, args.detector)
        if cameras > 1:
            args.split = cameras
            say(
                'both halves of these wide images show the board: they are split into left and '
                'right; --split 1 keeps them whole'
            )
    split = args.split or 1
    count = count_photographs(paths, args.every, split)
    with progress('searching', count) as done:
        detection = detect(
            find_photographs(paths, args.every, split),
            pattern,
            args.detector,
            progress=done,
            source=', '.join(paths),
            sync=args.sync,
        )
    odd = [
        f'{one.name}: {"; ".join(filter(None, (one.reason, *one.notes)))}'
        for one in sorted(detection.searched, key=lambda one: not one.reason)
        if one.reason or one.notes
    ]
    for line in odd[:_MAX_LISTED]:
        say(line)
    if len(odd) > _MAX_LISTED:
        say(f'and {len(odd) - _MAX_LISTED} more such photographs')
    _note_alone(detection)
    unsure = int((detection.certainty < _UNCERTAIN).sum())
    if unsure:
        say(
            f'{unsure} photographs: their orientation is less than {100 * _UNCERTAIN:.0f} % '
            f'sure, because {args.board} looks the same when turned'
        )
    unknown = [
        Path(one.name).name
        for one in detection.searched
        if one.points and np.isnan(one.points.sigma).any() and pattern.kind != LOOSE_TAGS
    ]
    if unknown:
        more = ', ...' if len(unknown) > _MAX_LISTED else ''
        say(
            f'{len(unknown)} photographs have centers of unknown sigma, because no lens fits '
            f'each of them separately: {", ".join(unknown[:_MAX_LISTED])}{more}'
        )
    detected = sum(one.points is not None for one in detection.searched)
    larger = sum(LARGER_BOARD in one.notes for one in detection.searched)
    if larger and larger >= _MIN_LARGER_SHARE * detected:
        say(
            f'{larger} of {detected} boards look larger than {args.board}. Count the inner '
            'corners again; otherwise, photographs may give different corners the same number'
        )
    _note_tags(detection, pattern)
    note_side_by_side(detection.observations, detection.image_sizes)
    if 2 * detected < len(detection.searched):
        counted = ' (inner corners)' if pattern.kind == 'chessboard' else ''
        say(f'no {args.board} in most photographs; check kind and size{counted} of the board')
    return detection


def _note_tags(detection: Detection, pattern: Pattern) -> None:
    """Say where many tags have numbers that the board, as it was described, does not have."""
    seen = sum(one.tags.seen for one in detection.searched)
    beyond = sum(one.tags.beyond for one in detection.searched)
    if beyond > _MIN_BEYOND_SHARE * seen:
        words = (
            'tagCols and tagRows'
            if pattern.kind == 'aprilgrid'
            else 'its columns and rows, or add the id of its first marker'
        )
        say(
            f'{beyond} of {seen} tags have ids beyond the {pattern.columns}x{pattern.rows} board; '
            f'check {words}'
        )


def note_side_by_side(table: Observations, sizes: Sizes) -> None:
    """Say where the frames of a camera look like those of two, whose images are joined."""
    for number, camera in enumerate(table.cameras):
        size = sizes.get(camera) or sizes.get('')
        if size and looks_side_by_side(table.take(table.camera == number), size):
            say(
                f'{table.source}: no frame lies across the middle of images of '
                f'{size[0]}x{size[1]} px: if two cameras lie side by side, search the '
                'photographs with --split 2'
            )


def _note_alone(detection: Detection) -> None:
    """Say which photographs of a rig have no partner of the same moment."""
    alone = [detection.searched[i].name for i in detection.pairing.alone]
    if len(alone) == len(detection.searched):
        say(
            f'no photographs of two cameras are simultaneous, by {detection.pairing.way}. Give '
            'simultaneous ones the same name or number, or name them by their stamps and raise '
            '--sync'
        )
    elif alone:
        more = f' and {len(alone) - _MAX_LISTED} more' if len(alone) > _MAX_LISTED else ''
        say(
            f'{len(alone)} of {len(detection.searched)} photographs have no simultaneous partner, '
            f'by {detection.pairing.way}: {", ".join(alone[:_MAX_LISTED])}{more}'
        )


def seconds(text: str) -> float:
    """Return a time, s, of a text such as 5ms."""
    match = _TIME.fullmatch(text)
    try:
        value = float(match[1]) * _UNITS[match[2]] if match else 0.0
    except ValueError:
        value = 0.0
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f'{text!r} is not a time with a unit, such as 5ms')
    return value


def positive_count(text: str) -> int:
    """Return a whole number above 0 of a text."""
    if not text.isdecimal() or not int(text):
        raise argparse.ArgumentTypeError(f'{text!r} is not a whole number above 0')
    return int(text)
