"""How a lens travels: what it predicts of another board, whose landmarks are fitted anew.

The board that a lens was fitted on is no measure of it, for the lens bends to that board's errors.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.diagnosis.checks.two_cameras import fit_and_predict
from fisheye_svp_ros.diagnosis.cross_validation import HeldOut
from fisheye_svp_ros.effects.target_effects import LandmarkSurveyEffect
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.rig_state import RigViews, with_effect


class Travel(NamedTuple):
    """Rms of the 2-D residual on another board, px, by the lens as given and the extended one."""

    given_px: float
    extended_px: float


def predict_board(data: RigViews, lens: Lens) -> HeldOut:
    """Predict the frames of one camera, each left out one by one, by a lens that stays as it is.

    Places of the landmarks are fitted to the other frames, poses to each frame, by least squares.
    Raises GeometryError where the lens cannot image all points.
    """
    state = initial_state(data, replace(lens, target={}))
    # In px every point counts alike, however noisy it is.
    terms = tuple(term for term in state.terms if term.effect.stage != 'noise')
    landmarks = np.unique(data.views.landmark[data.views.used]).tolist()
    free = LandmarkSurveyEffect(tuple(landmarks), everywhere=True)
    state = with_effect(replace(state, terms=terms), free)
    return fit_and_predict(data, state, (), [term.name for term in terms])[1]


def measure_travel(data: RigViews, given: Lens, extended: Lens) -> Travel:
    """Return how two lenses predict another board, from frames that either of them predicts.

    NaN for a lens that cannot image all of its points.
    """
    held = [_predict_if_seen(data, lens) for lens in (given, extended)]
    rows = held[0].is_predictable | held[1].is_predictable
    return Travel(*(prediction.take(rows).rms if rows.any() else np.nan for prediction in held))


def _predict_if_seen(data: RigViews, lens: Lens) -> HeldOut:
    try:
        return predict_board(data, lens)
    except GeometryError:
        return HeldOut(np.full(data.frames, np.nan), np.ones(data.frames))
