"""setup.py, package.xml, the page of dependencies and the README name the same things."""

from __future__ import annotations

import ast
import contextlib
import os
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from helpers.nodes import ROOT

from fisheye_svp_ros import __version__
from fisheye_svp_ros.nodes import NODES

# By package on PyPI, its key in rosdistro's rosdep/python.yaml; None: there is no key.
ROSDEP = {
    'numpy': 'python3-numpy',
    'scipy': 'python3-scipy',
    'pandas': 'python3-pandas',
    'PyYAML': 'python3-yaml',
    'matplotlib': 'python3-matplotlib',
    'rich': 'python3-rich',
    'Jinja2': 'python3-jinja2',
    'opencv-python-headless': 'python3-opencv',
    'rosbags': 'python3-rosbags-pip',
    'setuptools': 'python3-setuptools',
    'pyarrow': None,
    'mcap': None,
    'lz4': None,
    'zstandard': None,
    'threadpoolctl': None,
    'pytest': 'python3-pytest',
    'pytest-xdist': 'python3-pytest-xdist',
    'pytest-cov': 'python3-pytest-cov',
    'jsonschema': 'python3-jsonschema',
    'hypothesis': 'python3-hypothesis',
    'psutil': 'python3-psutil',
    'mpmath': None,
    'statsmodels': None,
    'pytest-rerunfailures': None,
}


OF_ROS = {'apriltag_msgs', 'builtin_interfaces', 'action_msgs', 'unique_identifier_msgs'}


@pytest.fixture(scope='module')
def distribution() -> Any:
    """Return what setup.py says."""
    pytest.importorskip('setuptools')
    with contextlib.chdir(ROOT):
        return import_module('distutils.core').run_setup('setup.py', stop_after='init')


def _names(requirements: list[str]) -> set[str]:
    return {re.split(r'[<>=!~\[; ]', requirement)[0] for requirement in requirements}


def _extras(distribution: Any) -> set[str]:
    """Return the names of the extras; setuptools puts markers of their packages behind them."""
    return {extra.partition(':')[0] for extra in distribution.extras_require}


def _tags(tag: str) -> set[str]:
    root = ElementTree.parse(ROOT / 'package.xml').getroot()
    return {str(element.text) for element in root.iter(tag)}


@pytest.mark.parametrize(('extra', 'tag'), [(None, 'exec_depend'), ('test', 'test_depend')])
def test_package_xml_and_setup_py_list_the_same(
    distribution: Any, extra: str | None, tag: str
) -> None:
    listed = distribution.extras_require[extra] if extra else distribution.install_requires
    keys = {ROSDEP[name] for name in _names(listed)}
    assert {key for key in _tags(tag) if key.startswith('python3-')} == keys - {None}


def test_versions_agree(distribution: Any) -> None:
    assert distribution.get_version() == __version__
    assert _tags('version') == {__version__}
    assert f'\nversion: {__version__}\n' in (ROOT / 'CITATION.cff').read_text()


def test_every_dependency_has_its_line(distribution: Any) -> None:
    page = (ROOT / 'docs' / 'reference' / 'dependencies.md').read_text()
    cells = {
        cell
        for line in page.splitlines()
        if line.startswith('|')
        for cell in re.split(r'[|,]\s*|`', line)
    }
    cells = {cell.strip() for cell in cells}
    extras = distribution.extras_require
    required = _names([*distribution.install_requires, *(r for e in extras.values() for r in e)])
    assert not required - cells
    assert _extras(distribution) <= cells


def test_what_is_imported_is_declared(distribution: Any) -> None:
    """A dependency of a dependency may go with its next release."""
    extras = distribution.extras_require.values()
    listed = [*distribution.install_requires, *(name for extra in extras for name in extra)]
    distributions = {'cv2': 'opencv-python-headless', 'yaml': 'PyYAML', 'jinja2': 'Jinja2'}
    imported = {
        name.partition('.')[0]
        for path in (ROOT / 'fisheye_svp_ros').rglob('*.py')
        for node in ast.walk(ast.parse(path.read_text()))
        for name in (
            [alias.name for alias in node.names]
            if isinstance(node, ast.Import)
            else [str(node.module)]
            if isinstance(node, ast.ImportFrom)
            else []
        )
    }
    foreign = imported - sys.stdlib_module_names - {'fisheye_svp_ros', *_tags('exec_depend')}
    assert {distributions.get(name, name) for name in foreign} <= _names(listed) | OF_ROS


def test_readme_names_the_extras(distribution: Any) -> None:
    text = (ROOT / 'README.md').read_text()
    for extra in _extras(distribution):
        assert f'`{extra}`' in text


def test_the_quality_declaration_says_what_a_release_lacks() -> None:
    path = ROOT / 'docs' / 'release.py'
    space: dict[str, Any] = {'__file__': str(path), '__name__': 'release'}
    exec(path.read_text(encoding='utf-8'), space)
    declared = (ROOT / 'QUALITY_DECLARATION.md').read_text().partition('## What a release')[2]
    assert sorted(space['findings']()) == sorted(re.findall('^- (.*)$', declared, re.MULTILINE))


@pytest.fixture
def installation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a function that says how make would install, with some Pythons on the path."""
    if shutil.which('make') is None:
        pytest.skip('make is not here')

    def commands(*pythons: str) -> str:
        for name in ('python3', 'python3.14', 'python3.13', 'python3.12', 'python3.11'):
            text = f'exec {sys.executable} "$@"' if name in pythons else 'exit 1'
            (tmp_path / name).write_text(f'#!/bin/sh\n{text}\n')
            (tmp_path / name).chmod(0o755)
        env = {**os.environ, 'PATH': f'{tmp_path}{os.pathsep}{os.environ["PATH"]}'}
        env.pop('PYTHON', None)
        return subprocess.run(
            ['make', '-n', 'VENV=venv', 'venv/ready'],
            cwd=ROOT,
            env=env,
            capture_output=True,
            text=True,
            check=True,
        ).stdout

    for name in ('MAKEFLAGS', 'MAKELEVEL', 'PYTHONPATH'):
        monkeypatch.delenv(name, raising=False)
    return commands


@pytest.mark.parametrize(
    ('pythons', 'taken'),
    [
        (['python3', 'python3.12'], 'python3'),
        (['python3.12', 'python3.11'], 'python3.12'),
        ([], 'python3'),
    ],
)
def test_make_takes_another_python_where_the_first_is_not_supported(
    installation: Any, pythons: list[str], taken: str
) -> None:
    assert f'\n{taken} -m venv venv\n' in installation(*pythons)


def test_make_installs_no_ros_beside_one_that_is_sourced(
    installation: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sourced = tmp_path / 'sourced'
    (sourced / 'rclpy').mkdir(parents=True)
    (sourced / 'rclpy' / '__init__.py').touch()
    (sourced / 'rclpy' / 'node.py').write_text('import nothing_of_that_name')
    monkeypatch.setenv('PYTHONPATH', str(sourced))
    assert ',ros]' in installation('python3')  # it cannot be imported: of another Python
    (sourced / 'rclpy' / 'node.py').write_text('')
    assert ',ros]' not in installation('python3') and 'lint' in installation('python3')


def test_make_installs_ros_although_an_activated_environment_has_it(installation: Any) -> None:
    """The new environment does not see that one: every test of a node was skipped."""
    pytest.importorskip('rclpy.node')
    assert ',ros]' in installation('python3')


def test_what_is_left_out_of_the_shorter_run_is_there():
    lines = (ROOT / 'test' / 'long_tests.txt').read_text().splitlines()
    tests = [line for line in lines if not line.startswith('#')]
    assert tests == sorted(set(tests))
    for line in tests:
        file, *_, name = line.partition('[')[0].split('::')
        assert re.search(rf'\bdef {name}\(', (ROOT / file).read_text()), line


@pytest.mark.skipif(shutil.which('make') is None, reason='make is not here')
def test_what_is_checked_at_every_save_is_there(monkeypatch):
    """A folder that was a file before ended `make check` without a test."""
    for name in ('MAKEFLAGS', 'MAKELEVEL'):
        monkeypatch.delenv(name, raising=False)
    told = subprocess.run(
        ['make', '-n', 'check'], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    paths = re.findall(r' (test/\S+)', told)
    assert len(paths) > 10 and all((ROOT / path).exists() for path in paths), paths


def test_editable_installations_are_paths_that_type_checkers_follow() -> None:
    text = (ROOT / 'Makefile').read_text()
    assert 'EDITABLE := --config-settings editable_mode=compat -e\n' in text
    assert " -e '." not in text and text.count('$(EDITABLE)') >= 1


@pytest.mark.parametrize(
    ('commands', 'for_colcon'),
    [(['install'], True), (['develop'], True), (['bdist_wheel'], False)],
)
def test_scripts_of_nodes_are_only_where_ros2_run_looks(
    commands: list[str], for_colcon: bool
) -> None:
    """A pip installation put nine of them on the path, and fisheye-svp twice."""
    pytest.importorskip('setuptools')
    with contextlib.chdir(ROOT):
        setup = import_module('distutils.core').run_setup('setup.py', commands, 'init')
    scripts = {line.partition(' ')[0] for line in setup.entry_points['console_scripts']}
    assert scripts - {'fisheye-svp'} == (set(NODES) if for_colcon else set())
    assert ('bin' in dict(setup.data_files)) == for_colcon
