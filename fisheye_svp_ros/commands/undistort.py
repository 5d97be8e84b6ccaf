"""`fisheye-svp undistort`: photographs, and maps for cv2.remap, of ideal cameras; stereo pairs."""

from __future__ import annotations

import argparse
import os
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

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
from fisheye_svp_ros.io.view_files import (
    ViewCamera,
    colmap_cameras_text,
    colmap_rig_text,
    nerfstudio_text,
)
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.rectify.cameras import PROJECTIONS, STEREO_PROJECTIONS, camera_for
from fisheye_svp_ros.rectify.maps import RANGE, Rectification, RectifiedPair, rectify_pair
from fisheye_svp_ros.rectify.views import (
    View,
    cube_views,
    face_size,
    perspective_view,
    rectify_views,
)
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
from fisheye_svp_ros.reporting.wording.inputs import exchanged_cameras, points_extrapolated
from fisheye_svp_ros.scene.observations import STEREO
from fisheye_svp_ros.solve.rig_checks import is_exchanged

# What camera_info calls the rectified cameras that it can describe, and its coefficients
_CAMERA_INFO = {'pinhole': ('plumb_bob', 5), 'fisheye': ('equidistant', 4)}
_RESULT = 'undistort.json'
CUBEMAP, _PERSPECTIVE = 'cubemap', 'perspective'
_IMAGES = 'images'  # folder of the photographs of views, which COLMAP reads whole
_MAX_LISTED = 12  # photographs that are skipped
_PICTURES = ('mask.png', 'shift.png')  # of each camera, beside its photographs


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument(
        'inputs',
        nargs='*',
        metavar='LENS PHOTOS',
        help='lens file of this package or of another tool, or the name of a lens of this '
        'package. For a stereo pair: a file or folder with both lenses and the rig. Then '
        'photographs: files, folders (left/ and right/ for a rig), videos, recordings. '
        'Without photographs, only the maps are written',
    )
    parser.add_argument(
        '--lens',
        action='append',
        metavar='CAMERA=LENS',
        help='left=LENS and right=LENS, instead of the argument LENS',
    )
    parser.add_argument(
        '--rig',
        metavar='FILE',
        help='pose of the left camera in the right one, if the lens files do not hold it: a '
        'file, or a folder with rig.yaml',
    )
    add_output_folder(
        parser,
        'folder to write the photographs, undistort.json, camera_info.yaml, mask.png, and '
        'pictures of the remaining errors to. Also maps.npz and maps.yml (map1 and map2 for '
        'cv2.remap, mask, K, R, P). For a rig, one subfolder per camera',
        required=True,
    )
    add_split_argument(parser, '1')
    parser.add_argument(
        '--as',
        action='append',
        type=_projection,
        metavar='PROJECTION',
        dest='projections',
        help='projection of the rectified camera: pinhole (default), cylindrical, '
        'equirectangular, or fisheye (equidistant). perspective:YAW,PITCH,FOV: a turned '
        'pinhole, in degrees to the right and upward; can be given several times. cubemap: '
        'six such views. For views, cameras of COLMAP and nerfstudio are written, too',
    )
    parser.add_argument(
        '--fov',
        type=float,
        metavar='DEG',
        help='its horizontal field of view. Default: 90 for a pinhole, a face of a cube, and a '
        'cylindrical pair, otherwise that of the lens',
    )
    parser.add_argument(
        '--size',
        type=image_size,
        metavar='WxH',
        help='size of the rectified images, px. Default: that of the photographs; for faces of '
        'a cube, a resolution like that of the photographs in their middle',
    )
    parser.add_argument(
        '--range',
        type=float,
        default=RANGE,
        metavar='M',
        dest='range_m',
        help='range at which the maps of a lens with a moving viewpoint are exact, m or inf. '
        f'For a pair, it is measured from the middle of the baseline. Default: {RANGE:g}',
    )


def _projection(text: str) -> str:
    """Return a projection; raise ArgumentTypeError for one that is unknown."""
    if text in (*PROJECTIONS, CUBEMAP):
        return text
    try:
        _view(text)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f'{text!r} is unknown; choose from {", ".join((*PROJECTIONS, CUBEMAP))} and '
            'perspective:YAW,PITCH,FOV in degrees, up to 360, for example perspective:45,0,90'
        ) from None
    return text


def _view(text: str) -> View:
    kind, _, angles = text.partition(':')
    yaw, pitch, field = (float(np.radians(float(word))) for word in angles.split(','))
    turns = np.abs([yaw, pitch]) <= 2 * np.pi  # NaN is none
    if kind != _PERSPECTIVE or not (turns.all() and np.isfinite(field)):
        raise ValueError(text)
    return perspective_view(yaw, pitch, field)


def _views(args: argparse.Namespace) -> list[View]:
    """Return the views that are asked for, none where one projection is.

    Raises ParameterError for projections that do not go together.
    """
    asked = args.projections or [PROJECTIONS[0]]
    if len(asked) > 1 and not all(one.startswith(_PERSPECTIVE) for one in asked):
        raise ParameterError(
            f'--as {" --as ".join(asked)}: one projection, or several perspectives, can be written'
        )
    if asked == [CUBEMAP]:
        return cube_views() if args.fov is None else cube_views(float(np.radians(args.fov)))
    if not asked[0].startswith(_PERSPECTIVE):
        return []
    return [_view(one) for one in asked]


class _Sides(NamedTuple):
    """Rectifications by the name of their folder; by_camera: these names; pair: of a rig.

    views: whether they are views, whose images are in a folder of their own.
    """

    sides: dict[str, Rectification]
    by_camera: dict[str, list[str]]
    pair: RectifiedPair | None = None
    views: bool = False

    def image_folder(self, name: str) -> Path:
        """Return the folder of the photographs of a side, in that of the output."""
        return Path(_IMAGES if self.views else '', name)


def run(args: argparse.Namespace) -> None:
    """Map the photographs, write maps and cameras, say what is left at other ranges."""
    every, paths = _rectifications(args)
    sides, pair = every.sides, every.pair
    if args.range_m != RANGE and not pair and all(one.lens.is_svp for one in sides.values()):
        say(f'--range {args.range_m:g} changes nothing: the lens has a single viewpoint')
    # Pictures of an earlier run are replaced, those of a camera are not.
    fresh = not (args.output / _RESULT).exists()
    with (
        keep_existing(fresh),
        write_together(),
        progress('undistorting', count_photographs(paths, 1, args.split or 1)) as done,
    ):
        written = _write_photographs(every, paths, args.output, args.split or 1, done)
        left = {name: shift_left(side) for name, side in sides.items() if not side.lens.is_svp}
        rows = rows_left(pair) if pair and left else None
        document: dict[str, Any] = {
            'as': args.projections if every.views else (args.projections or PROJECTIONS)[0],
            'range_m': args.range_m,
            'cameras': {
                name or side.lens.name: _write_camera(
                    side, name, left.get(name), args.output / name
                )
                | {'photographs': len(written[name])}
                for name, side in sides.items()
            },
        }
        if pair:
            document |= {
                'baseline_m': pair.baseline,
                'rows': remaining_document(rows) if rows else None,
            }
        if every.views:
            for camera, names in every.by_camera.items():
                _write_views(camera, {name: sides[name] for name in names}, written, args.output)
        write_json(args.output / _RESULT, document)
    with keep_existing(fresh):
        _draw(sides, pair, left, rows, args.output)
    for name, side in sides.items():
        if side.extrapolated_points:
            say(points_extrapolated(name or side.lens.name, side.extrapolated_points))
        _print_camera(side, name, left.get(name))
    if pair and rows:
        print_remaining(
            f'baseline {1000 * pair.baseline:.2f} mm; row difference between left and right',
            rows,
        )
        print(f'  {tolerated_text(rows)}')
    count, kind = sum(map(len, written.values())), 'images' if every.views else 'photographs'
    print(f'{args.output}: {count} {kind}, maps for cv2.remap')


def _rectifications(args: argparse.Namespace) -> tuple[_Sides, list[str]]:
    """Return the rectifications by camera, of a rig also as a pair, and the photographs."""
    if not (args.lens or args.inputs):
        raise ParameterError('no lens is named; give LENS, or --lens left=LENS --lens right=LENS')
    views = _views(args)
    paths = list(args.inputs) if args.lens else args.inputs[1:]
    lenses = load_lenses(args.lens or args.inputs[:1])
    for line in doubtful_folders(paths):
        say(line)
    photographs = find_photographs(paths, split=args.split or 1)
    photographed = tuple(dict.fromkeys(one.camera for one in photographs))
    by_camera = _by_camera(photographed, lenses)
    if views:
        return _view_sides(args, views, by_camera), paths
    rig = _rig(args, by_camera, lenses.files)
    field = None if args.fov is None else float(np.radians(args.fov))
    wanted = (args.projections or PROJECTIONS)[0], args.size, field
    own = {name: [name] for name in by_camera}
    if rig is None:
        if len(lenses.in_file or lenses) > 1 and wanted[0] in STEREO_PROJECTIONS:
            _note_unrectified(list(by_camera))
        sides = {
            name: Rectification(lens, camera_for([lens], *wanted), args.range_m)
            for name, lens in by_camera.items()
        }
        return _Sides(sides, own), paths
    if tuple(by_camera) == STEREO and is_exchanged(rig):
        say(exchanged_cameras(*STEREO))
    left, right = by_camera.values()
    camera = camera_for([left, right], *wanted, along_baseline=True)
    pair = rectify_pair(left, right, rig, camera, args.range_m)
    return _Sides(dict(zip(by_camera, (pair.left, pair.right), strict=True)), own, pair), paths


def _view_sides(
    args: argparse.Namespace, views: Sequence[View], lenses: Mapping[str, Lens]
) -> _Sides:
    """Return the rectifications of views, a folder for each, in one of its camera."""
    cube = args.projections == [CUBEMAP]
    if cube and args.size and args.size[0] != args.size[1]:
        raise ParameterError(f'--size {args.size[0]}x{args.size[1]}: faces of a cube are square')
    sides: dict[str, Rectification] = {}
    by_camera: dict[str, list[str]] = {}
    for camera, lens in lenses.items():
        size = face_size(lens) if cube and args.size is None else args.size
        found = rectify_views(lens, views, size, args.range_m)
        if dark := [view.name for view in views if view.name not in found]:
            say(f'{lens.name}: no pixel of {", ".join(dark)} is in its field of view')
        named = {str(Path(camera, name)): side for name, side in found.items()}
        by_camera[camera] = list(named)
        sides |= named
    return _Sides(sides, by_camera, views=True)


def _write_views(
    camera: str,
    sides: Mapping[str, Rectification],
    written: Mapping[str, Sequence[str]],
    folder: Path,
) -> None:
    """Write the views of a camera for COLMAP, and with their photographs for nerfstudio."""
    views = [
        ViewCamera(
            Path(name).name,
            (side.camera.width, side.camera.height),
            side.camera.f,
            side.camera.cx,
            side.camera.cy,
            side.rotation,
        )
        for name, side in sides.items()
    ]
    write_text(folder / camera / 'cameras.txt', colmap_cameras_text(views))
    write_text(folder / camera / 'rig_config.json', colmap_rig_text(views))
    frames = [
        (
            view,
            os.path.relpath(Path(_IMAGES, name, photograph), camera or '.'),
            f'{view.name}/mask.png',
        )
        for view, name in zip(views, sides, strict=True)
        for photograph in written[name]
    ]
    write_text(folder / camera / 'transforms.json', nerfstudio_text(frames))


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
            f'{" and ".join(cameras)} are not rectified as a pair, because no rig is named; add '
            '--rig FILE'
        )
    elif len(cameras) > 2:
        say(
            f'{len(cameras)} cameras are not rectified as a pair; name two of them and their rig: '
            f'--lens {cameras[0]}=LENS --lens {cameras[1]}=LENS --rig FILE'
        )


def _write_photographs(
    every: _Sides, paths: Sequence[str], folder: Path, split: int, done: Any
) -> dict[str, list[str]]:
    """Write the rectified photographs, and a picture of the first pair; return their names."""
    written: dict[str, list[str]] = {name: [] for name in every.sides}
    taken = {folder / name / file for name in every.sides for file in _PICTURES}
    first: dict[str, tuple[str, Any]] = {}
    skipped: list[str] = []
    for photograph in find_photographs(paths, split=split):
        names = every.by_camera[photograph.camera]
        try:
            pixels = photograph.pixels(color=True)
            images = {name: every.sides[name].remap(pixels) for name in names}
        except (ObservationError, ParameterError) as error:
            skipped.append(str(error).removeprefix(f'{photograph.name}: '))
            if len(skipped) <= _MAX_LISTED:
                say(f'{photograph.name}: {skipped[-1]}; it is skipped')
            done()
            continue
        key = Path(photograph.key).name
        for name, image in images.items():
            path = folder / every.image_folder(name) / f'{key}.png'
            _check_name(path, taken, photograph.name, key)
            taken.add(path)
            write_png(path, image)
            written[name].append(path.name)
            first.setdefault(name, (key, image))
        done()
    if len(skipped) > _MAX_LISTED:
        say(f'and {len(skipped) - _MAX_LISTED} more such photographs')
    if skipped and not any(written.values()):
        raise ObservationError(f'{", ".join(paths)}: no photograph can be used: {skipped[0]}')
    if every.pair and len(first) == 2:
        left, right = (first[name] for name in every.sides)
        if left[0] == right[0]:
            draw_pair(folder / 'pair.png', left[1], right[1])
    return written


def _check_name(path: Path, taken: Collection[Path], photograph: str, key: str) -> None:
    """Raise ParameterError where a photograph would be written over another file of this run."""
    if path not in taken:
        return
    if path.name in _PICTURES:
        raise ParameterError(
            f'{photograph}: {path.name} is a result of this command too; rename the photograph'
        )
    raise ParameterError(
        f'{photograph}: another photograph is also called {key}; give one folder at a time'
    )


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
