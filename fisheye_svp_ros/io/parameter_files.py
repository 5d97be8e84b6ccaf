"""ROS parameter files, without ROS: parameters by node, with the types that rcl gives them."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io.documents import LARGEST_YAML, compose_yaml
from fisheye_svp_ros.io.files import read_text

# Parameters by the pattern of full node names that they are for, such as /localizer, /* or /**.
ByNode = dict[str, dict[str, Any]]

_TRUE_STRINGS = {'Y', 'y', 'yes', 'Yes', 'YES', 'true', 'True', 'TRUE', 'on', 'On', 'ON'}
_FALSE_STRINGS = {'N', 'n', 'no', 'No', 'NO', 'false', 'False', 'FALSE', 'off', 'Off', 'OFF'}
_PATTERN = re.compile(r'(/(\*\*?|\w+))+')
_INTEGER = re.compile(r'[+-]?(0[xX][0-9a-fA-F]+|[0-9]+)')
_NOT_FINITE = re.compile(r'([+-]?)\.(inf|Inf|INF|nan|NaN|NAN)')


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


def parameters_of(node: str, by_node: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
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
        new = (_flatten(value, f'{name}.') if isinstance(value, yaml.MappingNode)
               else {name: _value(value)})
        if new.keys() & values.keys():
            raise ValueError(f'{min(new.keys() & values.keys())!r} is listed twice, the second '
                             f'time in line {value.start_mark.line + 1}')
        values |= new
    return values


def _items(node: yaml.Node | None) -> list[tuple[str, yaml.Node]]:
    if not isinstance(node, yaml.MappingNode):
        where = f'line {node.start_mark.line + 1}' if node else 'the empty file'
        raise ValueError(f'{where} should hold node names, ros__parameters and parameters')
    return [(str(key.value), value) for key, value in node.value]


def _value(node: yaml.Node | None) -> Any:
    """Return a parameter value with the type that rcl gives it, which is not always YAML's."""
    if isinstance(node, yaml.SequenceNode):
        values = [_value(item) for item in node.value]
        if len({type(value) for value in values}) > 1:
            raise ValueError(f'the values in line {node.start_mark.line + 1} differ in type')
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
