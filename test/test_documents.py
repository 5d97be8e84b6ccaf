"""Links and anchors of the documentation have targets; the site is built without a warning."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
from helpers.nodes import ROOT

import fisheye_svp_ros as fsvp
from fisheye_svp_ros.cli import COMMANDS
from fisheye_svp_ros.optics.curves import IMAGE_HEIGHTS, VIEWPOINT_SHIFTS
from fisheye_svp_ros.study.settings import SyntheticCameraSettings
from fisheye_svp_ros.study.solutions import (
    LOCALIZATION_METRICS,
    STEREO_CALIBRATION_METRICS,
    STEREO_DEPTH_METRICS,
)

EXAMPLES = sorted((ROOT / 'examples').glob('*.py'))
PAGES = sorted([*ROOT.glob('*.md'), *(ROOT / 'docs').rglob('*.md')])
_CODE = re.compile(r'^```.*?^```|`[^`\n]*`', re.DOTALL | re.MULTILINE)
_LINK = re.compile(r'\[[^\]]*\]\(([^)\s]+)\)')


@cache
def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub and MyST make them."""
    text = re.sub(
        r'^```.*?^```', '', page.read_text(encoding='utf-8'), flags=re.DOTALL | re.MULTILINE
    )
    headings = re.findall(r'^#+ (.*)$', text, re.MULTILINE)
    plain = [
        re.sub(r'[^\w\- ]', '', re.sub(r'\[([^\]]*)\]\([^)]*\)', r'\1', heading)).lower()
        for heading in headings
    ]
    return {heading.strip().replace(' ', '-') for heading in plain}


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_have_targets(page: Path) -> None:
    text = _CODE.sub('', page.read_text(encoding='utf-8'))
    for link in _LINK.findall(text):
        if re.match('[a-z]+:', link):
            continue
        target, _, anchor = link.partition('#')
        path = page.parent / target if target else page
        assert path.exists(), link
        if anchor:
            assert anchor in anchors(path.resolve()), link


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path: Path) -> None:
    for module in ('sphinx', 'myst_parser', 'furo'):
        pytest.importorskip(module, reason='needs the extra `docs`')
    done = subprocess.run(
        [
            sys.executable,
            '-m',
            'sphinx',
            '-W',
            '--keep-going',
            '-q',
            str(ROOT / 'docs'),
            str(tmp_path),
        ],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    for page in (ROOT / 'docs').rglob('*.md'):
        assert (tmp_path / page.relative_to(ROOT / 'docs')).with_suffix('.html').is_file()
    api = (tmp_path / 'reference' / 'python_api.html').read_text(encoding='utf-8')
    for name in fsvp.__all__:
        assert f'.{name}"' in api, name
    commands = (tmp_path / 'reference' / 'commands.html').read_text(encoding='utf-8')
    for name in COMMANDS:
        assert f'id="{name}"' in commands, name


def test_the_lens_files_name_every_curve() -> None:
    page = (ROOT / 'docs' / 'reference' / 'lens_files.md').read_text(encoding='utf-8')
    for name in (*IMAGE_HEIGHTS, *VIEWPOINT_SHIFTS):
        assert f'`{name}`' in page, name


def test_the_page_of_the_nodes_names_every_metric() -> None:
    """Along y and z as along x."""
    page = (ROOT / 'docs' / 'reference' / 'nodes.md').read_text(encoding='utf-8')
    for name in (*LOCALIZATION_METRICS, *STEREO_CALIBRATION_METRICS, *STEREO_DEPTH_METRICS):
        if not name.endswith(('_y_m', '_z_m')):
            assert f'`{name}`' in page, name


def test_documented_paths_below_share_are_installed() -> None:
    """The launch test was called where no installation has it."""
    texts = [path.read_text(encoding='utf-8') for path in (*PAGES, *EXAMPLES)]
    paths = set(re.findall(r'--share fisheye_svp_ros\)/([\w./]+)', '\n'.join(texts)))
    assert paths
    for path in paths:
        assert path.startswith(('config/', 'launch/')) and (ROOT / path).is_file(), path


def test_documented_lenses_of_nodes_are_files_folders_or_names() -> None:
    """A folder without its slash is refused; the managed localizer sees the default camera."""
    names = {path.stem for path in (ROOT / 'config' / 'lenses').iterdir()}
    for page in PAGES:
        for lens in re.findall(r'-p lens:=(\S+)', page.read_text(encoding='utf-8')):
            assert lens in names or lens.endswith(('/', '.yaml', '$lens')), (page, lens)
    page = (ROOT / 'docs' / 'reference' / 'nodes.md').read_text(encoding='utf-8')
    assert f'-p lifecycle:=true -p lens:={SyntheticCameraSettings().lens}\n' in page


def test_the_readme_echoes_a_topic_that_may_not_be_there_yet() -> None:
    """Without its type, `ros2 topic echo` ends where the nodes before it are only starting."""
    text = (ROOT / 'README.md').read_text(encoding='utf-8')
    assert re.findall(r'^ros2 topic echo (/\S+) +(\S+)', text, re.MULTILINE) == [
        ('/localizer/metrics/position_error_m', 'std_msgs/msg/Float64')
    ]


def test_a_diagnosis_is_what_its_schema_says() -> None:
    jsonschema = pytest.importorskip('jsonschema', reason='needs the extra `test`')
    path = ROOT / 'docs' / 'reference' / 'diagnosis.schema.json'
    scene = fsvp.simulate_scenario(
        lens='fish214', radius=0.5, noise_px=0.2, poses_file='calibration'
    )
    document = fsvp.diagnose(scene.observations, scene.lens.svp()).document
    validator = jsonschema.Draft202012Validator(json.loads(path.read_text(encoding='utf-8')))
    assert document['causes']
    validator.validate(json.loads(json.dumps(document)))
    assert not validator.is_valid({**document, 'verdict': 'good'})
    assert set(document) <= set(validator.schema['properties'])


def test_the_schema_is_that_of_the_records() -> None:
    """It lacked candidates, decision and file."""
    sys.path.insert(0, str(ROOT / 'docs'))
    try:
        import diagnosis_schema
    finally:
        sys.path.remove(str(ROOT / 'docs'))
    stale = 'stale; run: python docs/diagnosis_schema.py'
    assert diagnosis_schema.SCHEMA.read_text(encoding='utf-8') == diagnosis_schema.text(), stale


def test_the_glossary_has_the_terms_of_first_screens() -> None:
    """Of whoever has never seen a diagnosis."""
    page = (ROOT / 'docs' / 'reference' / 'glossary.md').read_text(encoding='utf-8')
    entries = re.findall(r'^\| ([^|]+) \|', page, re.MULTILINE)
    terms = {term for entry in entries for term in entry.split(', ')}
    used = (
        'extended lens, extrapolated, intrinsics, landmark, held-out error, mrad, noise, '
        'off axis, outlier, photograph, ray error, readout, rms, sensor tilt, single frame, sure, '
        'target, viewpoint'
    )
    assert {*used.split(', ')} <= terms


def test_the_figures_of_the_first_pages_are_those_of_the_results() -> None:
    sys.path.insert(0, str(ROOT / 'docs'))
    try:
        import measured
    finally:
        sys.path.remove(str(ROOT / 'docs'))
    undated = [re.sub(r'\| [\d-]* \|$', '', line) for line in measured.index().splitlines()]
    page = measured.INDEX.read_text(encoding='utf-8').splitlines()
    assert [re.sub(r'\| [\d-]* \|$', '', line) for line in page] == undated
    text = measured.README.read_text(encoding='utf-8')
    assert measured.readme(text) == text and len(text.splitlines()) <= 150
    pages = {path.stem for path in measured.RESULTS.glob('*.md')}
    assert {claim.page for claim in measured.CLAIMS} <= pages


def test_every_page_of_results_says_when_it_was_measured() -> None:
    """A reader took figures of older code for those of the present one."""
    for page in (ROOT / 'docs' / 'results').glob('*.md'):
        if page.stem != 'index':
            note = page.read_text(encoding='utf-8').split('\n\n')[1]
            assert re.match(r'\*Measured on 20\d\d-\d\d-\d\d with version \d', note), page.name
