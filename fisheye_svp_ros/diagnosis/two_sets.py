"""Two data sets of one camera: what moves with the lens must agree, what stays with a board not.

The causes that one set calls for are tried on the other, which took no part in finding them, and
both are fitted with the causes of both.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from fisheye_svp_ros.diagnosis.carried import (
    Carried,
    names_of,
    of_lens,
    of_target,
    settled,
    target_of,
    with_target,
)
from fisheye_svp_ros.diagnosis.diagnosis import Diagnosis, diagnose
from fisheye_svp_ros.diagnosis.evidence import bare_evidence
from fisheye_svp_ros.diagnosis.inputs import check_other
from fisheye_svp_ros.diagnosis.model import State
from fisheye_svp_ros.diagnosis.refit import fit_linear, refit
from fisheye_svp_ros.diagnosis.search import with_effect
from fisheye_svp_ros.diagnosis.standard_errors import standard_errors
from fisheye_svp_ros.diagnosis.target_map import KnownTarget, less_similarity
from fisheye_svp_ros.diagnosis.wanted import Wanted
from fisheye_svp_ros.effects.forward import Term
from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.optics.lens import INTRINSICS, Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import Observations

_SAME = 1e-6  # m: no two targets are told apart by less


class Shared(NamedTuple):
    """One parameter of the lens by each set: values, standard errors, difference over its own."""

    value: float
    stderr: float
    other_value: float
    other_stderr: float
    unit: str

    @property
    def apart(self) -> float:
        """The difference over its standard error."""
        return (self.value - self.other_value) / float(np.hypot(self.stderr, self.other_stderr))


@dataclass(frozen=True)
class Tried:
    """What of one set was tried on the other.

    lens: all causes that move with the lens, intrinsics fitted anew; whole: with the intrinsics
    as they are; causes: each of them, all others being there; target: what stays with the target,
    None where the other set shows other landmarks.
    """

    lens: Carried
    whole: Carried
    causes: dict[str, Carried]
    target: Carried | None


@dataclass(frozen=True)
class TwoSets:
    """What two data sets of one camera say of each other.

    tried: of this set on the other, and of the other on this; parameters: of the lens, by both,
    fitted with the causes of both; withdrawn: causes given up because the other set refutes them.
    """

    source: str
    tried: tuple[Tried | None, Tried | None]
    parameters: dict[str, Shared]
    withdrawn: tuple[str, ...] = ()

    @property
    def refuted(self) -> list[str]:
        """The causes of this set without which the other is predicted better beyond chance."""
        return [] if self.tried[0] is None else [
            name for name, one in self.tried[0].causes.items() if one.worse]

    @property
    def verdict(self) -> str:
        """Whether the lens's causes hold: agree, contradict, undecided; nothing: there is none."""
        both = [one.lens for one in self.tried if one is not None]
        if not both:
            return 'nothing'
        if self.withdrawn or any(one.worse for one in both):
            return 'contradict'
        return 'agree' if all(one.better for one in both) else 'undecided'

    def to_dict(self) -> dict[str, Any]:
        """Return what diagnosis.json holds."""
        def plain(one: Carried | None) -> dict[str, Any] | None:
            return None if one is None else one.to_dict()

        return {
            'against': self.source, 'verdict': self.verdict, 'withdrawn': list(self.withdrawn),
            'tried': [{
                'lens': plain(one.lens), 'whole': plain(one.whole), 'target': plain(one.target),
                'causes': {name: plain(cause) for name, cause in one.causes.items()},
            } for one in self.tried if one is not None],
            'parameters': {name: one._asdict() | {'apart': one.apart}
                           for name, one in self.parameters.items()},
        }


def diagnose_against(
    observations: Observations, other: Observations, lens: Lens | Mapping[str, Lens], *,
    free_intrinsics: bool | None = None, poses: dict[int, Pose] | None = None,
    held_out: Observations | None = None, wanted: Wanted | None = None,
    progress: Callable[[str, float], None] = lambda *_: None,
) -> Diagnosis:
    """Diagnose a data set, and ask another one of the same camera whether the lens's causes hold.

    other: its target may be another one; the rest as in `diagnose`.  Causes of the lens that the
    other set refutes are given up.
    Raises ObservationError for data sets of several cameras, and what `diagnose` raises.
    """
    for table in (observations, other):
        if len(np.unique(table.camera)) > 1:
            raise ObservationError(f'{table.source}: two data sets of one camera are compared; '
                                   'choose the rows of one camera')
    check_other(observations, other)
    wanted = wanted or Wanted()

    def part(begin: float, end: float, of: str = '') -> Callable[[str, float], None]:
        return lambda stage, done: progress(of + stage, begin + done * (end - begin))

    def this(wanted: Wanted, part: Callable[[str, float], None]) -> Diagnosis:
        return diagnose(observations, lens, free_intrinsics=free_intrinsics, poses=poses,
                        held_out=held_out, wanted=wanted, progress=part)

    found = this(wanted, part(0.0, 0.35))
    second = diagnose(other, lens, free_intrinsics=free_intrinsics, wanted=wanted,
                      progress=part(0.35, 0.7, 'the other set: '))
    progress('asking each set what it says of the other', 0.7)
    said = two_sets(found, second, observations.source, other.source)
    gone = tuple(name for name in said.refuted if name not in wanted.included)
    if gone:
        found = this(replace(wanted, left_out=(*wanted.left_out, *gone)),
                     part(0.7, 0.85, 'without what the other set refutes: '))
        said = replace(said, withdrawn=gone)
    return replace(found, against=said)


def two_sets(one: Diagnosis, other: Diagnosis, source: str, to: str) -> TwoSets:
    """Return what two diagnoses of one camera say of each other."""
    return TwoSets(
        to, (_tried(one, other, source, to), _tried(other, one, to, source)),
        _parameters(one, other),
    )


def _tried(one: Diagnosis, other: Diagnosis, source: str, to: str) -> Tried | None:
    """Try on another set what one found; None where it found nothing that moves with the lens."""
    carried = [term for term in one.after.state.terms if of_lens(term)]
    if not carried:
        return None
    data, free = other.after.data, other.after.free
    own = other.after.state
    bare = own.without(names_of([t for t in own.terms if of_lens(t)]))

    def held_out(terms: Sequence[Term], state: State = bare, free: Sequence[str] = free) -> Any:
        there = replace(state, terms=(*state.terms, *terms))
        return settled(data, there, free, names_of(terms))[1]

    without, there = held_out(()), held_out(carried)
    whole = (held_out((), replace(bare, lens=one.before.state.lens), ()),
             held_out(carried, replace(bare, lens=one.after.state.lens), ()))
    causes = {
        effect.name: Carried.of(source, to, held_out(
            [term for term in carried if term[0].name != effect.name]), there)
        for effect, _ in carried
    }
    return Tried(Carried.of(source, to, without, there), Carried.of(source, to, *whole),
                 causes, _target(one, other, source, to))


def _target(one: Diagnosis, other: Diagnosis, source: str, to: str) -> Carried | None:
    """Try the target's corrections on the other set, if it shows landmarks of the same places."""
    known, there = (KnownTarget.of(d.after.data.views) for d in (one, other))
    if not any(map(of_target, one.after.state.terms)) or not (
        np.array_equal(known.landmark, there.landmark)
        and np.abs(known.points - there.points).max() < _SAME
    ):
        return None
    fitted = fit_linear(one.after, one.errors.variances)
    own, free = other.after.state, other.after.free
    state = own.without(names_of([t for t in own.terms if of_target(t)]))
    moved = less_similarity(known.points, target_of(fitted, known))
    _, without = settled(other.after.data, state, free)
    _, carried = settled(with_target(other.after.data, known, moved), state, free)
    return Carried.of(source, to, without, carried)


def _parameters(one: Diagnosis, other: Diagnosis) -> dict[str, Shared]:
    """Fit both sets with the causes of both and compare what is the lens's."""
    both = [_with_lens_of(a, b) for a, b in ((one, other), (other, one))]
    found: dict[str, Shared] = {}
    first, second = (_estimates(d, state) for d, state in zip((one, other), both, strict=True))
    for name, (value, stderr, unit) in first.items():
        if name in second and np.isfinite([stderr, second[name][1]]).all():
            found[name] = Shared(value, stderr, *second[name][:2], unit)
    return found


def _with_lens_of(one: Diagnosis, other: Diagnosis) -> State:
    """Return the state with the other's causes of the lens as well, starting from nothing."""
    state = one.after.state
    known = {effect.name: len(values) for effect, values in state.terms}
    for effect, values in other.after.state.terms:
        # Of two forms of one effect the one with more parameters.
        if of_lens((effect, values)) and len(values) > known.get(effect.name, 0):
            state = with_effect(state, effect, np.zeros_like(values))
    return state


def _estimates(one: Diagnosis, state: State) -> dict[str, tuple[float, float, str]]:
    """Return value, standard error and unit of the intrinsics and the lens's causes."""
    data, free, variances = one.after.data, one.after.free, one.errors.variances
    state = refit(data, state, free, variances)
    evidence = bare_evidence(data, state, free, variances)
    errors = standard_errors(evidence)
    rig = evidence.own - len(free) - sum(len(values) for _, _, values in evidence.terms)
    found = {name: (state.parameters[name], float(errors[rig + i]),
                    'px' if name in INTRINSICS else '') for i, name in enumerate(free)}
    for effect, columns, values in evidence.terms:
        if of_lens((effect, values)):
            found |= {f'{effect.name}.{p.name}': (float(v), float(e), p.unit) for p, v, e in zip(
                effect.parameters, values, errors[columns], strict=True)}
    return found
