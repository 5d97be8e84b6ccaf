"""What a diagnosis has found so far, while it goes on, and what has become of it."""

from __future__ import annotations

from collections.abc import Sequence

from fisheye_svp_ros.diagnosis import Diagnosis
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.reporting.wording.causes import describe_effect
from fisheye_svp_ros.reporting.wording.findings import finding_reason


def provisional_headline(names: Sequence[str]) -> str:
    """Return the first of some causes as a headline, the others by name."""
    if not names:
        return 'Provisional: no model error found yet'
    first, *others = dict.fromkeys(names)
    words = CATALOGUE[first].headline or describe_effect(first)
    return f'Provisional: {words}' + (f' (also {", ".join(others)})' if others else '')


def what_changed(names: Sequence[str], d: Diagnosis) -> list[str]:
    """Return sentences: which causes were found since, and which are none after all."""
    final = [cause.effect for cause in d.causes]
    why = {step.effect: f' ({finding_reason(step)})' for step in (*d.trace, *d.candidates)}
    gone = [f'{name}{why.get(name, "")}' for name in dict.fromkeys(names) if name not in final]
    new = [name for name in dict.fromkeys(final) if name not in names]
    parts = [f'found: {", ".join(new)}'] if new else []
    parts += [f'not confirmed: {", ".join(gone)}'] if gone else []
    return [f'Since the provisional answer: {"; ".join(parts)}.'] if parts else []
