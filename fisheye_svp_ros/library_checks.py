"""What the library refuses in one line: arguments of another type, shape or range than needed."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, TypeVar

import numpy as np

from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.pose import Pose

T = TypeVar('T')


def check_type(value: T, kind: type[Any], name: str, needed: str) -> T:
    """Return a value of a type; raise ParameterError, naming what is needed, for another one."""
    if not isinstance(value, kind):
        raise ParameterError(f'{name} is of type {type(value).__name__}; {needed} is needed')
    return value


def check_pose(value: Any, name: str) -> Pose:
    """Return one pose; raise ParameterError for several, or for what is none."""
    pose: Pose = check_type(value, Pose, name, 'a Pose')
    if pose.position.shape != (3,):
        raise ParameterError(f'{name} holds {len(pose.position)} poses; one is needed')
    return pose


def check_size(size: Any, name: str) -> tuple[int, int]:
    """Return width and height, px; raise ParameterError where they are not two whole numbers."""
    width, height = check_pair(size, name, '(width, height) in whole px')
    if not (width.is_integer() and height.is_integer()):
        raise ParameterError(f'{name} is {size!r}; (width, height) in whole px is needed')
    return int(width), int(height)


def check_list(values: Any, name: str) -> list[Any]:
    """Return a list of values, those of NumPy as Python's; raise ParameterError for one value."""
    if isinstance(values, str) or not isinstance(values, Iterable):
        raise ParameterError(f'{name} is {values!r}; a list of values is needed')
    return [value.item() if isinstance(value, np.generic) else value for value in values]


def check_pair(values: Any, name: str, needed: str) -> tuple[float, float]:
    """Return two numbers; raise ParameterError for anything else."""
    numbers = np.asarray(values) if isinstance(values, Iterable) else np.empty(0)
    if numbers.shape != (2,) or numbers.dtype.kind not in 'iuf':
        raise ParameterError(f'{name} is {values!r}; {needed} is needed')
    return float(numbers[0]), float(numbers[1])


def is_at_most(value: Any, most: float) -> bool:
    """Say whether a value is a number of at most `most`."""
    return isinstance(value, int | float | np.number) and bool(value <= most)


def check_above(value: float, limit: float, name: str, unit: str = '') -> None:
    """Raise ParameterError for what is not a finite number above a limit."""
    if not is_at_most(value, np.finfo(float).max) or not limit < value:
        raise ParameterError(f'{name} is {value!r}; a number above {limit:g}{unit} is needed')
