"""The catalogue's effects in all forms that the data can hold, as columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.cameras import RigScene
from fisheye_svp_ros.diagnosis.model import Linearised
from fisheye_svp_ros.effects.base import Effect, Scene, Untestable
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.effects.landmark_survey import LandmarkSurveyEffect
from fisheye_svp_ros.effects.of_cameras import OfCameras, by_camera
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
            by_lens = _forms(kind, linear.scene, linear.state.labels)
        except Untestable as why:
            untestable[name] = str(why)
            continue
        forms = [form for own in by_lens for form in own]
        if name == LandmarkSurveyEffect.name:
            continue  # single landmarks are asked last, all at once
        effects += forms
        count[name] = len(forms)
        for own in by_lens:
            if name == SessionStepEffect.name:
                richest += _longest_pauses(own)
            else:
                richest.append(max(own, key=lambda form: len(form.parameters)))
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


def _forms(
    kind: type[Effect], scene: Scene, labels: Sequence[str]
) -> list[Sequence[Effect]]:
    """Return the forms of an effect; what a lens has, each lens of a rig has for itself.

    Raises Untestable where there is none.
    """
    of_lens = kind.stage in ('ray', 'image', 'detector') and not kind.of_target
    if not isinstance(scene, RigScene) or not of_lens:
        return [kind.candidates(scene)]
    found: list[Sequence[Effect]] = []
    reason = Untestable('no camera sees anything')
    for _, camera, own in scene.parts:
        try:
            found.append(by_camera(camera, labels[camera], kind.candidates(own)))
        except Untestable as why:
            reason = why
    if not found:
        raise reason
    return found


def _longest_pauses(steps: Sequence[Effect]) -> list[Effect]:
    """Return steps at the longest pauses between frames, where sessions are likely to change."""
    plain = [step.parts[0][2] if isinstance(step, OfCameras) else step for step in steps]
    starts = np.array([step.starts[0] for step in plain if isinstance(step, SessionStepEffect)])
    pauses = np.diff(starts, prepend=starts[:1])
    return [steps[i] for i in np.sort(np.argsort(-pauses, kind='stable')[:_GAPS])]
