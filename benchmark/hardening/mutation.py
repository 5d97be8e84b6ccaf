"""Mutation study: how many of a random sample of small faults the tests find.

`make hardening NAME=mutation` changes one operator or number at a time in a copy of the tree,
runs the tests that reach it (`mutation_reach`), the quickest first and up to the first that
fails, and writes docs/results/mutation.md: what died, and each survivor with its change. Mutants
that the compiler cannot tell from the original (annotations, docstrings) are not drawn.
Interrupted runs go on where they were (--folder).
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator
from itertools import accumulate, islice
from pathlib import Path
from typing import Any, NamedTuple

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator, operator_names
from rich.progress import track

from benchmark.hardening.mutation_reach import Reach, load, trace
from benchmark.hardening.trial import failing_test, preload

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = Path('fisheye_svp_ros')
ROOMS = (
    'optics',
    'scene',
    'effects',
    'mixed_model',
    'solve',
    'rectify',
    'diagnosis',
    'planning',
    'io',
    'nodes',
)
# Compiled, or part of what is: tried uncompiled first, which spares a minute where that fails.
COMPILED = {
    'optics/formulas.py',
    'optics/rays.py',
    *(f'optics/engines/{name}.py' for name in ('kernels', 'adjustment', 'entries', 'marquardt')),
}
BY_HAND = '\n<!-- what the survivors are: by hand -->\n'  # kept from here on
KINDS = {
    'NumberReplacer': 'a number one off',
    'ReplaceComparisonOperator': 'another comparison',
    'ReplaceBinaryOperator': 'another arithmetic operator',
    'ReplaceUnaryOperator': 'a sign or a `not`',
    'AddNot': 'an inverted condition',
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


def mutants_of(tree: Path, path: Path) -> Iterator[Mutant]:
    """Yield every mutant of a file."""
    nodes = list(ast_nodes(get_ast(path.read_text(encoding='utf-8'))))
    for name in operator_names():
        try:
            operator = get_operator(name)()
        except TypeError:  # operators that want arguments of their own
            continue
        starts = [start for node in nodes for start, _ in operator.mutation_positions(node)]
        for occurrence, (line, column) in enumerate(starts):
            yield Mutant(str(path.relative_to(tree)), line, column, name, occurrence)


def changes_meaning(mutant: Mutant, tree: Path) -> bool:
    """Say whether a mutant changes what the file computes."""
    source = (tree / mutant.path).read_text(encoding='utf-8')
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


def sample(count: int, seed: int, tree: Path) -> list[Mutant]:
    """Return mutants that change what is computed: random places, at each a random operator."""
    places: dict[tuple[str, int, int], list[Mutant]] = {}
    for room in ROOMS:
        for path in sorted((tree / PACKAGE / room).rglob('*.py')):
            for mutant in mutants_of(tree, path):
                places.setdefault(mutant[:3], []).append(mutant)
    rng = random.Random(seed)
    drawn = [rng.choice(mutants) for mutants in places.values()]
    rng.shuffle(drawn)
    return list(islice((one for one in drawn if changes_meaning(one, tree)), count))


def verdict(
    tests: list[str], compiled: bool, tree: Path, budget: float, seconds: list[float], log: Path
) -> str:
    """Say what the tests, the quickest first, make of the fault in a copy of the tree.

    'survived', 'survived N s of tests' where that is not all that reach it, 'nothing reaches it',
    'hung' where tests take several times as long as before, or the test that found it.
    """
    if not tests:
        return 'nothing reaches it'
    within = max(1, sum(total <= budget for total in accumulate(seconds)))
    chosen, patience = tests[:within], 120.0 + 4.0 * sum(seconds[:within])
    kinds = [{'NUMBA_DISABLE_JIT': '1'}] if compiled else []
    for environment in [*kinds, {'NUMBA_DISABLE_JIT': '0'}]:
        found = failing_test(chosen, tree, environment, patience, log)
        if found and (found != 'hung' or environment['NUMBA_DISABLE_JIT'] == '0'):
            return found
    return (
        'survived'
        if within == len(tests)
        else (f'survived {budget:g} s of {sum(seconds):.0f} s of tests')
    )


def attempt(mutant: Mutant, tree: Path, reach: Reach, budget: float) -> str:
    """Put one fault into the tree, run the tests that reach it, and take it out again."""
    target = tree / mutant.path
    source, times = target.read_text(encoding='utf-8'), target.stat()
    tests = reach.of(tree, mutant.path, mutant.line)
    operator = get_operator(mutant.operator)()
    target.write_text(mutate_code(source, operator, mutant.occurrence), encoding='utf-8')
    with tempfile.TemporaryDirectory() as folder:
        compiled = mutant.path.removeprefix(f'{PACKAGE}/') in COMPILED
        if compiled:
            os.environ['XDG_CACHE_HOME'] = folder
        try:
            return verdict(
                tests,
                compiled,
                tree,
                budget,
                [reach.seconds[one] for one in tests],
                Path(folder, 'log'),
            )
        finally:
            os.environ.pop('XDG_CACHE_HOME', None)
            target.write_text(source, encoding='utf-8')
            os.utime(target, ns=(times.st_atime_ns, times.st_mtime_ns))


def run(mutants: list[Mutant], folder: Path, budget: float) -> dict[str, str]:
    """Try every mutant that the folder does not know yet; return the verdicts by key."""
    state, tree = folder / 'verdicts.jsonl', folder.resolve() / 'tree'
    known: dict[str, str] = (
        dict(json.loads(line) for line in state.read_text().splitlines()) if state.exists() else {}
    )
    open_ones = [mutant for mutant in mutants if _key(mutant) not in known]
    reach = load(tree, folder / 'reach')
    preload()
    with state.open('a', encoding='utf-8') as stream:
        for mutant in track(open_ones, 'mutants'):
            known[_key(mutant)] = attempt(mutant, tree, reach, budget)
            print(json.dumps([_key(mutant), known[_key(mutant)]]), file=stream, flush=True)
    return known


def _key(mutant: Mutant) -> str:
    return ' '.join(map(str, mutant))


def _fate(verdict: str) -> str:
    """Return whether the fault is found, alive or cut off: then it may only have been slow."""
    if verdict == 'hung':
        return 'cut off'
    return 'alive' if verdict.startswith(('survived', 'nothing')) else 'found'


def _kind(operator: str) -> str:
    return next((text for name, text in KINDS.items() if name in operator), 'another fault')


def report(mutants: list[Mutant], verdicts: dict[str, str], command: str) -> str:
    """Return the page: a table by room, and the survivors by their fault."""
    rooms: dict[str, Counter[str]] = {room: Counter() for room in ROOMS}
    alive: dict[str, list[Mutant]] = {}
    for mutant in mutants:
        fate = _fate(verdicts[_key(mutant)])
        rooms[mutant.room][fate] += 1
        if fate == 'alive':
            alive.setdefault(_kind(mutant.operator), []).append(mutant)
    total: Any = sum(rooms.values(), Counter())
    lines = [
        '# Which faults the tests find',
        '',
        f'`{command}` puts one small fault at a time into the package and runs the tests that '
        'reach it; tests that take several times as long as before are cut off, and do not count.',
        '',
        '| room | mutants | found | share | cut off |',
        '|---|---|---|---|---|',
    ]
    for room, count in [*rooms.items(), ('all', total)]:
        tried = count['found'] + count['alive']
        if tried:
            lines.append(
                f'| {room} | {tried} | {count["found"]} | {count["found"] / tried:.0%} | '
                f'{count["cut off"]} |'
            )
    lines += ['', '| not found | faults | file and line |', '|---|---|---|']
    for kind, ones in sorted(alive.items()):
        places = ', '.join(
            f'`{m.path.removeprefix("fisheye_svp_ros/")}` {m.line}' for m in sorted(ones)
        )
        lines.append(f'| {kind} | {len(ones)} | {places} |')
    return '\n'.join(lines) + '\n'


def main() -> None:
    """Draw, try, report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--sample', type=int, default=300)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--budget', type=float, default=60.0, help='s of tests a mutant')
    parser.add_argument('--folder', type=Path, default=Path('out/mutation'), help='goes on here')
    parser.add_argument('-o', '--output', type=Path, default=ROOT / 'docs/results/mutation.md')
    args = parser.parse_args()
    tree = args.folder.resolve() / 'tree'
    if not tree.exists():
        shutil.copytree(ROOT, tree, ignore=shutil.ignore_patterns('.venv*', '.git', 'out'))
    trace(tree, args.folder / 'reach')
    mutants = sample(args.sample, args.seed, tree)
    verdicts = run(mutants, args.folder, args.budget)
    command = f'python -m benchmark.hardening.mutation --sample {args.sample} --seed {args.seed}'
    old = args.output.read_text(encoding='utf-8') if args.output.exists() else ''
    by_hand = ''.join(old.partition(BY_HAND)[1:])
    args.output.write_text(report(mutants, verdicts, command) + by_hand, encoding='utf-8')


if __name__ == '__main__':
    main()
