"""Parameter tables as declared parameters: descriptions, units and ranges in the descriptors."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from difflib import get_close_matches
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.parameter import Parameter

from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io.parameters import Row, read_parameter_file, rows, with_values
from fisheye_svp_ros.study.settings import Settings

S = TypeVar('S', bound=Settings)

MAX_FILE_BYTES = 1 << 26  # bytes of a file that somebody else names
_NAME = re.compile(r'[\w-]{0,100}')


def declare(node: Any, kind: type[S], given: Mapping[str, Any]) -> S:
    """Declare every row of a table on a node, and return the values it starts with.

    given: values by name, which may be whole numbers where others are asked for.
    Raises ParameterError for a value that is not allowed.
    """
    settings = with_values(kind(), given)
    for row in rows(kind):
        value = getattr(settings, row.name)
        node.declare_parameter(
            row.name,
            list(value) if isinstance(value, tuple) else value,
            descriptor(row),
            ignore_override=True,
        )
    return settings


def with_declared_types(node: Any, parameters: Sequence[Any]) -> list[Any]:
    """Return parameters with whole numbers as floating-point ones where those are declared.

    `ros2 param set NODE patience 1` sends an integer.
    """
    changed = []
    for one in parameters:
        declared = node.get_parameter(one.name).type_ if node.has_parameter(one.name) else None
        if (one.type_, declared) == (Parameter.Type.INTEGER, Parameter.Type.DOUBLE):
            one = Parameter(one.name, Parameter.Type.DOUBLE, float(one.value))
        elif (one.type_, declared) == (Parameter.Type.INTEGER_ARRAY, Parameter.Type.DOUBLE_ARRAY):
            values = [float(value) for value in one.value]
            one = Parameter(one.name, Parameter.Type.DOUBLE_ARRAY, values)
        changed.append(one)
    return changed


def unknown_parameters(node: Any, given: Mapping[str, Any], known: Sequence[str]) -> Iterator[str]:
    """Say of each parameter that was given and means nothing to a node what was meant.

    What a parameter file says of all nodes may be for others; it is named where it is nearly the
    name of one that is known.
    """
    for_all = _names_for_all(sys.argv)
    for name in given:
        # Those topics come and go with what there is to publish.
        if node.has_parameter(name) or '/metrics/' in name:
            continue
        meant = get_close_matches(name, known, 1)
        if meant:
            yield f'parameter {name!r} is unknown to this node; did you mean {meant[0]!r}?'
        elif name not in for_all:
            yield f'parameter {name!r} is unknown to this node; choose from {", ".join(known)}'


def _names_for_all(arguments: Sequence[str]) -> set[str]:
    """Return the parameters that the files of a command line give to all nodes."""
    names: set[str] = set()
    for word, file in pairwise(arguments):
        if word == '--params-file':
            with suppress(ParameterError):  # rcl has read it, or this node would not be here
                names |= {*read_parameter_file(Path(file)).get('/**', {})}
    return names


def descriptor(row: Row) -> Any:
    """Return the ParameterDescriptor of a row."""
    unit = f' [{row.unit}]' if row.unit else ''
    message = ParameterDescriptor(
        name=row.name, description=row.description + unit, read_only=row.fixed
    )
    # A parameter of one type would not let both `auto` and YAML's true be given.
    message.dynamic_typing = row.takes_booleans
    if row.choices:
        message.additional_constraints = row.constraint()
    if row.low is None or row.high is None:
        return message
    if isinstance(row.default, int):
        limits = IntegerRange(from_value=int(row.low), to_value=int(row.high))
        message.integer_range = [limits]
    else:
        limits = FloatingPointRange(from_value=float(row.low), to_value=float(row.high))
        message.floating_point_range = [limits]
    return message


def check_access(name: str, folder: str, what: str) -> str:
    """Return a name in config/, or a file, as given; raise ParameterError if it is out of bounds.

    folder: below which a file must lie, symbolic links followed; empty: no file at all.
    """
    if _NAME.fullmatch(name) and not Path(name).is_file():
        return name
    if not folder:
        raise ParameterError(
            f'{what}: {name[:100]!r} is a file, but a running node takes only '
            'names in config/; start it with folder:=DIR'
        )
    try:
        path = Path(name).resolve()
        inside = path.is_relative_to(Path(folder).resolve())
        size = path.stat().st_size if inside and (path.is_file() or path.is_dir()) else -1
    except (OSError, ValueError) as cause:
        raise ParameterError(f'{what}: {name[:100]!r} is not a path ({cause})') from cause
    if not inside:
        raise ParameterError(
            f'{what}: {name[:100]!r} is not below {folder}, the folder of this node'
        )
    if not 0 <= size <= MAX_FILE_BYTES:
        raise ParameterError(
            f'{what}: {name[:100]!r} is not a file, or above {MAX_FILE_BYTES >> 20} MB'
        )
    return name
