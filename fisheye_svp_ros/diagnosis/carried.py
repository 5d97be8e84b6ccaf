"""What was found in one place, tried in another: by another camera, or in another data set."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.adjustment import fit
from fisheye_svp_ros.diagnosis.budget import stage_of
from fisheye_svp_ros.diagnosis.evidence import bare_evidence
from fisheye_svp_ros.diagnosis.model import Data, State
from fisheye_svp_ros.diagnosis.prediction import HeldOut, Less, frames_in_turn, less_between
from fisheye_svp_ros.diagnosis.refit import Fitted, local_offsets
from fisheye_svp_ros.diagnosis.reml import Variances
from fisheye_svp_ros.diagnosis.target_map import KnownTarget, at_landmarks
from fisheye_svp_ros.effects.forward import Term


@dataclass(frozen=True)
class Carried:
    """Frames of `to`, each left out in turn, without and with what was found in `source`.

    without_px, with_px: rms of the 2-D residual; less_px: by how much it is less, and its 95 %
    interval over frames.
    """

    source: str
    to: str
    without_px: float
    with_px: float
    less_px: Less

    @classmethod
    def of(cls, source: str, to: str, without: HeldOut, carried: HeldOut) -> Carried:
        """Compare two predictions of the same frames, those that the others can predict."""
        rows = without.predicted | carried.predicted
        without, carried = without.take(rows), carried.take(rows)
        return cls(source, to, without.rms, carried.rms, less_between(without, carried))

    def to_dict(self) -> dict[str, Any]:
        """Return what diagnosis.json holds."""
        return asdict(self) | {'less_px': self.less_px._asdict()}

    @property
    def better(self) -> bool:
        """Whether it predicts better beyond chance."""
        return self.less_px.low > 0

    @property
    def worse(self) -> bool:
        """Whether it predicts worse beyond chance."""
        return self.less_px.high < 0


def of_lens(term: Term) -> bool:
    """Whether an effect moves with the lens, from one recording and target to the next."""
    effect = term[0]
    return effect.stage != 'noise' and not effect.of_recording and stage_of(effect.name) == 'lens'


def of_target(term: Term) -> bool:
    """Whether an effect displaces landmarks."""
    return term[0].stage == 'target'


def names_of(terms: Sequence[Term]) -> list[str]:
    """Return the names of effects."""
    return [effect.name for effect, _ in terms]


def settled(
    data: Data, state: State, free: Sequence[str], held: Collection[str] = ()
) -> tuple[State, HeldOut]:
    """Fit by least squares, and predict frames left out in turn; held: effects left as they are.

    Nothing random: what was carried over is tried as whoever uses it would.
    """
    fitted = fit(data, state, free, held=held)
    return fitted, frames_in_turn(bare_evidence(data, fitted, free), held=held)


def of_landmarks(data: Data, variances: Variances, landmark: Index) -> Variances:
    """Return variances of landmarks (L,) for the landmarks of other data."""
    seen = np.unique(data.views.landmark[data.views.used])
    return replace(variances, weight=variances.weight[np.searchsorted(landmark, seen)])


def target_of(fitted: Fitted, known: KnownTarget) -> Array:
    """Return where a fit has the landmarks of a target, displacements (L, 3), m.

    Effects of the target and predicted offsets; those of landmarks it did not see are zero.
    """
    local = local_offsets(fitted)
    moved = known.moved(fitted.state.terms, fitted.state.lens)
    moved[np.searchsorted(known.landmark, local.landmark)] += local.offset
    return moved


def with_target(data: Data, known: KnownTarget, moved: Array) -> Data:
    """Return data with displaced landmarks."""
    points = data.views.points + at_landmarks(data.views, known.landmark, moved)
    return replace(data, views=data.views._replace(points=points))
