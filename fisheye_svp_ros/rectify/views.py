"""Views of a lens that sees more than a plane image holds: pinhole cameras turned at its origin.

A view looks along (cos p sin y, -sin p, cos p cos y) of the camera frame: yaw y to the right,
pitch p upwards, without roll.  The views of one lens have one center, its origin.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import rotation_from_vector
from fisheye_svp_ros.rectify.cameras import camera_for
from fisheye_svp_ros.rectify.maps import Rectification

# Faces of a cube by yaw and pitch, degrees
_FACES = {
    'front': (0, 0),
    'right': (90, 0),
    'back': (180, 0),
    'left': (-90, 0),
    'up': (0, 90),
    'down': (0, -90),
}
_QUARTER = np.pi / 2


class View(NamedTuple):
    """A name, the rotation (3, 3) from the camera to the view, its field of view, rad."""

    name: str
    rotation: Array
    field_of_view: float


def perspective_view(yaw: float, pitch: float, field_of_view: float, name: str = '') -> View:
    """Return the view of angles, rad; by default it is called by them, in degrees."""
    turn = rotation_from_vector(np.array([0.0, yaw, 0.0]))
    raised = rotation_from_vector(np.array([pitch, 0.0, 0.0]))
    known = name or f'yaw{np.degrees(yaw):.6g}_pitch{np.degrees(pitch):.6g}'
    return View(known, np.asarray((turn @ raised).T), field_of_view)


def cube_views(field_of_view: float = _QUARTER) -> list[View]:
    """Return the faces of a cube; with more than 90 degrees they overlap."""
    return [
        perspective_view(float(np.radians(yaw)), float(np.radians(pitch)), field_of_view, name)
        for name, (yaw, pitch) in _FACES.items()
    ]


def face_size(lens: Lens) -> tuple[int, int]:
    """Return width and height, px, of a face of 90 degrees as fine as the image at its middle."""
    side = 2 * max(round(lens.focal), 1)
    return side, side


def rectify_views(
    lens: Lens, views: Sequence[View], size: tuple[int, int] | None, range_m: float
) -> dict[str, Rectification]:
    """Return what maps photographs to the views by name, without those that the lens never sees.

    size: width, height, px, by default those of the lens.
    Raises ParameterError for two views of one name, for a field of view that no plane image has,
    and where the lens sees none of them.
    """
    names = [view.name for view in views]
    if twice := next((name for name in names if names.count(name) > 1), ''):
        raise ParameterError(f'two views are called {twice}; give each yaw and pitch once')
    sides = {
        view.name: Rectification(
            lens, camera_for([lens], 'pinhole', size, view.field_of_view), range_m, view.rotation
        )
        for view in views
    }
    seen = {name: side for name, side in sides.items() if side.maps.mask.any()}
    if not seen:
        raise ParameterError(
            f'lens {lens.name!r} sees up to {np.degrees(lens.max_incidence):.0f} deg off its '
            f'axis, and nothing of {", ".join(names)}'
        )
    return seen
