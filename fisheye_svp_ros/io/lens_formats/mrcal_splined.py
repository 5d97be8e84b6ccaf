"""LENSMODEL_SPLINED_STEREOGRAPHIC of mrcal: a stereographic lens with an image field.

q = f (w + d(w)) + c, where w = 2 tan(theta / 2) (cos phi, sin phi) and d is a tensor product of
uniform cubic B-splines: that of `optics.image_field`, over the focal length.
Source: documentation of mrcal 2.2, lens models.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.forward import back_project
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.optics.curves import Stereographic
from fisheye_svp_ros.optics.image_field import MAX_NODES, MIN_NODES, ImageField
from fisheye_svp_ros.optics.lens import Lens

NAME = 'LENSMODEL_SPLINED_STEREOGRAPHIC'
_CONFIGURATION = re.compile(NAME + r'_order=(\d+)_Nx=(\d+)_Ny=(\d+)_fov_x_deg=(\d+)$')
_MARGIN_NODES = 3  # nodes that lie outside the field, along an axis
_NODES = (24, 36, 54, 80)  # along x that are tried
_SAMPLES = 4  # along each axis for a node
_TOLERANCE = 0.01  # px
_RIDGE = 1e-11  # of the weight of a sample: for nodes that none calls for


def read(model: str, values: Sequence[float], size: Sequence[int], where: str) -> Lens:
    """Return the lens; raise LensError, naming `where`, for one that is incomplete."""
    match = _CONFIGURATION.match(model)
    if match is None or match[1] != '3':
        raise LensError(f'{where}: {model} cannot be read; its splines must be of order 3')
    columns, rows, degrees = (int(match[i]) for i in (2, 3, 4))
    if not (min(rows, columns) >= MIN_NODES and max(rows, columns) <= MAX_NODES
            and 0 < degrees < 360 and len(values) == 4 + 2 * rows * columns):
        raise LensError(f'{where}: {model} with {len(values)} values; it needs '
                        f'{4 + 2 * rows * columns}')
    focal, centre = np.array(values[:2]), np.array(values[2:4])
    pitch = focal * _spacing(columns, degrees)
    low = centre - pitch * (np.array([columns, rows]) - 1) / 2
    field = ImageField(low, pitch, focal * np.reshape(values[4:], (rows, columns, 2)))
    # The spline holds between the second node and the last but one.
    steps = (np.arange(1.0, count - 1.75, 0.25) for count in (columns, rows))
    ideal = low + pitch * np.stack(np.meshgrid(*steps), axis=-1)
    shown = ((np.abs(field.apply(ideal) + 0.5 - np.array(size) / 2) <= np.array(size) / 2)
             .all(axis=-1))
    if not shown.any():
        raise LensError(f'{where}: {model}: no point of it is in the image')
    reach = np.linalg.norm((ideal[shown] - centre) / focal, axis=-1).max()
    theta = float(Stereographic().angle(np.asarray(reach)))
    fx, fy, cx, cy = values[:4]
    lens = Lens('camera', size[0], size[1], fx, fy, cx, cy, Stereographic(), theta,
                image_field=field)
    if wrong := lens.check():
        raise LensError(f'{where}: {wrong}')
    return lens


def fit_model(lens: Lens) -> tuple[str, list[float]]:
    """Return model and intrinsics of the nearest splined lens; raise LensError above 0.01 px."""
    worst = np.inf
    for columns in _NODES:
        model, field, worst = _fit_nodes(replace(lens, target={}), columns)
        if worst < _TOLERANCE:
            focal = [lens.fx, lens.fy]
            return model, [*focal, lens.cx, lens.cy, *(field.values / focal).ravel().tolist()]
    raise LensError(f'lens {lens.name!r}: its image is {worst:.2g} px from any splined model of '
                    f'{_NODES[-1]} nodes')


def _fit_nodes(lens: Lens, columns: int) -> tuple[str, ImageField, float]:
    """Return the name of a model of so many columns of nodes, its field, its worst error, px."""
    from scipy import sparse
    from scipy.sparse.linalg import splu

    count = _SAMPLES * columns
    uv = np.stack(np.meshgrid(np.linspace(0, lens.width - 1, count),
                              np.linspace(0, lens.height - 1, count)), axis=-1).reshape(-1, 2)
    rays = back_project(lens, uv)
    uv, way = uv[rays.valid], rays.direction[rays.valid]
    # tan(theta / 2) = sin / (1 + cos)
    plane = 2 * way[:, :2] / (1 + way[:, 2:])
    edge = np.abs(plane).max(axis=0)
    degrees = int(np.ceil(np.degrees(4 * np.arctan(edge[0] / 2))))
    if degrees >= 360:
        raise LensError(f'lens {lens.name!r}: a splined model cannot reach its max_incidence_deg, '
                        'so far behind the camera')
    spacing = _spacing(columns, degrees)
    rows = int(np.ceil(2 * edge[1] / spacing)) + _MARGIN_NODES
    focal, centre = np.array([lens.fx, lens.fy]), np.array([lens.cx, lens.cy])
    low = centre - focal * spacing * (np.array([columns, rows]) - 1) / 2
    empty = ImageField(low, focal * spacing, np.zeros((rows, columns, 2)))
    ideal = focal * plane + centre
    weight, node = empty.weights(ideal)
    design: Any = sparse.csr_array(
        (weight.ravel(), (np.repeat(np.arange(len(uv)), weight.shape[1]), node.ravel())),
        (len(uv), rows * columns))
    normal = design.T @ design + _RIDGE * sparse.csr_array(sparse.eye(rows * columns))
    values: Array = splu(normal.tocsc()).solve(design.T @ (uv - ideal))
    field = replace(empty, values=values.reshape(rows, columns, 2))
    worst = float(np.linalg.norm(field.apply(ideal) - uv, axis=-1).max())
    return f'{NAME}_order=3_Nx={columns}_Ny={rows}_fov_x_deg={degrees}', field, worst


def _spacing(columns: int, degrees: float) -> float:
    """Return the distance of neighboring nodes for unit focal length."""
    return float(4 * np.tan(np.radians(degrees) / 4) / (columns - _MARGIN_NODES))
