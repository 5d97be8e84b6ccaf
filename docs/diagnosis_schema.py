"""Writes diagnosis.schema.json from the entries and records of a diagnosis.

A test compares.  Run: python docs/diagnosis_schema.py
Types and keys are those of the code.  reference/diagnosis_meanings.json tells what each key
means, by its path or, for all of a name, by *.name; what lacks a meaning or its key is an error.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import is_dataclass
from enum import Enum
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    Any,
    Literal,
    NotRequired,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS.parent))

from fisheye_svp_ros.diagnosis import (  # noqa: E402
    Advice,
    Cause,
    EffectBound,
    Figure,
    FileFigure,
    Finding,
)
from fisheye_svp_ros.diagnosis.checks.turned_boards import TurnedFrame  # noqa: E402
from fisheye_svp_ros.diagnosis.evaluation import FitQuality, Intrinsic  # noqa: E402
from fisheye_svp_ros.diagnosis.variance_budget import Component, Structure  # noqa: E402
from fisheye_svp_ros.reporting.diagnosis_document import (  # noqa: E402
    ADVICE,
    CANDIDATE,
    CAUSE,
    STEP,
    Keys,
)

SCHEMA = DOCS / 'reference' / 'diagnosis.schema.json'
MEANINGS = DOCS / 'reference' / 'diagnosis_meanings.json'
Verdict = Literal['adequate', 'explained', 'partly_explained', 'unexplained']
Fields = dict[str, Any]


class Optional(Fields):
    """Keys of an object that may be absent."""


def _entry(kind: type, keys: Keys) -> Fields:
    """Return the types of an entry's keys: of a record's attributes, or of what computes them."""
    attributes = get_type_hints(kind)
    fields: Fields = {}
    for key, source in keys.items():
        if isinstance(source, str):
            known = attributes.get(source)
            fields[key] = known or get_type_hints(getattr(kind, source).fget)['return']
        else:
            fields[key] = get_type_hints(source)['return']
    if 'parameters' in fields:
        fields['parameters'] = dict[str, PARAMETER]  # type: ignore[valid-type]
    return fields


PARAMETER: Fields = {'value': float, 'stderr': float, 'unit': str}
AVERAGED: Fields = {
    'effect': str,
    'probability': float,
    'parameters': dict[str, PARAMETER],  # type: ignore[valid-type]
}
DECISION: Fields = {
    'say': str,
    'why': str,
    'figure': Figure,
    'confidence': float | None,
    'bound': NotRequired[list[EffectBound]],
}
FIELDS: Fields = {
    'verdict': Verdict,
    'first_screen': dict.fromkeys(('headline', 'wrong', 'target', 'photographs'), str),
    'noise_px': float,
    'frames': int,
    'observations': int,
    'base': FitQuality,
    'components': list[Component],
    'causes': [_entry(Cause, CAUSE)],
    'named': FitQuality,
    'lens': {
        'rms_px': float,
        'heldout_rms_px': float,
        'ray_error_mrad': dict,
        'averaged_effects': NotRequired[list[AVERAGED]],  # type: ignore[valid-type]
        'image_field': NotRequired[dict],
    },
    'extended': FitQuality,
    'file': FileFigure,
    'candidates': [_entry(Finding, CANDIDATE)],
    'decision': dict[str, DECISION],  # type: ignore[valid-type]
    'adequacy': [
        {
            'flaw': str,
            'size': float,
            'beside': float,
            'frames': list[list[int]],
            'photographs': list[list[str]],
            'camera': str,
            'why': str,
            'do': str,
        }
    ],
    'reached_deg': float,
    'photographs': list[dict],
    'gross': list[dict],
    'advice': [_entry(Advice, ADVICE)],
    'remaining': {'structure': list[Structure]},
    'untestable': [{'effect': str, 'why': str}],
    'gain': {'value': float, 'low': float, 'high': float},
    'intrinsics': dict[str, Intrinsic],
    'uncertainty': dict,
    'trace': [_entry(Finding, STEP)],
    'travel': Optional(given_px=float, extended_px=float),
    'external': NotRequired[dict],
    'turned': list[TurnedFrame],
    'hand_eye': Optional(
        camera_in_flange=NotRequired[dict],
        target_in_base=NotRequired[dict],
        camera_in_base=NotRequired[dict],
        target_in_flange=NotRequired[dict],
        odds=NotRequired[float],
        scale=float,
        covariance=list,
        noise_m=float,
        noise_rad=float,
        frames=int,
    ),
    'known_truth': NotRequired[dict],
    'next': NotRequired[list],
}
_NAMES: dict[Any, str] = {float: 'number', int: 'integer', str: 'string', bool: 'boolean'}


def schema() -> dict[str, Any]:
    """Return the JSON Schema of diagnosis.json."""
    meanings = json.loads(MEANINGS.read_text(encoding='utf-8'))
    used: set[str] = set()
    root = {
        '$schema': 'https://json-schema.org/draft/2020-12/schema',
        'title': 'diagnosis.json',
        'description': meanings[''],
        **_record(FIELDS, '', meanings, used),
    }
    if stale := set(meanings) - used - {''}:
        raise KeyError(f'{MEANINGS.name}: no such keys: {", ".join(sorted(stale))}')
    return root


def _record(fields: Fields, path: str, meanings: Mapping[str, str], used: set[str]) -> Fields:
    """Return the schema of an object with some keys."""
    properties, required = {}, []
    for name, kind in fields.items():
        where = f'{path}.{name}'.lstrip('.')
        known = where if where in meanings else f'*.{name}'
        used.add(known)
        properties[name] = {
            **_node(kind, where, meanings, used),
            'description': meanings[known],
        }
        if not _may_be_absent(kind):
            required.append(name)
    return {'type': 'object', 'required': required, 'properties': properties}


def _may_be_absent(kind: Any) -> bool:
    """Whether a key is left out where there is nothing to say."""
    if get_origin(kind) is NotRequired or isinstance(kind, Optional):
        return True
    return get_origin(kind) in (Union, UnionType) and NoneType in get_args(kind)


def _node(kind: Any, path: str, meanings: Mapping[str, str], used: set[str]) -> dict[str, Any]:
    """Return the schema of a type; a number that is not known is null."""
    origin, inside = get_origin(kind), get_args(kind)
    if origin is NotRequired:
        return _node(inside[0], path, meanings, used)
    if origin is Literal:
        return {'enum': list(inside)}
    if origin in (Union, UnionType):
        node = _node(inside[0], path, meanings, used)
        kinds = node['type'] if isinstance(node['type'], list) else [node['type']]
        return {**node, 'type': [*dict.fromkeys([*kinds, 'null'])]}
    if isinstance(kind, type) and issubclass(kind, Enum):
        return {'enum': [member.value for member in kind]}
    if isinstance(kind, dict):
        return _record(kind, path, meanings, used)
    if isinstance(kind, list):
        return {'type': 'array', 'items': _record(kind[0], path, meanings, used)}
    if origin is tuple:
        return {'type': 'array', 'items': _node(inside[0], path, meanings, used)}
    if origin in (list, Sequence):
        return {'type': 'array', 'items': _node(inside[0], path, meanings, used)}
    if origin in (dict, Mapping):
        item = _node(inside[1], f'{path}.NAME', meanings, used)
        return {'type': 'object', 'additionalProperties': item}
    if is_dataclass(kind) or hasattr(kind, '_fields'):
        fields = get_type_hints(kind)
        return _record(fields, path, meanings, used)
    if kind is float:
        return {'type': ['number', 'null']}
    return {'type': {dict: 'object', list: 'array', **_NAMES}[kind]}


def text() -> str:
    """Return the file."""
    return json.dumps(schema(), indent=2, ensure_ascii=False) + '\n'


if __name__ == '__main__':
    SCHEMA.write_text(text(), encoding='utf-8')
