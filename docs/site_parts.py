"""Parts of the site that come from the code, as Markdown (conf.py)."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

from fisheye_svp_ros.cli import COMMANDS

SCHEMA = Path(__file__).parent / 'reference' / 'diagnosis.schema.json'


def commands() -> str:
    """Return a section for each command, from the arguments that it declares."""
    parts = []
    for name, purpose in COMMANDS.items():
        parser = argparse.ArgumentParser(name)
        import_module(f'fisheye_svp_ros.commands.{name}').add_arguments(parser)
        parts += [
            f'## {name}',
            '',
            f'{purpose[0].upper()}{purpose[1:]}.',
            '',
            '| argument | meaning |',
            '|---|---|',
            *(_row(action) for action in parser._actions if action.dest != 'help'),
            '',
        ]
    return '\n'.join(parts)


def _row(action: argparse.Action) -> str:
    """Return the row of an argument, with its default where the help does not state it."""
    value = action.metavar or (
        ','.join(map(str, action.choices)) if action.choices else action.dest.upper()
    )
    value = ' '.join(value) if isinstance(value, tuple) else value
    names = ', '.join(action.option_strings)
    name = f'{names} {"" if action.nargs == 0 else value}'.strip()
    text = (action.help or '') % {**vars(action), 'prog': 'fisheye-svp'}
    told = action.default in (None, '', 0, False, argparse.SUPPRESS) or (
        'default' in text or f'({action.default})' in text
    )
    if not told:
        text += f'; default: {action.default}'
    return f'| `{name}` | {text} |'


def diagnosis_keys() -> str:
    """Return the table of the keys of diagnosis.json, from its schema."""
    schema = json.loads(SCHEMA.read_text(encoding='utf-8'))
    rows = [f'| `{key}` | {kind} | {text} |' for key, kind, text in _keys(schema, schema, '')]
    return '\n'.join(['| key | type | meaning |', '|---|---|---|', *rows])


def _keys(node: Any, schema: Any, path: str) -> Iterator[tuple[str, str, str]]:
    """Yield path, type and description of what a node of the schema holds."""
    parts = [
        (f'{path}.{name}'.lstrip('.'), part) for name, part in node.get('properties', {}).items()
    ]
    if 'items' in node:
        yield from _keys(_resolved(node['items'], schema), schema, f'{path}[]')
    if isinstance(node.get('additionalProperties'), dict):
        yield from _keys(node['additionalProperties'], schema, f'{path}.NAME')
    for name, part in parts:
        known = _resolved(part, schema)
        kinds = known.get('enum') or known.get('type', '')
        kind = kinds if isinstance(kinds, str) else ', '.join(map(str, kinds))
        yield name, kind, known.get('description', '')
        yield from _keys(known, schema, name)


def _resolved(node: Any, schema: Any) -> Any:
    """Return a node with its reference followed."""
    name = node.get('$ref', '').rpartition('/')[2]
    return {**schema['$defs'][name], **node} if name else node
