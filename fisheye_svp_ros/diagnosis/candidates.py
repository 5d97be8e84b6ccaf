"""The catalogue's effects in all forms that the data can hold, as columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.model import Linearised
from fisheye_svp_ros.effects.base import Effect, Untestable
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.effects.landmark_survey import LandmarkSurveyEffect
from fisheye_svp_ros.effects.session_step import SessionStepEffect

_GAPS = 4


@dataclass(frozen=True)
class Forms:
    """Effects in all their forms.

    effects: every form; at: the columns of each; columns (F, M, K), whitened; generic (K,): those
    of the richest forms; count: forms by name; untestable: why, by name.
    """

    effects: tuple[Effect, ...]
    at: tuple[slice, ...]
    columns: Array
    generic: Index
    count: dict[str, int]
    untestable: dict[str, str]

    def names(self) -> int:
        """Return how many effects are tested, single landmarks and causes without forms too."""
        return len(CATALOGUE) - len(self.untestable)


def forms_of(linear: Linearised, left_out: Sequence[str] = ()) -> Forms:
    """Return the columns of the catalogue, without the effects left out."""
    effects: list[Effect] = []
    richest: list[Effect] = []
    count: dict[str, int] = {}
    untestable: dict[str, str] = {}
    for name, kind in CATALOGUE.items():
        if kind.stage == 'noise' or name in left_out:
            continue
        try:
            forms = kind.candidates(linear.scene)
        except Untestable as why:
            untestable[name] = str(why)
            continue
        if name == LandmarkSurveyEffect.name:
            continue  # single landmarks are asked last, all at once
        effects += forms
        count[name] = len(forms)
        if name == SessionStepEffect.name:
            richest += _longest_pauses(linear, forms)
        else:
            richest.append(max(forms, key=lambda form: len(form.parameters)))
    at, start = [], 0
    for effect in effects:
        at.append(slice(start, start + len(effect.parameters)))
        start = at[-1].stop
    blocks = [linear.effect_columns(effect) for effect in effects]
    columns = np.concatenate([np.zeros((*linear.residual.shape, 0)), *blocks], axis=-1)
    generic = [np.arange(s.start, s.stop) for e, s in zip(effects, at, strict=True)
               if any(e is r for r in richest)]
    where = np.concatenate([np.zeros(0, dtype=np.int64), *generic])
    return Forms(tuple(effects), tuple(at), columns, where, count, untestable)


def _longest_pauses(linear: Linearised, steps: Sequence[Effect]) -> list[Effect]:
    """Return steps at the longest pauses between frames, where sessions are likely to change."""
    starts = np.array([step.starts[0] for step in steps if isinstance(step, SessionStepEffect)])
    pauses = np.diff(starts, prepend=starts[:1])
    return [steps[i] for i in np.sort(np.argsort(-pauses, kind='stable')[:_GAPS])]
