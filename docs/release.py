"""What a release on the ROS index (bloom) needs of this package: python docs/release.py.

Prints what is missing, one line each; nothing else keeps `bloom-release` from going through that
can be seen from here.  QUALITY_DECLARATION.md says the same; a test compares.
"""

from __future__ import annotations

import ast
import contextlib
import re
import sys
import xml.etree.ElementTree as ElementTree
from importlib import import_module
from itertools import pairwise
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = 'fisheye_svp_ros'
# By module that is imported, the key that brings it, where that is not the module's own name; ''
# where rosdistro has none (read on 2026-11-22).
KEYS = {
    'cv2': 'python3-opencv',
    'jinja2': 'python3-jinja2',
    'matplotlib': 'python3-matplotlib',
    'numpy': 'python3-numpy',
    'pandas': 'python3-pandas',
    'rich': 'python3-rich',
    'rosbags': 'python3-rosbags-pip',
    'scipy': 'python3-scipy',
    'yaml': 'python3-yaml',
    'mcap': '',
    'lz4': '',
    'zstandard': '',
}
# Extras, which the package does without where they are not installed; and what else is no package
OPTIONAL = {'apriltag_msgs', 'distributed', 'numba', 'pyarrow', 'threadpoolctl'}


def findings() -> list[str]:
    """Return what a release lacks, one line each."""
    root = ElementTree.parse(ROOT / 'package.xml').getroot()
    text = {child.tag: str(child.text).strip() for child in root}
    keys = {str(child.text) for child in root if child.tag in ('exec_depend', 'depend')}
    return [
        *_description(root, text),
        *_versions(text['version']),
        *_changelog(text['version']),
        *_imports(keys),
        *_keys(keys),
        *_installed(),
    ]


def _description(root: ElementTree.Element, text: dict[str, str]) -> list[str]:
    found = []
    if root.get('format') != '3':
        found.append('package.xml: format 3 is needed')
    if text['name'] != PACKAGE or not re.fullmatch('[a-z][a-z0-9_]*', text['name']):
        found.append('package.xml: the name is not that of the package')
    for person in root.iter('maintainer'):
        mail = person.get('email', '')
        if not re.fullmatch(r'[^@\s]+@[^@\s]+\.[a-z]+', mail) or mail.endswith('.example'):
            found.append(f'package.xml: {mail} reaches nobody; name a maintainer')
    if not any(url.get('type') == 'repository' for url in root.iter('url')):
        found.append('package.xml: no url of type repository; bloom releases from a public one')
    if not (ROOT / 'LICENSE').is_file() or text['license'] != 'Apache-2.0':
        found.append('LICENSE: missing, or not the one that package.xml names')
    if root.find('export/build_type') is None:
        found.append('package.xml: no build_type')
    return found


def _versions(version: str) -> list[str]:
    with contextlib.chdir(ROOT):
        setup = import_module('distutils.core').run_setup('setup.py', stop_after='init')
    same = setup.get_version() == version and re.fullmatch(r'\d+\.\d+\.\d+', version)
    return [] if same else ['setup.py and package.xml: versions differ, or are not x.y.z']


def _changelog(version: str) -> list[str]:
    lines = (ROOT / 'CHANGELOG.rst').read_text().splitlines()
    title = f'Changelog for package {PACKAGE}'
    heads = [
        line
        for line, under in pairwise(lines)
        if under and set(under) == {'-'} and len(under) == len(line)
    ]
    if title not in lines or not heads:
        return ['CHANGELOG.rst: not as catkin_generate_changelog writes it']
    dated = rf'{version} \(\d{{4}}-\d\d-\d\d\)'
    if heads[0] != 'Forthcoming' and not re.fullmatch(dated, heads[0]):
        return [f'CHANGELOG.rst: begins with {heads[0]!r}, neither Forthcoming nor the version']
    return []


def imported() -> set[str]:
    """Return the modules that the package and its launch files import, but for Python's own."""
    found = set()
    for path in [*(ROOT / PACKAGE).rglob('*.py'), *(ROOT / 'launch').glob('*.py')]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                found |= {name.name.partition('.')[0] for name in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                found.add(str(node.module).partition('.')[0])
    return found - set(sys.stdlib_module_names) - {PACKAGE, '__future__'}


def _imports(keys: set[str]) -> list[str]:
    found = []
    for module in sorted(imported() - OPTIONAL):
        key = KEYS.get(module, module)
        if not key:
            found.append(f'{module}: rosdistro has no key for it')
        elif key not in keys:
            found.append(f'package.xml: {key} is imported but not an exec_depend')
    return found


def _keys(keys: set[str]) -> list[str]:
    return [
        f'{key}: of pip, which a Debian package cannot depend on'
        for key in sorted(keys)
        if key.endswith('-pip')
    ]


def _installed() -> list[str]:
    """Return what ament needs to find an installed package, where it is missing."""
    with contextlib.chdir(ROOT):
        setup = import_module('distutils.core').run_setup('setup.py', stop_after='init')
    places = {
        Path(folder, Path(file).name).as_posix()
        for folder, files in setup.data_files
        for file in files
    }
    wanted = [
        f'share/ament_index/resource_index/packages/{PACKAGE}',
        f'share/{PACKAGE}/package.xml',
    ]
    config = (ROOT / 'setup.cfg').read_text()
    return [
        *(f'setup.py: {place} is not installed' for place in wanted if place not in places),
        *(
            []
            if f'install_scripts=$base/lib/{PACKAGE}' in config
            else ['setup.cfg: scripts are not installed below lib/']
        ),
    ]


if __name__ == '__main__':
    print('\n'.join(findings()) or 'ready')
