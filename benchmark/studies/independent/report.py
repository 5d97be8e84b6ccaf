"""Tables of blind trials, for people (Markdown) and for scripts (JSON)."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

Scores = Sequence[Mapping[str, Any]]
INTRODUCTION = """# Blind tests with data of other code

`benchmark/studies/independent` makes blind sets from the text of the design alone and shares no
code with the package. A trial draws a camera (any image height; a datasheet's lens, or one fitted
to these data), a scene (a board, a cube of boards, or landmarks all around; one or two cameras;
stills or video; 12 to 40 frames) and noise of 0.05 to 0.5 px. The command line gets observations,
held-out frames and the lens.

- Size 1: after poses, rig and fitted intrinsics are fitted, the rms of the effect in a coordinate
  equals the noise. For `noise_vs_angle` it is the rms relative growth of the noise, for
  `quantisation` step/√12; `wrong_ids` swaps five pairs.
- Background, in the same measure: errors of single landmarks and of their neighborhoods, an affine
  and quadratic field in each view, a static field in each camera; also up to 2 % outliers.
- An effect is named if a cause or its confounded set (`indistinguishable_from`) contains it. A
  name is false if no effect of its set is hidden.
- The oracle is the likelihood-ratio test that knows effect and direction, at the same corrected
  significance. Effects of noise, names and digits have no direction; it is counted for the others.
- The stage is right if the strongest significant component (1 %) is in the stage of the hidden
  effect. It is not tested with a background, which affects every stage.
"""


def write_reports(docs: Path, name: str, table: Mapping[str, Any]) -> None:
    """Write docs/results/blind/independent_NAME.json, then the page over all such tables."""
    folder = docs / 'blind'
    folder.mkdir(parents=True, exist_ok=True)
    lines = ',\n'.join(json.dumps(score) for score in table['scores'])
    head = json.dumps({key: value for key, value in table.items() if key != 'scores'})
    (folder / f'independent_{name}.json').write_text(f'{head[:-1]}, "scores": [\n{lines}\n]}}\n')
    tables = [json.loads(path.read_text()) for path in sorted(folder.glob('independent_*.json'))]
    (docs / 'blind_independent.md').write_text(page(tables))


def page(tables: Sequence[Mapping[str, Any]]) -> str:
    """Return the Markdown page of all tables."""
    parts = [INTRODUCTION]
    by_mode: dict[str, dict[float, list[Mapping[str, Any]]]] = defaultdict(
        lambda: defaultdict(list)
    )
    for table in tables:
        by_mode[table['mode']][table['background']] += table['scores']
    for mode, title, section in (
        ('one', 'One hidden effect', _one),
        ('two', 'Two hidden effects', _two),
        ('clean', 'Nothing hidden', _clean),
        ('outside', 'Outside the catalog', _outside),
    ):
        if mode in by_mode:
            commands = '\n'.join(
                f'    python -m benchmark.studies.independent --trials {t["trials"]} '
                f'--seed {t["seed"]} --background {t["background"]:g} --mode {mode} -o DIR'
                for t in tables
                if t['mode'] == mode
            )
            parts.append(f'## {title}\n\n{commands}\n\n' + section(by_mode[mode]))
    return '\n'.join(parts)


def _table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = [header, ['---'] * len(header), *rows]
    return '\n'.join('| ' + ' | '.join(map(str, line)) + ' |' for line in lines) + '\n'


def _rate(hits: Iterable[object]) -> str:
    values = [bool(hit) for hit in hits]
    return (
        f'{100 * sum(values) / len(values):.0f} % ({sum(values)}/{len(values)})' if values else '-'
    )


def _verdicts(scores: Scores) -> str:
    counted = Counter(score['verdict'] for score in scores)
    return ', '.join(f'{verdict} {count}' for verdict, count in counted.most_common())


def _one(runs: Mapping[float, Scores]) -> str:
    rows, cells = [], defaultdict(list)
    for background, scores in sorted(runs.items()):
        for size in sorted({s['hidden'][0]['size'] for s in scores}, reverse=True):
            some = [s for s in scores if s['hidden'][0]['size'] == size]
            stages = [s['stage_right'][0] for s in some if s['stage_right'] and not background]
            rows.append(
                (
                    f'{background:g}',
                    f'{size:g}',
                    _rate(s['found'][0] for s in some),
                    _rate(s['exactly'][0] for s in some),
                    *_beside_oracle(some),
                    _rate(s['false'] for s in some),
                    _rate(stages),
                    _verdicts(some),
                )
            )
            for s in some:
                cells[s['hidden'][0]['effect'], background].append(s)
    backgrounds = sorted(runs)
    effects = sorted({effect for effect, _ in cells})
    named = [
        (f'`{effect}`', *(_by_size(cells[effect, b]) for b in backgrounds)) for effect in effects
    ]
    return '\n'.join(
        [
            _table(
                (
                    'background',
                    'size',
                    'its class is named',
                    'itself',
                    'oracle',
                    'named of what the oracle finds',
                    'another effect named too',
                    'stage right',
                    'verdicts',
                ),
                rows,
            ),
            'By effect and background: named at size 1, 0.5, 0.2.\n',
            _table(('effect', *(f'background {b:g}' for b in backgrounds)), named),
            'Hidden effect (rows) and the first one named (columns); its confounded set counts as '
            'itself.\n',
            _confusion([s for scores in runs.values() for s in scores]),
        ]
    )


def _beside_oracle(scores: Scores) -> tuple[str, str]:
    """Return how often the oracle finds the effect, and how often it is then named."""
    known = [s for s in scores if s['hidden'][0].get('oracle') is not None]
    seen = [s for s in known if s['hidden'][0]['oracle_finds']]
    return _rate(s['hidden'][0]['oracle_finds'] for s in known), _rate(s['found'][0] for s in seen)


def _by_size(scores: Scores) -> str:
    found: dict[float, list[bool]] = defaultdict(list)
    for score in scores:
        found[score['hidden'][0]['size']].append(score['found'][0])
    return ', '.join(
        f'{sum(found[size])}/{len(found[size])}' if size in found else '-'
        for size in (1.0, 0.5, 0.2)
    )


def _confusion(scores: Scores) -> str:
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for score in scores:
        true = score['hidden'][0]['effect']
        first = score['said'][0] if score['said'] else 'nothing'
        counts[true][true if score['said'] and true in score['classes'][0] else first] += 1
    columns = sorted(counts)
    others = sorted({name for row in counts.values() for name in row} - set(columns) - {'nothing'})
    return _table(
        ('hidden', 'itself', 'nothing', 'another'),
        [
            (
                f'`{true}`',
                row[true],
                row['nothing'],
                ', '.join(
                    f'`{name}` {row[name]}'
                    for name in columns + others
                    if name != true and row[name]
                ),
            )
            for true, row in sorted(counts.items())
        ],
    )


def _two(runs: Mapping[float, Scores]) -> str:
    rows = []
    for background, scores in sorted(runs.items()):
        rows.append(
            (
                f'{background:g}',
                _rate(all(s['found']) for s in scores),
                _rate(f for s in scores for f in s['found']),
                _rate(s['false'] for s in scores),
                _verdicts(scores),
            )
        )
    return _table(
        ('background', 'both are named', 'each is named', 'another effect named too', 'verdicts'),
        rows,
    )


def _clean(runs: Mapping[float, Scores]) -> str:
    return _table(
        ('background', 'no name', 'false names', 'verdicts'),
        [
            (
                f'{background:g}',
                _rate(not s['said'] for s in scores),
                _names(scores),
                _verdicts(scores),
            )
            for background, scores in sorted(runs.items())
        ],
    )


def _names(scores: Scores) -> str:
    counted = Counter(name for score in scores for name in score['false'])
    return ', '.join(f'`{name}` {count}' for name, count in counted.most_common())


def _outside(runs: Mapping[float, Scores]) -> str:
    rows = []
    for background, scores in sorted(runs.items()):
        keys: list[tuple[str, float]] = sorted(
            {(s['hidden'][0]['effect'], -s['hidden'][0]['size']) for s in scores}
        )
        for effect, size in keys:
            some = [
                s
                for s in scores
                if s['hidden'][0]['effect'] == effect and s['hidden'][0]['size'] == -size
            ]
            rows.append((f'{background:g}', effect, f'{-size:g}', *_line(some, background)))
        rows.append((f'{background:g}', 'all', '', *_line(scores, background)))
    return _table(
        ('background', 'what', 'size', 'no name', 'names', 'stage right', 'verdicts'), rows
    )


def _line(scores: Scores, background: float) -> tuple[str, ...]:
    return (
        _rate(not s['said'] for s in scores),
        _names(scores),
        '-' if background else _rate(hit for s in scores for hit in s['stage_right']),
        _verdicts(scores),
    )
