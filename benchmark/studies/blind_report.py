"""The report of the blind tests: docs/results/blind.md and the pictures and numbers beside it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy import stats

from benchmark.studies.blind_effects import HIDDEN
from benchmark.studies.blind_outside import OUTSIDE
from benchmark.studies.blind_trial import Outcome
from benchmark.study import Rate, table, write_lines
from fisheye_svp_ros.reporting.plots import FAINT, OURS, PUBLISHED, picture

_GOALS = {1.0: 0.98, 0.5: 0.95, 0.2: 0.85}
_HEAD = """# Blind tests

`make study NAME=blind` runs 200 trials a mode (and a size of one effect). The command above a
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


def of(
    outcomes: Iterable[Outcome], mode: str, size: float | None = None, name: str | None = None
) -> list[Outcome]:
    """Return the outcomes of a mode, a size, a hidden effect."""
    return [
        o
        for o in outcomes
        if o.task.mode == mode
        and size in (None, o.task.size)
        and (name is None or name in o.task.names)
    ]


def sizes(outcomes: Iterable[Outcome], mode: str) -> list[float]:
    """Return the sizes of a mode, largest first."""
    return sorted({o.task.size for o in of(outcomes, mode)}, reverse=True)


def hits(outcomes: Iterable[Outcome]) -> Rate:
    """Count trials whose named classes hold all that was hidden."""
    return Rate.of(o.hit for o in outcomes)


def oracle_hits(outcomes: Iterable[Outcome]) -> Rate:
    """Count trials in which the oracle finds all that was hidden."""
    return Rate.of(all(o.oracle) for o in outcomes)


def adequate(outcomes: Iterable[Outcome]) -> Rate:
    """Count trials in which nothing was found."""
    return Rate.of(o.verdict == 'adequate' for o in outcomes)


def others(outcomes: Iterable[Outcome]) -> Rate:
    """Count trials in which an effect is named that was not hidden."""
    return Rate.of(bool(o.extra) for o in outcomes)


def coverage(outcomes: Iterable[Outcome], limit: float) -> Rate:
    """Count parameters whose error is within a multiple of its standard error."""
    return Rate.of(abs(error) < limit for o in outcomes for error in o.errors.values())


def uniformity(outcomes: Sequence[Outcome]) -> dict[str, tuple[int, float]]:
    """Return by effect the number of p-values under the null and their Kolmogorov-Smirnov p."""
    values = {name: [o.p_values[name] for o in outcomes if name in o.p_values] for name in HIDDEN}
    return {
        name: (len(some), float(stats.kstest(some, 'uniform').pvalue))
        for name, some in values.items()
        if len(some) >= 5
    }


def write_report(saved: Mapping[str, tuple[str, list[Outcome]]], directory: Path) -> None:
    """Write blind.md from the commands and outcomes by mode, and the pictures beside it."""
    sections: dict[str, Callable[[Sequence[Outcome], Path], list[str]]] = {
        'one': _one_effect,
        'clean': _clean,
        'outside': _outside,
        'two': _two,
        'background': _background,
    }
    lines, everything = _HEAD.split('\n'), []
    for mode, (command, outcomes) in saved.items():
        title, *rest = sections[mode](outcomes, directory / 'blind')
        lines += [title, '', f'{len(outcomes)} trials:', '', f'    {command}', *rest]
        everything += outcomes
    lines += ['## Every trial that failed', '', *(f'- {line}' for line in failures(everything))]
    write_lines(directory / 'blind.md', lines)


def _one_effect(outcomes: Sequence[Outcome], directory: Path) -> list[str]:
    steps = sizes(outcomes, 'one')
    rows = []
    for size in steps:
        mine = of(outcomes, 'one', size)
        rows.append(
            [
                f'{size:g}',
                hits(mine),
                hits(mine).bounds,
                f'{100 * _GOALS[size]:.0f} %' if size in _GOALS else '-',
                oracle_hits(mine),
                others(mine),
            ]
        )
    _draw_power(outcomes, directory / 'power.png')
    _draw_confusion([o for o in outcomes if o.task.size >= 0.2], directory / 'confusion.png')
    return [
        '## One hidden effect',
        '',
        *table(
            'size | its class is named | interval | goal | oracle | another effect named too', rows
        ),
        '',
        '![power](blind/power.png)',
        '',
        'Named by effect and size, oracle in brackets:',
        '',
        *table(
            'effect | ' + ' | '.join(f'{size:g}' for size in steps),
            [
                [f'`{name}`', *(_beside_oracle(of(outcomes, 'one', size, name)) for size in steps)]
                for name in HIDDEN
            ],
        ),
        '',
        '![confusion](blind/confusion.png)',
        '',
        _gain_text(outcomes),
        '',
        _coverage_text(outcomes),
        '',
    ]


def _gain_text(outcomes: Sequence[Outcome]) -> str:
    shares = np.array([o.recovered for o in outcomes if o.recovered is not None])
    if not shares.size:
        return ''
    good = Rate.of(shares >= 0.95)
    quantiles = ', '.join(f'{100 * q:.1f}' for q in np.quantile(shares, (0.05, 0.25, 0.5)))
    return (
        'Gain: the true model removes a part of the held-out residual variance above noise. The '
        f'extended model removes at least 95 % of that part in {good}. 5, 25 and 50 % of trials '
        f'are below {quantiles} %; the mean is {100 * shares.mean():.1f} %. (Effects that move '
        'points, size 1, 15 frames held out.)'
    )


def _coverage_text(outcomes: Sequence[Outcome]) -> str:
    mine = [o for o in outcomes if o.task.size >= 0.2]
    trials = sum(bool(o.errors) for o in mine)
    if not trials:
        return ''
    return (
        f'Standard errors: the true value lies within 1 standard error for {coverage(mine, 1.0)} '
        f'and within 1.96 for {coverage(mine, 1.96)} of the parameters, in {trials} trials at '
        'sizes from 0.2 whose effect has true values by the same names.'
    )


def _clean(outcomes: Sequence[Outcome], directory: Path) -> list[str]:
    noises = sorted({o.scene.split('noise ')[1].split(' px')[0] for o in outcomes if o.scene})
    groups = {'all': list(outcomes)} | {
        text: [o for o in outcomes if text in o.scene]
        for text in (
            'fish180',
            'fish214',
            'kannala_brandt',
            *(f'noise {value} px' for value in noises),
        )
    }
    for low, high in pairwise((0, 2000, 4000, 10**6)):
        text = f'{low} to {high} numbers' if high < 10**6 else f'from {low} numbers'
        groups[text] = [o for o in outcomes if low <= _numbers(o) < high]
    uniform = uniformity(outcomes)
    worst = min((p for _, p in uniform.values()), default=1.0)
    _draw_p_values(outcomes, directory / 'p_values.png')
    return [
        '## Clean data',
        '',
        *table(
            ' | adequate | interval',
            [(name, adequate(mine), adequate(mine).bounds) for name, mine in groups.items()],
        ),
        '',
        'p-values of the screening under the null, the simplest form of each effect, against the '
        'uniform distribution (Kolmogorov-Smirnov); of effects with a sign, those with the right '
        f'one. The smallest of {len(uniform)} is {worst:.3f}; by chance a smallest one below '
        f'{0.05 / max(len(uniform), 1):.4f} would be seen in 5 % of runs.',
        '',
        *table(
            'effect | p-values | KS p',
            [(f'`{name}`', n, f'{p:.3f}') for name, (n, p) in uniform.items()],
        ),
        '',
        '![p-values](blind/p_values.png)',
        '',
    ]


def _outside(outcomes: Sequence[Outcome], directory: Path) -> list[str]:
    groups = [('all', outcomes)]
    groups += [
        (f'`{name}`, size {size:g}', of(outcomes, 'outside', size, name))
        for name in OUTSIDE
        for size in sizes(outcomes, 'outside')
    ]
    return [
        '## Effects outside the catalog',
        '',
        *table(
            'hidden | no name | something left | right variable | verdict adequate',
            [
                (
                    name,
                    Rate.of(not o.causes for o in mine),
                    Rate.of(o.verdict in ('unexplained', 'partly_explained') for o in mine),
                    Rate.of(bool(OUTSIDE[o.task.names[0]][1] & set(o.remaining)) for o in mine),
                    adequate(mine),
                )
                for name, mine in groups
                if mine
            ],
        ),
        '',
    ]


def _two(outcomes: Sequence[Outcome], directory: Path) -> list[str]:
    both = hits(outcomes)
    single = Rate.of(_named(o, name) for o in outcomes for name in o.task.names)
    return [
        '## Two effects at once',
        '',
        f'At 0.5 of the noise each: both named in {both}, interval {both.bounds}; each in '
        f'{single}. The oracles find both in {oracle_hits(outcomes)}. '
        f'Another effect is named too in {others(outcomes)}.',
        '',
    ]


def _background(outcomes: Sequence[Outcome], directory: Path) -> list[str]:
    rows = []
    for low, high in [*pairwise((0.1, 0.22, 0.46, 1.0)), (0.0, 2.0)]:
        mine = [o for o in outcomes if low <= o.background < high]
        with_one = [o for o in mine if o.task.names]
        rows.append(
            [
                'all' if high > 1 else f'{low:g} to {high:g}',
                hits(with_one),
                hits(with_one).bounds,
                others(with_one),
                Rate.of(bool(o.causes) for o in mine if not o.task.names),
            ]
        )
    return [
        '## With local errors',
        '',
        'Every set has errors outside the catalog: offsets of single landmarks, a smooth field '
        'over the image and one in each frame, in random proportions, and up to 1 % outliers. '
        'Their rms over the noise is 0.1 to 1 after poses and free intrinsics are fitted. Half '
        'of the sets also have an effect of size 1.',
        '',
        *table(
            'background over the noise | effect named | interval | another effect named too '
            '| effect named though none is hidden',
            rows,
        ),
        '',
        _coverage_text(outcomes),
        '',
    ]


def _named(outcome: Outcome, name: str) -> bool:
    return any(name == effect or name in same for effect, same in outcome.causes.items())


def failures(outcomes: Sequence[Outcome]) -> Iterator[str]:
    """Yield a line for each trial that did not come out as it should, but at size 0.05."""
    for o in outcomes:
        wrong = {
            'one': (not o.hit or bool(o.extra)) and o.task.size >= 0.2,
            'clean': o.verdict != 'adequate',
            'two': not o.hit,
            'outside': bool(o.causes),
            'background': not o.hit or bool(o.extra),
        }[o.task.mode]
        if wrong:
            named = (
                ', '.join(f'{e}{f" or {same}" if same else ""}' for e, same in o.causes.items())
                or 'no name'
            )
            hidden = ' + '.join(o.hidden) or 'nothing'
            yield (
                f'{o.task.mode} {o.task.size:g} #{o.task.number}: {o.scene}; hidden: {hidden}; '
                f'{o.verdict}: {named}; left: {", ".join(o.remaining) or "nothing"}'
            )


def _draw_power(outcomes: Sequence[Outcome], path: Path) -> None:
    steps = sizes(outcomes, 'one')
    mine = [of(outcomes, 'one', size) for size in steps]
    named, oracle = [hits(some) for some in mine], [oracle_hits(some) for some in mine]
    with picture(path, 5.5, 3.6) as figure:
        axis = figure.subplots()
        reach = np.abs(np.array([r.interval for r in named]).T - [r.value for r in named])
        axis.errorbar(
            steps,
            [r.value for r in named],
            reach,
            color=OURS,
            marker='o',
            capsize=3,
            label='diagnosis: the class named holds the effect',
        )
        axis.plot(
            steps,
            [r.value for r in oracle],
            color=PUBLISHED,
            marker='s',
            fillstyle='none',
            markersize=10,
            linestyle='--',
            zorder=3,
            label='oracle: told which effect to look for',
        )
        axis.plot(
            list(_GOALS), list(_GOALS.values()), '_', color='#404850', markersize=14, label='goal'
        )
        axis.set(
            xscale='log',
            ylim=(0, 1.03),
            xlabel='size of the effect over the noise',
            ylabel='share of trials',
            title=f'{len(outcomes)} trials, one hidden effect each',
        )
        axis.set_xticks(steps, [f'{size:g}' for size in steps], minor=False)
        axis.minorticks_off()
        axis.legend(loc='lower right')


def _draw_confusion(outcomes: Sequence[Outcome], path: Path) -> None:
    rows, columns = list(HIDDEN), [*HIDDEN, 'no name']
    shares = np.zeros((len(rows), len(columns)))  # a trial with several names counts for each
    for i, name in enumerate(rows):
        mine = [o for o in outcomes if o.task.names == (name,)]
        for outcome in mine:
            for named in outcome.causes or ['no name']:
                shares[i, columns.index(named)] += 1 / len(mine)
    with picture(path, 8.5, 7.5) as figure:
        axis = figure.subplots()
        axis.imshow(shares, cmap='Blues', vmin=0, vmax=1)
        for i, j in zip(*np.nonzero(shares), strict=True):
            axis.text(
                j,
                i,
                f'{100 * shares[i, j]:.0f}',
                ha='center',
                va='center',
                fontsize=6.5,
                color='white' if shares[i, j] > 0.55 else 'black',
            )
        axis.set_xticks(range(len(columns)), columns, rotation=60, ha='right')
        axis.set_yticks(range(len(rows)), rows)
        axis.grid(visible=False)
        axis.set(
            xlabel='named',
            ylabel='hidden',
            title=f'Per cent of trials, sizes from 0.2 ({len(outcomes)} trials)',
        )


def _draw_p_values(outcomes: Sequence[Outcome], path: Path) -> None:
    with picture(path, 5.5, 4.2) as figure:
        axis = figure.subplots()
        for name in HIDDEN:
            values = np.sort([o.p_values[name] for o in outcomes if name in o.p_values])
            if values.size:
                axis.plot(
                    values,
                    (np.arange(values.size) + 0.5) / values.size,
                    color=OURS,
                    alpha=0.5,
                    linewidth=1,
                )
        axis.plot([0, 1], [0, 1], color=FAINT)
        axis.set(
            xlabel='p-value under the null',
            ylabel='share below',
            aspect='equal',
            title='Screening of clean data, one line an effect',
        )


def _beside_oracle(outcomes: Sequence[Outcome]) -> str:
    named, oracle = hits(outcomes), oracle_hits(outcomes)
    return f'{named.successes} ({oracle.successes}) of {named.trials}' if outcomes else '-'


def _numbers(outcome: Outcome) -> int:
    return int(outcome.scene.rsplit(', ', 1)[-1].split()[0]) if outcome.scene else -1
