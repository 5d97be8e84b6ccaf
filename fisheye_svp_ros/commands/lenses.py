"""Arguments about lenses: `--lens`, once or once a camera of a rig; `--medium`, `--port`."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from fisheye_svp_ros.commands.notes import say
from fisheye_svp_ros.effects.ray_effects import DomePortEffect
from fisheye_svp_ros.errors import LensError, ParameterError
from fisheye_svp_ros.io.lens_files import cameras_in, load_lens, read_lens_file
from fisheye_svp_ros.io.share import is_there, typed_lens_path, without_camera
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.optics.ports import MEDIA, DomeGlass, FlatGlass, Port
from fisheye_svp_ros.solve.lens_checks import is_known_in_part, probable_size

LARGE_DEVIATION = 0.5  # px, of a lens from what another tool's file says
_MAX_SHIFT = 0.1  # m, of the viewpoint at the edge of the field: no lens has so much
_MIN_FIELD_DEG = 5.0  # deg, of max_incidence_deg: no fisheye sees so little
_FORMS = 'flat, flat:5mm:1.49 (glass and its index), dome:60mm, dome:60mm:4mm:1.5 (inner radius)'


def add_lens_argument(parser: argparse.ArgumentParser, purpose: str = '') -> None:
    """Declare --lens, which may be given once a camera."""
    parser.add_argument(
        '--lens',
        required=True,
        action='append',
        metavar='[CAMERA=]LENS',
        help=f'{purpose}lens file of this package or of another tool, or the name of a lens of '
        'this package. For a rig: left=LENS and right=LENS, or a file or folder with both',
    )


def load_with_notes(path: str | Path) -> Lens:
    """Return the lens of a file, or raise LensError; say what is odd about it."""
    lens, foreign = load_lens(path), read_lens_file(path)
    note_odd(lens, path, foreign.deviation_px(lens) if foreign else 0.0)
    for note in foreign.notes if foreign else ():
        say(f'{path}: {note}')
    return lens


def note_odd(lens: Lens, path: str | Path, worst: float) -> None:
    """Say where a lens may not be what is meant; worst: px from what another tool's file says."""
    if not (-0.5 <= lens.cx <= lens.width - 0.5 and -0.5 <= lens.cy <= lens.height - 0.5):
        say(
            f'{path}: the principal point ({lens.cx:.1f}, {lens.cy:.1f}) lies outside the image '
            f'of {lens.width}x{lens.height} px; check cx, cy and the image size'
        )
    elif size := probable_size(lens):
        off = lens.cx - (lens.width - 1) / 2, lens.cy - (lens.height - 1) / 2
        say(
            f'{path}: the principal point is {off[0]:.0f}, {off[1]:.0f} px off the center of '
            f'{lens.width}x{lens.height} px. It would be the center of {size[0]}x{size[1]} px: '
            'check the image size'
        )
    limit = np.degrees(lens.max_incidence)
    shift = float(lens.shift_at(np.asarray(lens.max_incidence)))
    if abs(shift) > _MAX_SHIFT:
        say(
            f'{path}: the viewpoint shift is {shift:.2g} m at {limit:.3g} deg; its '
            'coefficients are in m'
        )
    if is_known_in_part(lens) and lens.calibrated_angle is not None:
        known = np.degrees(lens.calibrated_angle)
        say(
            f'{path}: image points of its calibration reach {known:.0f} deg of {limit:.0f} deg; '
            'beyond, the lens is extrapolated'
        )
    if limit < _MIN_FIELD_DEG:
        say(f'{path}: max_incidence_deg is {limit:.3g}; it is in degrees')
    if worst > LARGE_DEVIATION:
        say(
            f'{path}: the nearest lens is {worst:.2g} px off the model of this file; calibrate '
            'again from the photographs'
        )


class Lenses(dict[str, 'Lens']):
    """Lenses by camera; '' is that of every camera without its own.

    files: where they are from; in_file: cameras of a file that holds several, in its order; '' is
    the first of them; file: it, as given.
    """

    files: dict[str, Path]
    file: str = ''
    in_file: tuple[Lens, ...] = ()
    names: tuple[str, ...] = ()


def load_lenses(given: Sequence[str]) -> Lenses:
    """Return the lenses of --lens; raise LensError for a bad one, and for two of a camera."""
    lenses = Lenses()
    lenses.files = {}
    for text in given:
        camera, equals, path = text.partition('=')
        if not equals or is_there(Path(without_camera(text)[0])):
            camera, path = '', text
        if camera in lenses:
            raise LensError(
                f'--lens {text}: a lens '
                f'{"of camera " + camera if camera else "without a camera"} is '
                'already given'
            )
        file = typed_lens_path(path)
        lenses[camera] = load_with_notes(file)
        lenses.files[camera] = file
        if not camera:
            lenses.file, lenses.names = path, cameras_in(file)
            lenses.in_file = tuple(load_lens(f'{file}#{name}') for name in lenses.names)
    return lenses


def lenses_of(cameras: Sequence[str], lenses: Lenses) -> dict[str, Lens]:
    """Return the lens of each camera of the observations.

    Those of a file go by their names, or else by their order: the first is that of `left`.  A
    camera without a name has the first, which a note says.
    Raises LensError for a camera without a lens, and for a name that is no camera of theirs.
    """
    if len(lenses) == 1 and len(lenses.in_file) > 1:
        if any(cameras):
            return _in_order(cameras, lenses)
        say(
            f'{lenses.file}: it holds {", ".join(lenses.names)}, and no camera is named; the lens '
            f'of {lenses.names[0]} is used; use {lenses.file}#{lenses.names[1]} for another'
        )
    unknown = [camera for camera in lenses if camera and camera not in cameras]
    if unknown:
        held = ', '.join(filter(None, cameras)) or 'one camera without a name'
        raise LensError(f'--lens {unknown[0]}=...: the observations hold {held}')
    for camera in cameras:
        if camera not in lenses and '' not in lenses:
            raise LensError(
                f'camera {camera or "without a name"} has no lens; add '
                f'--lens {camera + "=" if camera else ""}LENS'
            )
    return {camera: lenses.get(camera) or lenses[''] for camera in cameras}


def _in_order(cameras: Sequence[str], lenses: Lenses) -> dict[str, Lens]:
    named = dict(zip(lenses.names, lenses.in_file, strict=True))
    if set(cameras) <= set(named):
        return {camera: named[camera] for camera in cameras}
    if len(cameras) != len(named):
        raise LensError(
            f'{lenses.file}: it holds {", ".join(named)}, the observations '
            f'{", ".join(cameras)}; assign them: --lens '
            f'{cameras[0]}={lenses.file}#{lenses.names[0]} ...'
        )
    return dict(zip(sorted(cameras), lenses.in_file, strict=True))


def add_port_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare --medium and --port."""
    parser.add_argument(
        '--medium',
        metavar='MEDIUM',
        help='medium between port and target: ' + ', '.join(MEDIA) + ' or a refractive index',
    )
    parser.add_argument(
        '--port',
        metavar='SPEC',
        help=f'what the camera looked through: {_FORMS}; default: flat, its glass counted as air',
    )


def port_of(args: argparse.Namespace) -> Port | None:
    """Return the port that the arguments speak of; None where they do not.

    Raises ParameterError for a medium or port that cannot be.
    """
    if args.medium is None and args.port is None:
        return None
    medium = args.medium or 'water'
    try:
        index = MEDIA.get(medium) or float(medium)
    except ValueError as cause:
        raise ParameterError(
            f'--medium {medium}: choose from {", ".join(MEDIA)}, and refractive indices'
        ) from cause
    kind, *numbers = (args.port or 'flat').split(':')
    try:
        if kind == 'flat' and len(numbers) <= 2:
            port: Port = FlatGlass(0.0, index, **_glass(numbers))
        elif kind == 'dome' and 1 <= len(numbers) <= 3:
            port = DomeGlass(_length(numbers[0]), index, **_glass(numbers[1:]))
        else:
            raise ValueError
    except ValueError as cause:
        raise ParameterError(f'--port {args.port}: it must be of the form {_FORMS}') from cause
    for option, given in (
        (f'--medium {args.medium}', FlatGlass(0.0, index)),
        (f'--port {args.port}', port),
    ):
        if wrong := given.check():
            raise ParameterError(f'{option}: {wrong}')
    return port


def add_dome_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare --medium and --port of a diagnosis: a dome in air."""
    parser.add_argument(
        '--medium', metavar='MEDIUM', help='with --port dome: air; other media are always tested'
    )
    parser.add_argument(
        '--port',
        metavar='SPEC',
        help='dome in front of the camera: dome:60mm:4mm:1.5 (inner radius, glass, index), or '
        'dome for 50 mm with 4 mm of glass. The offset of its center from the axis is '
        'estimated',
    )


def dome_of(args: argparse.Namespace, lenses: Mapping[str, Lens]) -> tuple[DomePortEffect, ...]:
    """Return the dome that a diagnosis in air is told of; none where the arguments name no port.

    Raises ParameterError for another port or medium, which is found without being named.
    """
    dome = DomePortEffect()
    if args.port == 'dome':
        args.port = f'dome:{1e3 * dome.radius:g}mm:{1e3 * dome.thickness:g}mm'
    port = port_of(args)
    if port is None:
        return ()
    option = ' '.join(
        f'--{name} {value}'
        for name, value in (('medium', args.medium), ('port', args.port))
        if value
    )
    if not isinstance(port, DomeGlass):
        raise ParameterError(f'{option}: a flat port is always tested; leave the option out')
    if port.medium_index != MEDIA['air']:
        raise ParameterError(
            f'{option}: a dome is diagnosed in air, with --medium air; in water '
            '`calibrate --lens AIR.yaml` with the same options fits it'
        )
    if not port.thickness:
        raise ParameterError(
            f'{option}: glass of no thickness bends nothing in air; state it, as '
            'in --port dome:60mm:4mm'
        )
    if len(lenses) > 1 or any(lens.port is not None for lens in lenses.values()):
        raise ParameterError(f'{option}: one lens without a port of its own is needed')
    return (DomePortEffect(port.radius, port.thickness, port.glass_index),)


def _glass(numbers: list[str]) -> dict[str, float]:
    glass = {'thickness': _length(numbers[0])} if numbers else {}
    return glass | ({'glass_index': float(numbers[1])} if numbers[1:] else {})


def _length(text: str) -> float:
    """Return a length, m, of a text such as 5mm."""
    if text.removesuffix('mm') == text:
        raise ValueError(text)
    return 1e-3 * float(text.removesuffix('mm'))
