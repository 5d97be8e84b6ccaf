"""The commands of the documentation run."""

from __future__ import annotations

import argparse
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from importlib import import_module
from pathlib import Path

import cv2
import pytest
from helpers.data import DATA, NO_DATA
from helpers.nodes import ROOT, need_ros
from helpers.pages import differing_lines, shown_output

from fisheye_svp_ros import cli

PAGES = [ROOT / 'README.md', *sorted((ROOT / 'docs').rglob('*.md'))]
_BLOCK = re.compile(r'<!-- a test runs this -->\n```(?:ba)?sh\n(.*?)```', re.DOTALL)
_ON_MEASURED_DATA = re.compile(_BLOCK.pattern.replace('this', 'this on measured data'), re.DOTALL)
_NEXT_CODE = re.compile(r'^```(?!text|$)', re.MULTILINE)
_COMMAND = re.compile(r'^ *fisheye-svp (.*?)(?:  +#.*| [|&>;].*)?$', re.MULTILINE)
_ALL = {
    f'{page.name} {number}': block
    for page in PAGES
    for number, block in enumerate(_BLOCK.findall(page.read_text()))
}


def _shown(block: str) -> list[str]:
    """Return the lines that pages show as printed by a block, or by one that it begins with."""
    found = []
    for page in PAGES:
        parts = _BLOCK.split(page.read_text())[1:]
        for start, rest in zip(parts[::2], parts[1::2], strict=True):
            if block.startswith(start):
                found += shown_output(_NEXT_CODE.split(rest)[0])
    return found


# A block that another one begins with runs there.
BLOCKS = [
    pytest.param(block, id=name, marks=pytest.mark.slow)
    for name, block in _ALL.items()
    if not any(other != block and other.startswith(block) for other in _ALL.values())
]


@pytest.mark.parametrize('block', BLOCKS)
def test_commands_run_as_they_stand(block: str, tmp_path: Path, ros_domain: int) -> None:
    if 'dask' in block:
        pytest.importorskip(
            'distributed', reason='dask.distributed is not installed (extra `dask`)'
        )
        with socket.socket() as probe:
            if probe.connect_ex(('127.0.0.1', 8786)) == 0:
                pytest.skip('somebody else has a Dask scheduler on port 8786')
    if 'fisheye-svp record' in block:
        need_ros()
    if 'tags:36h11' in block and not hasattr(cv2, 'aruco'):
        pytest.skip('this OpenCV has no markers')
    printed = run(block, tmp_path)
    assert differing_lines(_shown(block), printed) == [], printed


# Where a page that clones public repositories has what is here in DATA.
CLONES = {
    'babelcalib/data/ov_plane/corners': 'ov_plane/raw',
    'BoofCV-Data/example/calibration/fisheye': 'photos',
}
ON_MEASURED_DATA = [
    pytest.param(block, id=f'{page.name} {number}', marks=pytest.mark.slow)
    for page in PAGES
    for number, block in enumerate(_ON_MEASURED_DATA.findall(page.read_text()))
]


@pytest.mark.parametrize('block', ON_MEASURED_DATA)
def test_commands_on_measured_data_run_as_they_stand(block: str, tmp_path: Path) -> None:
    for clone, name in CLONES.items():
        if clone in block and not (DATA / name).exists():
            pytest.skip(NO_DATA)
        (tmp_path / clone).parent.mkdir(parents=True)
        (tmp_path / clone).symlink_to(DATA / name)
    run(block, tmp_path)


def run(block: str, tmp_path: Path) -> str:
    """Run a block of a page in a folder; fail where it fails. Return what it printed."""
    tools = tmp_path / 'bin'
    tools.mkdir()
    (tmp_path / 'examples').symlink_to(ROOT / 'examples')
    for name, module in (('fisheye-svp', 'fisheye_svp_ros.cli'), ('dask', 'dask')):
        script = tools / name
        script.write_text(f'#!/bin/sh\nexec {sys.executable} -m {module} "$@"\n')
        script.chmod(0o755)
    (tools / 'python3').write_text(f'#!/bin/sh\nexec {sys.executable} "$@"\n')
    (tools / 'python3').chmod(0o755)
    env = os.environ | {
        'PATH': f'{tools}{os.pathsep}{os.environ["PATH"]}',
        'PYTHONPATH': os.pathsep.join([str(ROOT), os.environ.get('PYTHONPATH', '')]),
    }
    log = tmp_path / 'log'
    with log.open('w') as stream:
        process = subprocess.Popen(
            ['bash', '-euc', block],
            cwd=tmp_path,
            env=env,
            start_new_session=True,
            stdout=stream,
            stderr=subprocess.STDOUT,
        )
        try:
            status = process.wait(300)
        finally:
            with suppress(ProcessLookupError):  # what a block that failed has left behind
                os.killpg(process.pid, signal.SIGKILL)
    text = log.read_text()
    assert status == 0 and ']: dropped:' not in text, text
    # Dask logs tracebacks of its own when workers and scheduler end at the same time.
    assert 'dask' in block or 'Traceback' not in text, text
    return text


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.name)
def test_every_command_is_one(page: Path) -> None:
    blocks = re.findall(r'```(?:ba)?sh\n(.*?)```', page.read_text(), re.DOTALL)
    text = '\n'.join(blocks).replace('\\\n', ' ') + '\n'.join(
        re.findall(r'`(fisheye-svp [a-z]+ [^`…]*)`', page.read_text())
    )
    for command in _COMMAND.findall(text):
        name, *words = shlex.split(command.translate(str.maketrans('', '', '[]')))
        if name == '--help':
            continue
        assert name in cli.COMMANDS, command
        parser = argparse.ArgumentParser(name)
        import_module(f'fisheye_svp_ros.commands.{name}').add_arguments(parser)
        if not {'-h', '--help', '…', '...'} & set(words):
            parser.parse_args(words)  # ends the test where it does not parse


@pytest.mark.parametrize('name', cli.COMMANDS)
def test_the_help_of_a_command_has_an_example(name: str) -> None:
    parser = argparse.ArgumentParser(name)
    import_module(f'fisheye_svp_ros.commands.{name}').add_arguments(parser)
    parser.parse_args(shlex.split(cli.EXAMPLES[name]))  # ends the test where it does not parse


def test_without_a_command_the_first_ones_are_shown(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 0
    assert len(_COMMAND.findall(capsys.readouterr().out)) == 5
