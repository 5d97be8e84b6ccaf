"""Pinhole views of one center for programs that reconstruct scenes: COLMAP, nerfstudio.

Their images begin at 0, half a pixel before the center of the first one.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.pose import quaternion_from_rotation

_CORNER = 0.5  # px
_FLIP = np.diag([1.0, -1.0, -1.0])  # of OpenGL's camera: y up, z backwards


class ViewCamera(NamedTuple):
    """A view: its name, size (width, height), f, cx, cy, px; rotation (3, 3) from the camera."""

    name: str
    size: tuple[int, int]
    f: float
    cx: float
    cy: float
    rotation: Array

    @property
    def colmap_parameters(self) -> list[float]:
        """Parameters of COLMAP's PINHOLE: fx, fy, cx, cy."""
        return [self.f, self.f, self.cx + _CORNER, self.cy + _CORNER]


def colmap_cameras_text(views: Sequence[ViewCamera]) -> str:
    """Return cameras.txt of COLMAP, a camera for each view in turn."""
    rows = [
        f'{number} PINHOLE {view.size[0]} {view.size[1]} '
        + ' '.join(map(repr, view.colmap_parameters))
        for number, view in enumerate(views, start=1)
    ]
    return '\n'.join(['# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]', *rows, ''])


def colmap_rig_text(views: Sequence[ViewCamera]) -> str:
    """Return rig_config.json of COLMAP's rig_configurator; images are in a folder for each view.

    The first view is the reference; quaternions are w, x, y, z.
    """
    first = views[0].rotation
    cameras = []
    for view in views:
        x, y, z, w = quaternion_from_rotation(view.rotation @ first.T).tolist()
        place = (
            {'ref_sensor': True}
            if view is views[0]
            else {
                'cam_from_rig_rotation': [w, x, y, z],
                'cam_from_rig_translation': [0.0, 0.0, 0.0],
            }
        )
        cameras.append(
            {
                'image_prefix': f'{view.name}/',
                **place,
                'camera_model_name': 'PINHOLE',
                'camera_params': view.colmap_parameters,
            }
        )
    return json.dumps([{'cameras': cameras}], indent=4) + '\n'


def nerfstudio_text(frames: Sequence[tuple[ViewCamera, str, str]]) -> str:
    """Return transforms.json of nerfstudio; frames: views with paths of image and mask.

    Poses are those in the camera that took the photograph, x right, y up, z backwards.
    """
    entries: list[dict[str, Any]] = []
    for view, image, mask in frames:
        turned = np.eye(4)
        turned[:3, :3] = _FLIP @ view.rotation.T @ _FLIP
        entries.append(
            {
                'file_path': image,
                'mask_path': mask,
                'w': view.size[0],
                'h': view.size[1],
                'fl_x': view.f,
                'fl_y': view.f,
                'cx': view.cx + _CORNER,
                'cy': view.cy + _CORNER,
                'transform_matrix': turned.tolist(),
            }
        )
    return json.dumps({'camera_model': 'PINHOLE', 'frames': entries}, indent=4) + '\n'
