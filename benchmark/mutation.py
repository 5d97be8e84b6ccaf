"""Mutation study: how many of a random sample of small faults the tests find.

`python -m benchmark.mutation --sample 300 --workers 2` changes one operator or number at a time in
a copy of the tree, runs the tests of that room, and writes docs/mutation.md: what died, and each
survivor with its change.  Mutants that the compiler cannot tell from the original (annotations,
docstrings) are not drawn.  Interrupted runs go on where they were (--state).
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from itertools import islice
from pathlib import Path
from queue import SimpleQueue
from typing import Any, NamedTuple

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator, operator_names
from rich.progress import track

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = Path('fisheye_svp_ros')
# The tests that speak for a room, the quickest first.
TESTS = {
    'optics': ('optics', 'solve', 'simulate', 'effects'),
    'scene': ('scene', 'io', 'solve', 'simulate', 'diagnosis'),
    'solve': ('solve', 'study', 'commands/test_cli.py'),
    'diagnosis': ('diagnosis', 'commands/test_diagnose_command.py'),
    'io': ('io', 'scene', 'optics/test_lens.py', 'study/test_sweep.py', 'nodes/test_record.py',
           'nodes/test_node_parameters.py', 'commands/test_cli.py'),
    'nodes': ('nodes',),
}
KINDS = {
    'NumberReplacer': 'a number one off',
    'ReplaceComparisonOperator': 'another comparison',
    'ReplaceBinaryOperator': 'another arithmetic operator',
    'ReplaceUnaryOperator': 'a sign or a `not`',
    'AddNot': 'a condition turned round',
    'Replace': 'a constant or keyword replaced',
}


class Mutant(NamedTuple):
    """One fault: its place in a file, cosmic-ray's operator and which of its occurrences."""

    path: str
    line: int
    column: int
    operator: str
    occurrence: int

    @property
    def room(self) -> str:
        """The room of the file."""
        return Path(self.path).parts[1]


def mutants_of(path: Path) -> Iterator[Mutant]:
    """Yield every mutant of a file."""
    nodes = list(ast_nodes(get_ast(path.read_text(encoding='utf-8'))))
    for name in operator_names():
        try:
            operator = get_operator(name)()
        except TypeError:  # operators that want arguments of their own
            continue
        starts = [start for node in nodes for start, _ in operator.mutation_positions(node)]
        for occurrence, (line, column) in enumerate(starts):
            yield Mutant(str(path.relative_to(ROOT)), line, column, name, occurrence)


def changes_meaning(mutant: Mutant) -> bool:
    """Say whether a mutant changes what the file computes."""
    source = (ROOT / mutant.path).read_text(encoding='utf-8')
    try:
        changed = mutate_code(source, get_operator(mutant.operator)(), mutant.occurrence)
    except AttributeError:  # cosmic-ray replaces no exception of a dotted name
        return False
    return _meaning(changed) != _meaning(source)


def _meaning(source: str) -> str:
    """Return the tree of a file without annotations and docstrings."""
    try:
        tree = ast.parse(source)
    except SyntaxError:
        return ''
    for node in ast.walk(tree):
        if isinstance(node, ast.arg):
            node.annotation = None
        elif isinstance(node, ast.FunctionDef):
            node.returns = None
        elif isinstance(node, ast.AnnAssign):
            node.annotation = ast.Constant(None)
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            node.value = ast.Constant(None)
    return ast.dump(tree)


def sample(count: int, seed: int) -> list[Mutant]:
    """Return mutants that change what is computed: random places, at each a random operator."""
    places: dict[tuple[str, int, int], list[Mutant]] = {}
    for room in TESTS:
        for path in sorted((ROOT / PACKAGE / room).rglob('*.py')):
            for mutant in mutants_of(path):
                places.setdefault(mutant[:3], []).append(mutant)
    rng = random.Random(seed)
    drawn = [rng.choice(mutants) for mutants in places.values()]
    rng.shuffle(drawn)
    return list(islice(filter(changes_meaning, drawn), count))


def survives(mutant: Mutant, tree: Path, patience: float) -> bool:
    """Run the tests of the room on a copy of the tree with one fault in it."""
    target = tree / mutant.path
    source = target.read_text(encoding='utf-8')
    operator = get_operator(mutant.operator)()
    target.write_text(mutate_code(source, operator, mutant.occurrence), encoding='utf-8')
    paths = [str(path) for name in TESTS[mutant.room] if (path := tree / 'test' / name).exists()]
    command = [sys.executable, '-m', 'pytest', '-x', '-q', '-p', 'no:cacheprovider', *paths]
    environment = os.environ | {
        'PYTHONPATH': str(tree), 'OMP_NUM_THREADS': '1', 'PYTHONDONTWRITEBYTECODE': '1',
    }
    process = subprocess.Popen(command, cwd=tree, env=environment, stdout=subprocess.DEVNULL,
                               stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        return process.wait(patience) == 0
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)  # a fault that hangs is found, too
        process.wait()
        return False
    finally:
        target.write_text(source, encoding='utf-8')


def run(mutants: list[Mutant], workers: int, patience: float, state: Path) -> dict[str, bool]:
    """Try every mutant that `state` does not know yet; return which ones survived, by key."""
    known: dict[str, bool] = json.loads(state.read_text()) if state.exists() else {}
    open_ones = [mutant for mutant in mutants if _key(mutant) not in known]
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(workers) as pool:
        trees: SimpleQueue[Path] = SimpleQueue()
        for number in range(workers):
            tree = Path(folder, str(number))
            shutil.copytree(ROOT, tree, ignore=shutil.ignore_patterns('.venv*', '.git', 'out'))
            trees.put(tree)

        def attempt(mutant: Mutant) -> tuple[Mutant, bool]:
            tree = trees.get()
            try:
                return mutant, survives(mutant, tree, patience)
            finally:
                trees.put(tree)

        tried = as_completed([pool.submit(attempt, mutant) for mutant in open_ones])
        for future in track(tried, 'mutants', total=len(open_ones)):
            mutant, survived = future.result()
            known[_key(mutant)] = survived
            state.write_text(json.dumps(known, indent=1))
    return known


def _key(mutant: Mutant) -> str:
    return ' '.join(map(str, mutant))


def _kind(operator: str) -> str:
    return next((text for name, text in KINDS.items() if name in operator), 'another fault')


def report(mutants: list[Mutant], survived: dict[str, bool], command: str) -> str:
    """Return the page: a table by room, and the survivors by kind."""
    rooms: dict[str, Counter[bool]] = {room: Counter() for room in TESTS}
    alive: dict[str, list[Mutant]] = {}
    for mutant in mutants:
        lives = survived[_key(mutant)]
        rooms[mutant.room][lives] += 1
        if lives:
            alive.setdefault(_kind(mutant.operator), []).append(mutant)
    total: Any = sum(rooms.values(), Counter())
    lines = [
        '# Which faults the tests find', '',
        f'`{command}` puts one small fault at a time into a copy of the package and runs the '
        'tests of its room.', '',
        '| room | mutants | found | share |', '|---|---|---|---|',
    ]
    for room, count in [*rooms.items(), ('all', total)]:
        tried = count.total()
        if tried:
            lines.append(f'| {room} | {tried} | {count[False]} | {count[False] / tried:.0%} |')
    for kind, ones in sorted(alive.items()):
        lines += ['', f'## Not found: {kind}', '']
        lines += [
            f'- `{m.path}`, line {m.line}: {m.operator.removeprefix("core/")}'
            for m in sorted(ones)
        ]
    return '\n'.join(lines) + '\n'


def main() -> None:
    """Draw, try, report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--sample', type=int, default=300)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--workers', type=int, default=2)
    parser.add_argument('--patience', type=float, default=600.0, help='s a mutant may take')
    parser.add_argument('--state', type=Path, default=Path('out/mutation.json'))
    parser.add_argument('-o', '--output', type=Path, default=ROOT / 'docs/mutation.md')
    args = parser.parse_args()
    mutants = sample(args.sample, args.seed)
    args.state.parent.mkdir(parents=True, exist_ok=True)
    survived = run(mutants, args.workers, args.patience, args.state)
    command = f'python -m benchmark.mutation --sample {args.sample} --seed {args.seed}'
    args.output.write_text(report(mutants, survived, command), encoding='utf-8')


if __name__ == '__main__':
    main()
