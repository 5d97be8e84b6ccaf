"""`--medium` and `--port`: what a camera looked through, and into."""

from __future__ import annotations

import argparse
from collections.abc import Mapping

from fisheye_svp_ros.effects.ray_effects import DomePortEffect
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.optics.ports import MEDIA, DomeGlass, FlatGlass, Port

_FORMS = 'flat, flat:5mm:1.49 (glass and its index), dome:60mm, dome:60mm:4mm:1.5 (inner radius)'


def add_port_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare --medium and --port."""
    parser.add_argument('--medium', metavar='MEDIUM',
                        help='medium between port and target: ' + ', '.join(MEDIA)
                        + ' or a refractive index')
    parser.add_argument('--port', metavar='SPEC',
                        help=f'what the camera looked through: {_FORMS}; default: flat, its glass '
                        'counted as air')


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
        raise ParameterError(f'--medium {medium}: known are {", ".join(MEDIA)}, and refractive '
                             'indices') from cause
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
    for option, given in ((f'--medium {args.medium}', FlatGlass(0.0, index)),
                          (f'--port {args.port}', port)):
        if wrong := given.check():
            raise ParameterError(f'{option}: {wrong}')
    return port


def add_dome_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare --medium and --port of a diagnosis: a dome in air."""
    parser.add_argument('--medium', metavar='MEDIUM',
                        help='with --port dome: air; other media are always tested')
    parser.add_argument('--port', metavar='SPEC',
                        help='dome in front of the camera: dome:60mm:4mm:1.5 (inner radius, '
                        'glass, index), or dome for 50 mm with 4 mm of glass; the offset of its '
                        'center from the axis is estimated')


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
    option = ' '.join(f'--{name} {value}' for name, value in (
        ('medium', args.medium), ('port', args.port)) if value)
    if not isinstance(port, DomeGlass):
        raise ParameterError(f'{option}: a flat port is always tested; leave the option out')
    if port.medium_index != MEDIA['air']:
        raise ParameterError(f'{option}: a dome is diagnosed in air, with --medium air; in water '
                             '`calibrate --lens AIR.yaml` with the same options fits it')
    if not port.thickness:
        raise ParameterError(f'{option}: glass of no thickness bends nothing in air; state it, as '
                             'in --port dome:60mm:4mm')
    if len(lenses) > 1 or any(lens.port is not None for lens in lenses.values()):
        raise ParameterError(f'{option}: one lens without a port of its own is needed')
    return (DomePortEffect(port.radius, port.thickness, port.glass_index),)


def _glass(numbers: list[str]) -> dict[str, float]:
    glass = {'thickness': _length(numbers[0])} if numbers else {}
    return glass | ({'glass_index': float(numbers[1])} if numbers[1:] else {})


def _length(text: str) -> float:
    """Return a length, m, of a text such as 5mm."""
    if not text.endswith('mm'):
        raise ValueError(text)
    return 1e-3 * float(text.removesuffix('mm'))
