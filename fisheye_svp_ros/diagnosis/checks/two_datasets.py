"""Two data sets of one camera: what moves with the lens must agree, what stays with a board not.

The causes that one set calls for are tried on the other, which took no part in finding them, and
both are fitted with the causes of both.  A lens travels: what it predicts of another board, whose
landmarks are fitted anew, measures it better than the board that it was fitted on and bends to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from fisheye_svp_ros.diagnosis.checks.two_cameras import (
    Transfer,
    displace_target,
    displaces_landmarks,
    fit_and_predict,
    fitted_target,
    moves_with_lens,
    without_terms,
)
from fisheye_svp_ros.diagnosis.cross_validation import HeldOut
from fisheye_svp_ros.diagnosis.fitted_model import FittedModel, refit
from fisheye_svp_ros.diagnosis.null_model import NullModel
from fisheye_svp_ros.diagnosis.uncertainty import standard_errors
from fisheye_svp_ros.effects.base import ModelTerm
from fisheye_svp_ros.effects.target_effects import LandmarkSurveyEffect
from fisheye_svp_ros.effects.target_map import KnownTarget, less_similarity
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.optics.lens import INTRINSICS, Lens
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.rig_state import Linearization, RigState, RigViews, with_effect

_PLACE_TOLERANCE = 1e-6  # m: no two targets are told apart by less


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


class SharedParameter(NamedTuple):
    """One parameter of the lens by each set: values, standard errors, difference over its own."""

    value: float
    stderr: float
    other_value: float
    other_stderr: float
    unit: str

    @property
    def standardized_difference(self) -> float:
        """The difference over its standard error."""
        return (self.value - self.other_value) / float(np.hypot(self.stderr, self.other_stderr))


class DatasetModel(NamedTuple):
    """What was found of one data set: the simulation as it was fitted, and the extended model."""

    simulation: Linearization
    null: NullModel


@dataclass(frozen=True)
class TransferredCauses:
    """What of one set was tried on the other.

    lens: all causes that move with the lens, intrinsics fitted anew; whole: with the intrinsics
    as they are; causes: each of them, all others being there; target: what stays with the target,
    None where the other set shows other landmarks.
    """

    lens: Transfer
    whole: Transfer
    causes: dict[str, Transfer]
    target: Transfer | None


@dataclass(frozen=True)
class TwoDatasets:
    """What two data sets of one camera say of each other.

    tried: of this set on the other, and of the other on this; parameters: of the lens, by both,
    fitted with the causes of both; withdrawn: causes given up because the other set refutes them;
    travel: what the lenses of this set predict of the other.
    """

    source: str
    tried: tuple[TransferredCauses | None, TransferredCauses | None]
    parameters: dict[str, SharedParameter]
    withdrawn: tuple[str, ...] = ()
    travel: Travel | None = None

    @property
    def refuted_causes(self) -> list[str]:
        """The causes of this set without which the other is predicted better beyond chance."""
        return (
            []
            if self.tried[0] is None
            else [name for name, transfer in self.tried[0].causes.items() if transfer.worsens]
        )

    @property
    def verdict(self) -> str:
        """Whether the lens's causes hold: agree, contradict, undecided; nothing: there is none."""
        both = [transfer.lens for transfer in self.tried if transfer is not None]
        if not both:
            return 'nothing'
        if self.withdrawn or any(transfer.worsens for transfer in both):
            return 'contradict'
        return 'agree' if all(transfer.improves for transfer in both) else 'undecided'

    def to_dict(self) -> dict[str, Any]:
        """Return what diagnosis.json holds."""

        def entry(transfer: Transfer | None) -> dict[str, Any] | None:
            return None if transfer is None else transfer.to_dict()

        return {
            'against': self.source,
            'verdict': self.verdict,
            'withdrawn': list(self.withdrawn),
            'tried': [
                {
                    'lens': entry(transfer.lens),
                    'whole': entry(transfer.whole),
                    'target': entry(transfer.target),
                    'causes': {name: entry(cause) for name, cause in transfer.causes.items()},
                }
                for transfer in self.tried
                if transfer is not None
            ],
            'parameters': {
                name: parameter._asdict() | {'apart': parameter.standardized_difference}
                for name, parameter in self.parameters.items()
            },
        }


def compare_datasets(
    model: DatasetModel, other: DatasetModel, source: str, to: str
) -> TwoDatasets:
    """Return what two data sets of one camera say of each other."""
    return TwoDatasets(
        to,
        (_transfer_causes(model, other, source, to), _transfer_causes(other, model, to, source)),
        _parameters(model, other),
    )


def _transfer_causes(
    model: DatasetModel, other: DatasetModel, source: str, to: str
) -> TransferredCauses | None:
    """Try on another set what one found; None where it found nothing that moves with the lens."""
    carried = [term for term in model.null.linear.state.terms if moves_with_lens(term)]
    if not carried:
        return None
    data, free = other.null.linear.data, other.null.linear.free
    bare = without_terms(other.null.linear.state, moves_with_lens)

    def predict(
        terms: Sequence[ModelTerm], state: RigState = bare, free: Sequence[str] = free
    ) -> HeldOut:
        there = replace(state, terms=(*state.terms, *terms))
        return fit_and_predict(data, there, free, [term.name for term in terms])[1]

    without, there = predict(()), predict(carried)
    whole = (
        predict((), replace(bare, lens=model.simulation.state.lens), ()),
        predict(carried, replace(bare, lens=model.null.linear.state.lens), ()),
    )
    causes = {
        cause.name: Transfer.compare(
            source, to, predict([term for term in carried if term.name != cause.name]), there
        )
        for cause in carried
    }
    return TransferredCauses(
        Transfer.compare(source, to, without, there),
        Transfer.compare(source, to, *whole),
        causes,
        _transfer_target(model, other, source, to),
    )


def _transfer_target(
    model: DatasetModel, other: DatasetModel, source: str, to: str
) -> Transfer | None:
    """Try the target's corrections on the other set, if it shows landmarks of the same places."""
    known, there = (KnownTarget.from_views(d.null.linear.data.views) for d in (model, other))
    if not any(map(displaces_landmarks, model.null.linear.state.terms)) or not (
        np.array_equal(known.landmark, there.landmark)
        and np.abs(known.points - there.points).max() < _PLACE_TOLERANCE
    ):
        return None
    fitted = FittedModel.of_state(model.null.linear, model.null.variances)
    linear = other.null.linear
    state = without_terms(linear.state, displaces_landmarks)
    shift = less_similarity(known.points, fitted_target(fitted, known))
    _, without = fit_and_predict(linear.data, state, linear.free)
    _, carried = fit_and_predict(displace_target(linear.data, known, shift), state, linear.free)
    return Transfer.compare(source, to, without, carried)


def _parameters(model: DatasetModel, other: DatasetModel) -> dict[str, SharedParameter]:
    """Fit both sets with the causes of both and compare what is the lens's."""
    both = [_with_lens_effects(a, b) for a, b in ((model, other), (other, model))]
    shared: dict[str, SharedParameter] = {}
    first, second = (_estimates(d, state) for d, state in zip((model, other), both, strict=True))
    for name, (value, stderr, unit) in first.items():
        if name in second and np.isfinite([stderr, second[name][1]]).all():
            shared[name] = SharedParameter(value, stderr, *second[name][:2], unit)
    return shared


def _with_lens_effects(model: DatasetModel, other: DatasetModel) -> RigState:
    """Return the state with the other's causes of the lens as well, starting from nothing."""
    state = model.null.linear.state
    known = {term.name: len(term.values) for term in state.terms}
    for term in other.null.linear.state.terms:
        # Of two forms of one effect the one with more parameters.
        if moves_with_lens(term) and len(term.values) > known.get(term.name, 0):
            state = with_effect(state, term.effect, np.zeros_like(term.values))
    return state


def _estimates(model: DatasetModel, state: RigState) -> dict[str, tuple[float, float, str]]:
    """Return value, standard error and unit of the intrinsics and the lens's causes."""
    data, free, variances = model.null.linear.data, model.null.linear.free, model.null.variances
    state = refit(data, state, free, variances)
    null = NullModel.with_variances(data, state, free, variances)
    errors = standard_errors(null)
    rig = null.column_count - len(free) - sum(len(term.values) for term in null.terms)
    estimates = {
        name: (state.parameters[name], float(errors[rig + i]), 'px' if name in INTRINSICS else '')
        for i, name in enumerate(free)
    }
    for term in filter(moves_with_lens, null.terms):
        estimates |= {
            f'{term.name}.{p.name}': (float(v), float(e), p.unit)
            for p, v, e in zip(
                term.effect.parameters, term.values, errors[term.columns], strict=True
            )
        }
    return estimates
