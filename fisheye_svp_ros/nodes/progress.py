"""How far a node is that gathers views: what the feedback of an action would tell.

An action needs a type of its own, which no package of Python alone can have; the common
interfaces hold none that fits.
"""

from __future__ import annotations

from collections.abc import Mapping

from diagnostic_msgs.msg import DiagnosticArray

from fisheye_svp_ros.nodes import messages
from fisheye_svp_ros.nodes.base import BaseNode
from fisheye_svp_ros.nodes.quality import LATCHED


class Progress:
    """Publishes `~/progress`: views, how many are missing, and what else a node has to tell."""

    def __init__(self, node: BaseNode) -> None:
        self._node = node
        self._publisher = node.announce(DiagnosticArray, '~/progress', LATCHED)

    def tell(self, stamp: int, views: int, missing: int, more: Mapping[str, object]) -> None:
        """Tell it; missing: views until the next result that counts."""
        name = f'{self._node.get_fully_qualified_name()}: progress'
        text = f'{missing} more views are needed' if missing else 'enough views'
        values = {'views': views, 'views_missing': missing, **more}
        self._publisher.publish(messages.key_values_message(name, values, stamp, text))
