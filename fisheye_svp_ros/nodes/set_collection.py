"""Sets of image points, collected by the nodes that solve for many of them at once.

How far that is, `Progress` publishes: what the feedback of an action would tell.  An action needs
a type of its own, which no package of Python alone can have.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray

from fisheye_svp_ros.io.decoding import ImagePoints
from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.base import BaseNode
from fisheye_svp_ros.nodes.quality import LATCHED
from fisheye_svp_ros.nodes.validation import Items
from fisheye_svp_ros.scene.observations import Observations, join_tables, make_observations

_MAX_MOTION_PX = 1.0  # px: what image points of a still camera move by at most
# What tells the sets of one scenario from each other; all else tells scenarios apart.
_WITHIN_SCENARIO = ('set', 'frame')


def make_set(stamp: int, items: Items, cameras: Sequence[str]) -> Observations:
    """Return one set of cameras given by namespace, each with its slash, as a frame of a table.

    t is the stamp, s.
    """
    sets: list[ImagePoints] = [items[f'{camera}image_points'] for camera in cameras]
    counts = [len(seen.landmark) for seen in sets]
    return make_observations(
        np.zeros(sum(counts), dtype=np.int64),
        np.concatenate([seen.landmark for seen in sets]),
        np.concatenate([seen.uv for seen in sets]),
        np.concatenate([seen.xyz for seen in sets]),
        camera=np.repeat(np.arange(len(sets)), counts),
        t=np.full(sum(counts), stamp / 1e9),
        cameras=tuple(camera.rstrip('/') for camera in cameras),
        source='image_points',
    )


def is_repeated(collected: Observations, earlier: Sequence[Observations]) -> bool:
    """Say whether a set is no new view.

    It is the last one again, the camera having stood still, or an earlier one to the last digit.
    """
    if not earlier:
        return False
    copies = any(
        np.array_equal(collected.landmark, one.landmark) and np.array_equal(collected.uv, one.uv)
        for one in earlier
    )
    return copies or _median_move(collected, earlier[-1]) < _MAX_MOTION_PX


def _median_move(collected: Observations, other: Observations) -> float:
    """Return how far, px, the image points that two sets share moved; infinite for none."""
    mine, theirs = (2**32 * seen.camera + seen.landmark for seen in (collected, other))
    _, mine, theirs = np.intersect1d(mine, theirs, return_indices=True)
    if not len(mine):
        return float('inf')
    return float(np.median(np.linalg.norm(collected.uv[mine] - other.uv[theirs], axis=1)))


def table_of(window: Sequence[Observations]) -> Observations:
    """Return sets as a table, one frame a set."""
    return join_tables(
        [replace(seen, frame=np.full(len(seen), i)) for i, seen in enumerate(window)]
    )


def scenario_of(items: Items) -> frozenset[tuple[str, str]]:
    """Return what the sets of one scenario have in common."""
    scenario: dict[str, str] = items.get('scenario', {})
    return frozenset((k, v) for k, v in scenario.items() if k not in _WITHIN_SCENARIO)


class Progress:
    """Publishes `~/progress`: views, how many are missing, and what else a node has to tell."""

    def __init__(self, node: BaseNode) -> None:
        self._node = node
        self._publisher = node.announce(DiagnosticArray, '~/progress', LATCHED)

    def publish(self, stamp: int, views: int, missing: int, more: Mapping[str, object]) -> None:
        """Publish it; missing: views until the next result that counts."""
        name = f'{self._node.get_fully_qualified_name()}: progress'
        text = f'{missing} more views are needed' if missing else 'enough views'
        values = {'views': views, 'views_missing': missing, **more}
        self._publisher.publish(messages.key_values_message(name, values, stamp, text))
