"""`make fuzz`: inputs by the million against every surface, and what came of them.

Each input follows from the name of its surface and its seed; `--only NAME --seed N` repeats one.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import sys
import time
from collections.abc import Iterator
from random import Random

from benchmark import study
from benchmark.fuzz.surfaces import Surface
from benchmark.fuzz.trials import LARGEST, SLOWEST, WAITING, Outcome, every, trial_of, work

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


class _Worker:
    """A process that tries chunks of seeds, one at a time."""

    def __init__(self) -> None:
        context = multiprocessing.get_context('spawn')
        self._pipe, theirs = context.Pipe()
        # No daemon: the detector's search has a process of its own.
        self._process = context.Process(target=work, args=(theirs,))
        self._process.start()
        theirs.close()
        self.task: Task | None = None
        self._since = 0.0

    def give(self, task: Task) -> None:
        """Begin a chunk."""
        self.task, self._since = task, time.monotonic()
        self._pipe.send(task)

    def outcome(self) -> Outcome | None:
        """Return what has become of the chunk, None while it is under way or lost."""
        if self.task is None or not self._pipe.poll(0.01):
            return None
        with contextlib.suppress(EOFError, OSError):
            found: Outcome = self._pipe.recv()
            self.task = None
            return found
        return None

    def lost(self) -> str:
        """Say whether the process has died with its chunk, or takes too long for it."""
        if self.task is None:
            return ''
        if not self._process.is_alive():
            return 'crashed'
        long = time.monotonic() - self._since > _HUNG * max(1, self.task[2] / 20)
        return 'hung' if long else ''

    def end(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.join()


def run_all(wanted: list[Surface], total: int, first: int, workers: int) -> dict[str, Outcome]:
    """Try inputs of all surfaces, in processes; one that dies or hangs is a fault, too.

    Ctrl-C ends it early.
    """
    outcomes = {surface.name: Outcome() for surface in wanted}
    pending = list(_chunks(wanted, total, first))[::-1]
    running = [_Worker() for _ in range(workers)]
    chunks = len(pending)
    try:
        while pending or any(worker.task for worker in running):
            if sys.stderr.isatty():
                print(f'\r{chunks - len(pending)} of {chunks} chunks', end='', file=sys.stderr)
            for number, worker in enumerate(running):
                _look_after(worker, pending, outcomes)
                if worker.lost():
                    worker.end()
                    running[number] = _Worker()
                    pending += _halves(worker, outcomes)
    except KeyboardInterrupt:
        print('interrupted: what was tried so far', file=sys.stderr)
    finally:
        for worker in running:
            worker.end()
    return outcomes


def _look_after(worker: _Worker, pending: list[Task], outcomes: dict[str, Outcome]) -> None:
    """Take the outcome of a chunk, give the next."""
    task = worker.task
    found = worker.outcome()
    if task and found:
        outcomes[task[0]].add(found)
    if worker.task is None and pending:
        worker.give(pending.pop())


def _halves(worker: _Worker, outcomes: dict[str, Outcome]) -> list[Task]:
    """Return the halves of a lost chunk, to find out which input it was, or count the fault."""
    assert worker.task
    name, first, count = worker.task
    if count == 1:
        outcomes[name].tried += 1
        outcomes[name].fault('hung or died', name, first, 'the process')
        return []
    return [(name, first + count // 2, count - count // 2), (name, first, count // 2)]


def section(outcomes: dict[str, Outcome], command: str) -> str:
    """Return the section of docs/results/reliability.md."""
    whole = Outcome()
    for outcome in outcomes.values():
        whole.add(outcome)
    said = ', '.join(f'{kind} {whole.faults[kind]}' for kind in (
        'crashed', 'hung or died', 'wrong', 'slow', 'large'))
    rows = [[name, one.tried, one.refused, *(one.faults[kind] for kind in (
        'crashed', 'hung or died', 'wrong')), f'{one.slowest:.2f}', f'{one.largest:.0f}']
            for name, one in outcomes.items()]
    return '\n'.join([
        f'`{command}`: {whole.tried} inputs, {whole.refused} refused, {said}. Slow is above '
        f'{SLOWEST:g} s of processor time or {WAITING:g} s on the clock, large above {LARGEST:g} '
        'MB of memory more than ever before.', '', *study.table(
            'surface | inputs | refused | crashed | hung or died | wrong | slowest s | most MB',
            rows, numbers=True)])


def main() -> int:
    """Run, print, write the section; return 1 where anything is at fault."""
    parser = study.parser(
        'fuzz', __doc__, None, inputs=(1_000_000, 'of all surfaces'),
        first=(0, 'the first seed of each surface'),
        only=('', 'surfaces whose names contain this'),
        no_docs=(False, 'leave docs/results/reliability.md alone'))
    parser.add_argument('--seed', type=int, help='try this one, here, and show what it raises')
    args = parser.parse_args()
    wanted = [surface for surface in every() if args.only in surface.name]
    if args.seed is not None:
        print(repr(trial_of(wanted[0].name)(Random(f'{wanted[0].name} {args.seed}'))))
        return 0
    outcomes = run_all(wanted, args.inputs, args.first, args.workers)
    text = section(outcomes, f'python -m benchmark.fuzz --inputs {args.inputs} '
                   f'--first {args.first}')
    print(text)
    for outcome in outcomes.values():
        for line in outcome.told[:5]:
            print(line)
    if not args.only and not args.no_docs:
        study.write_section(study.RELIABILITY, 'fuzz', text)
    return int(any(outcome.faults for outcome in outcomes.values()))


if __name__ == '__main__':
    sys.exit(main())
