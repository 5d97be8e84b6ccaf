"""A recording as a table: one row an input stamp, with its scenario and every metric."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Protocol

from fisheye_svp_ros.io.columns import typed
from fisheye_svp_ros.io.decoding import stamp_of, statuses

STAMP = 'stamp_ns'
NAMESPACE = 'namespace'


class _Record(Protocol):
    @property
    def topic(self) -> str:
        """Full name of the topic."""

    @property
    def message(self) -> Any:
        """A DiagnosticArray."""


Columns = dict[str, list[Any]]


def is_tabulated(topic: str, typename: str) -> bool:
    """Say whether a topic contributes to the table."""
    name = topic.rpartition('/')[2]
    return name in ('scenario', 'result') and typename == 'diagnostic_msgs/msg/DiagnosticArray'


def tabulate(records: Iterable[_Record]) -> Columns:
    """Join scenarios and results by stamp: columns of equal length, None where nothing is known.

    Metrics carry the name of the node, below the namespace of its scenario, before theirs.  Rows
    are in the order of namespace and stamp.
    """
    tags: dict[tuple[str, int], dict[str, str]] = {}
    results: list[tuple[str, int, dict[str, str]]] = []
    for record in records:
        base, _, name = record.topic.rpartition('/')
        stamp, told = stamp_of(record.message, record.topic), statuses(record.message)
        values = {key: value for status in told for key, value in status.values.items()}
        if name == 'scenario':
            tags[base, stamp] = values
        else:
            note = '; '.join(status.text for status in told)
            bad = any(status.level for status in told)
            results.append((base, stamp, {**values, **({'note': note} if bad else {})}))
    bases = {base for base, _ in tags}
    rows = {key: dict(values) for key, values in tags.items()}
    for node, stamp, values in results:
        base = _base_of(node, bases)
        prefix = node.removeprefix(f'{base}/')
        row = rows.setdefault((base, stamp), {})
        row.update({f'{prefix}.{key}': value for key, value in values.items()})
    return _columns(rows)


def _base_of(node: str, bases: set[str]) -> str:
    """Return the namespace of the scenario a node belongs to: the longest that holds it."""
    holding = [base for base in bases if node.startswith(f'{base}/')]
    return max(holding, key=len, default=node.rpartition('/')[0])


def _columns(rows: Mapping[tuple[str, int], Mapping[str, str]]) -> Columns:
    order = sorted(rows)
    names = dict.fromkeys(name for key in order for name in rows[key])
    columns: Columns = {NAMESPACE: [base or '/' for base, _ in order],
                        STAMP: [stamp for _, stamp in order]}
    for name in names:
        columns[name] = typed([rows[key].get(name) for key in order])
    return columns
