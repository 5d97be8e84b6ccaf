"""What the library refuses in one line: arguments of another type, shape or range than needed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
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
    return [python_value(value) for value in values]


def python_value(value: Any) -> Any:
    """Return a value, numbers of NumPy as Python's and arrays as flat lists of them."""
    if isinstance(value, np.generic | np.ndarray):
        return value.ravel().tolist() if value.ndim else value.item()
    return [python_value(one) for one in value] if isinstance(value, list | tuple) else value


def check_parameters(values: Any, name: str) -> dict[str, Any]:
    """Return parameters by name, those of NumPy as Python's; raise ParameterError for others."""
    given: Mapping[str, Any] = check_type(values, Mapping, name, 'a mapping of parameters')
    return {parameter: python_value(value) for parameter, value in given.items()}


def check_numbers(values: Any, name: str, needed: str) -> Array:
    """Return an array of numbers; raise ParameterError, naming what is needed, for others.

    What a mask hides is NaN.
    """
    try:
        if isinstance(values, np.ma.MaskedArray):
            values = np.ma.filled(values.astype(float), np.nan)
        if np.asarray(values).dtype.kind not in 'USc':
            return np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        pass
    raise ParameterError(f'{name} is not an array of numbers; {needed} is needed')


def check_whole_numbers(values: Any, name: str) -> Index:
    """Return an array of whole numbers; raise ParameterError for others."""
    numbers = check_numbers(values, name, '(N,)')
    if ((numbers != np.rint(numbers)) | (np.abs(numbers) >= 2.0**63)).any():
        raise ParameterError(f'{name} must be whole numbers')
    # Not by way of the others: frames may be stamps, ns, which they round.
    return np.asarray(values).astype(np.int64)


def check_count(count: Any, most: int, name: str) -> int:
    """Return a whole number from 1 to `most`; raise ParameterError for anything else."""
    if not isinstance(count, int | np.integer) or not 1 <= count <= most:
        raise ParameterError(f'{name} is {count!r}; a whole number from 1 to {most} is needed')
    return int(count)


def check_pair(values: Any, name: str, needed: str) -> tuple[float, float]:
    """Return two numbers; raise ParameterError for anything else."""
    numbers = np.asarray(values) if isinstance(values, Iterable) else np.empty(0)
    if numbers.shape != (2,) or numbers.dtype.kind not in 'iuf':
        raise ParameterError(f'{name} is {values!r}; {needed} is needed')
    return float(numbers[0]), float(numbers[1])


def check_room(room: Any) -> tuple[float, float]:
    """Return two distances, m; raise ParameterError where they are none."""
    near, far = check_pair(room, 'room', '(nearest, farthest) in m')
    if not 0 < near < far < np.inf:
        raise ParameterError(
            f'room is {room!r}; two distances above 0, m, are needed, the nearer first'
        )
    return near, far


def check_number(value: Any, name: str, needed: str) -> float:
    """Return a number; raise ParameterError, naming what is needed, for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        raise ParameterError(f'{name} is {value!r}; {needed} is needed')
    return float(value)


def is_at_most(value: Any, most: float) -> bool:
    """Say whether a value is a number of at most `most`."""
    return isinstance(value, int | float | np.number) and bool(value <= most)
