"""Parameters: typed tables (frozen dataclasses whose fields are the rows), sweeps, ROS files.

Parameter files are read without ROS, by node, with the types that rcl gives their values.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import yaml

from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io.files import LARGEST_YAML, compose_yaml, read_text
from fisheye_svp_ros.io.share import expand_path

SWEEP = 'sweep.'

S = TypeVar('S')
# Parameters by the pattern of full node names that they are for, such as /localizer, /* or /**.
ByNode = dict[str, dict[str, Any]]

_TRUE_STRINGS = {'Y', 'y', 'yes', 'Yes', 'YES', 'true', 'True', 'TRUE', 'on', 'On', 'ON'}
_FALSE_STRINGS = {'N', 'n', 'no', 'No', 'NO', 'false', 'False', 'FALSE', 'off', 'Off', 'OFF'}
_PATTERN = re.compile(r'(/(\*\*?|\w+))+')
_INTEGER = re.compile(r'[+-]?(0[xX][0-9a-fA-F]+|[0-9]+)')
# By type, what a message says is needed.
_NEEDED = {float: 'a number', int: 'a whole number', bool: 'true or false', str: 'text'}
_NOT_FINITE = re.compile(r'([+-]?)\.(inf|Inf|INF|nan|NaN|NAN)')


class Row(NamedTuple):
    """One parameter: its default gives the type; low to high is the range, ends included.

    fixed: it holds for the life of a node; file: it may name a file; frame: it is a frame id.
    """

    name: str
    default: Any
    description: str
    unit: str = ''
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    fixed: bool = False
    file: bool = False
    frame: bool = False

    def constraint(self) -> str:
        """Say what values are allowed beyond the type; empty for any."""
        if self.choices:
            return 'one of ' + ', '.join(filter(None, self.choices))
        return '' if self.low is None else f'{self.low:g} to {self.high:g}'

    @property
    def takes_booleans(self) -> bool:
        """Whether a boolean, as YAML reads true and false, stands for one of the words."""
        return 'true' in (*self.choices, self.default)

    def check(self, value: Any) -> Any:
        """Return the value in the type of the default; raise ParameterError if not allowed."""
        if isinstance(self.default, tuple):
            if isinstance(value, str) or not isinstance(value, Sequence):
                raise ParameterError(f'{self.name} is {value!r}; a list is needed')
            return tuple(self._check_one(item, self.default[0]) for item in value)
        return self._check_one(value, self.default)

    def _check_one(self, value: Any, like: Any) -> Any:
        kind = type(like)
        if self.takes_booleans and type(value) is bool:
            value = str(value).lower()
        if kind is float and type(value) is int:
            value = float(value)
        if type(value) is not kind:
            raise ParameterError(f'{self.name} is {value!r}; {_NEEDED[kind]} is needed')
        if kind is float and not math.isfinite(value):
            raise ParameterError(f'{self.name} is {value}; a finite number is needed')
        outside = self.low is not None and not self.low <= value <= (self.high or 0)
        if outside or (self.choices and value not in self.choices):
            raise ParameterError(f'{self.name} is {value!r}; allowed is {self.constraint()}')
        if self.frame and re.search(r'^/|\s', value):  # which tf2 refuses, message by message
            raise ParameterError(
                f'{self.name} is {value!r}; a frame id begins without a slash and holds no blanks'
            )
        return value


def parameter(
    default: Any,
    description: str,
    unit: str = '',
    span: tuple[Any, Any] = (None, None),
    choices: tuple[str, ...] = (),
    **flags: bool,
) -> Any:
    """Return a dataclass field that is a row of the table; span: smallest and largest value.

    flags: fixed, file and frame, as of `Row`.
    """
    row = Row('', default, description, unit, *span, choices, **flags)
    return field(default=default, metadata={'row': row})


def rows(table: Any) -> list[Row]:
    """Return the rows of a table, given as class or instance."""
    return [f.metadata['row']._replace(name=f.name) for f in fields(table)]


def with_values(table: S, values: Mapping[str, Any]) -> S:
    """Return the table with some values changed; names that are no row are ignored.

    Paths of files may begin with package://, file:// or ~.
    Raises ParameterError for a value that is not allowed.
    """
    changes = {
        row.name: _check_value(row, values[row.name])
        if row.name in values
        else getattr(table, row.name)
        for row in rows(table)
    }
    return type(table)(**changes)


def _check_value(row: Row, value: Any) -> Any:
    checked = row.check(value)
    return expand_path(checked) if row.file and isinstance(checked, str) else checked


@dataclass(frozen=True)
class Sweep:
    """The Cartesian product of lists of parameter values; the last list runs fastest."""

    lists: Mapping[str, Sequence[Any]]

    def __len__(self) -> int:
        return math.prod(map(len, self.lists.values()))

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return map(self.point, range(len(self)))

    def point(self, number: int) -> dict[str, Any]:
        """Return one combination of values, counted from 0."""
        values = {}
        for name in reversed(tuple(self.lists)):
            number, place = divmod(number, len(self.lists[name]))
            values[name] = self.lists[name][place]
        return {name: values[name] for name in self.lists}


def sweep_of(table: Any, parameters: Mapping[str, Any], excluded: Collection[str] = ()) -> Sweep:
    """Return the sweep that the `sweep.<parameter>` entries of a parameter file ask for.

    excluded: parameters that cannot be swept.
    Raises ParameterError for an unknown parameter, an empty list or a value that is not allowed.
    """
    points = {
        row.name: row
        for row in rows(table)
        if not isinstance(row.default, tuple) and row.name not in excluded
    }
    lists = {}
    for name, values in parameters.items():
        if not name.startswith(SWEEP):
            continue
        row = points.get(name.removeprefix(SWEEP))
        if row is None:
            raise ParameterError(
                f'{name}: no such parameter to sweep; choose from ' + ', '.join(points)
            )
        if values is None:  # as a parameter file has an empty list
            values = []
        if isinstance(values, str) or not isinstance(values, Sequence) or not len(values):
            raise ParameterError(f'{name} is {values!r}; a list of at least one value is needed')
        lists[row.name] = [row.check(value) for value in values]
    return Sweep(lists)


def read_parameter_file(path: Path) -> ByNode:
    """Return the parameters of a file by node; raise ParameterError where it is unusable."""
    where = f'parameter file {path}'
    text = read_text(path, ParameterError, LARGEST_YAML)
    document = compose_yaml(text, where, ParameterError)
    result: ByNode = {}
    try:
        _read_nodes(result, document, '')
    except ValueError as error:
        raise ParameterError(f'{where}: {error}') from error
    return result


def node_parameters(node: str, by_node: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the parameters that apply to a node, by its full name; later patterns win."""
    values: dict[str, Any] = {}
    for pattern, parameters in by_node.items():
        regex = pattern.replace('/*', r'(/\w+)')  # so that /** means any number of names
        if re.fullmatch(regex, node):
            values |= parameters
    return values


def _read_nodes(result: ByNode, node: yaml.Node | None, path: str) -> None:
    for key, value in _items(node):
        if key == 'ros__parameters':
            name = path if path.startswith('/') else f'/{path}'
            if not _PATTERN.fullmatch(name):
                raise ValueError(f'{path!r} names no node; /NAME, /* and /** do')
            result.setdefault(name, {}).update(_flatten(value, ''))
        else:
            _read_nodes(result, value, f'{path}/{key.strip("/")}')


def _flatten(node: yaml.Node, prefix: str) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for key, value in _items(node):
        name = f'{prefix}{key}'
        new = (
            _flatten(value, f'{name}.')
            if isinstance(value, yaml.MappingNode)
            else {name: _parameter_value(value, name)}
        )
        if new.keys() & values.keys():
            raise ValueError(
                f'{min(new.keys() & values.keys())!r} is listed twice, the second '
                f'time in line {value.start_mark.line + 1}'
            )
        values |= new
    return values


def _items(node: yaml.Node | None) -> list[tuple[str, yaml.Node]]:
    if not isinstance(node, yaml.MappingNode):
        where = f'line {node.start_mark.line + 1}' if node else 'the empty file'
        raise ValueError(f'{where} should hold node names, ros__parameters and parameters')
    return [(str(key.value), value) for key, value in node.value]


def _parameter_value(node: yaml.Node | None, name: str) -> Any:
    """Return a parameter value with the type that rcl gives it, which is not always YAML's."""
    if isinstance(node, yaml.SequenceNode):
        values = [_parameter_value(item, name) for item in node.value]
        kinds = {type(value) for value in values}
        if len(kinds) > 1:
            whole = [value for value in values if isinstance(value, int)]
            remedy = f'; write {whole[0]} as {whole[0]}.0' if kinds == {int, float} else ''
            raise ValueError(
                f'{name}: the values in line {node.start_mark.line + 1} differ in type{remedy}'
            )
        return values or None
    if not isinstance(node, yaml.ScalarNode):
        raise ValueError('a parameter holds a value or a list, nothing nested')
    text = str(node.value)
    if node.style in {'"', "'"}:
        return text
    if not text:
        raise ValueError(f'no value in line {node.start_mark.line + 1}')
    return _scalar(text)


def _scalar(text: str) -> bool | int | float | str:
    if text in _TRUE_STRINGS or text in _FALSE_STRINGS:
        return text in _TRUE_STRINGS
    if _INTEGER.fullmatch(text):
        digits = text.lstrip('+-')
        base = 16 if digits[:2] in {'0x', '0X'} else 8 if digits[0] == '0' else 10
        try:
            number = int(text, base)
        except ValueError:  # a number such as 08 is octal in C, so rcl reads it as a float
            return float(text)
        return number if -(2**63) <= number < 2**63 else float(text)
    if special := _NOT_FINITE.fullmatch(text):
        sign = -1.0 if special[1] == '-' else 1.0
        return math.copysign(float(special[2]), sign)
    try:
        return float(text) if '_' not in text else text
    except ValueError:
        return text
