"""`make hardening NAME=fuzz`: inputs by the million against every surface, and what came of them.

Each input follows from the name of its surface and its seed; `--only NAME --seed N` repeats one.
"""

from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from random import Random

from benchmark import study
from benchmark.hardening.fuzz.surfaces import Surface
from benchmark.hardening.fuzz.trials import (
    LARGEST,
    SLOWEST,
    WAITING,
    Outcome,
    every,
    prepare,
    run_chunk,
    trial_of,
)

_HUNG = 60.0  # s without an answer, then a worker is ended
_CHUNK = 500  # inputs of a task
Task = tuple[str, int, int]  # surface, first seed, number of seeds


def _chunks(wanted: list[Surface], total: int, first: int) -> Iterator[Task]:
    whole = sum(surface.share for surface in wanted)
    ends = {surface.name: -(-total * surface.share // whole) for surface in wanted}
    for begin in range(0, max(ends.values()), _CHUNK):
        for name, end in ends.items():
            if begin < end:
                yield name, first + begin, min(_CHUNK, end - begin)


def run_all(wanted: list[Surface], total: int, first: int, workers: int) -> dict[str, Outcome]:
    """Try inputs of all surfaces, in processes; one that dies or hangs is a fault, too.

    Ctrl-C ends it early.
    """
    outcomes = {surface.name: Outcome() for surface in wanted}
    pending = list(_chunks(wanted, total, first))[::-1]
    with ThreadPoolExecutor(workers) as threads:
        try:
            for tried in [threads.submit(_try_pending, pending) for _ in range(workers)]:
                for name, outcome in tried.result():
                    outcomes[name].add(outcome)
        except KeyboardInterrupt:
            print('interrupted: what was tried so far', file=sys.stderr)
            pending.clear()
    return outcomes


def _try_pending(pending: list[Task]) -> list[tuple[str, Outcome]]:
    """Try chunks in a process, in another one after each that it dies or hangs of."""
    found, pool = [], None
    while task := _take(pending):
        name, first, count = task
        pool = pool or ProcessPoolExecutor(1, multiprocessing.get_context('spawn'), prepare)
        try:
            outcome = pool.submit(run_chunk, *task).result(_HUNG * max(1, count / 20))
        except (BrokenProcessPool, TimeoutError):
            for process in (pool._processes or {}).values():
                process.kill()
            pool, outcome = None, Outcome()
            if count > 1:  # to find out which input it was
                half = count // 2
                pending += [(name, first + half, count - half), (name, first, half)]
            else:
                outcome.tried = 1
                outcome.fault('hung or died', name, first, 'the process')
        found.append((name, outcome))
    if pool:
        pool.shutdown()
    return found


def _take(pending: list[Task]) -> Task | None:
    """Return the next chunk, None where another thread has taken the last one."""
    if sys.stderr.isatty():
        print(f'\r{len(pending)} chunks to go ', end='', file=sys.stderr)
    try:
        return pending.pop()
    except IndexError:
        return None


def section(outcomes: dict[str, Outcome], command: str) -> str:
    """Return the section of docs/results/reliability.md."""
    whole = Outcome()
    for outcome in outcomes.values():
        whole.add(outcome)
    said = ', '.join(
        f'{kind} {whole.faults[kind]}'
        for kind in ('crashed', 'hung or died', 'wrong', 'slow', 'large')
    )
    rows = [
        [
            name,
            one.tried,
            one.refused,
            *(one.faults[kind] for kind in ('crashed', 'hung or died', 'wrong')),
            f'{one.slowest:.2f}',
            f'{one.largest:.0f}',
        ]
        for name, one in outcomes.items()
    ]
    return '\n'.join(
        [
            f'`{command}`: {whole.tried} inputs, {whole.refused} refused, {said}. Slow is above '
            f'{SLOWEST:g} s of processor time or {WAITING:g} s on the clock, large above '
            f'{LARGEST:g} '
            'MB of memory more than ever before.',
            '',
            *study.table(
                'surface | inputs | refused | crashed | hung or died | wrong | slowest s '
                '| most MB',
                rows,
                numbers=True,
            ),
        ]
    )


def main() -> int:
    """Run, print, write the section; return 1 where anything is at fault."""
    parser = study.parser(
        'fuzz',
        __doc__,
        None,
        room='hardening',
        inputs=(1_000_000, 'of all surfaces'),
        first=(0, 'the first seed of each surface'),
        only=('', 'surfaces whose names contain this'),
        no_docs=(False, 'leave docs/results/reliability.md alone'),
    )
    parser.add_argument('--seed', type=int, help='try this one, here, and show what it raises')
    args = parser.parse_args()
    wanted = [surface for surface in every() if args.only in surface.name]
    if args.seed is not None:
        print(repr(trial_of(wanted[0].name)(Random(f'{wanted[0].name} {args.seed}'))))
        return 0
    outcomes = run_all(wanted, args.inputs, args.first, args.workers)
    text = section(
        outcomes, f'python -m benchmark.hardening.fuzz --inputs {args.inputs} --first {args.first}'
    )
    print(text)
    for outcome in outcomes.values():
        for line in outcome.told[:5]:
            print(line)
    if not args.only and not args.no_docs:
        study.write_section(study.RELIABILITY, 'fuzz', text)
    return int(any(outcome.faults for outcome in outcomes.values()))


if __name__ == '__main__':
    sys.exit(main())
