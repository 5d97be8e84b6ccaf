"""What the diagnosis says, kept and compared (`python -m benchmark.hardening.frozen`).

For changes that must leave every number as it is.  `record FOLDER --data DATA` draws the inputs
(real sets, a rendered rig and a rendered board, blind scenes of all modes), runs `calibrate` and
`diagnose` on them and keeps what they wrote; `compare FOLDER` runs them again on the same inputs
and lists what differs: names and verdicts, numbers beyond 1e-6, and, apart, sentences.
DATA holds ov_plane, ov_cube (train.csv, test.csv) and photos (chessboard, square_grid).
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import re
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from benchmark.studies.independent.generator import GIVEN, MODES, generate, plan, write
from benchmark.studies.two_cameras import KINDS, pair
from benchmark.study import in_processes
from fisheye_svp_ros.cli import main as fisheye_svp
from fisheye_svp_ros.io.files import write_json
from fisheye_svp_ros.io.lens_files import save_lens
from fisheye_svp_ros.io.readers import write_observations

RELATIVE, ABSOLUTE = 1e-6, 1e-9
BLIND = 8  # trials of each mode
FAST = ('ov_plane-quick', 'blind-one-0', 'blind-two-1', 'blind-outside-2', 'blind-background-0')
_NUMBER = re.compile(r'[-+−]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?')
_PICTURE = re.compile(r'data:[^"\')]*|<(style|script).*?</\1>|<[^>]*>', re.S)


class Case(NamedTuple):
    """One run: a command's arguments, in which {inputs} and {output} stand for folders."""

    name: str
    arguments: list[str]


def draw_inputs(data: Path, folder: Path) -> list[Case]:
    """Write the inputs of all runs into a folder; return the runs."""
    return [*_real(data, folder), *_rendered(folder), *_blind(folder)]


def _real(data: Path, folder: Path) -> Iterator[Case]:
    for name in ('ov_plane', 'ov_cube'):
        for part in ('train', 'test'):
            text = (data / name / f'{part}.csv').read_text()
            (folder / f'{name}-{part}.csv').write_text(text)
        yield from _calibrated(folder, name, f'{name}-train.csv', '1280x800')
        run = [
            f'{{inputs}}/{name}-train.csv',
            '--lens',
            f'{{inputs}}/{name}.yaml',
            '--held-out',
            f'{{inputs}}/{name}-test.csv',
        ]
        yield _diagnosis(name, *run)
        yield _diagnosis(f'{name}-quick', *run, '--quick')
    yield _diagnosis(
        'ov_plane-against',
        '{inputs}/ov_plane-train.csv',
        '--quick',
        '--lens',
        '{inputs}/ov_plane.yaml',
        '--against',
        '{inputs}/ov_cube-train.csv',
    )
    for name, board in (
        ('chessboard', 'chessboard:4x6:30mm'),
        ('square_grid', 'squares:3x4:30mm:30mm'),
    ):
        _run(
            [
                'detect',
                str(data / 'photos' / name),
                '--board',
                board,
                '-o',
                str(folder / f'{name}.csv'),
            ]
        )
        yield from _calibrated(folder, name, f'{name}.csv', '640x720')
        yield _diagnosis(name, f'{{inputs}}/{name}.csv', '--lens', f'{{inputs}}/{name}.yaml')


def _rendered(folder: Path) -> Iterator[Case]:
    _run(['example', '-o', str(folder / 'example')])
    _run(
        [
            'detect',
            str(folder / 'example/photographs'),
            '--board',
            'chessboard:9x6:25mm',
            '-o',
            str(folder / 'example.csv'),
        ]
    )
    yield from _calibrated(folder, 'example', 'example.csv', '480x450')
    yield _diagnosis(
        'example',
        '{inputs}/example.csv',
        '--lens',
        '{inputs}/example.yaml',
        '--poses',
        '{inputs}/example/truth/poses.csv',
        '--next',
        '2',
    )
    yield _diagnosis(
        'example-for',
        '{inputs}/example.csv',
        '--quick',
        '--lens',
        '{inputs}/example.yaml',
        '--next',
        '2',
        '--for',
        'e0',
    )
    hidden = next(one for one in KINDS.values() if one.rendered)
    for name, seen in (
        ('rig', pair(hidden, 0)),
        ('drawn-rig', pair(replace(hidden, rendered=False), 1)),
    ):
        write_observations(folder / f'{name}.csv', seen.table)
        lenses = []
        for camera, lens in seen.lenses.items():
            save_lens(lens, folder / f'{name}-{camera}.yaml')
            lenses += ['--lens', f'{camera}={{inputs}}/{name}-{camera}.yaml']
        yield _diagnosis(name, f'{{inputs}}/{name}.csv', *lenses)
    yield Case(
        'rig-calibrate',
        [
            'calibrate',
            '{inputs}/rig.csv',
            '-o',
            '{output}/lenses',
            '--image-size',
            'left=1280x960,right=1024x768',
        ],
    )


def _blind(folder: Path) -> Iterator[Case]:
    """Write the sets of all modes, and sets of one effect among the background of real data."""
    for mode, hidden, background in (*((m, m, 0.0) for m in MODES), ('background', 'one', 0.5)):
        for number in range(BLIND):
            name = f'blind-{mode}-{number}'
            blind = generate(number, number, plan(hidden, number, number), background)
            write(blind, folder / name, folder / f'{name}.json')
            given = [f'{{inputs}}/{name}/{file}' for file in GIVEN]
            yield _diagnosis(name, given[0], '--lens', given[1], '--held-out', given[2])


def _calibrated(folder: Path, name: str, table: str, size: str) -> Iterator[Case]:
    """Calibrate the lens that the diagnosis is given, and yield the same as a run."""
    run = ['calibrate', f'{{inputs}}/{table}', '--image-size', size, '-o']
    _run([*(word.format(inputs=folder) for word in run), str(folder / f'{name}.yaml')])
    yield Case(f'{name}-calibrate', [*run, f'{{output}}/{name}.yaml'])


def _diagnosis(name: str, *arguments: str) -> Case:
    return Case(name, ['diagnose', *arguments, '-o', '{output}'])


def _run(arguments: Sequence[str]) -> str:
    """Run a command; return what it printed."""
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        fisheye_svp(arguments)
    return printed.getvalue()


def outcome(task: tuple[Case, str]) -> dict[str, Any]:
    """Run a case; return what it wrote, by file, as plain values."""
    case, inputs = task
    began = time.process_time()
    with tempfile.TemporaryDirectory() as output:
        words = [word.format(inputs=inputs, output=output) for word in case.arguments]
        try:
            printed = _run(words)
        except SystemExit as end:
            printed = f'ended with {end.code}'
        written = {'printed': _numbers(printed.replace(output, '').replace(inputs, ''))}
        for path in sorted(Path(output).rglob('*')):
            if (value := _content(path, (output, inputs))) is not None:
                written[str(path.relative_to(output))] = value
    return {'name': case.name, 'seconds': time.process_time() - began, 'written': written}


def _content(path: Path, folders: Sequence[str]) -> Any:
    """Return the numbers and names of a file; None of pictures."""
    if path.suffix == '.json':
        return json.loads(path.read_text())
    if path.suffix == '.yaml':
        return json.loads(json.dumps(yaml.safe_load(path.read_text()), default=str))
    if path.suffix == '.html':
        text = path.read_text()
        for folder in folders:
            text = text.replace(folder, '')
        return _numbers(_PICTURE.sub(' ', text))
    if path.suffix == '.csv':
        rows = np.genfromtxt(path, delimiter=',', names=True, dtype=None, encoding='utf-8')
        numbers = [name for name in rows.dtype.names if rows.dtype[name].kind in 'if']
        return {
            'rows': len(rows),
            'squares': {name: float(np.nansum(rows[name] ** 2.0)) for name in numbers},
        }
    return None


def _numbers(text: str) -> list[str]:
    return _NUMBER.findall(text)


def differences(before: Any, after: Any, place: str = '') -> Iterator[tuple[str, str]]:
    """Yield kind (`value`, `words`, `new`) and description of what is not the same."""
    if isinstance(before, dict) and isinstance(after, dict):
        for key in before:
            yield from differences(before[key], after.get(key), f'{place}/{key}')
        yield from (
            ('new', f'{place}/{key}: {str(after[key])[:200]}')
            for key in after
            if key not in before
        )
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        for number, both in enumerate(zip(before, after, strict=True)):
            yield from differences(*both, f'{place}/{number}')
    elif isinstance(before, str) and isinstance(after, str):
        if before != after:
            yield from _of_text(before, after, place)
    elif isinstance(before, float | int) and isinstance(after, float | int):
        if not np.isclose(after, before, RELATIVE, ABSOLUTE, equal_nan=True):
            yield 'value', f'{place}: {before!r} -> {after!r}'
    elif before != after:
        yield 'value', f'{place}: {str(before)[:200]} -> {str(after)[:200]}'


def _of_text(before: str, after: str, place: str) -> Iterator[tuple[str, str]]:
    """Yield how texts differ: numbers by more than a unit of their last place, or words."""
    both = _numbers(before), _numbers(after)
    alike = len(both[0]) == len(both[1]) and all(
        abs(_value(a) - _value(b)) <= 1.001 * _unit(a) for a, b in zip(*both, strict=True)
    )
    if not alike or ' ' not in before:
        if not (alike and _NUMBER.sub('', before) == _NUMBER.sub('', after)):
            yield 'value', f'{place}: {before!r} -> {after!r}'
    elif _NUMBER.sub('', before) != _NUMBER.sub('', after):
        yield 'words', f'{place}: {before!r} -> {after!r}'


def _value(number: str) -> float:
    return float(number.replace('−', '-'))


def _unit(number: str) -> float:
    """Return the value of one in the last place of a printed number."""
    mantissa, _, exponent = number.partition('e')
    return float(10.0 ** (int(exponent or 0) - len(mantissa.partition('.')[2])))


def record(folder: Path, data: Path, workers: int) -> None:
    """Draw the inputs, run everything, keep it in a folder."""
    inputs = folder / 'inputs'
    inputs.mkdir(parents=True, exist_ok=True)
    cases = draw_inputs(data, inputs)
    write_json(folder / 'cases.json', [case._asdict() for case in cases])
    for one in _outcomes(folder, cases, workers):
        write_json(folder / 'outcomes' / f'{one["name"]}.json', one)


def compare(folder: Path, names: Sequence[str], workers: int) -> int:
    """Run again what a folder holds, print what differs; return how many values do."""
    kept = [Case(**entry) for entry in json.loads((folder / 'cases.json').read_text())]
    cases = [case for case in kept if not names or case.name in names]
    count, seconds = 0, np.zeros(2)
    for one in _outcomes(folder, cases, workers):
        before = json.loads((folder / 'outcomes' / f'{one["name"]}.json').read_text())
        seconds += before['seconds'], one['seconds']
        found = list(differences(before['written'], json.loads(json.dumps(one['written']))))
        values = [text for kind, text in found if kind == 'value']
        count += len(values)
        kinds = [kind for kind, _ in found]
        print(
            f'{one["name"]}: {len(values)} values differ, {kinds.count("words")} sentences, '
            f'{kinds.count("new")} are new'
        )
        for kind, text in found:
            print(f'  {kind} {text}')
    print(
        f'{len(cases)} runs, {count} values differ; {seconds[0]:.0f} s of processors before, '
        f'{seconds[1]:.0f} s now'
    )
    return count


def _outcomes(folder: Path, cases: Sequence[Case], workers: int) -> list[dict[str, Any]]:
    os.environ['FISHEYE_SVP_ENGINE'] = 'numpy'
    inputs = str((folder / 'inputs').resolve())
    return in_processes('frozen runs', outcome, [(case, inputs) for case in cases], workers)


def main(arguments: Sequence[str] | None = None) -> None:
    """Record or compare."""
    parser = argparse.ArgumentParser(
        description=__doc__, prog='python -m benchmark.hardening.frozen'
    )
    parser.add_argument('what', choices=('record', 'compare'))
    parser.add_argument('folder', type=Path, help='where inputs and outcomes are kept')
    parser.add_argument('--data', type=Path, default=Path('data'), help='real sets, to record')
    parser.add_argument(
        '--subset',
        choices=('fast', 'all'),
        default='all',
        help=f'with compare: fast is {", ".join(FAST)}',
    )
    parser.add_argument('--only', nargs='+', default=[], help='with compare: these runs')
    parser.add_argument('--workers', type=int, default=2, help='processes')
    asked = parser.parse_args(arguments)
    if asked.what == 'record':
        record(asked.folder, asked.data, asked.workers)
    else:
        names = asked.only or (FAST if asked.subset == 'fast' else ())
        sys.exit(compare(asked.folder, names, asked.workers) > 0)


if __name__ == '__main__':
    main()
