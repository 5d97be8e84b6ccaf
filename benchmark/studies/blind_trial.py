"""One blind trial: hide, hand over, diagnose, and compare with what was hidden."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

import numpy as np

from benchmark.studies.blind_effects import HIDDEN
from benchmark.studies.blind_oracle import LinearScene, oracle_finds
from benchmark.studies.blind_outside import OUTSIDE, background, with_outliers
from benchmark.studies.blind_scene import Hidden, Needs, Scene, World, draw_scene
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.diagnosis import Diagnosis, EffectTests, NullModel, diagnose
from fisheye_svp_ros.mixed_model import eliminate
from fisheye_svp_ros.optics.lens import intrinsic_names

MODES = ('one', 'clean', 'outside', 'two', 'background')
_WEAKEST = 0.02  # an effect of which what is free leaves less than this is drawn again
_STEPS = 6
_LARGEST = 1e4  # px


class Task(NamedTuple):
    """What a trial is: its mode, size over the noise, the names to hide, its place in the run."""

    mode: str
    size: float
    names: tuple[str, ...]
    seed: int
    number: int


@dataclass
class Outcome:
    """What came of a trial.

    causes: each named effect with its class; hit: whether every hidden effect is among them;
    extra: named effects whose class holds nothing hidden; oracle: whether it finds each hidden
    effect; recovered: held-out residual variance above noise that the extended model removes, over
    what the true one does; errors: of parameters, over their standard errors; p_values: of the
    first screening; trace: its steps; background: rms of nameless local errors, over the noise.
    """

    task: Task
    scene: str
    hidden: list[str]
    verdict: str = ''
    causes: dict[str, list[str]] = field(default_factory=dict)
    remaining: list[str] = field(default_factory=list)
    hit: bool = False
    extra: list[str] = field(default_factory=list)
    oracle: list[bool] = field(default_factory=list)
    recovered: float | None = None
    errors: dict[str, float] = field(default_factory=dict)
    p_values: dict[str, float] = field(default_factory=dict)
    trace: list[str] = field(default_factory=list)
    background: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        """Return the fields by name; `from_dict` reads them."""
        return asdict(self) | {'task': self.task._asdict()}

    @classmethod
    def from_dict(cls, entry: dict[str, Any]) -> Outcome:
        """Return the outcome that `to_dict` wrote."""
        task = Task(**entry['task'])
        return cls(**entry | {'task': task._replace(names=tuple(task.names))})


class Case(NamedTuple):
    """What a trial hides: scene, effects, amounts; image points (S, N, 2), true and as handed."""

    scene: Scene
    hidden: list[Hidden]
    amounts: list[float]
    linear: LinearScene
    ideal: Array
    exact: Array
    given: Array
    background: float = 0.0


def run_trial(task: Task) -> Outcome:
    """Run one trial; the same task always gives the same data.

    An error of the diagnosis is an outcome too, and a miss.
    """
    case = draw_case(task)
    scene, whole = case.scene, list(zip(task.names, case.hidden, case.amounts, strict=True))
    test = scene.table(case.given, held_out=True) if scene.held_out.any() else None
    outcome = Outcome(
        task,
        _described(scene),
        [
            f'{name}{f" ({one.detail})" if one.detail else ""} {amount:.3g}'
            for name, one, amount in whole
        ],
        oracle=[
            oracle_finds(case.linear, name, one, amount, case.given)
            for name, one, amount in whole
            if name in HIDDEN
        ],
        background=case.background,
    )
    try:
        found = diagnose(
            scene.table(case.given), scene.lens, free_intrinsics=scene.free, held_out=test
        )
    except Exception as error:
        outcome.verdict = f'error: {type(error).__name__}: {error}'
        return outcome
    outcome.verdict = found.verdict
    outcome.causes = {cause.effect: cause.indistinguishable_from for cause in found.causes}
    outcome.remaining = [structure.variable for structure in found.remaining]
    outcome.hit = set(outcome.causes).union(*outcome.causes.values()).issuperset(task.names)
    outcome.extra = [e for e, same in outcome.causes.items() if not {e, *same} & set(task.names)]
    outcome.trace = [f'{s.effect}: corrected p {s.corrected:.1e}, {s.why}' for s in found.trace]
    if task.mode in ('one', 'background') and task.names:
        outcome.errors = _errors(case, task, found)
        lasting = test is not None and not case.background
        outcome.recovered = _recovered(case, found) if lasting else None
    if task.mode == 'clean':
        outcome.p_values = _null_p_values(found, scene.free)
    return outcome


def draw_case(task: Task) -> Case:
    """Draw scene and effects, set the amounts, take the pictures."""
    rng = np.random.default_rng(
        [task.seed, MODES.index(task.mode), round(1000 * task.size), task.number]
    )
    while True:
        scene = draw_scene(
            rng,
            _needs(task),
            held_out=task.mode == 'one' and task.size >= 1,
            landmarks=int(rng.choice([26, 54, 80])) if task.mode == 'clean' else 54,
        )
        case = _hide(task, scene, rng)
        if case is not None:
            return case


def _needs(task: Task) -> Needs:
    needs = Needs()
    for name in task.names:
        if name in HIDDEN:
            needs = needs.joined(HIDDEN[name][1])
    return needs


def _hide(task: Task, scene: Scene, rng: np.random.Generator) -> Case | None:
    """Return the case, or None where an effect does not show in this scene or shows too much."""
    world = scene.world()
    ideal = world.image()
    linear = LinearScene(scene, ideal)
    theta = world.angles
    hidden, amounts = [], []
    for name in task.names:
        draw = HIDDEN[name][0] if name in HIDDEN else OUTSIDE[name][0]
        one = draw(scene, rng)
        amount = _amount(one, task.size, scene, linear, theta, rng)
        if amount is None:
            return None
        world = one.world(world, amount) if one.world else world
        hidden.append(one)
        amounts.append(amount)
    level = 0.0
    if task.mode == 'background':
        level = float(10 ** rng.uniform(-1, 0))
        world = _with_background(world, scene, linear, level, rng)
    exact = world.image()
    if not np.isfinite(exact[scene.seen]).all():
        return None
    noise = scene.noise * rng.standard_normal(exact.shape)
    for one, amount in zip(hidden, amounts, strict=True):
        if one.scatter:
            noise = noise * one.scatter(theta, amount, rng)
    given = exact + noise
    if level:
        given = with_outliers(given, scene, rng)
    for one, amount in zip(hidden, amounts, strict=True):
        if one.recorded:
            given = one.recorded(given, amount, rng)
    return Case(scene, hidden, amounts, linear, ideal, exact, given, level)


def _with_background(
    world: World, scene: Scene, linear: LinearScene, level: float, rng: np.random.Generator
) -> World:
    """Return the world with local errors of a size (rms over the noise, poses taken out)."""
    add = background(scene, rng)
    small = 0.1 * scene.noise
    unit = linear.rms(add(scene.world(), small).image() - linear.ideal, outside=True)
    return add(world, small * level * scene.noise / unit)


def _amount(
    hidden: Hidden,
    size: float,
    scene: Scene,
    linear: LinearScene,
    theta: Array,
    rng: np.random.Generator,
) -> float | None:
    """Return the amount at which the effect has its size; None where it cannot.

    The size is the RMS, over the noise, of what is left once poses and free intrinsics are
    fitted; for scatter the RMS of its relative change.
    """

    def rms(amount: float) -> float:
        if hidden.scatter:
            factor = np.broadcast_to(hidden.scatter(theta, amount, rng), linear.ideal.shape)
            return float(np.sqrt(np.mean((factor[scene.seen] - 1) ** 2)))
        assert hidden.world
        moved = hidden.world(scene.world(), amount).image() - linear.ideal
        whole, left = linear.rms(moved), linear.rms(moved, outside=True)
        known = np.isfinite(whole) and whole < _LARGEST and left > _WEAKEST * whole
        return left / scene.noise if known else np.nan

    if hidden.recorded:
        return size * scene.noise
    amount = _solved(rms, hidden.start, size)
    return amount if amount is not None and amount <= hidden.largest else None


def _solved(rms: Callable[[float], float], start: float, size: float) -> float | None:
    """Solve rms(amount) = size by secants in logarithms, in which it is nearly straight."""
    before, after = ((np.log(a), np.log(rms(a))) for a in (start, 2 * start))
    for _ in range(_STEPS):
        slope = (after[1] - before[1]) / (after[0] - before[0])
        if not (np.isfinite(slope) and 0.2 < slope < 5):
            return None
        step = (np.log(size) - after[1]) / slope
        if abs(step) < 1e-3:
            return float(np.exp(after[0] + step))
        place = after[0] + step
        before, after = after, (place, np.log(rms(np.exp(place))))
    return None


def _described(scene: Scene) -> str:
    return ', '.join(
        [
            scene.lens.name,
            'free' if scene.free else 'fixed',
            'stereo' if scene.cameras == 2 else 'mono',
            'boards' if scene.board.any() else 'cloud',
            f'noise {scene.noise} px{" (stated)" if scene.stated else ""}',
            f'{2 * int(scene.seen[~scene.held_out[scene.frame]].sum())} numbers',
        ]
    )


def _errors(case: Case, task: Task, found: Diagnosis) -> dict[str, float]:
    """Return errors over standard errors where the true values are known by the same names."""
    truth = case.hidden[0].truth(case.amounts[0])
    mine = [cause for cause in found.causes if cause.effect == task.names[0]]
    # With other causes beside it the fit is of another model, which is counted elsewhere.
    if len(found.causes) != 1 or not mine or set(mine[0].parameters) != set(truth):
        return {}
    return {
        name: (entry['value'] - truth[name]) / entry['stderr']
        for name, entry in mine[0].parameters.items()
    }


def _recovered(case: Case, found: Diagnosis) -> float | None:
    """Return (before - after) / (before - true model) of the held-out residual variance, px^2."""
    if not (case.hidden[0].world and case.hidden[0].lasting):
        return None
    moves = np.where(case.scene.seen[..., None], case.exact - case.ideal, 0.0)
    truth = LinearScene(case.scene, case.ideal, held_out=True).pose_rms(case.given - moves)
    before, after = found.figures.base.heldout_rms_px, found.figures.extended.heldout_rms_px
    return float((before**2 - after**2) / (before**2 - truth**2))


def _null_p_values(found: Diagnosis, free: bool) -> dict[str, float]:
    """Return the p-value of the simplest form of each effect beside the null model."""
    linear = found.simulation
    names = intrinsic_names(linear.state.lens) if free else ()
    null = NullModel.estimate(linear.data, linear.state, names)
    tests, left = EffectTests(null), eliminate(null.information, null.included_columns)
    values: dict[str, float] = {}
    for form, effect in enumerate(null.fixed.forms.effects):
        if effect.name in values:
            continue  # the simplest form stands first
        columns = null.form_columns(form)
        result = tests.adjust_p_value(tests.score(left, columns), null.included_columns, columns)
        wrong = [
            value < 0
            for value, parameter in zip(result.estimate, effect.parameters, strict=True)
            if parameter.positive
        ]
        if result.rank and not any(wrong):
            values[effect.name] = round(result.p_value, 5)
    return values
