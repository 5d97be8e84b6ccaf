"""What a recording tells: a table, one row an input stamp; residuals; observations.

Residuals come with their scenarios, landmarks and image points are joined by stamp.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.io.bags import Bag
from fisheye_svp_ros.io.columns import make_table
from fisheye_svp_ros.io.decoding import (
    ImagePoints,
    Points,
    read_image_points,
    read_key_values,
    read_landmarks,
    read_residuals,
    stamp_of,
    statuses,
)
from fisheye_svp_ros.scene.observations import Landmarks, Observations, make_observations

if TYPE_CHECKING:
    from pandas import DataFrame

STAMP = 'stamp_ns'
NAMESPACE = 'namespace'

_CLOUD = 'sensor_msgs/msg/PointCloud2'
_IMAGES = ('sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage')
_NAMES = ('landmarks', 'image_points')
_INTEGER = re.compile(r'[+-]?[0-9]{1,18}')
_DECIMAL = re.compile(
    r'[+-]?(([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?|nan|inf)', re.IGNORECASE
)
_FRAME = re.compile(r'^frame \d+ ')
_EXCESS = re.compile(r'\S+ sigma_px, (?=above the gate)')
_NUMBER = re.compile(r'\d[\d.]*(e[-+]?\d+)?(?<!\.)')
_LIST = re.compile(r'# \(# px\)(, # \(# px\))*|#(, #)+(, \.\.\.)?')


class ResidualSet(NamedTuple):
    """Residuals of one localization (RESIDUALS); tags of its scenario, empty for none."""

    topic: str
    stamp: int
    points: Points
    tags: dict[str, str]


def is_tabulated(topic: str, typename: str) -> bool:
    """Say whether a topic contributes to the table."""
    name = topic.rpartition('/')[2]
    return name in ('scenario', 'result') and typename == 'diagnostic_msgs/msg/DiagnosticArray'


def tabulate(records: Iterable[Any]) -> DataFrame:
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
            text = '; '.join(status.text for status in told)
            if any(status.level for status in told):
                values |= _warning_columns(text) if values else {'note': note_of_set(text)}
            results.append((base, stamp, values))
    bases = {base for base, _ in tags}
    rows = {key: dict(values) for key, values in tags.items()}
    for node, stamp, values in results:
        # A node belongs to the scenario of the longest namespace that holds it.
        base = max(
            (base for base in bases if node.startswith(f'{base}/')),
            key=len,
            default=node.rpartition('/')[0],
        )
        prefix = node.removeprefix(f'{base}/')
        row = rows.setdefault((base, stamp), {})
        row.update({f'{prefix}.{key}': value for key, value in values.items()})
    return _join_rows(rows)


def note_of_set(reason: str) -> str:
    """Return why a set has no solution, the same for every set that lacks one for that reason."""
    return _EXCESS.sub('', _FRAME.sub('the set ', reason))


def _warning_columns(text: str) -> dict[str, str]:
    """Return why a solution should not be relied on: in few distinct words, and its first number.

    The number is a factor on sigma, or the first landmark that was left out.
    """
    number = _NUMBER.search(text)
    words = _LIST.sub('#', _NUMBER.sub('#', text))
    return {'warning': words, **({'warning_number': number[0]} if number else {})}


def _join_rows(rows: Mapping[tuple[str, int], Mapping[str, str]]) -> DataFrame:
    order = sorted(rows)
    names = dict.fromkeys(name for key in order for name in rows[key])
    columns: dict[str, list[Any]] = {
        NAMESPACE: [base or '/' for base, _ in order],
        STAMP: [stamp for _, stamp in order],
    }
    for name in names:
        columns[name] = parse_cells([rows[key].get(name) for key in order])
    return make_table(columns)


def parse_cells(cells: Sequence[str | None]) -> list[Any]:
    """Return whole numbers or numbers where every cell is one or empty; the text otherwise."""
    for kind, form in ((int, _INTEGER), (float, _DECIMAL)):
        if all(not cell or form.fullmatch(cell) for cell in cells):
            return [kind(cell) if cell else None for cell in cells]
    return list(cells)


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
        ResidualSet(
            topic, when, points, tags.get((topic.removesuffix('/localizer/residuals'), when), {})
        )
        for (topic, when), points in sorted(clouds.items(), key=lambda item: item[0])
    ]


class _PointSet(NamedTuple):
    stamp: int
    camera: str
    points: ImagePoints


def read(path: str | Path) -> Observations:
    """Read a recording; a frame is a stamp, a camera the namespace of its image points.

    t is the stamp, s.  Raises BagError for a recording that cannot be read and
    ObservationError, naming the topic, where it does not hold one world's observations.
    """
    bag = Bag(path)
    landmarks: dict[int, Landmarks] = {}
    worlds: set[str] = set()
    sets: list[_PointSet] = []
    for record in bag.records(
        lambda topic, kind: topic.rpartition('/')[2] in _NAMES and kind == _CLOUD
    ):
        namespace, _, name = record.topic.rpartition('/')
        where = f'{path}, {record.topic}'
        stamp = stamp_of(record.message, where)
        if name == 'landmarks':
            worlds.add(namespace)
            landmarks[stamp] = read_landmarks(record.message, where).landmarks
        else:
            sets.append(_PointSet(stamp, namespace, read_image_points(record.message, where)))
    if len(worlds) != 1 or not sets:
        raise ObservationError(
            f'{path}: observations need image_points and landmarks of one '
            f'namespace; {_topics_present(bag, worlds)}'
        )
    return _join_sets(sorted(sets, key=lambda one: one[:2]), landmarks, worlds.pop(), str(path))


def _topics_present(bag: Bag, worlds: set[str]) -> str:
    """Return what a recording has in place of one world's observations, and what to do."""
    images = {topic for topic, kind in bag.topics() if kind in _IMAGES}
    if images and not worlds:
        return f'it has images, on {min(images)}: add --board, for example chessboard:9x6:24mm'
    listed = ', '.join(world or '/' for world in sorted(worlds)) or 'none'
    wanted = f'{max(worlds)}/.*' if len(worlds) > 1 else '.*/(landmarks|image_points)'
    return f"landmarks are in: {listed}; record with --topics '{wanted}'"


def _join_sets(
    sets: list[_PointSet], landmarks: dict[int, Landmarks], world: str, source: str
) -> Observations:
    stamps = sorted({item.stamp for item in sets})
    frames = {stamp: frame for frame, stamp in enumerate(stamps)}
    named = [item.camera.removeprefix(world).lstrip('/').replace('/', '_') for item in sets]
    cameras = tuple(dict.fromkeys(named))
    counts = [len(item.points.landmark) for item in sets]
    return make_observations(
        np.repeat([frames[item.stamp] for item in sets], counts),
        np.concatenate([item.points.landmark for item in sets]),
        np.concatenate([item.points.uv for item in sets]),
        np.concatenate([_landmark_points(item, landmarks, source) for item in sets]),
        camera=np.repeat([cameras.index(name) for name in named], counts),
        t=np.repeat([item.stamp / 1e9 for item in sets], counts),
        cameras=cameras,
        source=source,
    )


def _landmark_points(one: _PointSet, landmarks: dict[int, Landmarks], source: str) -> Any:
    """Return the landmarks (N, 3) of a set: those of its stamp, or the latest before it."""
    stamps = sorted(landmarks)
    place = max(bisect_right(stamps, one.stamp) - 1, 0)
    points, is_listed = landmarks[stamps[place]].lookup(one.points.landmark)
    if not is_listed.all():
        missing = one.points.landmark[~is_listed][0]
        raise ObservationError(
            f'{source}: landmark {missing} of {one.camera}/image_points is not in the landmarks'
        )
    return points
