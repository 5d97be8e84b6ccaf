"""Fits of a flat port in front of a lens, and of a free lens curve that stands for anything."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fisheye_svp_ros.arrays import Array, flat_rows
from fisheye_svp_ros.effects.base import ModelTerm
from fisheye_svp_ros.effects.ray_effects import RadialProfileEffect
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.mixed_model import project_out, pseudo_inverse
from fisheye_svp_ros.optics.lens import INTRINSICS, Lens
from fisheye_svp_ros.optics.ports import MEDIA, FlatGlass
from fisheye_svp_ros.solve.bundle_adjustment import adjust
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.outliers import Outliers, find_outliers
from fisheye_svp_ros.solve.rig_state import Linearization, RigState, RigViews

PORT_PLACE = ('port_distance', 'port_tilt_x', 'port_tilt_y')
MEDIUM_INDEX, THICKNESS = 'port_medium_index', 'port_thickness'
LOST_PX = 5.0  # px: what leaves more explains nothing
_START_FRAMES = 12  # frames, enough for a start
CURVE_TERMS = 8  # of a free lens curve
_LIQUID_INDICES = (1.30, 1.56)  # refractive: of what one photographs through, water to oils
_MIN_KEPT_SHARE = 0.8  # of the points, at least, are no outliers behind a port that is there
_MAX_THICKNESS = 0.05  # m, of glass
_MAX_INDEX_ERROR = 0.02  # standard error above which the index is not told by the data


def start_port(data: RigViews, lens: Lens) -> Lens | None:
    """Return the lens with a port about where it is, fitted to a few frames."""
    chosen = np.linspace(0, data.frames - 1, min(_START_FRAMES, data.frames)).astype(int)
    few = data.select(np.isin(data.frame_of, chosen))
    tried: list[tuple[float, Lens]] = []
    for port in FlatGlass(0.0, MEDIA['water']).starts():
        try:
            state = adjust(few, initial_state(few, replace(lens, port=port)), PORT_PLACE)
        except GeometryError:
            continue  # nothing of a view is seen through a port there
        tried.append((Linearization(few, state, PORT_PLACE).sum_of_squares, state.lens))
    if not tried or not np.isfinite(min(cost for cost, _ in tried)):
        return None
    best = min(tried, key=lambda one: one[0])[1]
    return replace(lens, port=best.port)


def fit_port(
    everything: RigViews, wet: Lens
) -> tuple[RigViews, Outliers, RigState, tuple[str, ...]] | None:
    """Fit the place of a port; free the index where the data tell it.

    Returns also the data without the outliers that stand out behind the port: in air other
    points may have seemed to be some.
    """
    data, outliers = find_outliers(everything, initial_state(everything, wet))
    if data.views.used.sum() < _MIN_KEPT_SHARE * everything.views.used.sum():
        return None
    state = adjust(data, initial_state(data, wet), PORT_PLACE)
    if not np.isfinite(Linearization(data, state, ()).sum_of_squares):
        return None
    freed, errors, _ = _free_names(data, state, (*PORT_PLACE, MEDIUM_INDEX))
    names: tuple[str, ...] = PORT_PLACE
    liquid = _LIQUID_INDICES[0] <= freed.lens.parameters[MEDIUM_INDEX] <= _LIQUID_INDICES[1]
    if errors[-1] < _MAX_INDEX_ERROR and liquid:
        state, names = freed, (*PORT_PLACE, MEDIUM_INDEX)
    freed, errors, gain = _free_names(data, state, (*names, THICKNESS))
    # Glass of no thickness is part of the distance.
    has_glass = is_glass(freed.lens.parameters[THICKNESS])
    if has_glass and gain > np.log(2 * len(data.observations)):
        state, names = freed, (*names, THICKNESS)
    if Linearization(data, state, ()).rms_px > LOST_PX:
        return None
    return data, outliers, state, names


def is_glass(thickness: float) -> bool:
    """Whether a thickness, m, is one that glass has."""
    return 0 < thickness < _MAX_THICKNESS


def _free_names(
    data: RigViews, state: RigState, names: tuple[str, ...]
) -> tuple[RigState, Array, float]:
    """Fit named parameters; return their standard errors, and the last one's likelihood ratio."""
    freed = adjust(data, state, names)
    linear = Linearization(data, freed, names)
    flat = flat_rows(project_out(linear.shared_columns, linear.frame_columns))
    inverse = pseudo_inverse(flat.T @ flat, 1e-13)
    square = linear.sum_of_squares / int(linear.row_mask.sum())
    gain = (Linearization(data, state, ()).sum_of_squares - linear.sum_of_squares) / square
    return freed, np.sqrt(np.diag(inverse) * square), gain


def fit_free_curve(data: RigViews, base: RigState) -> RigState:
    """Return the fit of a lens curve and a center of any kind, in air."""
    theta = Linearization(data, base, ()).scene.theta_max
    terms = [t for t in base.terms if t.name != RadialProfileEffect.name]
    effect = RadialProfileEffect(CURVE_TERMS, round(theta, 6))
    free = replace(base, terms=(*terms, ModelTerm(effect, np.zeros(CURVE_TERMS))))
    return adjust(data, free, INTRINSICS)
