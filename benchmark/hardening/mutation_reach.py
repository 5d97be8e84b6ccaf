"""Which tests reach a line of the package, and how long each takes: what a mutant is tried on.

One run of the suite under coverage, a context a test, tells the tests of every line, in processes
that a test starts, too.  What Numba compiles is traced uncompiled.
"""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from coverage import CoverageData
from coverage.exceptions import DataError

# Traced one after the other, so that an interrupted trace goes on where it was.
GROUPS = {
    'numbers': [
        'optics',
        'scene',
        'io',
        'effects',
        'mixed_model',
        'simulate',
        'solve',
        'rectify',
        'study',
        'test_pose.py',
        'library',
        'test_registry.py',
    ],
    'uncompiled': ['optics', 'solve/test_least_squares.py', '-k', 'numba or engine or compiled'],
    'diagnosis': ['diagnosis', 'planning'],
    'nodes': ['nodes'],
    'commands': ['commands', 'detect', 'reporting', 'paper'],
}
_SETTINGS = """[run]
include = {tree}/fisheye_svp_ros/*
parallel = True
patch = subprocess
context = ${{PYTEST_CURRENT_TEST-}}
data_file = {folder}/{group}
disable_warnings = no-data-collected, module-not-measured, already-imported
"""
_DURATION = re.compile(r'([\d.]+)s (?:call|setup|teardown) +(test/.*)')
_PHASE = re.compile(r'\|(run|setup|teardown)$| \((call|setup|teardown)\)$')


class Reach(NamedTuple):
    """Tests by file and line, and the seconds that each test takes."""

    tests: dict[str, dict[int, set[str]]]
    seconds: dict[str, float]

    def of(self, tree: Path, path: str, line: int) -> list[str]:
        """Return the tests that a fault in a line of a file can change.

        The module's own tests come first, then the others; of both, the quickest first.
        """
        syntax = ast.parse((tree / path).read_text(encoding='utf-8'))
        around = [
            one
            for one in ast.walk(syntax)
            if isinstance(one, ast.stmt) and _first_line(one) <= line <= (one.end_lineno or 0)
        ]
        statement = around[-1] if around else syntax  # the innermost: `walk` goes by depth
        if any(isinstance(one, ast.FunctionDef) and line >= one.body[0].lineno for one in around):
            found = self._tests(path, _head(statement))
        elif isinstance(statement, ast.FunctionDef):  # a default or a decorator
            found = self._tests(path, _bodies(statement))
        else:  # what runs once, when the module is imported, shows where its names are used
            found = self._uses(tree, _targets(statement)) or self._tests(path, _bodies(syntax))
        own = f'/test_{Path(path).stem}.py'
        return sorted(
            found & self.seconds.keys(),
            key=lambda test: (own not in test, self.seconds[test], test),
        )

    def _tests(self, path: str, lines: Iterable[int]) -> set[str]:
        by_line = self.tests.get(path, {})
        return set().union(*(by_line.get(line, set()) for line in lines))

    def _uses(self, tree: Path, names: set[str]) -> set[str]:
        """Return the tests of every function of the package that mentions one of the names."""
        found: set[str] = set()
        for path in filter(lambda one: one.endswith('.py'), self.tests if names else ()):
            text = (tree / path).read_text(encoding='utf-8')
            if any(name in text for name in names):
                for function in _functions(ast.parse(text)):
                    if names & _mentions(function):
                        found |= self._tests(path, _bodies(function))
        return found


def trace(tree: Path, folder: Path) -> None:
    """Run the suite of a tree under coverage, group by group, those left out that are done."""
    folder.mkdir(parents=True, exist_ok=True)
    for group, arguments in GROUPS.items():
        log = folder / f'{group}.log'
        if log.exists():
            continue
        settings = folder / f'settings_{group}.ini'  # no name that coverage takes for data
        settings.write_text(_SETTINGS.format(tree=tree, folder=folder.resolve(), group=group))
        paths = [f'test/{word}' if (tree / 'test' / word).exists() else word for word in arguments]
        environment = os.environ | {'PYTHONPATH': str(tree), 'OMP_NUM_THREADS': '1'}
        if group == 'uncompiled':
            environment['NUMBA_DISABLE_JIT'] = '1'
        done = subprocess.run(
            [
                sys.executable,
                '-m',
                'pytest',
                '-q',
                '-p',
                'no:cacheprovider',
                '--cov',
                f'--cov-config={settings.resolve()}',
                '--cov-context=test',
                '--cov-report=',
                '--durations=0',
                '--durations-min=0',
                '-vv',
                *paths,
            ],
            cwd=tree,
            env=environment,
            capture_output=True,
            text=True,
        )
        log.write_text(done.stdout, encoding='utf-8')


def load(tree: Path, folder: Path) -> Reach:
    """Read what `trace` left, without the tests that failed."""
    seconds: dict[str, float] = defaultdict(float)
    failed: set[str] = set()
    for log in sorted(folder.glob('*.log')):
        for line in log.read_text(encoding='utf-8').splitlines():
            if match := _DURATION.match(line):
                seconds[match[2].strip()] += float(match[1])
            elif line.startswith(('FAILED ', 'ERROR ')):
                failed.add(line.split(' ', 1)[1].split(' - ')[0])
    tests: dict[str, dict[int, set[str]]] = {}
    for file in sorted(folder.iterdir()):
        if file.suffix in {'.log', '.ini'}:
            continue
        data = CoverageData(str(file))
        try:
            data.read()
        except DataError:  # of a process that was killed
            continue
        for path in data.measured_files():
            by_line = tests.setdefault(str(Path(path).relative_to(tree)), defaultdict(set))
            for line, contexts in data.contexts_by_lineno(path).items():
                by_line[line] |= {_PHASE.sub('', context) for context in contexts} - {''}
    return Reach(tests, {test: s for test, s in seconds.items() if test not in failed})


def _functions(node: ast.AST) -> Iterator[ast.FunctionDef]:
    return (one for one in ast.walk(node) if isinstance(one, ast.FunctionDef))


def _bodies(node: ast.AST) -> Iterator[int]:
    """Yield the lines of the bodies of all functions in a node."""
    for function in _functions(node):
        yield from range(function.body[0].lineno, (function.end_lineno or 0) + 1)


def _head(statement: Any) -> range:
    """Return the lines of a statement, of its head alone if it is a compound one."""
    body = getattr(statement, 'body', None)
    last = body[0].lineno - 1 if body else statement.end_lineno
    return range(statement.lineno, max(last, statement.lineno) + 1)


def _first_line(statement: ast.stmt) -> int:
    decorators = getattr(statement, 'decorator_list', ())
    return min([statement.lineno, *(one.lineno for one in decorators)])


def _targets(statement: ast.AST) -> set[str]:
    targets = getattr(statement, 'targets', None) or [getattr(statement, 'target', None)]
    return {
        one.id
        for target in targets
        if target is not None
        for one in ast.walk(target)
        if isinstance(one, ast.Name)
    }


def _mentions(function: ast.FunctionDef) -> set[str]:
    nodes = list(ast.walk(function))
    return (
        {one.id for one in nodes if isinstance(one, ast.Name)}
        | {one.attr for one in nodes if isinstance(one, ast.Attribute)}
        | {one.arg for one in nodes if isinstance(one, ast.keyword) and one.arg}
    )
