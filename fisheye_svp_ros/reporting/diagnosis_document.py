"""diagnosis.json: the facts of a diagnosis by key, with their sentences.

docs/reference/diagnosis.schema.json is generated from the keys here and the records that have
them: python docs/diagnosis_schema.py
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from enum import Enum
from math import degrees
from typing import Any

from fisheye_svp_ros.diagnosis import Decision, Diagnosis
from fisheye_svp_ros.reporting.wording.actions import photographs_words, target_words
from fisheye_svp_ros.reporting.wording.adequacy import flaw_document
from fisheye_svp_ros.reporting.wording.causes import finding_reason
from fisheye_svp_ros.reporting.wording.decisions import advised_action, decision_reason, separation
from fisheye_svp_ros.reporting.wording.headline import headline
from fisheye_svp_ros.reporting.wording.whats_wrong import wrong
from fisheye_svp_ros.scene.observations import photograph_names

Keys = Mapping[str, str | Callable[[Any], Any]]  # JSON key to attribute, or to what computes it


def _attributes(names: str) -> Keys:
    return {name: name for name in names.split()}


CAUSE: Keys = {
    **_attributes(
        'effect form parameters p_value probability status share survives heldout_rms_px'
    ),
    **_attributes('gain indistinguishable_from odds'),
    'to_separate': separation,
    'refuted_by_frames': 'refuted_by_frames',
}
CANDIDATE: Keys = {
    **_attributes('effect parameters'),
    'p_value': 'p_corrected',
    **_attributes('probability status'),
    'why': finding_reason,
}
STEP: Keys = {
    'effect': 'form',
    **_attributes('statistic rank p_value'),
    'corrected': 'p_corrected',
    **_attributes('held_out held_out_stderr'),
    'accepted': 'is_accepted',
    'why': finding_reason,
}
ADVICE: Keys = {
    'what': advised_action,
    **_attributes('frames photographs landmarks boards gain kind'),
}


def diagnosis_document(d: Diagnosis) -> dict[str, Any]:
    """Return what diagnosis.json holds (docs/reference/diagnosis_json.md)."""
    base, named, lens, extended = (
        {name: value for name, value in asdict(fit).items() if value is not None}
        for fit in d.figures[:4]
    )
    field = d.evaluation.written_field
    return {
        'verdict': d.verdict,
        'first_screen': {
            'headline': headline(d),
            'wrong': wrong(d),
            'target': target_words(d),
            'photographs': photographs_words(d),
        },
        'noise_px': d.noise_px,
        'frames': d.frames,
        'observations': d.observations,
        'base': base,
        'components': [part._asdict() for part in d.components],
        'causes': [_record_entry(cause, CAUSE) for cause in d.causes],
        'named': named,
        'lens': {
            **lens,
            'ray_error_mrad': d.ray_error_mrad(),
            **d.evaluation.averaged_model.to_dict(),
            **({} if field is None else {'image_field': field.to_dict()}),
        },
        'extended': extended,
        'file': d.file._asdict(),
        'candidates': [_record_entry(candidate, CANDIDATE) for candidate in d.candidates],
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
        'advice': [_record_entry(advice, ADVICE) for advice in d.advice],
        'remaining': {'structure': [s._asdict() for s in d.remaining]},
        'untestable': [{'effect': e, 'why': why} for e, why in d.untestable.items()],
        'gain': d.figures.gain.interval,
        'intrinsics': {name: asdict(value) for name, value in d.evaluation.intrinsics.items()},
        'uncertainty': d.evaluation.uncertainty,
        'trace': [_record_entry(finding, STEP) for finding in d.trace],
        **_external(d),
        'turned': [asdict(view) for view in d.turned],
        **({'hand_eye': d.hand_eye.to_dict()} if d.hand_eye else {}),
    }


def _record_entry(record: object, keys: Keys) -> dict[str, Any]:
    values = {
        key: getattr(record, source) if isinstance(source, str) else source(record)
        for key, source in keys.items()
    }
    return {key: v.value if isinstance(v, Enum) else v for key, v in values.items()}


def _decision(decision: Decision) -> dict[str, Any]:
    entry: dict[str, Any] = {
        'say': decision.say,
        'why': decision_reason(decision),
        'figure': decision.figure._asdict(),
        'confidence': decision.confidence,
    }
    if decision.bound:
        entry['bound'] = [asdict(bound) for bound in decision.bound]
    return entry


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
