"""Parameter tables as declared parameters: descriptions, units and ranges in the descriptors."""

from __future__ import annotations

from typing import Any, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

from fisheye_svp_ros.io.parameters import Row, changed, rows
from fisheye_svp_ros.study.settings import Settings

S = TypeVar('S', bound=Settings)


def declare(node: Any, kind: type[S]) -> S:
    """Declare every row of a table on a node, and return the values it starts with.

    Raises ParameterError for a value that is not allowed; rclpy's own errors for a wrong type.
    """
    values = {}
    for row in rows(kind):
        default = list(row.default) if isinstance(row.default, tuple) else row.default
        values[row.name] = node.declare_parameter(row.name, default, descriptor(row)).value
    return changed(kind(), values)


def descriptor(row: Row) -> Any:
    """Return the ParameterDescriptor of a row."""
    unit = f' [{row.unit}]' if row.unit else ''
    message = ParameterDescriptor(
        name=row.name, description=row.description + unit, read_only=row.fixed)
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
