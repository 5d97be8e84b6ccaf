"""Which options apply to what: one that would have no effect is refused."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from fisheye_svp_ros.detect.patterns import LOOSE_TAGS
from fisheye_svp_ros.errors import ParameterError


class Rule(NamedTuple):
    """Options of commands, when they apply, and what is said of one that does not."""

    commands: tuple[str, ...]
    options: tuple[str, ...]
    applies: Callable[[argparse.Namespace], object]
    reason: str


def _has_photographs(args: argparse.Namespace) -> bool:
    """Whether an input is no table: with a board, it is searched."""
    inputs = (args.observations, getattr(args, 'held_out', None), getattr(args, 'against', None))
    return any(Path(path).suffix.lower() != '.csv' for path in inputs if path)


def _is_perspective(projection: str) -> bool:
    return projection.startswith('perspective')


def _has_views(args: argparse.Namespace) -> bool:
    """Whether views of a lens are asked for."""
    asked = args.projections or ()
    return any(_is_perspective(one) or one == 'cubemap' for one in asked)


_READING = ('calibrate', 'diagnose', 'localize')
_DESTINATIONS = {'--for': 'number', '--range': 'range_m', '--next': 'count'}  # unlike the option
RULES = (
    Rule(
        _READING,
        ('--board',),
        _has_photographs,
        'has no effect on a CSV file, which holds its landmarks; leave it out',
    ),
    Rule(
        _READING,
        ('--detector', '--every', '--sync', '--split'),
        lambda args: args.board and _has_photographs(args),
        'has an effect only on photographs, with --board; leave it out',
    ),
    Rule(
        ('calibrate',),
        ('--lens',),
        lambda args: args.medium or args.port,
        'needs --medium (for example water) or --port, which say what the camera looked through',
    ),
    Rule(
        ('calibrate',),
        ('--model', '--image-size'),
        lambda args: not args.lens,
        'has no effect with --lens, whose curve and image are used; leave it out',
    ),
    Rule(('diagnose',), ('--for', '--room'), lambda args: args.count, 'needs --next N'),
    Rule(('lens',), ('--format',), lambda args: args.output, 'needs -o FILE'),
    Rule(('lens',), ('--range',), lambda args: args.format, 'needs --format, for example ros'),
    Rule(
        ('localize',),
        ('--model-error',),
        lambda args: not args.rig,
        'works for one camera at a time; leave --rig out',
    ),
    Rule(
        ('localize',),
        ('--tag-map',),
        lambda args: not _has_photographs(args) or (args.board or '').startswith(f'{LOOSE_TAGS}:'),
        'belongs to photographs of loose tags; add --board tags:36h11',
    ),
    Rule(
        ('render',),
        ('--count', '--ranges'),
        lambda args: not args.poses,
        'is for random poses; leave out either it or --poses',
    ),
    Rule(
        ('render',),
        ('--ranges',),
        lambda args: args.target != 'room',
        'is for one board or a cube; in a room, the poses are inside it: leave it out',
    ),
    Rule(
        ('undistort',),
        ('--rig',),
        lambda args: not _has_views(args),
        'has no effect on views, which belong to a single camera; leave it out',
    ),
    Rule(
        ('undistort',),
        ('--fov',),
        lambda args: not any(map(_is_perspective, args.projections or ())),
        'has no effect on --as perspective, where it is the last number; leave it out',
    ),
    Rule(
        ('undistort',),
        ('--split',),
        lambda args: len(args.inputs) > (0 if args.lens else 1),
        'has an effect only on photographs, and none is given; leave it out',
    ),
)


def check_options(command: str, args: argparse.Namespace, parser: argparse.ArgumentParser) -> None:
    """Raise ParameterError for an option that does not apply; parser: of the command."""
    for rule in RULES:
        for option in rule.options if command in rule.commands else ():
            name = _DESTINATIONS.get(option, option.removeprefix('--').replace('-', '_'))
            if name not in args or getattr(args, name) == parser.get_default(name):
                continue
            if not rule.applies(args):
                raise ParameterError(f'{option} {rule.reason}')
