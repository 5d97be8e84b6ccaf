"""The commands of the documentation run; its links lead somewhere; layouts name real topics."""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import pytest
import yaml
from helpers.nodes import ROOT

from fisheye_svp_ros import standalone

PAGES = ('paper.md', 'sweeps.md', 'neglect_the_shift.md', 'record_and_compare.md',
         'whats_wrong.md', 'photographs.md')
_BLOCK = re.compile(r'<!-- a test runs this -->\n```bash\n(.*?)```', re.DOTALL)
BLOCKS = [
    pytest.param(block, id=f'{page} {number}')
    for page in PAGES
    for number, block in enumerate(_BLOCK.findall((ROOT / 'docs' / page).read_text()))
]


@pytest.mark.parametrize('block', BLOCKS)
def test_commands_run_as_they_stand(block: str, tmp_path: Path, ros_domain: int) -> None:
    if 'dask' in block:
        pytest.importorskip(
            'distributed', reason='dask.distributed is not installed (extra `dask`)')
        with socket.socket() as probe:
            if probe.connect_ex(('127.0.0.1', 8786)) == 0:
                pytest.skip('somebody else has a Dask scheduler on port 8786')
    if 'record --sweep' in block and not standalone.is_genuine():
        pytest.importorskip('cyclonedds')
    tools = tmp_path / 'bin'
    tools.mkdir()
    for name, module in (('fisheye-svp', 'fisheye_svp_ros.cli'), ('dask', 'dask')):
        script = tools / name
        script.write_text(f'#!/bin/sh\nexec {sys.executable} -m {module} "$@"\n')
        script.chmod(0o755)
    env = os.environ | {
        'PATH': f'{tools}{os.pathsep}{os.environ["PATH"]}',
        'PYTHONPATH': os.pathsep.join([str(ROOT), os.environ.get('PYTHONPATH', '')]),
    }
    done = subprocess.run(['bash', '-euc', block], cwd=tmp_path, env=env, text=True, timeout=240,
                          stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize('page', sorted(path.name for path in (ROOT / 'docs').glob('*.md')))
def test_links_lead_somewhere(page: str) -> None:
    text = (ROOT / 'docs' / page).read_text()
    for target in re.findall(r'\]\(([^)#]+)\)', text):
        if not target.startswith('http'):
            assert (ROOT / 'docs' / target).exists(), target


@pytest.fixture(scope='module')
def layouts() -> tuple[Any, Any, Any]:
    """Return the layouts of RViz, Foxglove and PlotJuggler."""
    folder = ROOT / 'config' / 'layouts'
    return (yaml.safe_load((folder / 'fisheye_svp.rviz').read_text())['Visualization Manager'],
            json.loads((folder / 'foxglove.json').read_text()),
            ElementTree.parse(folder / 'plotjuggler.xml').getroot())


def test_layouts_name_topics_that_exist(
    layouts: tuple[Any, Any, Any], ros_domain: int
) -> None:
    if not standalone.is_genuine():
        pytest.importorskip('cyclonedds')
    from helpers.graph import Graph

    from fisheye_svp_ros.nodes.localizer import Localizer
    from fisheye_svp_ros.nodes.stereo_depth import StereoDepth
    from fisheye_svp_ros.nodes.synthetic_camera import SyntheticCamera

    rviz, foxglove, juggler = layouts
    shown = {display['Topic']['Value'] for display in rviz['Displays'] if 'Topic' in display}
    panels = foxglove['configById']
    shown |= set(panels['3D!scene']['topics']) | {panels['RawMessages!scenario']['topicPath']}
    shown |= {path['value'].removesuffix('.data') for name, panel in panels.items()
              if name.startswith('Plot!') for path in panel['paths']}
    shown |= {curve.attrib['name'].removesuffix('/data') for curve in juggler.iter('curve')}
    assert len(shown) > 8
    graph = Graph()
    for node in (Localizer, StereoDepth, SyntheticCamera):
        graph.start(node)
    graph.until(lambda: all(graph.probe.count_publishers(topic) for topic in shown))
    graph.close()


def test_layouts_are_built_as_the_programs_read_them(layouts: tuple[Any, Any, Any]) -> None:
    rviz, foxglove, juggler = layouts
    assert {display['Class'] for display in rviz['Displays']} == {
        f'rviz_default_plugins/{name}' for name in ('Grid', 'MarkerArray', 'PoseWithCovariance')}
    for display in rviz['Displays']:
        latched = display['Class'].endswith('MarkerArray')
        if 'Topic' in display:
            assert display['Topic']['Durability Policy'] == (
                'Transient Local' if latched else 'Volatile')
    # Foxglove: a binary tree whose leaves are the panels, each once.
    leaves, nodes = [], [foxglove['layout']]
    while nodes:
        node = nodes.pop()
        if isinstance(node, str):
            leaves.append(node)
        else:
            assert node['direction'] in ('row', 'column')
            nodes += [node['first'], node['second']]
    assert sorted(leaves) == sorted(foxglove['configById'])
    # PlotJuggler: a splitter has as many sizes and children as it counts, an area one plot.
    for splitter in juggler.iter('DockSplitter'):
        assert int(splitter.attrib['count']) == len(splitter)
        assert len(splitter.attrib['sizes'].split(';')) == len(splitter)
        assert splitter.attrib['orientation'] in ('|', '-')
    assert all([child.tag for child in area] == ['plot'] for area in juggler.iter('DockArea'))
    assert juggler.find('tabbed_widget').attrib['parent'] == 'main_window'


def test_architecture_names_every_room_and_what_is_there() -> None:
    page = (ROOT / 'docs' / 'architecture.md').read_text()
    paths = re.findall(r'`([\w./]+/[\w./]*|\w+\.(?:py|toml))`', page)
    assert len(paths) > 40
    for path in paths:
        assert (ROOT / path).exists() or (ROOT / 'fisheye_svp_ros' / path).exists(), path
    for room in (ROOT / 'fisheye_svp_ros').iterdir():
        if (room / '__init__.py').exists():
            assert re.search(rf'\b{re.escape(room.name)}\b', page), room.name
    for registry, home in (('READERS', 'io/readers.py'), ('COMMANDS', 'cli.py'),
                           ('_drawings', 'paper/report.py'), ('CATALOGUE', 'effects/catalogue.py'),
                           ('IMAGE_HEIGHTS', 'optics/curves.py')):
        assert registry in (ROOT / 'fisheye_svp_ros' / home).read_text()
