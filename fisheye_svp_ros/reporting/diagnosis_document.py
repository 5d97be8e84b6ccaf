"""diagnosis.json: facts of a diagnosis by the keys of the design, with their sentences.

docs/reference/diagnosis.schema.json is generated from the entries here and the records that they
hold: python docs/diagnosis_schema.py
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from math import degrees
from typing import Annotated, Any, NotRequired, TypedDict

from fisheye_svp_ros.diagnosis import (
    Advice,
    Cause,
    Decision,
    Diagnosis,
    EffectBound,
    Figure,
    Finding,
    Status,
)
from fisheye_svp_ros.reporting.wording.adequacy import flaw_document
from fisheye_svp_ros.reporting.wording.causes import finding_reason
from fisheye_svp_ros.reporting.wording.decisions import advised_action, decision_reason, separation
from fisheye_svp_ros.scene.observations import photograph_names


class Parameter(TypedDict):
    """An estimate."""

    value: float
    stderr: float
    unit: str


Parameters = Annotated[Mapping[str, Any], dict[str, Parameter]]  # what the schema says of it
StatusName = Annotated[str, Status]


class CauseEntry(TypedDict):
    """A cause."""

    effect: str
    form: str
    parameters: Parameters
    p_value: float
    probability: float
    status: StatusName
    share: float
    survives: bool
    heldout_rms_px: float
    gain: float
    indistinguishable_from: list[str]
    odds: dict[str, float]
    to_separate: str
    refuted_by_frames: Sequence[tuple[int, int]]


class CandidateEntry(TypedDict):
    """An effect that is not confirmed."""

    effect: str
    parameters: Parameters
    p_value: float
    probability: float
    status: StatusName
    why: str


class StepEntry(TypedDict):
    """What was tried in the selection."""

    effect: str
    statistic: float
    rank: int
    p_value: float
    corrected: float
    held_out: float
    held_out_stderr: float
    accepted: bool
    why: str


class AdviceEntry(TypedDict):
    """What to do."""

    what: str
    frames: list[int]
    photographs: list[str]
    landmarks: list[int]
    boards: list[int]
    gain: float
    kind: str


class DecisionEntry(TypedDict):
    """What to do about lens, target or photographs."""

    say: str
    why: str
    figure: Annotated[Mapping[str, Any], Figure]
    confidence: float | None
    bound: NotRequired[Annotated[list[dict[str, Any]], list[EffectBound]]]


def diagnosis_document(d: Diagnosis) -> dict[str, Any]:
    """Return what diagnosis.json holds (docs/reference/diagnosis_json.md)."""
    base, named, lens, extended = (
        {name: value for name, value in asdict(fit).items() if value is not None}
        for fit in d.figures[:4]
    )
    field = d.evaluation.written_field
    return {
        'verdict': d.verdict,
        'noise_px': d.noise_px,
        'frames': d.frames,
        'observations': d.observations,
        'base': base,
        'components': [part._asdict() for part in d.components],
        'causes': [_cause(cause) for cause in d.causes],
        'named': named,
        'lens': {
            **lens,
            'ray_error_mrad': d.ray_error_mrad(),
            **d.evaluation.averaged_model.to_dict(),
            **({} if field is None else {'image_field': field.to_dict()}),
        },
        'extended': extended,
        'file': d.file._asdict(),
        'candidates': [_candidate(candidate) for candidate in d.candidates],
        'decision': {about: _decision(decision) for about, decision in d.decision.items()},
        'adequacy': [flaw_document(flaw) for flaw in d.adequacy.flaws],
        'reached_deg': degrees(d.adequacy.reached),
        'photographs': [
            {'frame': frame, 'camera': camera, 'name': name}
            for (frame, camera), name in photograph_names(
                d.evaluation.problem.observations
            ).items()
        ],
        'gross': d.gross,
        'advice': [_advice(advice) for advice in d.advice],
        'remaining': {'structure': [s._asdict() for s in d.remaining]},
        'untestable': [{'effect': e, 'why': why} for e, why in d.untestable.items()],
        'gain': d.figures.gain.interval,
        'intrinsics': {name: asdict(value) for name, value in d.evaluation.intrinsics.items()},
        'uncertainty': d.evaluation.uncertainty,
        'trace': [_step(finding) for finding in d.trace],
        **_external(d),
        'turned': [asdict(view) for view in d.turned],
        **({'hand_eye': d.hand_eye.to_dict()} if d.hand_eye else {}),
    }


def _decision(decision: Decision) -> DecisionEntry:
    entry: DecisionEntry = {
        'say': decision.say,
        'why': decision_reason(decision),
        'figure': decision.figure._asdict(),
        'confidence': decision.confidence,
    }
    if decision.bound:
        entry['bound'] = [asdict(bound) for bound in decision.bound]
    return entry


def _cause(cause: Cause) -> CauseEntry:
    return {
        'effect': cause.effect,
        'form': cause.form,
        'parameters': cause.parameters,
        'p_value': cause.p_value,
        'probability': cause.probability,
        'status': cause.status.value,
        'share': cause.share,
        'survives': cause.survives,
        'heldout_rms_px': cause.heldout_rms_px,
        'gain': cause.gain,
        'indistinguishable_from': cause.indistinguishable_from,
        'odds': dict(cause.odds),
        'to_separate': separation(cause),
        'refuted_by_frames': cause.refuted_by_frames,
    }


def _advice(advice: Advice) -> AdviceEntry:
    return {
        'what': advised_action(advice),
        'frames': advice.frames,
        'photographs': advice.photographs,
        'landmarks': advice.landmarks,
        'boards': advice.boards,
        'gain': advice.gain,
        'kind': advice.kind,
    }


def _candidate(candidate: Finding) -> CandidateEntry:
    return {
        'effect': candidate.effect,
        'parameters': candidate.parameters,
        'p_value': candidate.p_corrected,
        'probability': candidate.probability,
        'status': candidate.status.value,
        'why': finding_reason(candidate),
    }


def _step(finding: Finding) -> StepEntry:
    return {
        'effect': finding.form,
        'statistic': finding.statistic,
        'rank': finding.rank,
        'p_value': finding.p_value,
        'corrected': finding.p_corrected,
        'held_out': finding.held_out,
        'held_out_stderr': finding.held_out_stderr,
        'accepted': finding.is_accepted,
        'why': finding_reason(finding),
    }


def _external(d: Diagnosis) -> dict[str, Any]:
    external: dict[str, Any] = {}
    if d.cameras:
        external['cameras'] = [pair.to_dict() for pair in d.cameras]
    if d.against is not None:
        external['sets'] = d.against.to_dict()
    travel = d.against and d.against.travel
    return {
        **({'travel': travel._asdict()} if travel else {}),
        **({'external': external} if external else {}),
    }
