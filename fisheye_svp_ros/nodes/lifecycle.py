"""The lifecycle of managed nodes: configure loads the lens, activate listens."""

from __future__ import annotations

from typing import Any

from rclpy.lifecycle import LifecycleNodeMixin, TransitionCallbackReturn

from fisheye_svp_ros.errors import FisheyeSvpError
from fisheye_svp_ros.nodes.base import BaseNode
from fisheye_svp_ros.study.settings import SolverSettings


class ManagedNode(LifecycleNodeMixin, BaseNode):  # type: ignore[misc]
    """A node that, with the parameter `lifecycle`, waits to be configured and activated.

    Without it nothing here makes a difference.
    """

    settings: SolverSettings

    def __init__(self, node_name: str | None = None, **options: Any) -> None:
        BaseNode.__init__(self, node_name, **options)
        self._active = not self.settings.lifecycle
        if self.settings.lifecycle:
            LifecycleNodeMixin.__init__(self)

    @property
    def listening(self) -> bool:
        """Whether the node is active."""
        return self._active

    def take_up(self) -> None:
        """Take the initial parameters into use, unless `on_configure` is to do it."""
        if not self.settings.lifecycle:
            super().take_up()

    def introduce(self) -> None:
        """Say what the node listens to, once it does."""
        if self._active:
            super().introduce()

    def has_listeners(self) -> bool:
        """Say whether there is anybody to work for; there is nobody for an inactive node."""
        return self._active and super().has_listeners()

    def on_configure(self, state: Any) -> Any:
        """Load the lens; the node stays unconfigured where that fails."""
        try:
            super().take_up()
        except FisheyeSvpError as error:
            self.get_logger().error(f'not configured: {error}')
            return TransitionCallbackReturn.FAILURE
        return super().on_configure(state)

    def on_activate(self, state: Any) -> Any:
        """Listen."""
        self._active = True
        for one in self._inputs.values():
            one.subscribe()
        self.introduce()
        return super().on_activate(state)

    def on_deactivate(self, state: Any) -> Any:
        """Listen no more."""
        self._fall_silent()
        return super().on_deactivate(state)

    def on_shutdown(self, state: Any) -> Any:
        """Listen no more, for good."""
        self._fall_silent()
        return super().on_shutdown(state)

    def _fall_silent(self) -> None:
        self._active = False
        for one in self._inputs.values():
            one.unsubscribe()
