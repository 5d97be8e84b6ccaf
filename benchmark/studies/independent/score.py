"""What was said about a blind set beside what is in it, by the words of the design."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

# What p-value of a component counts as found.
LEVEL = 0.01


def named_by(cause: Mapping[str, Any]) -> set[str]:
    """Return all effects of a cause's class: its own and those it cannot be told from."""
    alike = cause.get('indistinguishable_from') or []
    return {cause['effect'], *(a['effect'] if isinstance(a, Mapping) else a for a in alike)}


def score(truth: Mapping[str, Any], said: Mapping[str, Any]) -> dict[str, Any]:
    """Return the facts of one trial: what is hidden, said, found and false, verdict and stages."""
    hidden = [h['effect'] for h in truth['hidden']]
    causes = said.get('causes', [])
    classes = [named_by(cause) for cause in causes]
    components = [
        c
        for c in said.get('components', [])
        if c.get('stage') != 'noise' and (c.get('p_value') is None or c['p_value'] < LEVEL)
    ]
    strength: dict[str, float] = {}
    for component in components:
        stage = component['stage']
        strength[stage] = strength.get(stage, 0.0) + component['sd_px'] ** 2
    return {
        'hidden': [
            {
                key: h.get(key)
                for key in ('effect', 'size', 'amount', 'stage', 'oracle', 'oracle_finds')
            }
            for h in truth['hidden']
        ],
        'said': [cause['effect'] for cause in causes],
        'classes': [sorted(members) for members in classes],
        'p_values': [cause.get('p_value') for cause in causes],
        'found': [any(name in members for members in classes) for name in hidden],
        'exactly': [name in {cause['effect'] for cause in causes} for name in hidden],
        'false': [
            cause['effect']
            for cause, members in zip(causes, classes, strict=True)
            if not members & set(hidden)
        ],
        'verdict': said.get('verdict', 'failed'),
        'stages': strength,
        'stage_right': [stage_right(h['stage'], strength) for h in truth['hidden']]
        if 'components' in said
        else [],
        'rms': {
            key: (said.get(key) or {}).get('heldout_rms_px')
            for key in ('base', 'named', 'lens', 'extended')
        },
        'set': {
            key: truth[key]
            for key in (
                'noise_px',
                'target',
                'model',
                'fitted',
                'stereo',
                'moving',
                'frames',
                'observations',
                'background',
            )
        },
        'noise_px': said.get('noise_px'),
        'failed': said.get('failed'),
        'seconds': round(said['seconds'], 1),
    }


def stage_right(stage: str, strength: Mapping[str, float]) -> bool:
    """Return whether the strongest significant component sits where the effect does.

    An effect of the noise has no place but the noise: no other component stands out.
    """
    strongest = max(strength, key=lambda name: strength[name], default='noise')
    return strongest in stage.split(' or ')
