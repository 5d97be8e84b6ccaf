"""setup.py, package.xml, the page of dependencies and the README name the same things."""

from __future__ import annotations

import contextlib
import re
import xml.etree.ElementTree as ElementTree
from importlib import import_module
from typing import Any

import pytest
from helpers.nodes import ROOT

from fisheye_svp_ros import __version__

# By package on PyPI, its key in rosdistro's rosdep/python.yaml; None: there is no key.
ROSDEP = {
    'numpy': 'python3-numpy', 'scipy': 'python3-scipy', 'PyYAML': 'python3-yaml',
    'matplotlib': 'python3-matplotlib', 'rich': 'python3-rich', 'Jinja2': 'python3-jinja2',
    'opencv-python-headless': 'python3-opencv', 'rosbags': 'python3-rosbags-pip',
    'setuptools': 'python3-setuptools', 'pyarrow': None, 'mcap': None,
    'threadpoolctl': None,
    'pytest': 'python3-pytest', 'pytest-xdist': 'python3-pytest-xdist',
    'pytest-cov': 'python3-pytest-cov', 'jsonschema': 'python3-jsonschema',
    'hypothesis': 'python3-hypothesis', 'psutil': 'python3-psutil', 'mpmath': None,
}


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
    cells = {cell for line in page.splitlines() if line.startswith('|')
             for cell in re.split(r'[|,]\s*|`', line)}
    cells = {cell.strip() for cell in cells}
    extras = distribution.extras_require
    required = _names([*distribution.install_requires, *(r for e in extras.values() for r in e)])
    assert not required - cells
    assert _extras(distribution) <= cells


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
