"""Names of nodes, topics and services: validation, expansion and remapping."""

from __future__ import annotations

import re
from dataclasses import dataclass

from fisheye_svp_ros.standalone.exceptions import NameValidationException

_TOKEN = r'[A-Za-z_][A-Za-z0-9_]*'
_FULL = re.compile(rf'(/{_TOKEN})+')
_NAMESPACE = re.compile(rf'/|(/{_TOKEN})+')
_NODE = re.compile(_TOKEN)


def node_name(name: str) -> str:
    """Return a node name that is well formed."""
    return _checked(_NODE, 'node name', name)


def namespace(name: str) -> str:
    """Return a namespace that is well formed and starts with a slash."""
    absolute = name if name.startswith('/') else f'/{name}'
    return _checked(_NAMESPACE, 'namespace', absolute)


def join(ns: str, name: str) -> str:
    """Return the absolute form of a name in a namespace."""
    return f'{ns.rstrip("/")}/{name}'


def expand(name: str, node: str, ns: str, kind: str = 'topic') -> str:
    """Return the absolute name of a relative, private (`~/x`) or absolute one."""
    if name == '~' or name.startswith('~/'):
        absolute = join(ns, node) + name[1:]
    else:
        absolute = name if name.startswith('/') else join(ns, name)
    return _checked(_FULL, f'{kind} name', absolute, name)


@dataclass(frozen=True)
class Rule:
    """One remapping rule: `from:=to`, `node:from:=to`, `__node:=to` or `__ns:=to`."""

    match: str
    replacement: str
    node: str | None = None  # the only node that it applies to
    kind: str | None = None  # `topic` or `service`, when it applies to one of them only

    @classmethod
    def parse(cls, text: str) -> Rule:
        """Read a rule as it follows `-r` on the command line."""
        left, separator, right = text.partition(':=')
        if not (left and separator and right):
            raise NameValidationException(f'remapping rule {text!r} is not from:=to')
        found = re.fullmatch(rf'(?:({_TOKEN}):(?!//))?(?:ros(topic|service)://)?(.+)', left,
                             re.DOTALL)
        assert found, left  # the last group takes any text
        node, kind, match = found.groups()
        return cls('__node' if match == '__name' else match, right, node, kind)


def remap_node(rules: list[Rule], name: str, ns: str) -> tuple[str, str]:
    """Return name and namespace of a node after its rules."""
    names = {'__node': name, '__ns': ns}
    for special in names:
        for rule in rules:
            if rule.match == special and rule.node in {None, name}:
                names[special] = rule.replacement
                break
    return node_name(names['__node']), namespace(names['__ns'])


def remap(rules: list[Rule], name: str, node: str, ns: str, kind: str = 'topic') -> str:
    """Expand a name and apply the first rule that matches it."""
    absolute = expand(name, node, ns, kind)
    for rule in rules:
        if rule.match.startswith('__') or rule.node not in {None, node}:
            continue
        if rule.kind in {None, kind} and expand(rule.match, node, ns, kind) == absolute:
            return expand(rule.replacement, node, ns, kind)
    return absolute


def _checked(pattern: re.Pattern[str], what: str, name: str, given: str | None = None) -> str:
    if not pattern.fullmatch(name):
        raise NameValidationException(f'Invalid {what}: {given or name!r}')
    return name
