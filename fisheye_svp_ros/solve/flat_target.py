"""Flat targets seen small: tilted to one side they look like tilted to the other.

The misfit has a minimum on either side and a start may lead to the wrong one (Schweighofer and
Pinz, PAMI 2006; Collins and Bartoli, IJCV 2014).
"""

from __future__ import annotations

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Views
from fisheye_svp_ros.solve.localization import Localization, localize

_FLAT = 0.1  # thickness of a target relative to its length


def localize_both_sides(
    model: ForwardModel, views: Views, start: Pose | None = None
) -> Localization:
    """Return the better of the poses that the starts (S,) and their reflections lead to.

    No start value is needed.  Raises GeometryError as `localize` does.
    """
    found = localize(model, views, start)
    centre, spread = _moments(views)
    extent, axes = np.linalg.eigh(spread)
    flat = np.flatnonzero(extent[:, 0] < _FLAT**2 * extent[:, 2])
    if not flat.size:
        return found
    reflected = _reflected(found.pose.take(flat), centre[flat], axes[flat, :, 0])
    other = localize(model, views.take(flat), reflected)
    better = other.cost < found.cost[flat]
    rows = flat[better]
    for old, new in zip((*found.pose, *found[1:]), (*other.pose, *other[1:]), strict=True):
        old[rows] = new[better]
    return found


def _moments(views: Views) -> tuple[Array, Array]:
    """Return centres (S, 3) and spread (S, 3, 3) of the weighted points."""
    weight = views.weight[:, None]
    centre = weight @ views.points / weight.sum(axis=2, keepdims=True)
    centred = views.points - centre
    return centre[:, 0], (np.swapaxes(centred, -1, -2) * weight) @ centred


def _reflected(pose: Pose, centre: Array, normal: Array) -> Pose:
    """Reflect the target, flat across `normal` (S, 3), by the plane across its line of sight."""
    sight = pose.inverse().transform(centre)
    along = sight / np.maximum(np.linalg.norm(sight, axis=-1, keepdims=True), 1e-12)
    to_camera = _mirror(along) @ np.swapaxes(pose.rotation, -1, -2) @ _mirror(normal)
    rotation = np.swapaxes(to_camera, -1, -2)
    return Pose(rotation, centre - (rotation @ sight[..., None])[..., 0])


def _mirror(normal: Array) -> Array:
    mirror: Array = np.eye(3) - 2 * normal[..., :, None] * normal[..., None, :]
    return mirror
