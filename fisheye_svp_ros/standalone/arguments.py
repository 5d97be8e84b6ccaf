"""What follows `--ros-args` on a command line, and parameter files."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from fisheye_svp_ros.io.documents import LARGEST_YAML, compose_yaml
from fisheye_svp_ros.io.files import read_text
from fisheye_svp_ros.standalone.exceptions import UnknownROSArgsError
from fisheye_svp_ros.standalone.logging import LoggingSeverity
from fisheye_svp_ros.standalone.names import Rule

_TRUE = {'Y', 'y', 'yes', 'Yes', 'YES', 'true', 'True', 'TRUE', 'on', 'On', 'ON'}
_FALSE = {'N', 'n', 'no', 'No', 'NO', 'false', 'False', 'FALSE', 'off', 'Off', 'OFF'}
_PATTERN = re.compile(r'(/(\*\*?|\w+))+')
_INTEGER = re.compile(r'[+-]?(0[xX][0-9a-fA-F]+|[0-9]+)')
_NOT_FINITE = re.compile(r'([+-]?)\.(inf|Inf|INF|nan|NaN|NAN)')


@dataclass
class Arguments:
    """Remapping rules, parameter values by node pattern, and log levels by logger."""

    rules: list[Rule] = field(default_factory=list)
    parameters: dict[str, dict[str, Any]] = field(default_factory=dict)
    log_levels: dict[str, LoggingSeverity] = field(default_factory=dict)
    rosout: bool = True

    def overrides(self, node: str) -> dict[str, Any]:
        """Return the parameter values that apply to a node, by its full name."""
        values: dict[str, Any] = {}
        for pattern, parameters in self.parameters.items():
            regex = pattern.replace('/*', r'(/\w+)')  # so that /** means any number of names
            if re.fullmatch(regex, node):
                values |= parameters
        return values

    def _add(self, node: str, values: dict[str, Any]) -> None:
        name = node if node.startswith('/') else f'/{node}'
        if not _PATTERN.fullmatch(name):
            raise ValueError(f'{node!r} names no node; /NAME, /* and /** do')
        self.parameters.setdefault(name, {}).update(values)


def parse(argv: list[str]) -> Arguments:
    """Read the ROS part of a command line; everything outside `--ros-args … --` is left alone."""
    result = Arguments()
    words = iter(argv)
    for word in words:
        if word == '--ros-args':
            for inner in words:
                if inner == '--':
                    break
                if inner != '--ros-args':
                    _parse_word(result, inner, words)
    return result


def _parse_word(result: Arguments, word: str, words: Any) -> None:
    if word in {'--disable-rosout-logs', '--enable-rosout-logs'}:
        result.rosout = word.startswith('--enable')
    elif word in {'-r', '--remap'}:
        result.rules.append(Rule.parse(_next(word, words)))
    elif word in {'-p', '--param'}:
        _parse_parameter(result, _next(word, words))
    elif word == '--params-file':
        _read_file(result, Path(_next(word, words)))
    elif word == '--log-level':
        name, _, level = _next(word, words).rpartition(':=')
        if level.upper() not in LoggingSeverity.__members__:
            raise UnknownROSArgsError(f'log level {level!r} is none of debug, info, warn, error')
        result.log_levels[name] = LoggingSeverity[level.upper()]
    elif re.fullmatch('--(enable|disable)-(stdout|external-lib)-logs', word):
        pass  # logs go to stderr here, and no other library writes any
    else:
        raise UnknownROSArgsError(f'unknown ROS argument {word!r}')


def _next(flag: str, words: Any) -> str:
    try:
        return str(next(words))
    except StopIteration:
        raise UnknownROSArgsError(f'{flag} needs a value') from None


def _parse_parameter(result: Arguments, text: str) -> None:
    left, separator, value = text.partition(':=')
    node, _, name = left.rpartition(':')
    if not (separator and name and value):
        raise UnknownROSArgsError(f'parameter {text!r} is not name:=value')
    try:
        document = compose_yaml(value, f'parameter {text!r}', UnknownROSArgsError)
        result._add(node or '/**', {name: _value(document)})
    except ValueError as error:
        raise UnknownROSArgsError(f'parameter {text!r}: {error}') from error


def _read_file(result: Arguments, path: Path) -> None:
    where = f'parameter file {path}'
    text = read_text(path, UnknownROSArgsError, LARGEST_YAML)
    document = compose_yaml(text, where, UnknownROSArgsError)
    try:
        _read_nodes(result, document, '')
    except ValueError as error:
        raise UnknownROSArgsError(f'{where}: {error}') from error


def _read_nodes(result: Arguments, node: yaml.Node | None, path: str) -> None:
    for key, value in _items(node):
        if key == 'ros__parameters':
            result._add(path, _flatten(value, ''))
        else:
            _read_nodes(result, value, f'{path}/{key.strip("/")}')


def _flatten(node: yaml.Node, prefix: str) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for key, value in _items(node):
        name = f'{prefix}{key}'
        new = (_flatten(value, f'{name}.') if isinstance(value, yaml.MappingNode)
               else {name: _value(value)})
        if new.keys() & values.keys():
            raise ValueError(f'{min(new.keys() & values.keys())!r} stands there twice, the second '
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
    return _plain(text)


def _plain(text: str) -> bool | int | float | str:
    if text in _TRUE or text in _FALSE:
        return text in _TRUE
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
