"""Writes docs/results/index.md and the evidence of README.md from the pages of results.

Each claim names its page, a pattern that finds its numbers there, and the command that measures
them; a test compares.  Run: python docs/measured.py
"""

from __future__ import annotations

import re
import subprocess
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / 'docs' / 'results'
README = ROOT / 'README.md'
INDEX = RESULTS / 'index.md'
_MARKS = '<!-- evidence -->', '<!-- end of evidence -->'
_NUMBER = re.compile(r'(?<![\w/])\d+\.\d+|\b\d+ %')
_DATED = re.compile(r'^\*Measured on [^*]*\*\n\n', re.MULTILINE)
_VERSION = '1.1.0'
_DIAGNOSIS = ('diagnosis', 'mixed_model', 'effects')
# Rooms that a page measures, where it is not the diagnosis.
ROOMS = {
    'benchmarks': (),
    'detectors': ('detect',),
    'hand_eye': ('solve',),
    'mutation': (),
    'paper': ('paper', 'solve', 'optics'),
    'pose_covariance': ('solve',),
    'rectification': ('rectify',),
    'rectifier': ('rectify',),
    'reliability': ('solve',),
    'rig_transforms': ('solve',),
    'rigs': ('solve',),
    'rules': (),
    'tag_drive': ('solve',),
}
_HEAD = """# Measured results

Each figure stands on its page with how it was measured; this table is made from the pages
(`python docs/measured.py`). The date is that of the figure's last change.

| claim | figure | against | command | page | date |
|---|---|---|---|---|---|
"""


class Claim(NamedTuple):
    """A claim; figure: with {0}, {1}, ... for the groups of a pattern in its page.

    sentence: what README says, with the same groups; '' for nothing.
    """

    text: str
    page: str
    pattern: str
    figure: str
    against: str
    command: str
    sentence: str = ''


CLAIMS = (
    Claim(
        'The extended lens is closer to the truth than least squares',
        'ray_coverage',
        r'\| all \| (\d+) \|.*\| (0\.\d+) \|\n',
        'ray error x {1} on {0} simulated cameras (geometric mean)',
        '`calibrate --plain`',
        'make study NAME=ray_coverage',
        'On {0} simulated cameras, the extended lens that `diagnose` writes has '
        '**{1} times the ray error** of plain least squares (geometric mean).',
    ),
    Claim(
        'A lens predicts another board, poses and landmarks fitted anew',
        'travel',
        r'extended\s+lens\s+of\s+`diagnose`\s+is\s+off\s+by\s+([\d.]+)\s+and\s+([\d.]+)\s+px,'
        r'.*?OpenCV\s+by\s+([\d.]+)\s+and\s+([\d.]+)\s+px',
        '{0} px instead of {2} px; with the boards exchanged, {1} px instead of {3} px',
        '`cv2.fisheye`',
        'make peers NAME=travel',
        'On a board that it was not calibrated on, the extended lens predicts points to '
        '**{0} px**, and `cv2.fisheye` to {2} px. Calibrated on the other board instead, they '
        'predict to {1} and {3} px.',
    ),
    Claim(
        'Stated ray errors hold',
        'ray_coverage',
        r'\| all \| \d+ \| \d+ % \| (\d+) % \|.*?\| \d+ % \| (\d+) % \| \d+ % \| \d\.\d+ \| \d\.',
        '{0} % (given lens) and {1} % (extended) within their 95 % intervals',
        'the truth',
        'make study NAME=ray_coverage',
    ),
    Claim(
        'What an oracle sees is named: a shift in few photographs, a drift without times',
        'power',
        r'shift, few \| 5\.5 to 8 \| (\d+ of \d+).*?no times \| 7 to 11 \| (\d+ of \d+)'
        r'.*?false name: [\d.]+ % \((\d+)/(\d+)\)',
        '{0} and {1}; false names in {2} of {3} sets',
        'a test that is told what to look for',
        'make study NAME=power',
    ),
    Claim(
        "Kita's tables 1 and 2 are reproduced",
        'paper',
        r'z and residual \| (\d+ of \d+) within 10 %.*?\| (\d+) and (\d+) \|',
        '{1} of 36 cells within 10 %, {2} within 5 %',
        'the published tables',
        'make paper',
        "Tables 1 and 2 of Kita's paper hold 36 values of z and residual. The package reproduces "
        '**{1} of them within 10 %** and {2} within 5 %.',
    ),
    Claim(
        'Transforms of a camera on a robot arm',
        'hand_eye',
        r'\| ours \| ([\d.]+) \|.*?OpenCV, Park \| ([\d.]+)',
        '{0} mm, against {1} mm (median)',
        "OpenCV's best",
        'make peers NAME=hand_eye',
    ),
    Claim(
        'Rigs of four cameras',
        'rigs',
        r'\| ours \| \d+ \| ([\d.]+).*?multical \| \d+ \| ([\d.]+).*?OpenCV \| \d+ \| ([\d.]+)',
        '{0} mm, against {1} and {2} mm (median rms)',
        'multical, OpenCV',
        'make peers NAME=rigs',
    ),
    Claim(
        'Corners of a chessboard',
        'detectors',
        r'scatters by ([\d.]+) px near.*?cornerSubPix` scatters by ([\d.]+) px',
        '{0} px, against {1} px',
        '`cv2.cornerSubPix`',
        'make study NAME=detectors',
    ),
    Claim(
        'Corrupted views give no wrong pose without a warning',
        'reliability',
        r'Of ([\d ]+) corrupted views, (none)',
        '{1} of {0}',
        'the truth',
        'make study NAME=poses',
    ),
    Claim(
        'Covariances of poses hold where geometry is weak (a frontal board at 1.5 m)',
        'pose_covariance',
        r'frontal, 1\.5 m \| [\d.]+ / ([\d.]+) \|.*?\| [\d.]+ / ([\d.]+) \| [\d.]+ /',
        '{0} % within the 99.9 % ellipsoid, not {1} %',
        '`cv2.solvePnP` and its Jacobian',
        "make study NAME=weak_geometry ARGS='--poses 500'",
    ),
    Claim(
        'Photographs that determine a viewpoint shift',
        'next_photographs',
        r'have \| (\d+) \| \d+ \| ([\d.]+) \|',
        '{0} chosen ones do what {1} random ones do (median)',
        'random photographs',
        'python -m benchmark.studies.next_photographs --cameras 100',
    ),
    Claim(
        'Stereo calibration, NumPy and Numba',
        'benchmarks',
        r'Kannala-Brandt \| numpy \| cv2\.fisheye\.stereoCalibrate \| 4 × \| ([\d.]+) ×'
        r'.*?numba \| cv2\.fisheye\.stereoCalibrate \| 20 × \| ([\d.]+) ×',
        '{0} and {1} times as fast',
        '`cv2.fisheye.stereoCalibrate`',
        'make bench',
    ),
    Claim(
        'Small faults put into the code are found by the tests',
        'mutation',
        r'\| all \| (\d+) \| (\d+) \| (\d+)% \|',
        '{1} of {0} ({2} %)',
        'a random sample',
        'make hardening NAME=mutation',
    ),
    Claim(
        'Statistical rules taken out are found by the tests of their module alone',
        'rules',
        r'\| all \| (\d+) \| (\d+) \| (\d+)% \|',
        '{1} of {0} ({2} %)',
        'one rule at a time',
        'make hardening NAME=rules',
    ),
)


def found(claim: Claim) -> re.Match[str]:
    """Return where a page has the figure of a claim; ValueError where it has none."""
    page = RESULTS / f'{claim.page}.md'
    match = re.search(claim.pattern, page.read_text(encoding='utf-8'), re.DOTALL)
    if not match:
        raise ValueError(f'{page}: nothing like {claim.pattern}')
    return match


def figure(claim: Claim) -> str:
    """Return the figure of a claim, from its page."""
    return claim.figure.format(*found(claim).groups())


def date(claim: Claim) -> str:
    """Return the date of the commit that wrote the figure of a claim."""
    page, text = str(RESULTS / f'{claim.page}.md'), found(claim)[0]
    command = ['git', 'log', '-1', '--format=%cs', '-S', text, '--', page]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True).stdout.strip()


def numbers_date(page: Path) -> str:
    """Return the date of the last commit that changed a number of a page; '' where there is none.

    Its own first line is left out.
    """
    name = page.relative_to(ROOT).as_posix()
    commits = _git('log', '--format=%h %cs', '--', name).split('\n')
    for commit, day in (line.split() for line in commits if line):
        texts = (_git('show', f'{version}:{name}') for version in (f'{commit}^', commit))
        before, after = (_NUMBER.findall(_DATED.sub('', text)) for text in texts)
        if before != after:
            return day
    return ''


def dated(page: Path) -> str:
    """Return a page with the date of its numbers, and whether their code was edited since."""
    day, text = numbers_date(page), page.read_text(encoding='utf-8')
    title, _, rest = _DATED.sub('', text).partition('\n\n')
    rooms = [f'fisheye_svp_ros/{room}' for room in ROOMS.get(page.stem, _DIAGNOSIS)]
    edited = _git('log', '-1', '--format=%cs', '--', *rooms).strip() if rooms else ''
    note = f'*Measured on {day} with version {_VERSION}.'
    if edited > day:
        note += (
            f' The code that it measures was last edited on {edited}. Run the command again before'
            ' you rely on a figure.'
        )
    return f'{title}\n\n{note}*\n\n{rest}'


def _git(*words: str) -> str:
    return subprocess.run(['git', *words], cwd=ROOT, capture_output=True, text=True).stdout


def index() -> str:
    """Return the page of all claims."""
    rows = [
        f'| {c.text} | {figure(c)} | {c.against} | `{c.command}` | [{c.page}]({c.page}.md) '
        f'| {date(c)} |'
        for c in CLAIMS
    ]
    return _HEAD + '\n'.join(rows) + '\n'


def evidence() -> str:
    """Return the list of README's claims."""
    return '\n'.join(
        f'- {c.sentence.format(*found(c).groups())} ([How measured](docs/results/{c.page}.md).)'
        for c in CLAIMS
        if c.sentence
    )


def readme(text: str) -> str:
    """Return README with its evidence written anew."""
    begin, end = _MARKS
    head, _, rest = text.partition(begin)
    return f'{head}{begin}\n{evidence()}\n{end}{rest.partition(end)[2]}'


def main() -> None:
    """Write both files, and the dates of the pages of results."""
    for page in sorted(RESULTS.glob('*.md')):
        if page != INDEX:
            page.write_text(dated(page), encoding='utf-8')
    INDEX.write_text(index(), encoding='utf-8')
    README.write_text(readme(README.read_text(encoding='utf-8')), encoding='utf-8')


if __name__ == '__main__':
    main()
