"""`fisheye-svp undistort`: photographs, and maps for cv2.remap, of ideal cameras; stereo pairs."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fisheye_svp_ros.commands.detect import add_split_argument, image_size
from fisheye_svp_ros.commands.lenses import Lenses, lenses_of, load_lenses
from fisheye_svp_ros.commands.notes import say
from fisheye_svp_ros.commands.outputs import add_output_folder
from fisheye_svp_ros.detect.photographs import (
    count_photographs,
    doubtful_folders,
    find_photographs,
)
from fisheye_svp_ros.errors import ObservationError, ParameterError
from fisheye_svp_ros.io.files import keep_existing, write_json, write_text, write_together
from fisheye_svp_ros.io.image_files import save_maps, write_png
from fisheye_svp_ros.io.lens_formats.ros import camera_info_text
from fisheye_svp_ros.io.rig_files import load_pair, pair_of_camera_infos, pair_of_lenses
from fisheye_svp_ros.io.share import typed_lens_path
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.rectify.cameras import PROJECTIONS, STEREO_PROJECTIONS, camera_for
from fisheye_svp_ros.rectify.maps import RANGE, Rectification, RectifiedPair, rectify_pair
from fisheye_svp_ros.reporting.terminal import draw_or_note, progress, range_text
from fisheye_svp_ros.reporting.undistort_report import (
    Remaining,
    draw_pair,
    draw_remaining,
    print_remaining,
    remaining_document,
    rows_left,
    shift_left,
    tolerated_text,
)
from fisheye_svp_ros.reporting.wording.inputs import points_extrapolated

# What camera_info calls the rectified cameras that it can describe, and its coefficients
_CAMERA_INFO = {'pinhole': ('plumb_bob', 5), 'fisheye': ('equidistant', 4)}
_RESULT = 'undistort.json'
_MAX_LISTED = 12  # photographs that are skipped
_PICTURES = ('mask.png', 'shift.png')  # of each camera, beside its photographs


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument(
        'inputs',
        nargs='*',
        metavar='LENS PHOTOS',
        help='lens file, also of other tools, or the name of a lens of this '
        'package; for a stereo pair, a file or folder with both lenses and '
        'the rig; then photographs: files, folders (left/ and right/ for a '
        'rig), videos, recordings; without photographs, only the maps are '
        'written',
    )
    parser.add_argument(
        '--lens',
        action='append',
        metavar='CAMERA=LENS',
        help='left=LENS and right=LENS, in place of the argument LENS',
    )
    parser.add_argument(
        '--rig',
        metavar='FILE',
        help='pose of the left camera in the right one: a file, or a folder with '
        'rig.yaml; if the lens files do not hold it',
    )
    add_output_folder(
        parser,
        'folder to write the photographs, maps.npz and maps.yml (map1 and '
        'map2 for cv2.remap, mask, K, R, P), mask.png, camera_info.yaml, '
        'pictures of the remaining errors and undistort.json to; for a rig, '
        'one subfolder per camera',
        required=True,
    )
    add_split_argument(parser, '1')
    parser.add_argument(
        '--as',
        choices=PROJECTIONS,
        default=PROJECTIONS[0],
        dest='projection',
        help='projection of the rectified camera; fisheye: equidistant; default: pinhole',
    )
    parser.add_argument(
        '--fov',
        type=float,
        metavar='DEG',
        help='its field of view over the width; default: 90 for a pinhole '
        'and for a cylindrical pair, otherwise that of the lens',
    )
    parser.add_argument(
        '--size',
        type=image_size,
        metavar='WxH',
        help='size of the rectified images, px; default: that of the photographs',
    )
    parser.add_argument(
        '--range',
        type=float,
        default=RANGE,
        metavar='M',
        dest='range_m',
        help='range at which the maps of a lens with a moving viewpoint are '
        'exact, m or inf; of a pair, from the middle of the baseline; '
        f'default: {RANGE:g}',
    )


def run(args: argparse.Namespace) -> None:
    """Map the photographs, write maps and cameras, say what is left at other ranges."""
    sides, pair, paths = _rectifications(args)
    # Pictures of an earlier run are replaced, those of a camera are not.
    fresh = not (args.output / _RESULT).exists()
    with (
        keep_existing(fresh),
        write_together(),
        progress('undistorting', count_photographs(paths, 1, args.split or 1)) as done,
    ):
        counts = _write_photographs(sides, pair, paths, args.output, args.split or 1, done)
        left = {name: shift_left(side) for name, side in sides.items() if not side.lens.is_svp}
        rows = rows_left(pair) if pair and left else None
        document: dict[str, Any] = {
            'as': args.projection,
            'range_m': args.range_m,
            'cameras': {
                name or side.lens.name: _write_camera(
                    side, name, left.get(name), args.output / name
                )
                | {'photographs': counts[name]}
                for name, side in sides.items()
            },
        }
        if pair:
            document |= {
                'baseline_m': pair.baseline,
                'rows': remaining_document(rows) if rows else None,
            }
        write_json(args.output / _RESULT, document)
    with keep_existing(fresh):
        _draw(sides, pair, left, rows, args.output)
    for name, side in sides.items():
        if side.extrapolated_points:
            say(points_extrapolated(name or side.lens.name, side.extrapolated_points))
        _print_camera(side, name, left.get(name))
    if pair and rows:
        print_remaining(
            f'baseline {1000 * pair.baseline:.2f} mm; difference between the rows of '
            'left and right',
            rows,
        )
        print(f'  {tolerated_text(rows)}')
    print(f'{args.output}: {sum(counts.values())} photographs, maps for cv2.remap')


def _rectifications(
    args: argparse.Namespace,
) -> tuple[dict[str, Rectification], RectifiedPair | None, list[str]]:
    """Return the rectifications by camera, of a rig also as a pair, and the photographs."""
    if not (args.lens or args.inputs):
        raise ParameterError('no lens is named; give LENS, or --lens left=LENS --lens right=LENS')
    paths = list(args.inputs) if args.lens else args.inputs[1:]
    lenses = load_lenses(args.lens or args.inputs[:1])
    for line in doubtful_folders(paths):
        say(line)
    photographs = find_photographs(paths, split=args.split or 1)
    photographed = tuple(dict.fromkeys(one.camera for one in photographs))
    by_camera = _by_camera(photographed, lenses)
    rig = _rig(args, by_camera, lenses.files)
    field = None if args.fov is None else float(np.radians(args.fov))
    wanted = args.projection, args.size, field
    if rig is None:
        if len(lenses.in_file or lenses) > 1 and args.projection in STEREO_PROJECTIONS:
            _note_unrectified(list(by_camera))
        sides = {
            name: Rectification(lens, camera_for([lens], *wanted), args.range_m)
            for name, lens in by_camera.items()
        }
        return sides, None, paths
    left, right = by_camera.values()
    camera = camera_for([left, right], *wanted, along_baseline=True)
    pair = rectify_pair(left, right, rig, camera, args.range_m)
    return dict(zip(by_camera, (pair.left, pair.right), strict=True)), pair, paths


def _by_camera(photographed: Sequence[str], lenses: Lenses) -> dict[str, Lens]:
    """Return lenses by camera: as the photographs call them, or else as the lenses are called."""
    names = lenses.names or tuple(lenses)
    cameras = names if set(photographed) <= set(names) else tuple(sorted(photographed))
    return lenses_of(cameras, lenses)


def _rig(
    args: argparse.Namespace, lenses: dict[str, Lens], files: Mapping[str, Path]
) -> Pose | None:
    if args.rig:
        if len(lenses) != 2:
            raise ParameterError(
                f'--rig {args.rig}: a rig of two cameras needs two lenses, got '
                f'{len(lenses)}; give --lens left=LENS --lens right=LENS'
            )
        return load_pair(args.rig, list(lenses))
    if len(lenses) != 2:
        return None
    if args.lens:
        return pair_of_camera_infos([files[name] for name in lenses if name in files])
    return pair_of_lenses(typed_lens_path(args.inputs[0]), list(lenses))


def _note_unrectified(cameras: Sequence[str]) -> None:
    """Say why the photographs of several cameras are not rectified as those of a pair."""
    if len(cameras) == 2:
        say(
            f'{" and ".join(cameras)} are not rectified as a pair, since no rig is named; add '
            '--rig FILE'
        )
    elif len(cameras) > 2:
        say(
            f'{len(cameras)} cameras are not rectified as a pair; name two of them and their rig: '
            f'--lens {cameras[0]}=LENS --lens {cameras[1]}=LENS --rig FILE'
        )


def _write_photographs(
    sides: dict[str, Rectification],
    pair: RectifiedPair | None,
    paths: Sequence[str],
    folder: Path,
    split: int,
    done: Any,
) -> dict[str, int]:
    """Write the rectified photographs, and a picture of the first pair; return how many."""
    counts = dict.fromkeys(sides, 0)
    written = {folder / name / file for name in sides for file in _PICTURES}
    first: dict[str, tuple[str, Any]] = {}
    skipped: list[str] = []
    for photograph in find_photographs(paths, split=split):
        try:
            image = sides[photograph.camera].remap(photograph.pixels(color=True))
        except (ObservationError, ParameterError) as error:
            skipped.append(str(error).removeprefix(f'{photograph.name}: '))
            if len(skipped) <= _MAX_LISTED:
                say(f'{photograph.name}: {skipped[-1]}; it is skipped')
            done()
            continue
        key = Path(photograph.key).name
        path = folder / photograph.camera / f'{key}.png'
        if path in written:
            if path.name in _PICTURES:
                raise ParameterError(
                    f'{photograph.name}: {path.name} is a result of this command '
                    'too; rename the photograph'
                )
            raise ParameterError(
                f'{photograph.name}: another photograph is also called {key}; '
                'give one folder at a time'
            )
        written.add(path)
        write_png(path, image)
        counts[photograph.camera] += 1
        first.setdefault(photograph.camera, (key, image))
        done()
    if len(skipped) > _MAX_LISTED:
        say(f'and {len(skipped) - _MAX_LISTED} more such photographs')
    if skipped and not any(counts.values()):
        raise ObservationError(f'{", ".join(paths)}: no photograph can be used: {skipped[0]}')
    if pair and len(first) == 2:
        left, right = (first[name] for name in sides)
        if left[0] == right[0]:
            draw_pair(folder / 'pair.png', left[1], right[1])
    return counts


def _write_camera(
    side: Rectification, name: str, left: Remaining | None, folder: Path
) -> dict[str, Any]:
    """Write maps, camera and picture of one camera; return its part of undistort.json."""
    camera, maps = side.camera, side.maps
    size = camera.width, camera.height
    save_maps(folder, *maps, side.k, side.rotation, side.p)
    write_png(folder / 'mask.png', 255 * maps.mask.astype(np.uint8))
    if camera.projection in _CAMERA_INFO:
        model, count = _CAMERA_INFO[camera.projection]
        write_text(
            folder / 'camera_info.yaml',
            camera_info_text(name or side.lens.name, size, side.k, model, [0.0] * count, side.p),
        )
    return {
        'lens': side.lens.name,
        'size': list(size),
        'k': side.k.tolist(),
        'r': side.rotation.tolist(),
        'p': side.p.tolist(),
        'fov_deg': float(np.degrees(camera.field_of_view)),
        'reached': float(maps.mask.mean()),
        'shift': remaining_document(left) if left else None,
    }


def _draw(
    sides: dict[str, Rectification],
    pair: RectifiedPair | None,
    left: dict[str, Remaining],
    rows: Remaining | None,
    folder: Path,
) -> None:
    """Draw what is left: of each camera, and between the rows of a pair."""
    for name, remaining in left.items():
        path = folder / name / 'shift.png'
        draw_or_note(path, draw_remaining, sides[name], remaining, 'error of image points')
    if pair and rows:
        path = folder / 'rows.png'
        draw_or_note(path, draw_remaining, pair.left, rows, 'difference of rows')


def _print_camera(side: Rectification, name: str, left: Remaining | None) -> None:
    camera = side.camera
    print(
        f'{name or side.lens.name}: {camera.projection} {camera.width}x{camera.height} px, f '
        f'{camera.f:.2f} px, {np.degrees(camera.field_of_view):.1f} deg wide; '
        f'{100 * side.maps.mask.mean():.1f} % of the pixels lie in its field of view'
    )
    if left is None:
        print('  the lens has one viewpoint: the maps are exact at every range')
        return
    print_remaining(
        f'{f"{name}: " * bool(name)}the maps are exact at {range_text(side.range)}; '
        'error at other ranges',
        left,
    )
    print(f'  {tolerated_text(left)}')
