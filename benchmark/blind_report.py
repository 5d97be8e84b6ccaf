"""The report of the blind tests: docs/results/blind.md and the pictures and numbers beside it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmark.blind_effects import HIDDEN
from benchmark.blind_figures import (
    Rate,
    confusion,
    coverage,
    is_clean,
    is_hit,
    is_open,
    is_right_variable,
    of,
    oracle_finds_all,
    rate,
    sizes,
    uniformity,
)
from benchmark.blind_outside import OUTSIDE
from benchmark.blind_trial import Outcome
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.reporting.plots import FAINT, OURS, PUBLISHED, picture

_GOALS = {1.0: 0.98, 0.5: 0.95, 0.2: 0.85}
_HEAD = """# Blind tests

`make blind` runs 200 trials for each mode (and for each size of one effect). The command above a
table repeats its trials. A trial draws a scene: mono or stereo, boards or a cloud of landmarks, 30
frames, about 3000 numbers, noise of 0.05 to 0.4 px, fish180, fish214 or a random Kannala-Brandt
lens, intrinsics fixed or free. It hides an effect and gives `diagnose` only the observations and
the lens. Effects are simulated physically, not by the columns of the catalog: boards are bent,
rows are exposed one after the other, rays are traced through the window.

Size: the rms residual that the effect causes after poses, rig and free intrinsics are fitted, over
the noise. For `noise_vs_angle`: the rms relative change of the noise. For `quantisation`: the rms
of rounding. `wrong_ids` swaps at least one pair.

Oracle: the likelihood-ratio (F) test of the hidden effect and its form, at the same significance
and with the same correction for the numbers of effects and forms. Intervals are 95 % (Clopper and
Pearson).
"""


def write_report(saved: Mapping[str, tuple[str, list[Outcome]]], directory: Path) -> None:
    """Write blind.md from the commands and outcomes by mode, and the pictures beside it."""
    sections: dict[str, Callable[[Sequence[Outcome], Path], str]] = {
        'one': _one_effect, 'clean': _clean, 'outside': _outside, 'two': _two,
        'background': _background,
    }
    parts, everything = [_HEAD], []
    for mode, (command, outcomes) in saved.items():
        title, rest = sections[mode](outcomes, directory / 'blind').split('\n', 1)
        parts.append(f'{title}\n\n{len(outcomes)} trials:\n\n    {command}\n{rest}')
        everything += outcomes
    parts += ['## Every trial that failed\n', *(f'- {line}' for line in failures(everything)), '']
    write_text(directory / 'blind.md', '\n'.join(parts))


def _one_effect(outcomes: Sequence[Outcome], directory: Path) -> str:
    steps = sizes(outcomes, 'one')
    lines = ['## One hidden effect', '', _table(
        ['size', 'its class is named', 'interval', 'goal', 'oracle', 'another effect named too'],
        [
            [
                f'{size:g}', str(named := rate(of(outcomes, 'one', size), is_hit)),
                _interval(named), f'{100 * _GOALS[size]:.0f} %' if size in _GOALS else '-',
                str(rate(of(outcomes, 'one', size), oracle_finds_all)),
                str(rate(of(outcomes, 'one', size), lambda o: bool(o.extra))),
            ] for size in steps
        ],
    ), '![power](blind/power.png)', '', 'Named by effect and size, oracle in brackets:', '',
        _effects_table(outcomes, steps), '![confusion](blind/confusion.png)', '',
        _gain_text(outcomes), '', _coverage_text(outcomes)]
    _draw_power(outcomes, directory / 'power.png')
    _draw_confusion([o for o in outcomes if o.task.size >= 0.2], directory / 'confusion.png')
    return '\n'.join([*lines, ''])


def _effects_table(outcomes: Sequence[Outcome], steps: Sequence[float]) -> str:
    return _table(
        ['effect', *(f'{size:g}' for size in steps)],
        [[f'`{name}`', *(_beside_oracle(of(outcomes, 'one', s, name)) for s in steps)]
         for name in HIDDEN],
    )


def _gain_text(outcomes: Sequence[Outcome]) -> str:
    shares = np.array([o.recovered for o in outcomes if o.recovered is not None])
    if not shares.size:
        return ''
    good = Rate(int((shares >= 0.95).sum()), shares.size)
    quantiles = ', '.join(f'{100 * q:.1f}' for q in np.quantile(shares, (0.05, 0.25, 0.5)))
    return (
        'Gain: the true model removes a part of the held-out residual variance above noise. The '
        f'extended model removes at least 95 % of that part in {good}. 5, 25 and 50 % of trials '
        f'are below {quantiles} %; the mean is {100 * shares.mean():.1f} %. (Effects that move '
        'points, size 1, 15 frames held out.)'
    )


def _coverage_text(outcomes: Sequence[Outcome]) -> str:
    mine = [o for o in outcomes if o.task.size >= 0.2]
    one, two = coverage(mine, 1.0), coverage(mine, 1.96)
    trials = sum(bool(o.errors) for o in mine)
    if not trials:
        return ''
    return (
        f'Standard errors: the true value lies within 1 standard error for {one} and within 1.96 '
        f'for {two} of the parameters, in {trials} trials at sizes from 0.2 whose effect has true '
        'values by the same names.'
    )


def _clean(outcomes: Sequence[Outcome], directory: Path) -> str:
    kinds = {
        'all': [''], 'lens': ['fish180', 'fish214', 'kannala_brandt'],
        'noise': sorted({o.scene.split('noise ')[1].split(' px')[0] for o in outcomes if o.scene}),
    }
    rows = [['all', str(rate(outcomes, is_clean)), _interval(rate(outcomes, is_clean))]]
    for kind, values in list(kinds.items())[1:]:
        for value in values:
            text = f'noise {value} px' if kind == 'noise' else value
            found = rate([o for o in outcomes if text in o.scene], is_clean)
            rows.append([text, str(found), _interval(found)])
    bounds = (0, 2000, 4000, 10**6)
    for low, high in pairwise(bounds):
        found = rate([o for o in outcomes if low <= _numbers(o) < high], is_clean)
        rows.append([f'{low} to {high} numbers' if high < 10**6 else f'from {low} numbers',
                     str(found), _interval(found)])
    uniform = uniformity(outcomes)
    worst = min((p for _, p in uniform.values()), default=1.0)
    _draw_p_values(outcomes, directory / 'p_values.png')
    return '\n'.join([
        '## Clean data', '', _table(['', 'adequate', 'interval'], rows),
        'p-values of the screening under the null, the simplest form of each effect, against the '
        'uniform distribution (Kolmogorov-Smirnov); of effects with a sign, those with the right '
        f'one. The smallest of {len(uniform)} is {worst:.3f}; by chance a smallest one below '
        f'{0.05 / max(len(uniform), 1):.4f} would be seen in 5 % of runs.', '',
        _table(['effect', 'p-values', 'KS p'],
               [[f'`{name}`', str(n), f'{p:.3f}'] for name, (n, p) in uniform.items()]),
        '![p-values](blind/p_values.png)', '',
    ])


def _outside(outcomes: Sequence[Outcome], directory: Path) -> str:
    groups = [('all', outcomes)]
    groups += [
        (f'`{name}`, size {size:g}', of(outcomes, 'outside', size, name))
        for name in OUTSIDE for size in sizes(outcomes, 'outside')
    ]
    return '\n'.join(['## Effects outside the catalog', '', _table(
        ['hidden', 'no name', 'something left', 'right variable', 'verdict adequate'],
        [[
            name, str(rate(mine, lambda o: not o.causes)), str(rate(mine, is_open)),
            str(rate(mine, is_right_variable)), str(rate(mine, is_clean)),
        ] for name, mine in groups if mine],
    )])


def _two(outcomes: Sequence[Outcome], directory: Path) -> str:
    both = rate(outcomes, is_hit)
    single = Rate(
        sum(_named(o, name) for o in outcomes for name in o.task.names), 2 * len(outcomes)
    )
    return '\n'.join([
        '## Two effects at once', '',
        f'At 0.5 of the noise each: both named in {both}, interval {_interval(both)}; each in '
        f'{single}. The oracles find both in {rate(outcomes, oracle_finds_all)}. '
        f'Another effect is named too in {rate(outcomes, lambda o: bool(o.extra))}.', '',
    ])


def _background(outcomes: Sequence[Outcome], directory: Path) -> str:
    bounds = (0.1, 0.22, 0.46, 1.0)
    rows = []
    for low, high in [*pairwise(bounds), (0.0, 2.0)]:
        mine = [o for o in outcomes if low <= o.background < high]
        with_one = [o for o in mine if o.task.names]
        without = [o for o in mine if not o.task.names]
        named = rate(with_one, is_hit)
        rows.append([
            'all' if high > 1 else f'{low:g} to {high:g}', str(named), _interval(named),
            str(rate(with_one, lambda o: bool(o.extra))),
            str(rate(without, lambda o: bool(o.causes))),
        ])
    errors = _coverage_text(outcomes)
    return '\n'.join([
        '## With local errors', '',
        'Every set has errors outside the catalog: offsets of single landmarks, a smooth field '
        'over the image and one in each frame, in random proportions, and up to 1 % outliers. '
        'Their rms over the noise is 0.1 to 1 after poses and free intrinsics are fitted. Half '
        'of the sets also have an effect of size 1.', '',
        _table(['background over the noise', 'effect named', 'interval',
                'another effect named too', 'effect named though none is hidden'], rows),
        errors, '',
    ])


def _named(outcome: Outcome, name: str) -> bool:
    return any(name == effect or name in same for effect, same in outcome.causes.items())


def failures(outcomes: Sequence[Outcome]) -> Iterator[str]:
    """Yield a line for each trial that did not come out as it should, but at size 0.05."""
    for o in outcomes:
        wrong = {
            'one': (not o.hit or bool(o.extra)) and o.task.size >= 0.2,
            'clean': not is_clean(o), 'two': not o.hit, 'outside': bool(o.causes),
            'background': not o.hit or bool(o.extra),
        }[o.task.mode]
        if wrong:
            named = ', '.join(
                f'{e}{f" or {same}" if same else ""}' for e, same in o.causes.items()
            ) or 'no name'
            hidden = ' + '.join(o.hidden) or 'nothing'
            yield (f'{o.task.mode} {o.task.size:g} #{o.task.number}: {o.scene}; hidden: {hidden}; '
                   f'{o.verdict}: {named}; left: {", ".join(o.remaining) or "nothing"}')


def _draw_power(outcomes: Sequence[Outcome], path: Path) -> None:
    steps = sizes(outcomes, 'one')
    named, oracle = (
        [rate(of(outcomes, 'one', size), success) for size in steps]
        for success in (is_hit, oracle_finds_all)
    )
    with picture(path, 5.5, 3.6) as figure:
        axis = figure.subplots()
        reach = np.abs(np.array([r.interval for r in named]).T - [r.value for r in named])
        axis.errorbar(steps, [r.value for r in named], reach, color=OURS, marker='o', capsize=3,
                      label='diagnosis: the class named holds the effect')
        axis.plot(steps, [r.value for r in oracle], color=PUBLISHED, marker='s', fillstyle='none',
                  markersize=10, linestyle='--', zorder=3,
                  label='oracle: told which effect to look for')
        axis.plot(list(_GOALS), list(_GOALS.values()), '_', color='#404850', markersize=14,
                  label='goal')
        axis.set(xscale='log', ylim=(0, 1.03), xlabel='size of the effect over the noise',
                 ylabel='share of trials', title=f'{len(outcomes)} trials, one hidden effect each')
        axis.set_xticks(steps, [f'{size:g}' for size in steps], minor=False)
        axis.minorticks_off()
        axis.legend(loc='lower right')


def _draw_confusion(outcomes: Sequence[Outcome], path: Path) -> None:
    rows, columns, shares = confusion(outcomes)
    with picture(path, 8.5, 7.5) as figure:
        axis = figure.subplots()
        axis.imshow(shares, cmap='Blues', vmin=0, vmax=1)
        for i, j in zip(*np.nonzero(shares), strict=True):
            axis.text(j, i, f'{100 * shares[i, j]:.0f}', ha='center', va='center', fontsize=6.5,
                      color='white' if shares[i, j] > 0.55 else 'black')
        axis.set_xticks(range(len(columns)), columns, rotation=60, ha='right')
        axis.set_yticks(range(len(rows)), rows)
        axis.grid(visible=False)
        axis.set(xlabel='named', ylabel='hidden',
                 title=f'Per cent of trials, sizes from 0.2 ({len(outcomes)} trials)')


def _draw_p_values(outcomes: Sequence[Outcome], path: Path) -> None:
    with picture(path, 5.5, 4.2) as figure:
        axis = figure.subplots()
        for name in HIDDEN:
            values = np.sort([o.p_values[name] for o in outcomes if name in o.p_values])
            if values.size:
                axis.plot(values, (np.arange(values.size) + 0.5) / values.size, color=OURS,
                          alpha=0.5, linewidth=1)
        axis.plot([0, 1], [0, 1], color=FAINT)
        axis.set(xlabel='p-value under the null', ylabel='share below', aspect='equal',
                 title='Screening of clean data, one line an effect')


def _beside_oracle(outcomes: Sequence[Outcome]) -> str:
    if not outcomes:
        return '-'
    named, oracle = rate(outcomes, is_hit), rate(outcomes, oracle_finds_all)
    return f'{named.successes} ({oracle.successes}) of {named.trials}'


def _numbers(outcome: Outcome) -> int:
    return int(outcome.scene.rsplit(', ', 1)[-1].split()[0]) if outcome.scene else -1


def _interval(found: Rate) -> str:
    low, high = found.interval
    return f'{100 * low:.1f} to {100 * high:.1f} %'


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ['---'] * len(header), *rows]
    return '\n'.join('| ' + ' | '.join(line) + ' |' for line in lines) + '\n'
