"""What many blind trials say together: rates, intervals, matrices."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from benchmark.blind_effects import HIDDEN
from benchmark.blind_outside import OUTSIDE
from benchmark.blind_trial import Outcome
from fisheye_svp_ros.arrays import Array

OPEN = ('unexplained', 'partly_explained')


class Rate(NamedTuple):
    """A number of successes among trials, with its 95 % interval (Clopper and Pearson, 1934)."""

    successes: int
    trials: int

    @property
    def value(self) -> float:
        return self.successes / self.trials if self.trials else float('nan')

    @property
    def interval(self) -> tuple[float, float]:
        k, n = self.successes, self.trials
        low = stats.beta.ppf(0.025, k, n - k + 1) if k else 0.0
        high = stats.beta.ppf(0.975, k + 1, n - k) if k < n else 1.0
        return float(low), float(high)

    def __str__(self) -> str:
        return f'{100 * self.value:.1f} % ({self.successes}/{self.trials})' if self.trials else '-'


def rate(outcomes: Iterable[Outcome], success: Callable[[Outcome], bool]) -> Rate:
    """Count successes."""
    results = [success(outcome) for outcome in outcomes]
    return Rate(sum(results), len(results))


def of(
    outcomes: Iterable[Outcome], mode: str, size: float | None = None, name: str | None = None
) -> list[Outcome]:
    """Return the outcomes of a mode, a size, a hidden effect."""
    return [
        o for o in outcomes
        if o.task.mode == mode and size in (None, o.task.size)
        and (name is None or name in o.task.names)
    ]


def sizes(outcomes: Iterable[Outcome], mode: str) -> list[float]:
    """Return the sizes of a mode, largest first."""
    return sorted({o.task.size for o in of(outcomes, mode)}, reverse=True)


def is_hit(outcome: Outcome) -> bool:
    """Whether the named classes hold all that was hidden."""
    return outcome.hit


def is_clean(outcome: Outcome) -> bool:
    """Whether nothing was found."""
    return outcome.verdict == 'adequate'


def is_open(outcome: Outcome) -> bool:
    """Whether the verdict says that something is left."""
    return outcome.verdict in OPEN


def is_right_variable(outcome: Outcome) -> bool:
    """Whether the report names a variable on which an effect outside the catalogue depends."""
    return bool(OUTSIDE[outcome.task.names[0]][1] & set(outcome.remaining))


def oracle_finds_all(outcome: Outcome) -> bool:
    """Whether the oracle finds all that was hidden."""
    return all(outcome.oracle)


def confusion(outcomes: Sequence[Outcome]) -> tuple[list[str], list[str], Array]:
    """Return hidden effects, named effects and the share (hidden, named) of trials; last: none.

    A trial with several names counts for each.
    """
    rows, columns = list(HIDDEN), [*HIDDEN, 'no name']
    shares = np.zeros((len(rows), len(columns)))
    for i, name in enumerate(rows):
        mine = [o for o in outcomes if o.task.names == (name,)]
        for outcome in mine:
            for named in outcome.causes or ['no name']:
                shares[i, columns.index(named)] += 1 / len(mine)
    return rows, columns, shares


def uniformity(outcomes: Iterable[Outcome]) -> dict[str, tuple[int, float]]:
    """Return by effect the number of p-values under the null and their Kolmogorov-Smirnov p."""
    values: dict[str, list[float]] = {}
    for outcome in outcomes:
        for name, p in outcome.p_values.items():
            values.setdefault(name, []).append(p)
    return {
        name: (len(values[name]), float(stats.kstest(values[name], 'uniform').pvalue))
        for name in HIDDEN if len(values.get(name, ())) >= 5
    }


def coverage(outcomes: Iterable[Outcome], limit: float) -> Rate:
    """Count parameters whose error is within a multiple of its standard error."""
    errors = [error for outcome in outcomes for error in outcome.errors.values()]
    return Rate(sum(abs(error) < limit for error in errors), len(errors))
