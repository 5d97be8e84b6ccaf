"""Mutation study of statistical rules: whether a test fails when one is taken out.

`make hardening NAME=rules` takes out one rule at a time in a copy of the tree: a correction, a
square root, a clip, one of two limits, a term of a sum, a condition; or swaps a tail, makes a
number of degrees of freedom 1, trebles a threshold.  Each fault is tried on the tests of its own
module alone (`TESTS`), which take seconds.  Writes docs/results/rules.md: what died, and each
survivor with its change.  Interrupted runs go on where they were (--folder).
"""

from __future__ import annotations

import argparse
import ast
import json
import random
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from rich.progress import track

from benchmark.hardening.trial import failing_test, preload

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = 'fisheye_svp_ros'
# The tests of a module, its own first: they are run up to the first that fails.
TESTS = {
    **{
        f'mixed_model/{name}.py': [f'mixed_model/test_{name}.py']
        for name in (
            'equations',
            'model_averaging',
            'model_columns',
            'reml',
            'score_tests',
            'solution',
        )
    },
    'solve/outliers.py': ['solve/test_outliers.py'],
    'solve/reliability.py': ['solve/test_examination.py', 'solve/test_reliability.py'],
    'solve/weak_geometry.py': ['solve/test_weak_geometry.py'],
    'solve/wrong_landmarks.py': ['solve/test_wrong_landmarks.py'],
    'solve/ray_errors.py': ['solve/test_ray_errors.py'],
    **{
        f'solve/{name}.py': [f'solve/test_{name}.py']
        for name in (
            'hand_eye',
            'mirrored_points',
            'pose_gate',
            'readout',
            'tag_mapping',
            'tag_units',
        )
    },
    'diagnosis/effect_tests.py': ['diagnosis/test_effect_tests.py'],
    'diagnosis/cross_validation.py': ['diagnosis/test_cross_validation.py'],
    'diagnosis/variance_budget.py': ['diagnosis/test_variance_budget.py'],
    'diagnosis/decision.py': ['diagnosis/test_decision.py'],
    'diagnosis/adequacy.py': ['diagnosis/test_adequacy.py'],
    'diagnosis/similar_views.py': ['diagnosis/test_similar_views.py'],
}
BY_HAND = '\n<!-- what the survivors are: by hand -->\n'  # kept from here on
_DROPPED = {'sqrt', 'abs', 'absolute', 'square', 'clip', 'log1p', 'nan_to_num'}
_CHOICES = {'maximum', 'minimum', 'fmax', 'fmin', 'max', 'min'}
_OTHER_TAIL = {
    f'{family}{tail}': f'{family}{other}'
    for family, tails in (('chdtr', 'c'), ('fdtr', 'c'), ('pdtr', 'c'), ('gammainc', 'c'))
    for tail, other in ((tails, ''), ('', tails))
}
_MEANS = {'median': 'mean', 'nanmedian': 'nanmean'}
_DEGREES = {'freedom', 'dof', 'rank', 'rows', 'count', 'group_rank', 'effect_count'}


class Fault(NamedTuple):
    """One rule taken out: where, of what kind, and the text of it before and after."""

    path: str
    line: int
    kind: str
    start: int
    end: int
    new: str

    def of(self, source: str) -> str:
        """Return a file with the fault in it."""
        text = source.encode()
        return (text[: self.start] + self.new.encode() + text[self.end :]).decode()


def faults_of(path: str, source: str) -> list[Fault]:
    """Return every rule of a file that can be taken out, and how."""
    starts = [0]
    for line in source.encode().split(b'\n'):
        starts.append(starts[-1] + len(line) + 1)

    def place(node: Any) -> tuple[int, int]:
        return (
            starts[node.lineno - 1] + node.col_offset,
            starts[node.end_lineno - 1] + node.end_col_offset,
        )

    faults, whole = [], ast.dump(ast.parse(source))
    for node, kind, new in _changes(ast.parse(source)):
        fault = Fault(path, node.lineno, kind, *place(node), new)
        try:
            changed = ast.dump(ast.parse(fault.of(source)))
        except SyntaxError:
            continue
        if changed != whole:
            faults.append(fault)
    return faults


def _changes(tree: ast.Module) -> Iterator[tuple[Any, str, str]]:
    """Yield nodes, what is taken out of each, and what stands there instead."""
    for node in tree.body:
        if (
            isinstance(node, ast.Assign)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, float)
        ):
            yield node.value, 'a threshold trebled', repr(3 * node.value.value)
    for function in ast.walk(tree):
        if isinstance(function, ast.FunctionDef):
            for statement in function.body:
                yield from _within(statement)


def _within(node: ast.AST) -> Iterator[tuple[Any, str, str]]:
    """Yield the changes of a statement, but of messages, inner functions and what only checks."""
    if isinstance(node, (ast.FunctionDef, ast.Raise, ast.Assert, ast.JoinedStr, ast.Subscript)):
        if isinstance(node, ast.Subscript):
            yield from _within(node.value)
        return
    yield from ((node, kind, f'({new})') for kind, new in _expressions(node))
    if isinstance(node, ast.AugAssign):
        yield node, 'a term dropped', 'pass'
    for child in ast.iter_child_nodes(node):
        if not (isinstance(node, ast.AnnAssign) and child is node.annotation):
            yield from _within(child)


def _expressions(node: ast.AST) -> Iterator[tuple[str, str]]:
    """Yield what can stand for an expression: what is taken out of it, and the rest."""
    if isinstance(node, ast.Call):
        yield from _calls(node)
    elif isinstance(node, ast.BinOp):
        left, right = ast.unparse(node.left), ast.unparse(node.right)
        if isinstance(node.op, (ast.Add, ast.Sub)):
            yield 'a term dropped', left
            yield 'a term dropped', right
        elif isinstance(node.op, (ast.Mult, ast.Div)):
            yield 'a factor dropped', left
            if isinstance(node.op, ast.Mult):
                yield 'a factor dropped', right
        elif isinstance(node.op, ast.Pow):
            yield 'a power dropped', left
        elif isinstance(node.op, (ast.BitAnd, ast.BitOr)):
            yield 'a condition dropped', left
            yield 'a condition dropped', right
    elif isinstance(node, ast.BoolOp):
        for i in range(len(node.values)):
            rest = node.values[:i] + node.values[i + 1 :]
            word = ' and ' if isinstance(node.op, ast.And) else ' or '
            yield 'a condition dropped', word.join(f'({ast.unparse(one)})' for one in rest)
    elif isinstance(node, ast.IfExp):
        yield 'a case dropped', ast.unparse(node.body)
        yield 'a case dropped', ast.unparse(node.orelse)
    elif isinstance(node, ast.Compare) and isinstance(
        node.ops[0], (ast.Lt, ast.LtE, ast.Gt, ast.GtE)
    ):
        if ast.unparse(node.comparators[0]) != '0':
            symbol = ' < ' if isinstance(node.ops[0], (ast.Lt, ast.LtE)) else ' > '
            yield 'a limit of zero', f'{ast.unparse(node.left)}{symbol}0'
    elif isinstance(node, ast.UnaryOp) and not isinstance(node.operand, ast.Constant):
        yield 'a sign or `not` dropped', ast.unparse(node.operand)
    elif (isinstance(node, ast.Attribute) and node.attr in _DEGREES) or (
        isinstance(node, ast.Name) and node.id in _DEGREES and isinstance(node.ctx, ast.Load)
    ):
        yield 'a number of degrees is 1', '1'


def _calls(node: ast.Call) -> Iterator[tuple[str, str]]:
    function = node.func
    name = function.attr if isinstance(function, ast.Attribute) else getattr(function, 'id', '')
    arguments = [ast.unparse(one) for one in node.args if not isinstance(one, ast.Starred)]
    text = ast.unparse(node)
    if name in _DROPPED and arguments:
        yield 'a function dropped', arguments[0]
    elif name in _CHOICES and len(arguments) > 1:
        yield 'one of two limits', arguments[0]
        yield 'one of two limits', arguments[1]
    elif name in _OTHER_TAIL:
        yield 'the other tail', text.replace(name, _OTHER_TAIL[name], 1)
    elif name in _MEANS:
        yield 'a mean for a median', text.replace(name, _MEANS[name], 1)
    elif name == 'chdtri':
        yield 'the other tail', f'{ast.unparse(function)}({arguments[0]}, 1 - {arguments[1]})'
    elif name == 'where' and len(arguments) == 3:
        yield 'a case dropped', arguments[1]
        yield 'a case dropped', arguments[2]
    elif name in ('sum', 'len', 'prod'):
        yield 'a sum or count is 1', '1'
    if any(keyword.arg == 'ddof' for keyword in node.keywords):
        keywords = [one for one in node.keywords if one.arg != 'ddof']
        changed = ast.Call(function, node.args, keywords)
        yield 'a number of degrees is 1', ast.unparse(changed)


def sample(count: int, seed: int, modules: Iterable[str]) -> list[Fault]:
    """Return so many faults of each module: of a random kind each, at places that differ."""
    rng, drawn = random.Random(seed), []
    for module in modules:
        path = f'{PACKAGE}/{module}'
        kinds: dict[str, list[Fault]] = {}
        for fault in faults_of(path, (ROOT / path).read_text(encoding='utf-8')):
            kinds.setdefault(fault.kind, []).append(fault)
        some: dict[tuple[int, int], Fault] = {}
        while kinds and len(some) < count:
            kind = rng.choice(list(kinds))
            fault = kinds[kind].pop(rng.randrange(len(kinds[kind])))
            some.setdefault((fault.start, fault.end), fault)
            kinds = {name: faults for name, faults in kinds.items() if faults}
        drawn += sorted(some.values())
    return drawn


def run(faults: list[Fault], folder: Path, names: list[str]) -> dict[Fault, str]:
    """Try every fault that the folder does not know yet; return the test that found each, or ''.

    'hung' where tests take ten times as long as without a fault, and longer than a minute.
    """
    state, tree = folder / 'verdicts.jsonl', folder.resolve() / 'tree'
    known: dict[Fault, str] = {}
    if state.exists():
        lines = (json.loads(line) for line in state.read_text(encoding='utf-8').splitlines())
        known = {Fault(*fault): verdict for fault, verdict in lines}
    preload()
    patience: dict[str, float] = {}
    with state.open('a', encoding='utf-8') as stream, tempfile.TemporaryDirectory() as scratch:
        for fault in track([one for one in faults if one not in known], 'faults'):
            module = fault.path.removeprefix(f'{PACKAGE}/')
            tests = [f'test/{one}' for one in dict.fromkeys(TESTS[module]) if not names]
            tests = tests or names
            log = Path(scratch, 'log')
            if module not in patience:
                begin = time.monotonic()
                if failed := failing_test(tests, tree, {}, 3600.0, log):
                    raise SystemExit(f'{failed} fails without a fault')
                patience[module] = 60 + 10 * (time.monotonic() - begin)
            target = tree / fault.path
            source = target.read_text(encoding='utf-8')
            target.write_text(fault.of(source), encoding='utf-8')
            try:
                known[fault] = failing_test(tests, tree, {}, patience[module], log)
            finally:
                target.write_text(source, encoding='utf-8')
            print(json.dumps([fault, known[fault]]), file=stream, flush=True)
    return known


def report(faults: list[Fault], verdicts: dict[Fault, str], command: str) -> str:
    """Return the page: tables by module and by kind, and the survivors with their change."""
    lines = [
        '# Which statistical rules the tests hold',
        '',
        f'`{command}` takes out one rule at a time (a correction, a square root, a clip, a term, '
        'a condition, a tail) and runs the tests of its module alone.',
    ]
    for title, key in (('module', lambda fault: fault.path), ('fault', lambda fault: fault.kind)):
        tried: Counter[str] = Counter(map(key, faults))
        found = Counter(key(fault) for fault in faults if verdicts[fault])
        lines += ['', f'| {title} | tried | found | share |', '|---|---|---|---|']
        rows = [(name, tried[name], found[name]) for name in sorted(tried)]
        if title == 'module':
            rows.append(('all', sum(tried.values()), sum(found.values())))
        lines += [
            f'| {name.removeprefix(PACKAGE + "/")} | {count} | {ours} | {ours / count:.0%} |'
            for name, count, ours in rows
        ]
    lines += ['', '| not found | before | after |', '|---|---|---|']
    for fault in (fault for fault in faults if not verdicts[fault]):
        text = (ROOT / fault.path).read_bytes()[fault.start : fault.end].decode()
        before, after = (
            f'`{" ".join(one.split()).replace("|", chr(92) + "|")}`' for one in (text, fault.new)
        )
        place = f'`{fault.path.removeprefix(PACKAGE + "/")}` {fault.line}'
        lines.append(f'| {place} | {before} | {after} |')
    return '\n'.join(lines) + '\n'


def main() -> None:
    """Draw, try, report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--sample', type=int, default=12, help='faults of each module')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--modules', nargs='+', choices=TESTS, default=list(TESTS))
    parser.add_argument('--tests', nargs='+', default=[], help='these in place of the own ones')
    parser.add_argument('--folder', type=Path, default=Path('out/rules'), help='goes on here')
    parser.add_argument('-o', '--output', type=Path, default=ROOT / 'docs/results/rules.md')
    args = parser.parse_args()
    tree = args.folder.resolve() / 'tree'
    if not tree.exists():
        shutil.copytree(ROOT, tree, ignore=shutil.ignore_patterns('.venv*', '.git', 'out'))
    faults = sample(args.sample, args.seed, args.modules)
    verdicts = run(faults, args.folder, args.tests)
    command = f'python -m benchmark.hardening.rules --sample {args.sample} --seed {args.seed}'
    old = args.output.read_text(encoding='utf-8') if args.output.exists() else ''
    by_hand = ''.join(old.partition(BY_HAND)[1:])
    args.output.write_text(report(faults, verdicts, command) + by_hand, encoding='utf-8')


if __name__ == '__main__':
    main()
