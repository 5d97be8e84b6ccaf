"""What a diagnosis concludes: what to do about lens, target and photographs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from fisheye_svp_ros.diagnosis.advice import RETAKE, UNLIKE, USE_EXTENDED, Advice
from fisheye_svp_ros.diagnosis.causes import Cause
from fisheye_svp_ros.diagnosis.confirmation import UnconfirmedCause
from fisheye_svp_ros.diagnosis.cross_validation import gain_and_confidence
from fisheye_svp_ros.diagnosis.decision import (
    Decision,
    FileFigure,
    LensFacts,
    PhotographsFacts,
    TargetFacts,
    decide_lens,
    decide_photographs,
    decide_target,
)
from fisheye_svp_ros.diagnosis.effect_tests import SIGNIFICANCE
from fisheye_svp_ros.diagnosis.evaluation import Evaluation
from fisheye_svp_ros.diagnosis.lens_evidence import (
    LensesOf,
    compare_lens_files,
    find_bounds,
    find_lens_rays,
)
from fisheye_svp_ros.diagnosis.variance_budget import Component
from fisheye_svp_ros.effects.target_map import board_maps
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.solve.ray_errors import RayError
from fisheye_svp_ros.solve.rig_checks import is_unpaired


@dataclass(frozen=True)
class Conclusion:
    """The decisions about lens, target, photographs, and what they rest on.

    candidates: effects that are not confirmed; ray_error: of each camera, of the lens as given
    and of the extended one, by range.
    """

    decision: dict[str, Decision]
    file: FileFigure
    ray_error: dict[str, dict[str, list[RayError]]]
    candidates: list[UnconfirmedCause]

    def ray_error_mrad(self) -> dict[str, Any]:
        """Return the expected ray errors, mrad, of the worst camera, and of each of several."""
        each = {camera: self.ray_error_of(camera) for camera in self.ray_error}
        if len(each) < 2:
            return next(iter(each.values()), {})
        worst = max(each.values(), key=lambda both: both['given'][0]['value'])
        return {**worst, 'cameras': each}

    def ray_error_of(self, camera: str) -> dict[str, list[dict[str, float]]]:
        """Return the expected ray errors, mrad, of a camera's lens as given and as extended."""
        return {side: [one.in_mrad() for one in found]
                for side, found in self.ray_error.get(camera, {}).items()}

    def with_ray_error(self, lens: Lens, camera: str) -> Lens:
        """Return the extended lens of a camera with its ray errors in its `uncertainty`."""
        found = self.ray_error_of(camera)
        if not found:
            return lens
        return replace(lens, uncertainty={**(lens.uncertainty or {}), 'ray_error_mrad': found})

    def to_dict(self) -> dict[str, Any]:
        """Return the keys of diagnosis.json that are its own."""
        return {
            'file': self.file._asdict(),
            'candidates': [asdict(one) for one in self.candidates],
            'decision': {name: one.to_dict() for name, one in self.decision.items()},
        }


def conclude(
    evaluation: Evaluation, causes: Sequence[Cause], components: Sequence[Component],
    advice: Sequence[Advice], candidates: list[UnconfirmedCause], lenses: Mapping[str, Lens],
    lenses_of: LensesOf, contradicted: bool,
) -> Conclusion:
    """Return what to do.

    lenses: as given, by camera; lenses_of: makes extended ones of a state; contradicted: whether
    the cameras of a rig contradict each other about the target.
    """
    rays = find_lens_rays(evaluation, lenses, lenses_of)
    file, gain = compare_lens_files(evaluation), evaluation.gains['named']
    lens = decide_lens(LensFacts(
        [c.effect for c in causes if c.effect_class.budget_stage() == 'lens'],
        [c.effect for c in causes if c.effect_class.budget_stage() != 'noise'],
        bool(evaluation.averaged_model.shifts),
        (gain.value, gain.low), file, rays.offset if evaluation.free else None,
        find_bounds(evaluation.null), evaluation.noise_px, evaluation.falling,
        evaluation.frames))
    scatter = np.hypot.reduce([part.sd_px for part in components
                               if part.stage == 'frame' and not part.named_share]
                              + [evaluation.noise_px])
    target = decide_target(_target_facts(evaluation, causes, components, contradicted))
    photographs = decide_photographs(PhotographsFacts(
        evaluation.frames, frames_of(advice, RETAKE), frames_of(advice, UNLIKE),
        evaluation.named_quality.heldout_rms_px, 2**0.5 * float(scatter), lens.say,
        target.say == 'measure_again' and target.confidence is not None,
        evaluation.selection.problem.plannable,
        'view' if is_unpaired(evaluation.null.linear.data) else 'frame'))
    return Conclusion({'lens': lens, 'target': target, 'photographs': photographs}, file,
                      rays.errors, candidates)


def advice_on_lens(advice: Sequence[Advice], conclusion: Conclusion) -> list[Advice]:
    """Return advice that agrees with the decision about the lens, what brings most first."""
    rest = [one for one in advice if one.what != USE_EXTENDED]
    if conclusion.decision['lens'].say == 'use_extended':
        rest.append(Advice(USE_EXTENDED, gain=conclusion.file.gain))
    return sorted(rest, key=lambda one: -one.gain)


def frames_of(advice: Sequence[Advice], kind: str) -> list[str]:
    """Return the names of the frames of some advice: of their photographs, or their numbers."""
    return list(dict.fromkeys(
        name for one in advice if one.kind == kind
        for name in (one.photographs or [f'frame {n}' for n in one.frames])))


def _target_facts(
    evaluation: Evaluation, causes: Sequence[Cause], components: Sequence[Component],
    contradicted: bool,
) -> TargetFacts:
    mine = [cause for cause in causes if cause.effect_class.budget_stage() == 'target']
    gain = (0.0, 0.0, 0.0)
    if mine:
        both = evaluation.predict([cause.effect for cause in mine]), evaluation.predict()
        found, sure = gain_and_confidence(*both, evaluation.noise_px)
        gain = found.value, found.low, sure
    of_target = [part for part in components if part.stage == 'target']
    local = [part for part in of_target
             if not part.named_share and part.p_value < SIGNIFICANCE]
    far = np.linalg.norm(evaluation.offsets.offset, axis=1) if local else np.zeros(1)

    def size(parts: Sequence[Component]) -> float:
        return float(np.sqrt(sum(part.sd_px**2 for part in parts)))

    return TargetFacts(
        [cause.effect for cause in mine], _largest_error(evaluation, mine), gain,
        size([part for part in of_target if part.named_share]), size(local),
        float(np.sqrt((far**2).mean())), max((p.p_value for p in local), default=0.0),
        evaluation.noise_px, contradicted, evaluation.frames)


def _largest_error(evaluation: Evaluation, causes: Sequence[Cause]) -> str:
    """Return how large the largest error of the target is, as the start of a sentence."""
    if not causes:
        return ''
    worst = max(causes, key=lambda cause: cause.share)
    if worst.effect == 'target_shape':
        linear = evaluation.fixed_model
        terms = [term for term in linear.state.terms if term[0].name == worst.effect]
        maps = board_maps(linear.data.views, terms, linear.state.lens)
        one = max(maps, key=lambda board: board.peak_to_valley)
        which = f'board {one.board}' if len(maps) > 1 else 'the board'
        return f'{which} is bent by {1e3 * one.peak_to_valley:.2g} mm'
    if worst.effect == 'landmark_survey':
        count = len({name.partition('.')[0] for name in worst.parameters})
        return f'{count} landmark{"s are" if count > 1 else " is"} displaced'
    if worst.effect == 'landmark_scale':
        most = max((abs(p['value']) for p in worst.parameters.values()), default=0.0)
        stretched = 'relative' not in worst.parameters
        what = 'the board is stretched' if stretched else 'the scale of the board is off'
        return f'{what} by {100 * most:.2g} %'
    if worst.effect == 'board_pose':
        return 'the relative poses of its boards are wrong'
    return f'confirmed cause: {worst.effect}'
