"""`fisheye-svp lens`: a lens shown, checked, converted; a rig as well."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction

import numpy as np

from fisheye_svp_ros.commands.detect import image_size
from fisheye_svp_ros.commands.lenses import load_with_notes
from fisheye_svp_ros.commands.notes import note_reader_limit, say
from fisheye_svp_ros.commands.outputs import output_file
from fisheye_svp_ros.effects.extension import LANDMARKS
from fisheye_svp_ros.effects.forward import project_corrected
from fisheye_svp_ros.effects.resizing import ImageChange
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.io.lens_files import cameras_in, load_lens, read_lens_file, save_lens
from fisheye_svp_ros.io.lens_formats import (
    RIG_WRITABLE,
    WRITABLE,
    read_foreign,
    write_foreign,
    write_foreign_rig,
)
from fisheye_svp_ros.io.rig_files import load_cameras, rigs_of_lenses, save_rig
from fisheye_svp_ros.io.share import typed_lens_path
from fisheye_svp_ros.library.lenses import change_image
from fisheye_svp_ros.optics.curves import Gennery
from fisheye_svp_ros.optics.lens import IMAGE_FIELD, PORT, Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.rectify.maps import MAX_RANGE, nearest_svp_lens
from fisheye_svp_ros.reporting.terminal import print_table, range_text
from fisheye_svp_ros.scene.observations import STEREO

_ANGLES, _RANGES = (20, 40, 60, 75, 85, 95, 105), (0.1, 0.2, 0.5, 2.0)  # deg, m
_AZIMUTHS = np.radians(np.arange(0, 360, 15))  # the axis
_VISIBLE_PX = 5e-4  # px
_STRETCH = 2e-3  # of one axis against the other, beyond what rounding to whole pixels does


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument(
        'lens',
        metavar='LENS',
        help='lens file of this package or of another tool, or the name of a lens of this '
        'package. FILE#cam1 selects another camera than the first',
    )
    parser.add_argument('-o', '--output', type=output_file, metavar='FILE', help='file to write')
    parser.add_argument(
        '--format',
        choices=WRITABLE,
        help='format of the file to write; default: a lens file of this package',
    )
    parser.add_argument(
        '--range',
        type=float,
        metavar='M',
        dest='range_m',
        help='range, m or inf, at which a format with a single viewpoint is '
        'fitted to a lens whose viewpoint moves',
    )
    parser.add_argument(
        '--crop',
        type=_crop,
        metavar='X,Y,W,H',
        help='show and write the lens of a part of the image, px: first column and row, width '
        'and height',
    )
    size = parser.add_mutually_exclusive_group()
    size.add_argument(
        '--scale',
        type=_scale,
        metavar='FACTOR',
        help='the lens of an image resized by a factor, such as 1/2, after --crop. Pixel '
        'centers are at whole numbers, so cx becomes (cx + 0.5) / 2 - 0.5, as for binning '
        'and cv2.INTER_AREA',
    )
    size.add_argument(
        '--size',
        type=image_size,
        metavar='WxH',
        help='the lens of an image resized to this size, px',
    )


def run(args: argparse.Namespace) -> None:
    """Show the lens, write it, say what the form cannot hold."""
    path = typed_lens_path(args.lens)
    foreign = read_lens_file(path)
    changed = (args.crop, args.scale, args.size) != (None, None, None)
    if foreign is not None and not foreign.lenses and not args.format and not changed:
        _print_rig(foreign.rigs)
        if args.output:
            save_rig(foreign.rigs, args.output, foreign.cameras or STEREO)
        return
    lens = _changed(load_with_notes(path), args) if changed else load_with_notes(path)
    several = cameras_in(path)
    steps = rigs_of_lenses(path) if several else ()
    chain = load_cameras(path)[0] if steps else ()
    whole = args.format in RIG_WRITABLE and len(chain) > 1 and sorted(chain) == sorted(several)
    if several:
        only = f' and only {several[0]} is written' if args.output and not whole else ''
        say(
            f'{path}: it holds {", ".join(several)}; the first is shown{only}; use '
            f'{args.lens}#{several[1]} for another'
            + (f', or --format {" or ".join(RIG_WRITABLE)} for the rig' if only and steps else '')
        )
    print(
        f'{lens.name}: {lens.width}x{lens.height} px, up to {np.degrees(lens.max_incidence):.2f}'
        ' deg'
    )
    for name, value in lens.parameters.items():
        print(f'  {name:<18}{value:.10g}')
    for name, entry in lens.corrections.items():
        for parameter, value in entry.get('parameters', {}).items():
            print(f'  {f"{name} {parameter}":<18} {value:.10g}')
    if lens.image_field is not None:
        print(
            f'  {IMAGE_FIELD:<18}{lens.image_field.rms:.3g} px rms, splines of '
            f'{" x ".join(map(str, lens.image_field.values.shape[1::-1]))} nodes'
        )
    if foreign is not None:
        for camera, worst in foreign.worst_px.items():
            if worst > 0:
                print(
                    f'  {camera}: kannala_brandt fitted to {foreign.form}, at most {worst:.2g} '
                    'px off'
                )
    _print_rig(steps)
    if args.output and args.format:
        cameras = [load_lens(f'{path}#{name}') for name in chain] if whole else []
        cameras = [_changed(camera, args) for camera in cameras] if changed else cameras
        _convert(cameras or [lens], steps if cameras else (), args)
    elif args.output:
        save_lens(lens, args.output)
    if args.output:
        print(f'{args.output}: {args.format or "lens file of this package"}')


def _changed(lens: Lens, args: argparse.Namespace) -> Lens:
    """Return the lens of the image that the arguments ask for; say what that loses."""
    change = ImageChange.of((lens.width, lens.height), args.crop, args.scale, args.size)
    resized, lost = change_image(lens, change)
    if lost:
        say(f'left out, because the pixels have another size: {", ".join(lost)}')
    if abs(np.log(change.scale[0] / change.scale[1])) > _STRETCH:
        say(
            f'{args.size[0]}x{args.size[1]} px stretches the image by {change.scale[0]:.4g} '
            f'along u and {change.scale[1]:.4g} along v; if it was cropped, give the part with '
            '--crop'
        )
    return resized


def _crop(text: str) -> tuple[int, int, int, int]:
    """Return X, Y, width and height, px, of a text such as 0,40,1280,720."""
    words = text.split(',')
    if len(words) != 4 or not all(word.strip().isdecimal() for word in words):
        raise argparse.ArgumentTypeError(f'{text!r} is not of the form X,Y,WIDTH,HEIGHT, px')
    x, y, width, height = map(int, words)
    return x, y, width, height


def _scale(text: str) -> float:
    """Return the factor of a text such as 1/2 or 0.5."""
    try:
        factor = float(Fraction(text))
    except (ValueError, ZeroDivisionError, OverflowError):
        factor = 0.0
    if not 0 < factor < np.inf:
        raise argparse.ArgumentTypeError(f'{text!r} is not a factor above 0, such as 1/2 or 0.5')
    return factor


def _convert(lenses: Sequence[Lens], steps: Sequence[Pose], args: argparse.Namespace) -> None:
    """Write another tool's form of lenses, or of the nearest SVP lenses; say what that loses.

    steps: each camera in the next one, of a rig.
    """
    fitted = [_at_range(lens, args) for lens in lenses]
    given = [lens for lens, _ in fitted]
    if len(given) > 1:
        text = write_foreign_rig(given, steps, args.format)
    else:
        text = write_foreign(given[0], args.format)
    write_text(args.output, text)
    written = read_foreign(args.output, text)
    for i, (lens, (near, ranges)) in enumerate(zip(lenses, fitted, strict=True)):
        if written is not None:
            _print_loss(lens, [*written.lenses.values()][i], ranges, args.range_m is None)
        note_reader_limit(near, args.format)


def _at_range(lens: Lens, args: argparse.Namespace) -> tuple[Lens, tuple[float, ...]]:
    """Return the lens, or the SVP lens nearest at the range that is asked for, and ranges, m."""
    given, ranges = lens, _RANGES
    if args.range_m is not None and lens.is_svp:
        if not args.range_m > 0:
            raise ParameterError(f'--range {args.range_m:g}: a distance in m, above 0, is needed')
        say(f'--range {args.range_m:g} changes nothing: lens {lens.name!r} has a single viewpoint')
    elif args.range_m is not None:
        given, worst = nearest_svp_lens(lens, args.range_m)
        ranges = tuple(sorted({*_RANGES, args.range_m}))
        print(
            f'  one viewpoint, fitted at {range_text(args.range_m)}: {worst:.2g} px off there '
            'at most'
        )
    return given, ranges


def _print_rig(steps: Sequence[Pose]) -> None:
    for number, rig in enumerate(steps):
        print(
            f'  camera {number} in camera {number + 1} at '
            + ', '.join(f'{1000 * value:.3f}' for value in rig.position)
            + ' mm'
        )


def _print_loss(lens: Lens, written: Lens, ranges: Sequence[float], as_it_stands: bool) -> None:
    """Say what the form does not hold, px, by angle and range; or how that could be less."""
    port = () if lens.port is None else (PORT,)
    field = [IMAGE_FIELD] if lens.image_field and not written.image_field else []
    # Of corrections, an image field that was made for the form holds all.
    held = lens.corrections if written.image_field else written.corrections
    own = [name for name in lens.corrections if name not in held]
    named = [name for name in (*port, *own, *field, *lens.target) if name != LANDMARKS]
    shift = lens.viewpoint_shift
    if shift is not None and written.viewpoint_shift != shift:
        constant = isinstance(shift, Gennery) and written.viewpoint_shift == replace(shift, s0=0.0)
        named.insert(0, 's0 of the viewpoint shift' if constant else 'the viewpoint shift')
    if named:
        print(f'left out: {", ".join(named)}')
    angles = [angle for angle in _ANGLES if np.radians(angle) < lens.max_incidence]
    theta = np.radians(angles)[:, None]
    sin = np.sin(theta)
    around = np.stack(
        np.broadcast_arrays(sin * np.cos(_AZIMUTHS), sin * np.sin(_AZIMUTHS), np.cos(theta)),
        axis=-1,
    )
    distance = np.minimum(ranges, MAX_RANGE)
    points = distance[:, None, None] * around[:, None]
    uv = project_corrected(lens, points).uv
    half = np.array([lens.width, lens.height]) / 2
    inside = (np.abs(uv + 0.5 - half) <= half).all(axis=-1)
    off = np.linalg.norm(uv - project_corrected(written, points).uv, axis=-1)
    worst = np.fmax.reduce(np.where(inside, off, np.nan), axis=-1)
    if np.fmax.reduce(worst, axis=None) > _VISIBLE_PX:
        print_table(
            'largest error of points in the image, px',
            ('deg', *map(range_text, ranges)),
            [
                (str(angle), *('-' if np.isnan(value) else f'{value:.3f}' for value in row))
                for angle, row in zip(angles, worst, strict=True)
                if not np.isnan(row).all()
            ],
        )
        if as_it_stands and 'the viewpoint shift' in named:
            print('  --range M fits the curve at one range, without error there')
        elif as_it_stands and written.viewpoint_shift is not None:
            print('  --range M fits a splined model at one range, without the viewpoint shift')
