"""One blind set: a random camera, scene and background, and what is hidden in it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from benchmark.studies.independent.adjust import Free, fit_lens
from benchmark.studies.independent.background import Background, draw_background
from benchmark.studies.independent.camera import HEIGHTS, Array, Lens, draw_lens
from benchmark.studies.independent.effects import EFFECTS, STEPS, Effect
from benchmark.studies.independent.formation import Departure, form, observed, simulated
from benchmark.studies.independent.oracle import amplitudes, finds
from benchmark.studies.independent.outside import OUTSIDE
from benchmark.studies.independent.scene import Scene, draw_scene

Rng = np.random.Generator
CATALOGUE = {**EFFECTS, **OUTSIDE}
SIZES = (1.0, 0.5, 0.2)
MODES = ('one', 'two', 'clean', 'outside')
GIVEN = ('observations.csv', 'lens.yaml', 'held_out.csv')
# Pairs of which nobody could say which of the two it is.
ALIKE = (
    {'viewpoint_shift', 'flat_port'},
    {'focal_length', 'radial_profile'},
    {'focal_drift', 'session_step'},
    {'noise_vs_angle', 'quantisation'},
    {'detector_bias', 'quantisation'},
    {'rolling_shutter', 'stereo_time_offset'},
)


class Hidden(NamedTuple):
    """An effect, its size in noise levels, its amount in its own unit, and what the oracle sees.

    oracle: amplitude over its standard error; None for effects without a direction.
    """

    effect: str
    size: float
    amount: float
    oracle: float | None = None


class BlindSet(NamedTuple):
    """Image points (M, 2) of a scene, the lens that is handed over, and what is hidden."""

    uv: Array
    scene: Scene
    lens: Lens
    rms_px: float
    hidden: tuple[Hidden, ...]
    background: Background


def plan(mode: str, seed: int, index: int) -> tuple[tuple[str, float], ...]:
    """Return the effects and sizes of trial `index` of a run: every effect in turn."""
    rng = np.random.default_rng([seed, index, 7])
    if mode == 'clean':
        return ()
    if mode == 'outside':
        names, sizes = list(OUTSIDE), SIZES[:2]
    else:
        names, sizes = np.random.default_rng(seed).permutation(list(EFFECTS)).tolist(), SIZES
    turn, place = divmod(index, len(names))
    first = names[place]
    if mode in ('one', 'outside'):
        return ((first, sizes[(turn + place) % len(sizes)]),)
    if mode != 'two':
        raise ValueError(f'mode {mode!r}; choose from one, two, clean, outside')
    others = [
        name
        for name in names
        if name != first and {first, name} not in ALIKE and _both(EFFECTS[first], EFFECTS[name])
    ]
    return tuple(
        (name, float(rng.choice([1.0, 0.5])))
        for name in (first, others[rng.integers(len(others))])
    )


def _both(a: Effect, b: Effect) -> bool:
    return bool(set(a.kinds) & set(b.kinds)) and not (a.not_kannala and b.not_kannala)


def generate(
    seed: int, index: int, wanted: tuple[tuple[str, float], ...], background: float
) -> BlindSet:
    """Return the blind set of a seed and number that hides effects of given sizes.

    Scenes are drawn until one can hold what is wanted at believable amounts.
    """
    rng = np.random.default_rng([seed, index])
    for _ in range(400):
        scene = _scene(rng, [CATALOGUE[name] for name, _ in wanted])
        if scene is None:
            continue
        free, hidden, departures = Free.of(scene), [], []
        for name, size in wanted:
            scene, amount, departure = _hide(rng, scene, free, name, size)
            if departure is None:
                break
            hidden.append(Hidden(name, size, amount))
            departures.append(departure)
        if len(hidden) == len(wanted):
            return _observe(rng, scene, free, tuple(hidden), departures, background)
    raise RuntimeError(f'no scene holds {wanted}')


def _pick(rng: Rng, wishes: list[bool | None], share: float) -> bool | None:
    """Return what all wish, else a random choice; None where wishes contradict each other."""
    firm = {wish for wish in wishes if wish is not None}
    if len(firm) > 1:
        return None
    return firm.pop() if firm else bool(rng.random() < share)


def _scene(rng: Rng, effects: list[Effect]) -> Scene | None:
    kinds = [kind for kind in ('board', 'cube', 'world') if all(kind in e.kinds for e in effects)]
    fitted = _pick(rng, [e.fitted for e in effects], 0.5)
    stereo = _pick(rng, [e.stereo for e in effects], 0.25)
    moving = _pick(rng, [e.moving for e in effects], 0.4)
    if fitted is None or stereo is None or moving is None:
        raise ValueError('these effects never go together')
    models = list(HEIGHTS)
    if fitted and rng.random() < 0.6:
        models = ['kannala_brandt']
    if fitted and any(e.not_kannala for e in effects):
        models = [model for model in HEIGHTS if model != 'kannala_brandt']
    lens = draw_lens(rng, str(rng.choice(models)), min([e.widest for e in effects], default=2.0))
    noise = float(np.exp(rng.uniform(np.log(0.05), np.log(0.5))))
    return draw_scene(
        rng, lens, str(rng.choice(kinds)), fitted=fitted, stereo=stereo, moving=moving, noise=noise
    )


def _hide(
    rng: Rng, scene: Scene, free: Free, name: str, size: float
) -> tuple[Scene, float, Departure | None]:
    """Return scene, amount and departure of an effect at a size; None if it would not be believed.

    Size 1: what poses, rig and free intrinsics leave is, in rms of a coordinate, the noise.
    """
    effect = CATALOGUE[name]
    draw = effect.draw(rng, scene)
    if name == 'quantisation':
        steps = [step for step in STEPS if 0.05 <= step / (12**0.5 * size) <= 0.5]
        step = float(rng.choice(steps))
        return replace(scene, noise=step / (12**0.5 * size)), step, draw(step)
    if effect.direct:
        departure = draw(size)
        return scene, size if departure.swaps is None else len(departure.swaps), departure
    nominal, target, amount = simulated(scene), size * scene.noise, 1e-2 * effect.limit
    for _ in range(8):
        left = free.size(form(scene, [draw(amount)]) - nominal)
        if abs(left / target - 1) < 0.03:
            return scene, amount, draw(amount)
        amount *= (target / max(left, 1e-9)) ** (1 / effect.power)
        if amount > effect.limit:
            break
    return scene, amount, None


def _observe(
    rng: Rng,
    scene: Scene,
    free: Free,
    hidden: tuple[Hidden, ...],
    departures: list[Departure],
    size: float,
) -> BlindSet:
    background = draw_background(rng, scene, size, free)
    uv, named = observed(rng, scene, [*background.departures, *departures], background.outliers)
    scores = amplitudes(scene, free, uv, departures)
    hidden = tuple(h._replace(oracle=z) for h, z in zip(hidden, scores, strict=True))
    lens, rms = scene.lens, 0.0
    if scene.fitted:
        lens, rms = fit_lens(named, uv, scene.lens)
    return BlindSet(uv, named, lens, rms, hidden, background)


def write(blind: BlindSet, given: Path, truth: Path) -> None:
    """Write observations.csv, held_out.csv and lens.yaml into `given`, truth.json apart."""
    given.mkdir(parents=True, exist_ok=True)
    truth.parent.mkdir(parents=True, exist_ok=True)
    held = blind.scene.held[blind.scene.frame]
    (given / 'observations.csv').write_text(_table(blind, ~held))
    (given / 'held_out.csv').write_text(_table(blind, held))
    (given / 'lens.yaml').write_text(yaml.safe_dump(_lens_document(blind), sort_keys=False))
    truth.write_text(json.dumps(_truth(blind), indent=1))


def _table(blind: BlindSet, rows: Array) -> str:
    scene, target = blind.scene, blind.scene.target
    head = ['frame', 'landmark', 'u', 'v', 'x', 'y', 'z', 't']
    boards, rig = target.kind != 'world', scene.rig is not None
    lines = [','.join(head + ['board'] * boards + ['camera'] * rig)]
    for i in np.flatnonzero(rows):
        frame, landmark = scene.frame[i], scene.landmark[i]
        words = [
            str(frame),
            str(landmark),
            *(f'{value:.5f}' for value in blind.uv[i]),
            *(f'{value:.7f}' for value in target.points[landmark]),
            f'{scene.track.times[frame]:.6f}',
        ]
        words += [str(target.board[landmark])] * boards
        words += [('left', 'right')[scene.camera[i]]] * rig
        lines.append(','.join(words))
    return '\n'.join(lines) + '\n'


def _lens_document(blind: BlindSet) -> dict[str, Any]:
    lens = blind.lens
    projection: dict[str, Any] = {'model': lens.model}
    projection |= {'f': lens.fx} if lens.fx == lens.fy else {'fx': lens.fx, 'fy': lens.fy}
    projection |= {'cx': lens.cx, 'cy': lens.cy}
    if lens.k:
        projection['k'] = list(lens.k)
    document = {
        'name': 'camera',
        'image': {'width': lens.width, 'height': lens.height},
        'projection': projection,
        'max_incidence_deg': round(float(np.degrees(lens.theta_max)), 3),
    }
    if blind.scene.fitted:
        kept = ~blind.scene.held
        document['calibration'] = {
            'rms_px': blind.rms_px,
            'observations': int(kept[blind.scene.frame].sum()),
            'frames': int(kept.sum()),
            'source': 'observations.csv',
        }
    return document


def _truth(blind: BlindSet) -> dict[str, Any]:
    scene = blind.scene
    return {
        'hidden': [
            {
                **h._asdict(),
                'oracle_finds': h.oracle is not None and finds(h.oracle, len(EFFECTS)),
                'stage': CATALOGUE[h.effect].stage,
                'unit': CATALOGUE[h.effect].unit,
            }
            for h in blind.hidden
        ],
        'background': {'outliers': blind.background.outliers, **blind.background.parts},
        'noise_px': scene.noise,
        'target': scene.target.kind,
        'model': scene.lens.model,
        'fitted': scene.fitted,
        'stereo': scene.rig is not None,
        'moving': scene.track.moving,
        'frames': scene.frames,
        'observations': len(scene.frame),
        'theta_max_deg': float(np.degrees(scene.lens.theta_max)),
    }
