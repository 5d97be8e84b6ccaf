"""Reports in a real browser: nothing wider than the window, what matters above the fold."""

from __future__ import annotations

import html
import json
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest
from helpers.data import DATA, NO_DATA

from fisheye_svp_ros import cli

BROWSER = next(
    filter(None, map(shutil.which, ('chromium', 'chromium-browser', 'google-chrome'))), None
)
PHOTOGRAPHS = DATA / 'photos' / 'chessboard'
# One process makes both reports once.
pytestmark = [pytest.mark.xdist_group('browser'), pytest.mark.slow]
SIZES = ((1280, 800), (390, 844))
_MEASURE = """<script>
const bottom = name => [...document.querySelectorAll(name)].map(
  one => Math.round(one.getBoundingClientRect().bottom));
onload = () => parent.document.body.innerHTML = '<pre>' + JSON.stringify({
  width: document.documentElement.scrollWidth, window: window.innerWidth,
  headline: bottom('h1'), actions: bottom('.action'),
  broken: [...document.images].filter(one => !one.naturalWidth).length,
  links: [...document.querySelectorAll('a[href^="#"]')].filter(
    one => !document.getElementById(one.getAttribute('href').slice(1))).length,
}) + '</pre>';
</script></body>"""
# A window of Chromium is never as narrow as a telephone; a frame in it is.
_FRAME = '<body><iframe style="width: {}px; height: {}px; border: 0" srcdoc="{}"></iframe></body>'


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory, drawn_in_module: None) -> Path:
    """Return a folder with the reports of a calibration and a diagnosis of photographs."""
    if not PHOTOGRAPHS.exists():
        pytest.skip(NO_DATA)
    found = tmp_path_factory.mktemp('reports')
    board = ['--board', 'chessboard:4x6:30mm']
    lens = str(found / 'lens.yaml')
    assert cli.main(['calibrate', str(PHOTOGRAPHS), *board, '-o', lens]) == 0
    assert (
        cli.main(
            [
                'diagnose',
                str(PHOTOGRAPHS),
                *board,
                '--lens',
                lens,
                '--quick',
                '-o',
                str(found / 'out'),
            ]
        )
        == 0
    )
    return found


@pytest.mark.skipif(BROWSER is None, reason='no Chromium is installed')
@pytest.mark.parametrize('name', ['out/report.html', 'lens.calibrate.html'])
@pytest.mark.parametrize(('width', 'height'), SIZES)
def test_nothing_is_cut_and_what_matters_is_above_the_fold(
    folder: Path, name: str, width: int, height: int
) -> None:
    page = (folder / name).read_text()
    copy = folder / f'measured_{width}.html'
    page = html.escape(page.replace('</body>', _MEASURE))
    copy.write_text(_FRAME.format(width, height, page))
    shown = subprocess.run(
        [
            str(BROWSER),
            '--headless',
            '--no-sandbox',
            '--disable-gpu',
            '--hide-scrollbars',
            '--window-size=1400,1000',
            '--virtual-time-budget=10000',
            '--dump-dom',
            copy.as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    ).stdout
    match = re.search('<pre>({.*?})</pre>', shown)
    assert match, shown[:500]
    found = json.loads(html.unescape(match[1]))
    assert found['window'] == width and found['width'] <= width
    assert found['broken'] == found['links'] == 0
    assert max([*found['headline'][:1], *found['actions']]) <= height


def test_photographs_go_by_their_names_and_the_command_runs_as_printed(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = (folder / 'out' / 'report.html').read_text()
    match = re.search('<pre id="go-on">(.*?)</pre>', page)
    assert match
    command = html.unescape(match[1])
    assert '--board chessboard:4x6:30mm' in command
    monkeypatch.chdir(folder)
    assert cli.main(shlex.split(command)[1:]) == 0
    found = json.loads((folder / 'out' / 'diagnosis.json').read_text())
    names = {one['name'] for one in found['photographs']}
    assert '19.jpg' in names
    for one in found['advice']:
        assert len(one['photographs']) >= len(set(one['frames']))
    header, row = (folder / 'out' / 'residuals.csv').read_text().splitlines()[:2]
    assert header.split(',')[-1] == 'photograph' and row.split(',')[-1] in names
