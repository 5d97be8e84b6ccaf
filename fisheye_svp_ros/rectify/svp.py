"""The single-viewpoint lens nearest to a lens whose viewpoint moves, for points at a range."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import LensError, ParameterError
from fisheye_svp_ros.optics import camera
from fisheye_svp_ros.optics.camera import unique_range
from fisheye_svp_ros.optics.curves import kannala_brandt_equivalent
from fisheye_svp_ros.optics.lens import Lens, curve_limit
from fisheye_svp_ros.rectify.maps import meet_sphere

_SAMPLES = 60  # along the longer side of the image
_MOST_STEPS = 50
_TOLERANCE = 1e-7  # px


def svp_equivalent(lens: Lens) -> Lens:
    """Return the Kannala-Brandt lens that an SVP user would be given, extended curves included."""
    return kannala_brandt_equivalent(ForwardModel(lens).lens)


def nearest_svp_lens(lens: Lens, range_m: float) -> tuple[Lens, float]:
    """Return the Kannala-Brandt lens nearest to a lens at a range, m, and its worst error, px.

    Nearest in the least squares of image points, all over the image; range: from the origin of the
    camera.  What the lens has of corrections and a port is in it as far as it can be.
    Raises ParameterError for a range at which the lens has no image, LensError where no such lens
    comes near.
    """
    if not range_m > (nearest := unique_range(lens)):
        raise ParameterError(f'range is {range_m:g} m; lens {lens.name!r} needs more than '
                             f'{nearest:.3g} m')
    step = max(lens.width, lens.height) / _SAMPLES
    uv = np.stack(np.meshgrid(np.arange(0.0, lens.width, step), np.arange(0.0, lens.height, step)),
                  axis=-1).reshape(-1, 2)
    model = ForwardModel(replace(lens, target={})).without_motion()
    rays = model.back_project(uv[None]).reshape((len(uv),))
    uv, origin, direction = uv[rays.valid], rays.origin[rays.valid], rays.direction[rays.valid]
    points = meet_sphere(origin, direction, np.zeros(3), range_m)
    square = lens.fx == lens.fy and not lens.corrections and lens.is_bare
    names = (*(('f',) if square else ('fx', 'fy')), 'cx', 'cy', 'k1', 'k2', 'k3', 'k4')
    found = _fit_parameters(svp_equivalent(lens), names, points, uv)
    reach = float(np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2]).max())
    off = np.linalg.norm(camera.project(found, points, limited=False).uv - uv, axis=-1)
    if reach > curve_limit(found):
        raise LensError(f'lens {lens.name!r}: no Kannala-Brandt curve grows to the edge of its '
                        'image at this range; lower its max_incidence_deg')
    return replace(found, max_incidence=reach), float(off.max())


def _fit_parameters(start: Lens, names: tuple[str, ...], points: Array, uv: Array) -> Lens:
    """Return the lens with some parameters fitted to image points (N, 2) of points (N, 3)."""
    found = start
    for _ in range(_MOST_STEPS):
        image = camera.LinearImage(found, points, False, *camera.project(found, points, False),
                                   np.empty((len(points), 2, 3)))
        columns = camera.lens_columns(found, image, names).reshape(-1, len(names))
        size = np.linalg.norm(columns, axis=0)
        residual = (uv - image.uv).ravel()
        change = np.linalg.lstsq(columns / size, residual, rcond=None)[0]
        moved = columns @ (change / size)
        values = [found.fx if name == 'f' else found.parameters[name] for name in names]
        found = found.with_parameters(names, values + change / size)
        if np.abs(moved).max() < _TOLERANCE:
            break
    return found
