"""Sentences for users have at most 25 words: in what the package prints, and in its pages."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.nodes import ROOT

PACKAGE = ROOT / 'fisheye_svp_ros'
MAX_WORDS = 25
# Rooms and files of the package, whose strings are what commands, nodes and the library say.
AREAS = sorted(
    path for path in PACKAGE.iterdir() if path.suffix == '.py' or (path / '__init__.py').exists()
)
PAGES = [
    *sorted(ROOT.glob('*.md')),
    *sorted((ROOT / 'docs').glob('*.md')),
    *(
        page
        for folder in ('tutorials', 'how_to', 'reference', 'explanation')
        for page in sorted((ROOT / 'docs' / folder).glob('*.md'))
    ),
]
_VALUE = '#'  # stands for a value, and counts as a word
_NUMBERS = re.compile(r'[-+\d.nae\s]*$')


def _text(node: ast.expr) -> str | None:
    """Return a string of the code as a reader sees it, its values as one word each."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return re.sub(r'\{[^{}\s]*\}', _VALUE, node.value)
    if isinstance(node, ast.JoinedStr):
        return ''.join(
            str(part.value) if isinstance(part, ast.Constant) else _VALUE for part in node.values
        )
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        parts = [_text(node.left), _text(node.right)]
        return None if parts == [None, None] else ''.join(part or _VALUE for part in parts)
    return None


def strings(tree: ast.AST) -> Iterator[str]:
    """Yield the strings of a module but its docstrings."""
    told = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef))
        and node.body
        and isinstance(node.body[0], ast.Expr)
    }
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop()
        text = _text(node) if isinstance(node, ast.expr) and id(node) not in told else None
        if text is None:
            waiting += ast.iter_child_nodes(node)
        else:
            yield text
            waiting += [
                part.value for part in ast.walk(node) if isinstance(part, ast.FormattedValue)
            ]


def sentences(text: str) -> list[str]:
    """Return the sentences of what is printed; a line break ends one."""
    return re.split(r'(?<=[.!?])[)"]*\s+|\n', text)


def too_long(found: list[str]) -> list[str]:
    """Return the sentences of more than MAX_WORDS words."""
    return [one for one in found if len(one.split()) > MAX_WORDS and not _NUMBERS.match(one)]


@pytest.mark.parametrize('area', AREAS, ids=lambda path: path.stem)
def test_sentences_of_the_package_are_short(area: Path) -> None:
    files = sorted(area.rglob('*.py')) if area.is_dir() else [area]
    found = {
        f'{file.relative_to(ROOT)}: {sentence}'
        for file in files
        for text in strings(ast.parse(file.read_text(encoding='utf-8')))
        for sentence in too_long(sentences(text))
    }
    assert not found


def prose(page: str) -> Iterator[str]:
    """Yield the paragraphs, items and entries of cells of a page in Markdown, without its code."""
    page = re.sub(r'^```.*?^```|<!--.*?-->', '\n\n', page, flags=re.DOTALL | re.MULTILINE)
    page = re.sub(r'!?\[([^\]]*)\](?:\([^)]*\)|\[[^\]]*\])', r'\1', page)
    page = re.sub(r'`[^`]*`', _VALUE, page)
    page = re.sub(rf'{_VALUE}(?:,? (?:and |or )?{_VALUE})+', _VALUE, page)  # a list of names
    for block in re.split(r'\n\s*\n|\n(?=\s*(?:[-*#|]|\d+\.) )|(?<=\|)\n', page):
        text = ' '.join(block.split())
        if text.startswith('|'):
            yield from (entry for cell in text.split('|') for entry in re.split('[;:]', cell))
        else:
            yield re.sub(r'^(?:[-*]|#+|\d+\.) ', '', text)


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_sentences_of_pages_are_short(page: Path) -> None:
    paragraphs = prose(page.read_text(encoding='utf-8'))
    assert not too_long([one for text in paragraphs for one in sentences(text)])


def test_long_sentences_are_seen() -> None:
    words = ' '.join(['word'] * MAX_WORDS)
    code = (
        f'def f(x):\n    """{words} {words}."""\n'
        f"    raise E(f'{words} {{x}}; ' '{words}' if x else '{words}. {words} {{name}}')\n"
    )
    said, other = (text for text in strings(ast.parse(code)) if ' ' in text)
    assert len(too_long(sentences(said))) == len(too_long(sentences(other))) == 1
    page = f'# A head\n\n{words}. {words} a\nb\n- {words} `c` [d\ne](f)\n\n| {words}; {words} |\n'
    long = [text for text in prose(page) if too_long(sentences(text))]
    assert long == [f'{words}. {words} a b', f'{words} # d e']
    assert not too_long(list(prose('`a`, ' * 30 + 'and `b`')))
