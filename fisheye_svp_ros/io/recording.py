"""What a recording tells: a table, one row an input stamp; residuals, with their scenarios."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from fisheye_svp_ros.io.clouds import Points
from fisheye_svp_ros.io.columns import parse_cells
from fisheye_svp_ros.io.decoding import read_key_values, read_residuals, stamp_of, statuses

STAMP = 'stamp_ns'
NAMESPACE = 'namespace'

Columns = dict[str, list[Any]]


class ResidualSet(NamedTuple):
    """Residuals of one localization: clouds.RESIDUALS; tags of its scenario, empty for none."""

    topic: str
    stamp: int
    points: Points
    tags: dict[str, str]


def is_tabulated(topic: str, typename: str) -> bool:
    """Say whether a topic contributes to the table."""
    name = topic.rpartition('/')[2]
    return name in ('scenario', 'result') and typename == 'diagnostic_msgs/msg/DiagnosticArray'


def tabulate(records: Iterable[Any]) -> Columns:
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
        # A node belongs to the scenario of the longest namespace that holds it.
        base = max((base for base in bases if node.startswith(f'{base}/')), key=len,
                   default=node.rpartition('/')[0])
        prefix = node.removeprefix(f'{base}/')
        row = rows.setdefault((base, stamp), {})
        row.update({f'{prefix}.{key}': value for key, value in values.items()})
    return _columns(rows)


def _columns(rows: Mapping[tuple[str, int], Mapping[str, str]]) -> Columns:
    order = sorted(rows)
    names = dict.fromkeys(name for key in order for name in rows[key])
    columns: Columns = {NAMESPACE: [base or '/' for base, _ in order],
                        STAMP: [stamp for _, stamp in order]}
    for name in names:
        columns[name] = parse_cells([rows[key].get(name) for key in order])
    return columns


def has_residuals(topic: str, typename: str) -> bool:
    """Say whether `residual_sets` wants a topic."""
    return topic.endswith(('/localizer/residuals', '/scenario'))


def residual_sets(records: Iterable[Any]) -> list[ResidualSet]:
    """Return the residuals of every localization, by topic and stamp."""
    tags: dict[tuple[str, int], dict[str, str]] = {}
    clouds: dict[tuple[str, int], Points] = {}
    for record in records:
        when = stamp_of(record.message, record.topic)
        if record.topic.endswith('/scenario'):
            namespace = record.topic.removesuffix('/scenario')
            tags[namespace, when] = read_key_values(record.message, record.topic)
        else:
            clouds[record.topic, when] = read_residuals(record.message, record.topic)
    return [
        ResidualSet(topic, when, points,
                    tags.get((topic.removesuffix('/localizer/residuals'), when), {}))
        for (topic, when), points in sorted(clouds.items(), key=lambda item: item[0])
    ]
