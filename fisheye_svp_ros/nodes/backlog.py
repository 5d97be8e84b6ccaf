"""What became of the sets of a solver, and whether it keeps up with them."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace


@dataclass
class Counts:
    """What became of the sets so far."""

    taken: int = 0
    solved: int = 0
    unsolved: int = 0
    dropped: int = 0
    incomplete: int = 0


class Pace:
    """How late the sets are, and what became of them since the last report."""

    def __init__(self) -> None:
        self.latency = 0.0  # s, of the latest set
        self._restarted = time.monotonic()
        self._reported = Counts()

    def restart(self, counts: Counts) -> tuple[Counts, float]:
        """Return the counts at the last call, and the seconds since; remember those of now."""
        counted, self._reported = self._reported, replace(counts)
        before, self._restarted = self._restarted, time.monotonic()
        return counted, max(self._restarted - before, 1e-3)


def report(
    counts: Counts, pace: Pace, waiting: int
) -> tuple[dict[str, object], str]:
    """Return the counts since the start, and what is wrong since the last report.

    taken = solved + not solved + dropped + incomplete + waiting, at any time.
    """
    before, seconds = pace.restart(counts)
    came = (counts.taken - before.taken) / seconds
    done = (counts.solved + counts.unsolved - before.solved - before.unsolved) / seconds
    latency = pace.latency
    told: dict[str, object] = {
        'sets: taken': counts.taken, 'sets: solved': counts.solved,
        'sets: not solved': counts.unsolved, 'sets: dropped': counts.dropped,
        'sets: incomplete': counts.incomplete, 'sets: waiting': waiting,
        'sets: received per second': round(came, 1), 'sets: solved per second': round(done, 1),
        'sets: latency_s': round(latency, 4),
    }
    if counts.dropped == before.dropped:
        return told, ''
    return told, (f'too slow: {came:.0f} sets per second are received and {done:.0f} are solved, '
                  f'{latency:.2f} s late; {waiting} wait, {counts.dropped} are dropped')
