"""What could be added to a model: the catalogue's effects in all forms, and fields without a name.

Forms are the columns of effects that the data can hold.  Smooth fields over angle, range, place in
a pixel and time, and walks of the intrinsics, are what structure without a name is tested by.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np
import scipy
from scipy import sparse

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.effects.base import Effect, Scene, Untestable
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.effects.recording_effects import SessionStepEffect
from fisheye_svp_ros.effects.rig_effect import assign_camera
from fisheye_svp_ros.solve.rig_state import Linearization

_LONGEST_PAUSES = 4
_BUMP_REACH = 3.0  # of a bump, in its standard deviations
_BUMP_WIDTH = 0.65  # standard deviation of a bump over the distance of its neighbors
_CURVE_DEGREE = 5  # degree of smooth curves over an angle
_MAX_WAVES = 12


@dataclass(frozen=True)
class EffectForms:
    """Effects in all their forms.

    effects: every form; at: the columns of each (a form of several cameras has those of each);
    columns (F, M, K), whitened; generic (K,): those of the richest forms, of equals all;
    form_counts: of each name; untestable: why, by name; look_alikes: effects that are not tested,
    with their columns.
    """

    effects: tuple[Effect, ...]
    at: tuple[Index, ...]
    columns: Array
    generic: Index
    form_counts: Mapping[str, int]
    untestable: dict[str, str]
    look_alikes: tuple[tuple[Effect, Index], ...]


def effect_forms(linear: Linearization, left_out: Sequence[str] = ()) -> EffectForms:
    """Return the columns of the catalogue, without the effects left out."""
    effects, richest, untestable = _catalogue_effects(linear, left_out)
    # Effects that are not tested, of each camera, as others may be mistaken for them.
    alike = [
        form
        for name, kind in CATALOGUE.unlisted.items()
        if effects and name not in left_out
        for own in _forms(kind, linear)
        for form in own
    ]
    ends = np.cumsum([0, *(len(effect.parameters) for effect in (*effects, *alike))])
    at = [np.arange(*ends[i : i + 2]) for i in range(len(ends) - 1)]
    blocks = [linear.effect_columns(effect) for effect in (*effects, *alike)]
    columns = np.concatenate([np.zeros((*linear.residual.shape, 0)), *blocks], axis=-1)
    look_alikes = tuple(zip(alike, at[len(effects) :], strict=True))
    at = at[: len(effects)]
    generic = [own for e, own in zip(effects, at, strict=True) if any(e is r for r in richest)]
    where = np.concatenate([np.zeros(0, dtype=np.int64), *generic])
    for both, theirs in _common_forms(effects, at, linear.data.cameras):
        effects.append(both)
        at.append(theirs)
    form_counts = Counter(effect.name for effect in effects)
    return EffectForms(
        tuple(effects), tuple(at), columns, where, form_counts, untestable, look_alikes
    )


def _catalogue_effects(
    linear: Linearization, left_out: Sequence[str]
) -> tuple[list[Effect], list[Effect], dict[str, str]]:
    """Return all forms, the richest of each effect, and why others are untestable, by name."""
    effects: list[Effect] = []
    richest: list[Effect] = []
    untestable: dict[str, str] = {}
    for name, kind in CATALOGUE.items():
        if kind.stage == 'noise' or name in left_out:
            continue
        try:
            by_lens = _forms(kind, linear)
        except Untestable as why:
            untestable[name] = str(why)
            continue
        if kind.asked_last:
            continue  # single landmarks are asked last, all at once
        for own in by_lens:
            effects += own
            if name == SessionStepEffect.name:
                richest += _longest_pauses(own)
            elif lasting := [form for form in own if not form.per_frame]:
                # What every frame has anew would take up the frames' own variance.
                most = max(len(form.parameters) for form in lasting)
                richest += [form for form in lasting if len(form.parameters) == most]
    return effects, richest, untestable


def simplest_form(kind: type[Effect], linear: Linearization) -> Effect:
    """Return the simplest form of an effect, of every camera of a rig where lenses have it.

    Raises Untestable where there is none.
    """
    return _merge([forms[0] for forms in _forms(kind, linear)])


def _forms(kind: type[Effect], linear: Linearization) -> list[Sequence[Effect]]:
    """Return the forms of an effect; what a lens has, each lens of a rig has for itself.

    Raises Untestable where there is none.
    """
    scene, labels = linear.scene, linear.state.labels
    of_lens = kind.stage in ('pupil', 'ray', 'image', 'detector') and not kind.of_target
    if not scene.cameras or not of_lens:
        return [_catalogue_forms(kind, scene, linear.free)]
    found: list[Sequence[Effect]] = []
    reason = Untestable('no camera has any image point')
    for _, camera, own in scene.cameras:
        try:
            forms = _catalogue_forms(kind, own, linear.free)
            found.append([assign_camera(form, camera, labels[camera]) for form in forms])
        except Untestable as why:
            reason = why
    if not found:
        raise reason
    return found


def _catalogue_forms(kind: type[Effect], scene: Scene, free: Sequence[str]) -> Sequence[Effect]:
    forms = kind.candidates(scene)
    return [form.beside_intrinsics(scene) for form in forms] if free else forms


def _common_forms(
    effects: Sequence[Effect], at: Sequence[Index], cameras: int
) -> list[tuple[Effect, Index]]:
    """Return forms that every camera of a rig has alike, with the columns of each camera's own.

    What lenses of one kind have in common they show together before one of them shows it.
    """
    alike: dict[str, list[tuple[Effect, Index]]] = {}
    for effect, own in zip(effects, at, strict=True):
        if effect.cameras:
            alike.setdefault(effect.form.key, []).append((effect, own))
    return [
        (
            _merge([effect for effect, _ in forms]),
            np.concatenate([own for _, own in forms]),
        )
        for forms in alike.values()
        if len(forms) == cameras
    ]


def _merge(effects: Sequence[Effect]) -> Effect:
    """Return forms of one effect as one."""
    return reduce(lambda known, effect: known.merge_with(effect), effects)


def _longest_pauses(steps: Sequence[Effect]) -> list[Effect]:
    """Return steps at the longest pauses between frames, where sessions are likely to change."""
    plain = [step.form for step in steps]
    starts = np.array([step.starts[0] for step in plain if isinstance(step, SessionStepEffect)])
    pauses = np.diff(starts, prepend=starts[:1])
    return [steps[i] for i in np.sort(np.argsort(-pauses, kind='stable')[:_LONGEST_PAUSES])]


def smooth_fields(linear: Linearization) -> dict[str, Array]:
    """Generic smooth fields (F, M, P) over each variable, at the image stage."""
    scene, views = linear.scene, linear.data.views
    m = scene.normalized_uv()
    scale = max(float(np.nanmax(np.abs(m[views.used]))), 1e-9)
    x, y = np.moveaxis(np.nan_to_num(m / scale), -1, 0)
    theta = np.nan_to_num(scene.theta / scene.theta_max)
    distance = np.linalg.norm(scene.pose.into_body(views.points), axis=-1)
    near = np.where(views.used, 1 / np.maximum(distance, 1e-6), 0.0)
    near = near / max(near.max(), 1e-9)
    radial = np.stack([x, y], axis=-1) / np.maximum(np.hypot(x, y), 1e-9)[..., None]
    tangential = np.stack([-radial[..., 1], radial[..., 0]], axis=-1)
    phase = 2 * np.pi * np.nan_to_num(linear.linear.optical)
    fields = {
        'theta': [
            direction * (theta**i)[..., None]
            for direction in (radial, tangential)
            for i in range(1, _CURVE_DEGREE + 1)
        ],
        'range': [
            direction * (near**i * theta**j)[..., None]
            for direction in (radial, tangential)
            for i in (1, 2)
            for j in (1, 2, 3)
        ],
        'pixel_phase': [
            wave(harmonic * phase) * axis
            for harmonic in (1, 2)
            for wave in (np.sin, np.cos)
            for axis in np.eye(2)
        ],
    }
    t = scene.times
    if np.isfinite(t).all() and np.ptp(t) > 0:
        when = (2 * (t - t.min()) / np.ptp(t) - 1)[:, None] * np.ones_like(x)
        fields['time'] = [
            (field * when**i)[..., None] * axis
            for field in (np.ones_like(x), x, y)
            for axis in np.eye(2)
            for i in (1, 2, 3)
        ]
    return {name: linear.whiten(np.stack(columns, axis=-1)) for name, columns in fields.items()}


def intrinsic_walks(linear: Linearization) -> tuple[Array, Array]:
    """Smooth paths (F, M, P) of each camera's focal length and center, in the order of time.

    Cosines over the frames, each half period of three frames at least; and the precision (P,) of
    the coefficient of each beside that of the slowest, as the square of the second derivative.
    """
    data, scene = linear.data, linear.scene
    instant = scene.times if np.isfinite(scene.times).all() else scene.views.frame
    _, place = np.unique(instant, return_inverse=True)
    count = int(place.max()) + 1
    waves = np.arange(1, min(_MAX_WAVES, count // 3) + 1)
    path = np.cos(np.pi * waves * (place[:, None] + 0.5) / count)
    mine = data.camera_of[:, None] == np.arange(data.cameras)
    moves = (path[..., None] * mine[:, None]).reshape(len(path), -1)
    growth = np.nan_to_num(scene.normalized_uv())[..., None]
    step = np.concatenate([growth, np.broadcast_to(np.eye(2), (*growth.shape[:-1], 2))], axis=-1)
    columns = step[..., None] * moves[:, None, None, None]
    roughness = np.tile(np.repeat(waves**4.0, data.cameras), step.shape[-1])
    return linear.whiten(columns.reshape(*growth.shape[:-1], -1)), roughness


def hexagons(low: Array, high: Array, pitch: float) -> Array:
    """Return the centers (K, 2) of a hexagonal grid of a pitch over a rectangle."""
    columns = np.arange(low[0] - pitch / 2, high[0] + pitch, pitch)
    rows = np.arange(low[1] - pitch / 2, high[1] + pitch, pitch * np.sqrt(0.75))
    return np.array([(x + pitch / 2 * (j % 2), y) for j, y in enumerate(rows) for x in columns])


def bump_values(at: Array, mine: Mask, centers: Array, pitch: float) -> sparse.csr_array:
    """Return Gaussian bumps (n, K) at places (..., 2), zero out of reach and not of `mine`."""
    sd = _BUMP_WIDTH * pitch
    near = scipy.spatial.cKDTree(at[mine]).sparse_distance_matrix(
        scipy.spatial.cKDTree(centers), _BUMP_REACH * sd, output_type='ndarray'
    )
    row = np.flatnonzero(mine)[near['i']]
    values = np.exp(-((near['v'] / sd) ** 2) / 2)
    return sparse.csr_array((values, (row, near['j'])), (mine.size, len(centers)))
