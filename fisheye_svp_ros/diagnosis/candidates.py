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
from fisheye_svp_ros.effects.of_cameras import OfCameras, by_camera, together
from fisheye_svp_ros.effects.session_step import SessionStepEffect

_GAPS = 4


@dataclass(frozen=True)
class Forms:
    """Effects in all their forms.

    effects: every form; at: the columns of each (a form of several cameras has those of each);
    columns (F, M, K), whitened; generic (K,): those of the richest forms, of equals all; count:
    forms by name; untestable: why, by name.
    """

    effects: tuple[Effect, ...]
    at: tuple[Index, ...]
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
            by_lens = _forms(kind, linear)
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
            elif lasting := [form for form in own if not form.per_frame]:
                # What every frame has anew would take up the frames' own variance.
                most = max(len(form.parameters) for form in lasting)
                richest += [form for form in lasting if len(form.parameters) == most]
    ends = np.cumsum([0, *(len(effect.parameters) for effect in effects)])
    at = [np.arange(*ends[i : i + 2]) for i in range(len(effects))]
    blocks = [linear.effect_columns(effect) for effect in effects]
    columns = np.concatenate([np.zeros((*linear.residual.shape, 0)), *blocks], axis=-1)
    generic = [own for e, own in zip(effects, at, strict=True) if any(e is r for r in richest)]
    where = np.concatenate([np.zeros(0, dtype=np.int64), *generic])
    for both, theirs in _of_all_cameras(effects, at, linear.data.cameras):
        effects.append(both)
        at.append(theirs)
        count[both.name] += 1
    return Forms(tuple(effects), tuple(at), columns, where, count, untestable)


def simplest_form(kind: type[Effect], linear: Linearised) -> Effect:
    """Return the simplest form of an effect, of every camera of a rig where lenses have it.

    Raises Untestable where there is none.
    """
    first = [forms[0] for forms in _forms(kind, linear)]
    own = [effect for effect in first if isinstance(effect, OfCameras)]
    return together(own) if own else first[0]


def _forms(kind: type[Effect], linear: Linearised) -> list[Sequence[Effect]]:
    """Return the forms of an effect; what a lens has, each lens of a rig has for itself.

    Raises Untestable where there is none.
    """
    scene, labels = linear.scene, linear.state.labels
    of_lens = kind.stage in ('ray', 'image', 'detector') and not kind.of_target
    if not isinstance(scene, RigScene) or not of_lens:
        return [_asked(kind, scene, linear.free)]
    found: list[Sequence[Effect]] = []
    reason = Untestable('no camera sees anything')
    for _, camera, own in scene.parts:
        try:
            found.append(by_camera(camera, labels[camera], _asked(kind, own, linear.free)))
        except Untestable as why:
            reason = why
    if not found:
        raise reason
    return found


def _asked(kind: type[Effect], scene: Scene, free: Sequence[str]) -> Sequence[Effect]:
    forms = kind.candidates(scene)
    return [form.beside_intrinsics(scene) for form in forms] if free else forms


def _of_all_cameras(
    effects: Sequence[Effect], at: Sequence[Index], cameras: int
) -> list[tuple[Effect, Index]]:
    """Return forms that every camera of a rig has alike, with the columns of each camera's own.

    What lenses of one kind have in common they show together before one of them shows it.
    """
    alike: dict[str, list[tuple[OfCameras, Index]]] = {}
    for effect, own in zip(effects, at, strict=True):
        if isinstance(effect, OfCameras):
            alike.setdefault(effect.parts[0][2].key, []).append((effect, own))
    return [
        (together([effect for effect, _ in forms]), np.concatenate([own for _, own in forms]))
        for forms in alike.values() if len(forms) == cameras
    ]


def _longest_pauses(steps: Sequence[Effect]) -> list[Effect]:
    """Return steps at the longest pauses between frames, where sessions are likely to change."""
    plain = [step.parts[0][2] if isinstance(step, OfCameras) else step for step in steps]
    starts = np.array([step.starts[0] for step in plain if isinstance(step, SessionStepEffect)])
    pauses = np.diff(starts, prepend=starts[:1])
    return [steps[i] for i in np.sort(np.argsort(-pauses, kind='stable')[:_GAPS])]
