"""Residuals out of a recording, with the scenario of each set."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.io.clouds import Points
from fisheye_svp_ros.io.decoding import columns, read_key_values, read_residuals, stamp_of


class ResidualField(NamedTuple):
    """Residuals of one localization: uv and residual (N, 2), px."""

    lens: str
    radius: float
    uv: Array
    residual: Array


class ResidualSet(NamedTuple):
    """Residuals of one localization: clouds.RESIDUALS; tags of its scenario, empty for none."""

    topic: str
    stamp: int
    points: Points
    tags: dict[str, str]


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


def residual_field(one: ResidualSet) -> ResidualField:
    """Return the residuals of one set over the image; its scenario names lens and radius."""
    points = one.points
    return ResidualField(
        one.tags['lens'], float(one.tags['radius']),
        columns(points, ('u', 'v')), columns(points, ('du', 'dv')),
    )
