"""YAML and JSON that are made to break what reads them: one line, at once."""

from __future__ import annotations

import math
import time
from pathlib import Path

import numpy as np
import pytest

from fisheye_svp_ros.errors import LensError, ObservationError, ParameterError
from fisheye_svp_ros.io.files import dump_yaml, parse_json, parse_yaml, read_bytes, read_yaml
from fisheye_svp_ros.io.parameters import node_parameters, read_parameter_file

BOMB = 'a: &a [1, 1]\n' + ''.join(
    f'{n}: &{n} [*{m}, *{m}, *{m}, *{m}]\n' for m, n in zip('abcdefgh', 'bcdefghi', strict=True)
)
# libyaml from 0.2.6 on has a limit of its own.
_DEEP = 'nested deeper than 50|exceeded maximum nesting depth'
HOSTILE = {
    'aliases': (BOMB, 'line 2: there is an alias'),
    'merged': ('a: &a {b: 1}\nc: {<<: *a}\n', 'line 2: there is an alias'),
    'twice': ('a: 1\nb: 2\na: 3\n', "line 3: there is the key 'a' a second time"),
    'twice within lists': (
        'a:\n- {b: 2}\n- - b: 2\n    b: 3\n  - c\nd: 1\n',
        "line 4: there is the key 'b' a second time",
    ),
    'twice below': ('a:\n  b: 2\n  "b": 3\n', "line 3: there is the key 'b' a second time"),
    'digits': ('a: ' + '9' * 5000, 'too many digits'),
    'deep lists': ('a: ' + '[' * 100_000, _DEEP),
    'deep dashes': ('- ' * 100_000, _DEEP),
    'deep mappings': ('{a: ' * 100_000, _DEEP),
    'many': ('a: [' + '1,' * 200_000 + ']', 'more than 100000 values'),
    'huge': ('#' * (1 << 22) + '\na: 1', 'above 4 MB'),
    'a time': ('a: !!timestamp x', 'does not match its tag'),
    'a bool': ('a: !!bool x', 'does not match its tag'),
    'code': ('a: !!python/object/apply:os.system [ls]', 'could not determine a constructor'),
    'control': ('a: \x01', 'cannot be parsed'),
    'list key': ('[1]: 2', 'unhashable'),
}


@pytest.mark.parametrize('name', HOSTILE)
def test_hostile_yaml_is_refused_in_one_line_at_once(name: str, tmp_path: Path) -> None:
    text, said = HOSTILE[name]
    path = tmp_path / 'a.yaml'
    path.write_text(text)
    begun = time.process_time()
    with pytest.raises(LensError, match=said) as error:
        read_yaml(path, LensError)
    assert time.process_time() - begun < 2.0
    assert str(error.value).startswith(f'{path}: ') and '\n' not in str(error.value)


def test_plain_values_stay() -> None:
    text = 'name: 2001-99-99\nwhen: 2001-01-01\na: 1e-3\nb: [1, 2.5, yes]\n'
    assert parse_yaml(text, 'x', LensError) == {
        'name': '2001-99-99',
        'when': '2001-01-01',
        'a': 1e-3,
        'b': [1, 2.5, True],
    }
    shared = [1.0, 2.0]
    assert parse_yaml(dump_yaml({'a': shared, 'b': shared}), 'x', LensError)['b'] == shared


def test_numpy_scalars_are_written_as_numbers() -> None:
    written = {'a': np.float64(0.1), 'b': np.int64(3), 'c': np.bool_(True), 'd': [np.float32(0.5)]}
    assert dump_yaml(written) == dump_yaml({'a': 0.1, 'b': 3, 'c': True, 'd': [0.5]})


def test_numbers_are_those_of_yaml_1_2() -> None:
    text = 'a: 01536\nb: 1:30:00\nc: 0x10\nd: -.inf\ne: 1_0\nf: 08.5\n'
    assert parse_yaml(text, 'x', LensError) == {
        'a': 1536,
        'b': '1:30:00',
        'c': 16,
        'd': -math.inf,
        'e': '1_0',
        'f': 8.5,
    }


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        ('{"a": 1, "b": {"c": 1, "c": 2}}', "'c' is listed twice"),
        ('[' * 100_000, 'broken JSON'),
        ('{"a": ' + '9' * 5000 + '}', 'broken JSON'),
        ('[1]', 'a JSON object is expected'),
        ('', 'broken JSON'),
    ],
)
def test_hostile_json(text: str, said: str) -> None:
    with pytest.raises(ObservationError, match=said):
        parse_json(text, 'x', ObservationError)


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        (BOMB, 'an alias'),
        ('localizer: {ros__parameters: {}}\nlocalizer: {ros__parameters: {}}', 'a second time'),
        ('localizer:\n  ros__parameters:\n    a.b: 1\n    a: {b: 2}\n', "'a.b' is listed twice"),
        ('/(*: {ros__parameters: {a: 1}}', 'names no node'),
        ('/***: {ros__parameters: {a: 1}}', 'names no node'),
        ('ros__parameters: {a: 1}', 'names no node'),
    ],
)
def test_hostile_parameter_files(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / 'a.yaml'
    path.write_text(text)
    with pytest.raises(ParameterError, match=said) as error:
        read_parameter_file(path)
    assert str(path) in str(error.value) and '\n' not in str(error.value)


@pytest.mark.parametrize(
    'text',
    [
        '- 1',
        '/**: 3',
        'a: {ros__parameters: [1]}',
        '',
        'a: [',
        ':',
        'a: {ros__parameters: {x: [1, a]}}',
        'a: {ros__parameters: {x: }}',
    ],
)
def test_unusable_parameter_files_are_named(tmp_path: Path, text: str) -> None:
    file = tmp_path / 'bad.yaml'
    file.write_text(text)
    with pytest.raises(ParameterError, match=r'bad\.yaml'):
        read_parameter_file(file)


@pytest.mark.parametrize(
    ('text', 'value'),
    [
        ('1', 1),
        ('-7', -7),
        ('0x1F', 31),
        ('010', 8),
        ('08', 8.0),
        ('1e-3', 0.001),
        ('1.', 1.0),
        ('.inf', math.inf),
        ('-.inf', -math.inf),
        ('on', True),
        ('N', False),
        ('"1"', '1'),
        ("'yes'", 'yes'),
        ('text', 'text'),
        ('[1, 2]', [1, 2]),
        ('[a, "1"]', ['a', '1']),
        ('1_000', '1_000'),
        ('99999999999999999999', 1e20),
        ('[true]', [True]),
    ],
)
def test_values_have_the_type_that_rcl_gives_them(
    text: str, value: object, tmp_path: Path
) -> None:
    file = tmp_path / 'a.yaml'
    file.write_text(f'/**: {{ros__parameters: {{x: {text}}}}}\n')
    read = node_parameters('/node', read_parameter_file(file))['x']
    assert read == value and type(read) is type(value)


def test_patterns_of_node_names() -> None:
    given = {'/**/localizer': {'a': 1}, '/*': {'b': 2}}
    assert node_parameters('/x/y/localizer', given) == {'a': 1}
    assert node_parameters('/localizer', given) == {'a': 1, 'b': 2}


def test_files_have_bounds(tmp_path: Path) -> None:
    path = tmp_path / 'a'
    path.write_bytes(bytes(10))
    assert read_bytes(path, ParameterError, 10) == bytes(10)
    with pytest.raises(ParameterError, match='the largest size that is read'):
        read_bytes(path, ParameterError, 9)
    with pytest.raises(ParameterError, match='Is a directory'):
        read_bytes(tmp_path, ParameterError)
    with pytest.raises(ParameterError, match='cannot be read'):
        read_bytes('a\0b', ParameterError)


def test_errors_are_one_line_of_bounded_length() -> None:
    text = str(LensError('a\n\x1b[31mb ' + 'c' * 10**6 + ' end'))
    assert text.startswith('a [31mb c') and text.endswith(' end') and len(text) < 2000
