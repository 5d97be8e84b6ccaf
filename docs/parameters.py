"""Writes the tables of parameters in nodes.md, from those in the code; a test compares.

Run: python docs/parameters.py
What at least `_SHARED` nodes have alike stands in a table of its own.
"""

from __future__ import annotations

import re
import sys
import textwrap
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / 'docs' / 'reference' / 'nodes.md'
sys.path.insert(0, str(ROOT))

from fisheye_svp_ros.io.parameters import Row  # noqa: E402
from fisheye_svp_ros.nodes import NODES, executables  # noqa: E402

_TABLE = '<!-- parameters of {node} -->\n{table}<!-- end -->'
_SHARED = 2  # nodes
_COMMON = 'several nodes'


def markdown(table: list[Row]) -> str:
    """Return a parameter table for nodes.md."""
    lines = ['| parameter | default | allowed | meaning |', '|---|---|---|---|']
    for row in table:
        allowed = ' '.join(filter(None, (row.constraint(), row.unit)))
        cells = (f'`{row.name}`', f'`{_yaml(row.default)}`', allowed, row.description)
        lines.append('| ' + ' | '.join(cells) + ' |')
    return '\n'.join(lines) + '\n'


def common_rows(tables: Iterable[list[Row]]) -> list[Row]:
    """Return the rows that several nodes have alike, in their order."""
    counts = Counter(row for table in tables for row in table)
    return [row for row, count in counts.items() if count >= _SHARED]


def node_section(table: list[Row], common: list[Row]) -> str:
    """Return what nodes.md says of the parameters of one node."""
    own = [row for row in table if row not in common]
    names = ', '.join(f'`{row.name}`' for row in table if row in common)
    shared = textwrap.fill(
        f'[Common parameters](#common-parameters): {names}.',
        100,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return '\n'.join([*([markdown(own)] if own else []), *([shared + '\n'] if names else [])])


def nodes_page() -> str:
    """Return what nodes.md should hold."""
    text = PAGE.read_text(encoding='utf-8')
    tables = {
        node: executables.parameters(node)
        for node in NODES
        if (ROOT / 'fisheye_svp_ros' / 'nodes' / f'{node}.py').exists()
    }
    common = common_rows(tables.values())
    sections = {node: node_section(table, common) for node, table in tables.items()}
    for node, section in {_COMMON: markdown(common), **sections}.items():
        pattern = re.escape(_TABLE.format(node=node, table='\0')).replace('\0', '.*?')
        new = _TABLE.format(node=node, table=section)
        text, places = re.subn(pattern, lambda _, new=new: new, text, flags=re.DOTALL)
        if not places:
            raise SystemExit(f'{PAGE.name} has no place for the parameters of {node}')
    return text


def _yaml(value: Any) -> str:
    plain = list(value) if isinstance(value, tuple) else value
    text: str = yaml.safe_dump(plain, default_flow_style=True, width=1000)
    return text.removesuffix('\n').removesuffix('\n...')


if __name__ == '__main__':
    PAGE.write_text(nodes_page(), encoding='utf-8')
