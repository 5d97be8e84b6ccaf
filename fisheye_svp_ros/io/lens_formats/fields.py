"""Parts of other tools' files: sections, numbers, poses, XML, with errors that name the field."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.files import LARGEST_YAML, parse_yaml
from fisheye_svp_ros.pose import Pose, nearest_rotation, rotation_from_quaternion

MAX_NUMBER = 1e12  # any number of a lens
_SLACK = 1e-3  # of the elements of a rotation


def section(mapping: Mapping[str, Any], name: str, where: str) -> Mapping[str, Any]:
    """Return a mapping in a mapping; raise LensError naming the field."""
    value = mapping.get(name)
    if not isinstance(value, dict):
        raise LensError(f'{where}: {name} is {value!r}; a mapping is needed')
    return value


def sections(mapping: Mapping[str, Any], name: str, where: str) -> list[Mapping[str, Any]]:
    """Return a list of mappings in a mapping; raise LensError naming the field."""
    entries = mapping.get(name)
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise LensError(f'{where}: {name} is {entries!r:.80}; a list of mappings is needed')
    return entries


def numbers(mapping: Mapping[str, Any], name: str, count: int, where: str) -> list[float]:
    """Return a list of `count` numbers of a mapping; raise LensError naming the field."""
    values = mapping.get(name)
    if (
        not isinstance(values, list)
        or len(values) != count
        or not all(isinstance(value, int | float) and abs(value) < MAX_NUMBER for value in values)
    ):
        raise LensError(f'{where}: {name} must be a list of {count} finite numbers, is {values!r}')
    return [float(value) for value in values]


def number_list(mapping: Mapping[str, Any], name: str, where: str) -> list[float]:
    """Return a list of any length of numbers of a mapping; raise LensError naming the field."""
    entries = mapping.get(name)
    return numbers(mapping, name, len(entries) if isinstance(entries, list) else 1, where)


def matrix(mapping: Mapping[str, Any], name: str, shape: tuple[int, int], where: str) -> Array:
    """Return the rows of a mapping as an array of a shape; raise LensError naming the field."""
    rows = mapping.get(name)
    flat = [
        number
        for row in (rows if isinstance(rows, list) else [])
        for number in (row if isinstance(row, list) else [row])
    ]
    return np.reshape(numbers({name: flat}, name, shape[0] * shape[1], where), shape)


def values(mapping: Mapping[str, Any], names: Sequence[str], where: str) -> list[float]:
    """Return numbers of a mapping by their names; raise LensError naming the first missing one."""
    for name in names:
        value = mapping.get(name)
        if (
            isinstance(value, bool)
            or not isinstance(value, int | float)
            or (not abs(value) < MAX_NUMBER)
        ):
            raise LensError(f'{where}: {name} is {value!r}; a finite number is needed')
    return [float(mapping[name]) for name in names]


def coefficient_list(
    mapping: Mapping[str, Any], name: str, counts: Sequence[int], where: str
) -> list[float]:
    """Return as many numbers of a list as one of `counts`, or raise LensError; zeros follow."""
    entries = mapping.get(name)
    count = len(entries) if isinstance(entries, list) else 0
    numbers_given = numbers(mapping, name, count or counts[0], where)
    if count > counts[-1] and not any(numbers_given[counts[-1] :]):
        count = counts[-1]
    if count not in counts:
        raise LensError(
            f'{where}: {name} has {count} numbers, not {" or ".join(map(str, counts))}'
        )
    return numbers_given[:count]


def yaml(text: str, where: str) -> dict[str, Any]:
    """Return the mapping of a YAML text, which may begin as OpenCV's do, with %YAML:1.0.

    Raises LensError, naming `where` and line.
    """
    start = text.lstrip()
    if start.startswith('%YAML'):
        # The line stays, so that others keep their numbers.
        text = '#' + start
    return parse_yaml(text, where, LensError)


def pose(place: ArrayLike, turn: ArrayLike, where: str) -> Pose:
    """Return the pose of a place, m, and a quaternion x, y, z, w or a matrix (3, 3).

    Raises LensError where these are no numbers, or the turn is none.
    """
    place, matrix = np.array(place), np.array(turn)
    length = np.linalg.norm(matrix)
    if np.isfinite([*place, length]).all() and length > 0.5:
        if matrix.ndim == 1:
            return Pose(rotation_from_quaternion(matrix), place)
        rotation = nearest_rotation(matrix)
        if np.allclose(rotation, matrix, atol=_SLACK):
            return Pose(rotation, place)
    raise LensError(
        f'{where}: a translation and a quaternion of unit length or a rotation matrix are needed'
    )


def rectified(r: Any, p: Any, where: str) -> tuple[Array, Array] | None:
    """Return R (3, 3) and P (3, 4) of a camera_info, from lists; None where one is missing.

    Raises LensError, naming `where`, for lists of other lengths.
    """
    if r is None or p is None:
        return None
    lists = (('R', r, 9), ('P', p, 12))
    turn, projection = (
        numbers({name: entries}, name, count, where) for name, entries, count in lists
    )
    return np.reshape(turn, (3, 3)), np.reshape(projection, (3, 4))


def xml(text: str, where: str, form: str) -> ElementTree.Element:
    """Return the root of an XML text; raise LensError for one that is no whole file of a form."""
    if '<!' in text.replace('<!--', '') or len(text) > LARGEST_YAML:
        raise LensError(
            f'{where}: not a whole {form} (document types are not read, nor more than '
            f'{LARGEST_YAML >> 20} MB)'
        )
    try:
        return ElementTree.fromstring(text.lstrip().encode())
    except (ElementTree.ParseError, ValueError, LookupError) as cause:
        raise LensError(f'{where}: not a whole {form} ({cause})') from cause
