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

import pytest
import yaml
from conftest import ROOT

from fisheye_svp_ros import standalone
from fisheye_svp_ros.evaluation.errors import LOCALIZATION_METRICS

PAGES = ('sweeps.md', 'neglect_the_shift.md', 'record_and_compare.md', 'whats_wrong.md')
_BLOCK = re.compile(r'<!-- a test runs this -->\n```bash\n(.*?)```', re.DOTALL)
BLOCKS = [
    pytest.param(block, id=f'{page} {number}')
    for page in PAGES
    for number, block in enumerate(_BLOCK.findall((ROOT / 'docs' / page).read_text()))
]
TOPICS = {'/markers', '/scenario', '/localizer/markers', '/localizer/pose',
          *(f'/localizer/metrics/{name}' for name in LOCALIZATION_METRICS)}


@pytest.mark.parametrize('block', BLOCKS)
def test_commands_run_as_they_stand(block: str, tmp_path: Path, ros_domain: int) -> None:
    pytest.importorskip('pyarrow')
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


@pytest.mark.parametrize('page', PAGES)
def test_links_lead_somewhere(page: str) -> None:
    text = (ROOT / 'docs' / page).read_text()
    for target in re.findall(r'\]\(([^)#]+)\)', text):
        if not target.startswith('http'):
            assert (ROOT / 'docs' / target).exists(), target


def test_layouts_name_topics_that_exist() -> None:
    folder = ROOT / 'config' / 'layouts'
    rviz = yaml.safe_load((folder / 'fisheye_svp.rviz').read_text())
    shown = {display['Topic']['Value'] for display in rviz['Visualization Manager']['Displays']
             if 'Topic' in display}
    foxglove = json.loads((folder / 'foxglove.json').read_text())
    panels = foxglove['configById']
    shown |= set(panels['3D!scene']['topics']) | {panels['RawMessages!scenario']['topicPath']}
    shown |= {path['value'].removesuffix('.data') for name, panel in panels.items()
              if name.startswith('Plot!') for path in panel['paths']}
    juggler = ElementTree.parse(folder / 'plotjuggler.xml')
    shown |= {curve.attrib['name'].removesuffix('/data') for curve in juggler.iter('curve')}
    assert shown <= TOPICS and len(shown) > 8
