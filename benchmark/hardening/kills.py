"""What is left when a command is killed, or may not write: `python -m benchmark.hardening.kills`.

Every command that writes, and nodes, get SIGTERM or SIGKILL at random moments of their run, half
of them while they write.  Then: are the files of the set all there, as a whole run writes them, or
none, or all but the pictures, which come last?  Is a temporary file left, a process?  Does the
same command go through afterwards, with the same tables to the last byte?  Disks that are full at
some point of a run, folders that are read-only or another user's, need root.  Ctrl-C ends it early
and reports what was tried.  Writes docs/results/reliability.md.
"""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import psutil

from benchmark import study
from fisheye_svp_ros.nodes import NODES as NODE_NAMES
from fisheye_svp_ros.reporting.terminal import progress

_WRITING = 0.15  # of a run: the end, where most is written
_PATIENCE = 20.0  # s to end after SIGTERM, and for children to go with their parent
_LONGEST = 240.0  # s for the kills of one command
_NOBODY = 65534
_PAGE = 4096  # bytes
_PICTURES = ('.png', '.pdf', '.html', '.md')  # written last, apart from the numbers
COMMANDS = {
    line.split()[0]: tuple(line.split())
    for line in """\
budget --lens fish180 -o {out}
calibrate {obs} --model kannala_brandt -o {out}/lens.yaml
demo --lenses fish180 --radii 0.2 -o {out}
detect {photographs} --board chessboard:6x5:25mm -o {out}/seen.csv --overlays {out}/overlays
diagnose {obs} --lens {lens} --quick -o {out}
example -o {out}
lens {lens} --format opencv -o {out}/opencv.yaml
localize {obs} --lens {lens} -o {out}
map {room}/walk --board tags:36h11:300mm --lens {room}/lens.yaml -o {out}/tags.yaml
paper -o {out}
plan --lens fish180 --board chessboard:6x5:25mm --room 0.1 0.5 --count 4 -o {out}
plot {swept} -o {out}
render --lens fish180 --board chessboard:6x5:25mm --count 6 -o {out}
sweep {sweep} -o {out} --workers 2 --resume
table {recording} -o {out}
undistort {lens} {photographs} -o {out}
""".splitlines()
}
NODES = {
    'record': ('record', '-o', '{out}/recording'),
    'watch': ('watch',),
    **{f'run {node}': ('run', node) for node in NODE_NAMES},
    'run measured_camera': ('run', 'measured_camera', '--ros-args', '-p', 'observations:={obs}'),
}
_MEASURED = {'demo'}  # their tables hold times
# What is made on the way, and is there whether or not the run came to its end.
_WORK = {'parts', 'recording', 'logs', '.demo'}
_SWEEP = """synthetic_camera: {ros__parameters: {sweep.seed: [1, 2, 3, 4, 5, 6, 7, 8, 9],
  sweep.radius: [0.2, 0.5, 2.0], sweep.noise_px: [0.1, 0.2, 0.3, 0.5],
  trajectory_steps: 40, poses: [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0,
                                0.05, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]}}
"""


@dataclass
class Outcome:
    """How often what was found; told: the first few faults, in words."""

    kills: Counter[str] = field(default_factory=Counter)
    whole: int = 0
    nothing: int = 0
    faults: Counter[str] = field(default_factory=Counter)
    told: list[str] = field(default_factory=list)

    def fault(self, kind: str, text: str) -> None:
        """Count a fault."""
        self.faults[kind] += 1
        self.told.append(f'{kind}: {text}')


def call(words: Sequence[str], before: Sequence[str] = ()) -> subprocess.Popen[str]:
    """Start `fisheye-svp WORDS` in a session of its own; before: what is to start it."""
    # One engine: another one, once it is compiled, gives other last digits.
    environment = {
        **os.environ,
        'OMP_NUM_THREADS': '1',
        'ROS_DOMAIN_ID': '97',
        'FISHEYE_SVP_ENGINE': 'numpy',
    }
    return subprocess.Popen(
        [*before, sys.executable, '-m', 'fisheye_svp_ros.cli', *words],
        env=environment,
        start_new_session=True,
        text=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )


def done(words: Sequence[str], before: Sequence[str] = ()) -> tuple[int, str]:
    """Run a command to its end; return its status and what it said on stderr."""
    process = call(words, before)
    _, said = process.communicate()
    return process.returncode, said


def files(folder: Path) -> tuple[dict[str, int], list[str]]:
    """Return the sizes of a command's files by name, and the names of temporary ones."""
    found, rest = {}, []
    for path in sorted(folder.rglob('*')):
        name = path.relative_to(folder)
        if path.is_file() and not _WORK & set(name.parts):
            if name.name.startswith('.'):
                rest.append(str(name))
            else:
                found[str(name)] = path.stat().st_size
    return found, rest


def left_running(session: int) -> list[int]:
    """Return the processes of a session that live on."""
    found = []
    for entry in psutil.process_iter():
        with suppress(OSError, psutil.Error):
            if os.getsid(entry.pid) == session and entry.status() != psutil.STATUS_ZOMBIE:
                found.append(entry.pid)
    return found


def prepare(folder: Path) -> dict[str, Path]:
    """Make the inputs of the commands."""
    given = {name: folder / name for name in ('photographs', 'swept', 'recording', 'room')}
    walk = Path(__file__).parents[2] / 'examples' / 'where_is_my_robot.py'
    subprocess.run([sys.executable, walk, given['room']], check=True, stdout=subprocess.DEVNULL)
    given |= {
        'obs': folder / 'obs.csv',
        'lens': folder / 'lens.yaml',
        'sweep': folder / 'sweep.yaml',
    }
    given['sweep'].write_text(_SWEEP)
    demonstration = folder / 'demonstration'
    for line in """\
render --lens fish180 --board chessboard:6x5:25mm --count 12 -o {photographs}
detect {photographs} --board chessboard:6x5:25mm -o {obs}
calibrate {obs} --model kannala_brandt -o {lens}
sweep {sweep} -o {swept}
demo --lenses fish180 --radii 0.2 -o {demonstration}
""".splitlines():
        words = [word.format(demonstration=demonstration, **given) for word in line.split()]
        status, said = done(words)
        if status:
            raise SystemExit(f'{" ".join(words)}: {said}')
    (demonstration / 'recording').rename(given['recording'])
    return given


def moments(count: int, rng: random.Random) -> Iterator[float]:
    """Yield moments of a run, 0 to 1: half of them anywhere, half at its end."""
    for number in range(count):
        yield rng.uniform(0.0, 1.0) if number % 2 else rng.uniform(1 - _WRITING, 1.02)


def tables(folder: Path) -> dict[str, bytes]:
    """Return the tables of a command's folder by name, as they are."""
    return {
        name: (folder / name).read_bytes() for name in files(folder)[0] if name.endswith('.csv')
    }


def killed(words: Sequence[str], folder: Path, count: int, rng: random.Random) -> Outcome:
    """Kill a command by each signal; words: with {out} for its folder.

    count: how often, one that takes long less often.
    """
    outcome = Outcome()
    out = folder / 'whole'
    begun = time.monotonic()
    status, said = done([word.format(out=out) for word in words])
    length = time.monotonic() - begun
    whole, rest = files(out)
    if status or rest:
        outcome.fault('whole run', f'status {status}, {[*whole, *rest]}, {said}')
        return outcome
    count = max(2, min(count, round(_LONGEST / (4 * length))))
    for number, moment in enumerate(moments(2 * count, rng)):
        how = signal.SIGTERM if number // 2 % 2 else signal.SIGKILL
        out = folder / str(number)
        kill(words, out, how, moment * length, whole, outcome)
        # The next one goes through where this one was killed.
        status, said = done([word.format(out=out) for word in words])
        other = words[0] not in _MEASURED and tables(out) != tables(folder / 'whole')
        if status or other or not _same(files(out)[0], whole):
            outcome.fault('rerun', f'status {status}, other tables {other}, {said[-300:]}')
        shutil.rmtree(out, ignore_errors=True)
    return outcome


def kill(
    words: Sequence[str],
    out: Path,
    how: signal.Signals,
    after: float,
    whole: dict[str, int],
    outcome: Outcome,
) -> None:
    """Kill a command after some seconds; whole: the sizes of its files in `out`, if it ends."""
    process = call([word.format(out=out) for word in words])
    with process:
        try:
            process.wait(after)
        except subprocess.TimeoutExpired:
            outcome.kills[how.name] += 1
            process.send_signal(how)
        try:
            process.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            outcome.fault('no end', f'{how.name} after {after:.2f} s')
            process.kill()
    end = time.monotonic() + _PATIENCE
    while (alive := left_running(process.pid)) and time.monotonic() < end:
        time.sleep(0.05)
    for number in alive:
        outcome.fault('orphan', f'{how.name} after {after:.2f} s')
        os.kill(number, signal.SIGKILL)
    found, rest = files(out)
    if rest and how == signal.SIGTERM:
        outcome.fault('temporary file', f'{how.name} after {after:.2f} s: {rest}')
    # SIGKILL may come between two renames, which nothing makes one: each file is whole then.
    wanted = {
        name: size
        for name, size in whole.items()
        if name in found or (how == signal.SIGTERM and not name.endswith(_PICTURES))
    }
    if not found:
        outcome.nothing += 1
    elif _same(found, wanted):
        outcome.whole += 1
    else:
        outcome.fault('part', f'{how.name} after {after:.2f} s: {[*found]}')


def _same(found: dict[str, int], whole: dict[str, int]) -> bool:
    """Whether the files of a set are all there, and about as long as they ought to be."""
    return found.keys() == whole.keys() and all(
        0.8 * whole[name] <= size <= 1.25 * whole[name] for name, size in found.items()
    )


def killed_node(words: Sequence[str], folder: Path, count: int, rng: random.Random) -> Outcome:
    """Kill a node `count` times by each signal while it starts or runs."""
    outcome = Outcome()
    for number in range(2 * count):
        how = signal.SIGTERM if number % 2 else signal.SIGKILL
        out = folder / str(number)
        out.mkdir()
        kill(
            [word.format(out=out) for word in words], out, how, rng.uniform(0.1, 6.0), {}, outcome
        )
        shutil.rmtree(out)
    return outcome


@contextmanager
def disk(folder: Path, kilobytes: int) -> Iterator[Path]:
    """Mount a small disk."""
    folder.mkdir(exist_ok=True)
    subprocess.run(
        ['mount', '-t', 'tmpfs', '-o', f'size={kilobytes}k', 'tmpfs', folder], check=True
    )
    try:
        yield folder
    finally:
        subprocess.run(['umount', '-l', folder], check=True)


def refused(words: Sequence[str], folder: Path, whole: dict[str, int]) -> Outcome:
    """Run a command on disks that are too small for its files, and where it may not write.

    Anything but one line, status 2 and no file, or all but the pictures, is a fault.
    whole: sizes of its files by name.
    """
    outcome, size = Outcome(), sum(whole.values())
    numbers = [name for name in whole if not name.endswith(_PICTURES)]
    for part in (0.0, 0.3, 0.9):
        # A disk has room for whole pages, and one of none is a disk without bounds.
        pages = int(part * size / _PAGE)
        with disk(folder / 'disk', (pages + 1) * _PAGE // 1024) as mounted:
            (mounted / 'full').write_bytes(bytes(_PAGE))
            _judge(outcome, f'disk of {part:.1f} of it', mounted / 'out', words, numbers)
    with disk(folder / 'disk', 64) as mounted:
        subprocess.run(['mount', '-o', 'remount,ro', mounted], check=True)
        _judge(outcome, 'read-only', mounted / 'out', words, [])
    owned = folder / 'owned'
    owned.mkdir()
    os.chown(owned, _NOBODY, _NOBODY)
    # Without its capabilities root is as anybody else.
    _judge(outcome, 'not allowed', owned / 'out', words, [], ['setpriv', '--bounding-set=-all'])
    owned.rmdir()
    return outcome


def _judge(
    outcome: Outcome,
    what: str,
    out: Path,
    words: Sequence[str],
    numbers: Sequence[str],
    before: Sequence[str] = (),
) -> None:
    status, said = done([word.format(out=out) for word in words], before)
    outcome.kills[what] += 1
    lines = [line for line in said.splitlines() if ': note: ' not in line]
    if status != 2 or len(lines) != 1:
        outcome.fault('line', f'{what}: status {status}, {lines[-3:]}')
    found, rest = files(out)
    if rest or (found and [*found] != numbers):
        outcome.fault('part', f'{what}: {[*found, *rest]}')
    else:
        outcome.nothing += 1


def section(
    commands: dict[str, Outcome], nodes: dict[str, Outcome], disks: dict[str, Outcome], how: str
) -> str:
    """Return the section of docs/results/reliability.md."""
    kinds = ('part', 'temporary file', 'orphan', 'no end', 'rerun')
    tried = sum(sum(one.kills.values()) for one in disks.values())
    faults = sum((one.faults for one in disks.values()), Counter[str]())
    return '\n'.join(
        [
            f'`{how}`:',
            '',
            *study.table(
                'killed | SIGTERM | SIGKILL | all files | none | some | temporary files '
                '(SIGTERM) | '
                'processes left | no end | rerun fails',
                [
                    [
                        name,
                        one.kills['SIGTERM'],
                        one.kills['SIGKILL'],
                        one.whole,
                        one.nothing,
                        *(one.faults[kind] for kind in kinds),
                    ]
                    for name, one in {**commands, **nodes}.items()
                ],
                numbers=True,
            ),
            '',
            'Disks that are full before, after 30 % or after 90 % of what the command writes, '
            f'a read-only file system, and a folder of another user: {tried} runs of {len(disks)} '
            f'commands; not one line and status 2: {faults["line"]}, files left: '
            f'{faults["part"]}.',
        ]
    )


def main() -> int:
    """Kill everything, write the section; return 1 where anything is at fault."""
    parser = study.parser(
        'kills',
        __doc__,
        None,
        room='hardening',
        workers=False,
        kills=(20, 'of each command by each signal'),
        seed=(0, 'of the moments'),
    )
    parser.add_argument('--without', nargs='*', default=[], choices=[*COMMANDS, *NODES])
    asked = parser.parse_args()
    ended: dict[str, Outcome] = {}
    stopped: dict[str, Outcome] = {}
    kept_out: dict[str, Outcome] = {}
    names = [name for name in (*NODES, *COMMANDS) if name not in asked.without]
    with tempfile.TemporaryDirectory() as place:
        Path(place).chmod(0o755)
        given = prepare(Path(place))
        with suppress(KeyboardInterrupt), progress('killing', len(names)) as advance:
            for name in names:
                template = NODES.get(name) or COMMANDS[name]
                words = [word.format(out='{out}', **given) for word in template]
                folder, rng = Path(place, name), random.Random(f'{asked.seed} {name}')
                folder.mkdir()
                if name in NODES:
                    stopped[name] = killed_node(words, folder, asked.kills, rng)
                else:
                    ended[name] = killed(words, folder, asked.kills, rng)
                    if os.geteuid() == 0:
                        kept_out[name] = refused(words, folder, files(folder / 'whole')[0])
                advance()
    said = ' '.join(['python -m benchmark.hardening.kills', *sys.argv[1:]])
    text = section(ended, stopped, kept_out, said)
    print(text)
    told = [
        f'{name}: {line}'
        for group in (ended, stopped, kept_out)
        for name, one in group.items()
        for line in one.told[:5]
    ]
    print(*told, sep='\n')
    study.write_section(study.RELIABILITY, 'kills', text)
    return int(bool(told))


if __name__ == '__main__':
    sys.exit(main())
