"""Writes what is said about parameters twice: the tables of nodes.md and config/*.yaml.

Both come from the tables in the code; a test compares.  Run: python docs/parameters.py
"""

from __future__ import annotations

import re
import sys
import textwrap
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from fisheye_svp_ros.io.parameters import Row  # noqa: E402
from fisheye_svp_ros.nodes import NODES, executables  # noqa: E402

_TABLE = '<!-- parameters of {node} -->\n{table}<!-- end -->'


def markdown(table: list[Row]) -> str:
    """Return a parameter table for nodes.md."""
    lines = ['| parameter | default | unit | allowed | meaning |', '|---|---|---|---|---|']
    for row in table:
        default = _yaml(row.default)
        cells = (f'`{row.name}`', f'`{default}`', row.unit, row.constraint(), row.description)
        lines.append('| ' + ' | '.join(cells) + ' |')
    return '\n'.join(lines) + '\n'


def parameter_file(node: str, table: list[Row]) -> str:
    """Return a commented parameter file that holds the defaults."""
    lines = [f'# Parameters of {node}, with their defaults.  docs/reference/nodes.md says more.',
             '/**:', '  ros__parameters:']
    for row in table:
        unit = f' [{row.unit}]' if row.unit else ''
        allowed = f' ({row.constraint()})' if row.constraint() else ''
        text = f'{row.description}{unit}{allowed}.'
        lines += [f'    # {line}' for line in textwrap.wrap(text, 90)]
        lines.append(f'    {row.name}: {_yaml(row.default)}')
    return '\n'.join(lines) + '\n'


def documents() -> dict[Path, str]:
    """Return what the files should hold."""
    page = ROOT / 'docs' / 'reference' / 'nodes.md'
    text, wanted = page.read_text(encoding='utf-8'), {}
    for node in NODES:
        if not (ROOT / 'fisheye_svp_ros' / 'nodes' / f'{node}.py').exists():
            continue
        table = executables.parameters(node)
        pattern = re.escape(_TABLE.format(node=node, table='\0')).replace('\0', '.*?')
        new = _TABLE.format(node=node, table=markdown(table))
        text, found = re.subn(pattern, lambda _, new=new: new, text, flags=re.DOTALL)
        if not found:
            raise SystemExit(f'docs/reference/nodes.md has no place for the parameters of {node}')
        wanted[ROOT / 'config' / f'{node}.yaml'] = parameter_file(node, table)
    return {**wanted, page: text}


def _yaml(value: Any) -> str:
    plain = list(value) if isinstance(value, tuple) else value
    text: str = yaml.safe_dump(plain, default_flow_style=True, width=1000)
    return text.removesuffix('\n').removesuffix('\n...')


if __name__ == '__main__':
    for path, content in documents().items():
        path.write_text(content, encoding='utf-8')
