"""Whether nodes live, count and answer after a million hostile messages over DDS.

Two rounds.  In the first, readers keep everything and the sender waits for the nodes' own counts,
so that every message is accounted for; in the second, nodes are as by default and are flooded.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault('ROS_DOMAIN_ID', '77')

from benchmark import study
from benchmark.hardening.soak import answers
from benchmark.hardening.soak.victims import KINDS, Victim, Watch, Wire
from fisheye_svp_ros.reporting.terminal import progress

_AHEAD = 1000  # messages that a node has not counted, and sets that wait, in the first round
_CHUNK = 100
_LONG = 600.0  # s for all nodes to come up, on a machine that may be busy
_STEADY = 0.2  # of a round, after which memory is compared


def round_of(
    names: list[str], total: int, exactly: bool, folder: Path, wire: Wire
) -> tuple[list[list[object]], list[str], int]:
    """Attack nodes with `total` messages; return rows, faults, the number of messages sent."""
    watch = Watch(wire)
    victims = {name: Victim(name, wire, folder, exactly) for name in names}
    try:
        return _attacked(victims, watch, total, exactly)
    finally:
        for victim in victims.values():
            victim.end()


def _attacked(
    victims: dict[str, Victim], watch: Watch, total: int, exactly: bool
) -> tuple[list[list[object]], list[str], int]:
    everybody = victims.values()
    if not watch.until(victims, lambda: all(v.connected() and v.counts for v in everybody), _LONG):
        raise SystemExit(f'not all nodes have come up: {[v.trouble() for v in everybody]}')
    each = -(-total // len(victims))
    measured = time.monotonic()
    with progress('counted' if exactly else 'flooded', total) as advance:
        while pending := [v for v in everybody if v.alive() and v.hostile.total() < each]:
            watch.look(victims)
            ready = [v for v in pending if not exactly or v.behind() + v.waiting() < _AHEAD]
            for victim in ready:
                victim.attack(_CHUNK)
                advance(_CHUNK)
            if not ready:
                time.sleep(0.02)
            if time.monotonic() > measured + 1:
                measured = time.monotonic()
                for victim in everybody:
                    victim.measure()
    watch.until(victims, lambda: all(v.behind() <= 0 for v in everybody), 60 if exactly else 5)
    _settle(watch, victims)
    rows, faults = [], []
    for victim in everybody:
        answer = answers.wrong(victim, watch, victims) if victim.alive() else 'is dead'
        watch.until(victims, lambda victim=victim: victim.behind() <= 0, 10 if exactly else 3)
        faults += [f'{victim.name}: {text}' for text in (answer, *judged(victim, exactly)) if text]
        rows.append(row(victim, 'yes' if not answer else 'no'))
        trace = victim.end()
        if trace:
            faults.append(f'{victim.name}: {trace}')
    return rows, faults, sum(v.hostile.total() for v in everybody)


def _settle(watch: Watch, victims: dict[str, Victim]) -> None:
    """Wait until no node has anything left to look at."""
    before: list[dict[str, int]] = []
    for _ in range(60):
        watch.until(victims, lambda: False, 2.5)
        now = [
            {k: n for k, n in v.counts.items() if ': read' in k or 'sets: w' in k}
            for v in victims.values()
        ]
        if now == before:
            return
        before = now


def judged(victim: Victim, exactly: bool) -> list[str]:
    """Return what is wrong with a node's account of what was sent to it."""
    faults, counts = [], victim.counts
    if counts.get('internal errors'):
        faults.append(f'{counts["internal errors"]} internal errors')
    for topic in victim.topics:
        got, read, bad = (
            counts.get(f'{topic}: {what}', 0) for what in ('received', 'read', 'dropped')
        )
        came = victim.sent[topic] - victim.lost[topic]
        if got > came or (exactly and got != came):
            faults.append(f'{topic}: {came} sent, {got} received')
        if exactly and got == read and bad < victim.unusable[topic]:
            faults.append(f'{topic}: {victim.unusable[topic]} unusable, {bad} counted')
    if exactly and victim.name == 'detector':
        overtaken = victim.received() - victim.received('read') - counts['images overtaken']
        if not 0 <= overtaken <= 1:  # one may wait
            faults.append(f'{overtaken} images neither read nor overtaken')
    if 'sets: taken' in counts:
        ends = ('solved', 'not solved', 'dropped', 'incomplete', 'waiting')
        if counts['sets: taken'] != sum(counts[f'sets: {end}'] for end in ends):
            faults.append(f'sets do not add up: {counts}')
    if grown(victim) > 50:
        faults.append(f'memory grew by {grown(victim):.0f} MB')
    return faults


def grown(victim: Victim) -> float:
    """Return by how much memory grew after the beginning of a round, MB."""
    early = victim.memory[: max(1, round(_STEADY * len(victim.memory)))]
    return max(victim.memory) - max(early) if early else 0.0


def row(victim: Victim, answers_well: str) -> list[object]:
    """Return a row of the table."""
    counts = victim.counts
    unusable = '' if victim.name == 'detector' else victim.unusable.total()
    dropped = victim.received('dropped')
    sets = [
        counts.get(f'sets: {end}', '')
        for end in ('taken', 'solved', 'not solved', 'dropped', 'incomplete')
    ]
    return [
        victim.name,
        victim.hostile.total(),
        victim.sent.total(),
        victim.lost.total(),
        victim.received(),
        victim.received('read'),
        unusable,
        dropped,
        *sets,
        counts.get('internal errors', ''),
        f'{grown(victim):.0f}',
        answers_well,
    ]


def section(rounds: list[list[list[object]]], total: int, how: str) -> str:
    """Return the section of docs/results/reliability.md."""
    counted, flooded = (
        study.table(
            'node | hostile | sent | lost by the sender | received | read | unusable | dropped '
            '| sets taken | solved | not solved | sets dropped | incomplete | internal errors '
            '| memory grown MB | answers',
            rows,
            numbers=True,
        )
        for rows in rounds
    )
    return '\n'.join(
        [
            f'`{how}`: {total} hostile messages.',
            '',
            'All counted:',
            '',
            *counted,
            '',
            'Flooded, as nodes are by default:',
            '',
            *flooded,
        ]
    )


def main() -> int:
    """Attack, write the section; return 1 where anything is at fault."""
    parser = study.parser(
        'soak',
        __doc__,
        None,
        room='hardening',
        workers=False,
        messages=(1_000_000, 'hostile ones'),
        flood=(0.2, 'share of the second round'),
        no_docs=(False, 'leave docs/results/reliability.md alone'),
    )
    parser.add_argument('--nodes', nargs='*', choices=KINDS, default=[*KINDS])
    asked = parser.parse_args()
    flood = round(asked.flood * asked.messages)
    wire = Wire()
    with tempfile.TemporaryDirectory() as place:
        first = round_of(asked.nodes, asked.messages - flood, True, Path(place), wire)
        second = round_of(asked.nodes, flood, False, Path(place), wire)
    how = ' '.join(['python -m benchmark.hardening.soak', *sys.argv[1:]])
    text = section([first[0], second[0]], first[2] + second[2], how)
    print(text)
    faults = [*first[1], *second[1]]
    print(*faults, sep='\n')
    if not asked.no_docs:
        study.write_section(study.RELIABILITY, 'soak', text)
    return int(bool(faults))


if __name__ == '__main__':
    sys.exit(main())
