"""What a diagnosis concludes: decisions about lens, target, photographs, and advice.

Advice comes in the order of what it brings; nothing that held-out data refute.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any

import numpy as np

from fisheye_svp_ros.diagnosis.adequacy import Adequacy, are_rays_known, judge_data
from fisheye_svp_ros.diagnosis.causes import Cause
from fisheye_svp_ros.diagnosis.checks.medium import Medium
from fisheye_svp_ros.diagnosis.checks.turned_boards import TurnedFrame
from fisheye_svp_ros.diagnosis.cross_validation import gain_and_confidence, predictable_rows
from fisheye_svp_ros.diagnosis.decision import (
    Decision,
    FileFigure,
    LensFacts,
    PhotographsFacts,
    TargetError,
    TargetFacts,
    decide_lens,
    decide_photographs,
    decide_target,
)
from fisheye_svp_ros.diagnosis.effect_tests import SIGNIFICANCE
from fisheye_svp_ros.diagnosis.evaluation import Evaluation
from fisheye_svp_ros.diagnosis.findings import LIKELY_PROBABILITY, Finding, Status
from fisheye_svp_ros.diagnosis.lens_evidence import compare_lens_files, find_bounds, find_lens_rays
from fisheye_svp_ros.diagnosis.random_effects import BEND, MILLIMETRE, MOTION, SAG
from fisheye_svp_ros.diagnosis.variance_budget import Component, significant_components
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.effects.target_map import board_maps
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.scene.observations import Observations, frame_names
from fisheye_svp_ros.solve.bundle_adjustment import adjust_poses
from fisheye_svp_ros.solve.outliers import FRAME, VIEW, Outliers
from fisheye_svp_ros.solve.ray_errors import RayError
from fisheye_svp_ros.solve.rig_checks import is_unpaired

RETAKE, UNLIKE, TURNED = 'retake', 'unlike', 'turned'
_OUTSTANDING_RATIO = 2.0  # times the typical one
_MAX_LISTED = 8
_MIN_SAG = _MIN_BEND = 0.05  # mm
_REACHED = 0.75  # of the points of a frame, by other frames: less, and it alone shows a part


class Action(Enum):
    """What there is to do."""

    USE_EXTENDED = 1
    DIAGNOSE_AIR = 2
    CALIBRATE_AIR = 3
    MEASURE_BOARD = 4
    MEASURE_LANDMARKS = 5
    SUPPORT_BOARD = 6
    VARY_VIEWS = 7
    RETAKE = 8
    CHECK_VIEWS = 9  # most points of one view are outliers
    CHECK_FRAMES = 10
    CHECK_HELD_OUT_VIEWS = 11
    CHECK_HELD_OUT_FRAMES = 12
    CHECK_HELD_OUT_RIG = 13
    HOLD_OUT_SAME_TARGET = 14
    TAKE_MORE_LIKE_THESE = 15
    NUMBER_LIKE_OTHERS = 16  # they were reordered
    CHECK_NUMBERS = 17  # they were not
    SEPARATE_CAUSE = 18
    HOLD_STILL = 19


_ACTION_KINDS = {
    Action.CHECK_VIEWS: RETAKE,
    Action.CHECK_FRAMES: RETAKE,
    Action.TAKE_MORE_LIKE_THESE: UNLIKE,
    Action.NUMBER_LIKE_OTHERS: TURNED,
    Action.CHECK_NUMBERS: TURNED,
}


@dataclass(frozen=True)
class Advice:
    """One thing to do: what, to which frames, landmarks and boards; gain: of held-out variance.

    photographs: the files of the frames, as far as they are known; value: m of a sag, rad of a
    turn while an image is read, odds of a turned board, s for which errors last; cause: which
    one, where it is about one.
    """

    action: Action
    frames: list[int] = field(default_factory=list)
    photographs: list[str] = field(default_factory=list)
    landmarks: list[int] = field(default_factory=list)
    boards: list[int] = field(default_factory=list)
    gain: float = 0.0
    value: float = 0.0
    cause: Cause | None = None

    @property
    def kind(self) -> str:
        """RETAKE, UNLIKE where others do not predict these, TURNED; '' of other advice."""
        return _ACTION_KINDS.get(self.action, '')


def advise(
    evaluation: Evaluation, causes: Sequence[Cause], parts: Sequence[Component], held_back: bool
) -> list[Advice]:
    """Return what to do, what brings most first; parts: the random components that are there.

    held_back: whether a large effect is; no frame is to be taken again for what it leaves.
    """
    selection, gains = evaluation.selection, evaluation.gains
    advice = _use_causes(evaluation, causes)
    if any(part.stage == 'target' for part in parts):
        advice += _measure_landmarks(evaluation, (1 - gains['named'].value) * gains['local'].value)
    if any(part.name == SAG for part in parts):
        advice += _support_boards(evaluation)
    if any(part.name == MOTION for part in parts):
        advice.append(Advice(Action.HOLD_STILL, value=evaluation.fitted.turn_while_read()))
    if evaluation.offsets.views is not None:
        advice.append(Advice(Action.VARY_VIEWS, value=evaluation.offsets.views.lasting))
    advice += [] if held_back else _retake_frames(evaluation)
    advice += _check_photographs(
        selection.null.linear.data.observations, selection.revision.outliers
    )
    advice += _check_held_out(evaluation)
    advice += [
        Advice(Action.SEPARATE_CAUSE, cause=cause)
        for cause in causes
        if cause.stage in ('noise', 'frame') or cause.indistinguishable_from
    ]
    if evaluation.medium is not None:
        advice += _calibrate_in_air(evaluation.medium, causes)
    # Advice without a figure keeps its order, after all that has one.
    return sorted(advice, key=lambda task: -task.gain)


def turn_advice(turned: Sequence[TurnedFrame]) -> list[Advice]:
    """Return what to do about photographs whose board is numbered from another end."""
    advice = []
    for corrected, action in ((True, Action.NUMBER_LIKE_OTHERS), (False, Action.CHECK_NUMBERS)):
        mine = [turn for turn in turned if turn.corrected == corrected]
        if mine:
            advice.append(
                Advice(
                    action,
                    frames=[turn.frame for turn in mine],
                    photographs=[turn.photograph for turn in mine if turn.has_photograph],
                    value=min(turn.odds for turn in mine),
                )
            )
    return advice


def _use_causes(evaluation: Evaluation, causes: Sequence[Cause]) -> list[Advice]:
    """Return what to do about causes of lens and target that held-out data confirm."""
    gains, advice = evaluation.gains, []
    if any(cause.stage == 'lens' for cause in causes) and gains['lens'].value > 0:
        advice.append(Advice(Action.USE_EXTENDED, gain=gains['lens'].value))
    of_target = [cause for cause in causes if cause.stage == 'target']
    gain = gains['named'].value - max(gains['lens'].value, 0.0)
    if of_target and gain > 0:
        boards = {
            int(part[5:])
            for cause in of_target
            for part in cause.members
            if part.startswith('board') and part[5:].isdigit()
        }
        advice.append(
            Advice(
                Action.MEASURE_BOARD,
                boards=sorted(boards),
                gain=gain,
                landmarks=[
                    int(part)
                    for cause in causes
                    if cause.effect_class.target_map == 'single'
                    for part in cause.members
                ],
            )
        )
    return advice


def _support_boards(evaluation: Evaluation) -> list[Advice]:
    """Return what to do about boards that sag by their own weight."""
    boards = evaluation.null.linear.scene.boards
    sizes = np.linalg.norm(evaluation.fitted.board_sags(), ord=2, axis=(1, 2))
    return [
        Advice(Action.SUPPORT_BOARD, boards=[board.id], value=1e-3 * float(size))
        for board, size in zip(boards, sizes, strict=True)
        if size > _MIN_SAG
    ]


def _check_held_out(evaluation: Evaluation) -> list[Advice]:
    """Return what to do about held-out frames that are no measure of a model."""
    test = evaluation.held_out
    if test is None:
        linear = evaluation.null.linear
        near = predictable_rows(linear).sum(axis=1) / linear.row_mask.sum(axis=1)
        alone = linear.data.frame_numbers[~evaluation.counted_frames | (near < _REACHED)]
        return (
            [
                _about_frames(
                    evaluation.null.linear.data.observations,
                    Action.TAKE_MORE_LIKE_THESE,
                    alone.tolist(),
                )
            ]
            if len(alone)
            else []
        )
    table = test.data.observations
    advice = _check_photographs(table, test.outliers, held_out=True)
    if test.another_target:
        advice.append(Advice(Action.HOLD_OUT_SAME_TARGET))
    if test.rig_differs:
        views = np.unique(np.stack([table.frame, table.camera]), axis=1)
        frames, count = np.unique(views[0], return_counts=True)
        shared = frames[count > 1].tolist()
        advice.append(_about_frames(table, Action.CHECK_HELD_OUT_RIG, shared))
    return advice


def _calibrate_in_air(medium: Medium, causes: Sequence[Cause]) -> list[Advice]:
    """Return what would make a lens surer that was calibrated in air."""
    advice = []
    others = {cause.effect for cause in causes if cause.stage == 'lens'}
    told = medium.state.lens.uncertainty is not None  # by `diagnose`
    if not told and (medium.moved or len(others) > 1):
        advice.append(Advice(Action.DIAGNOSE_AIR))
    if medium.moved:
        advice.append(Advice(Action.CALIBRATE_AIR))
    return advice


def _measure_landmarks(evaluation: Evaluation, gain: float) -> list[Advice]:
    """Return the landmarks whose predicted offsets stand out, where predicting them helps."""
    far = np.linalg.norm(evaluation.offsets.offset, axis=1)
    if gain <= 0 or not far.any():
        return []
    typical = float(np.median(far[far > 0]))
    order = np.argsort(-far)[:_MAX_LISTED]
    chosen = [
        int(evaluation.offsets.landmark[i]) for i in order if far[i] > _OUTSTANDING_RATIO * typical
    ]
    return [Advice(Action.MEASURE_LANDMARKS, landmarks=chosen, gain=gain)] if chosen else []


def _retake_frames(evaluation: Evaluation) -> list[Advice]:
    """Return the frames that scatter more than the others."""
    squares = evaluation.fitted.standardized_squares()
    used = evaluation.null.linear.row_mask
    size = squares.sum(axis=1) / np.maximum(used.sum(axis=1), 1)
    bad = np.flatnonzero(size > _OUTSTANDING_RATIO * np.median(size))
    worst = bad[np.argsort(-size[bad])][:_MAX_LISTED]
    return (
        [
            _about_frames(
                evaluation.null.linear.data.observations,
                Action.RETAKE,
                evaluation.null.linear.data.frame_numbers[worst].tolist(),
            )
        ]
        if len(bad)
        else []
    )


def _check_photographs(
    table: Observations, outliers: Outliers, held_out: bool = False
) -> list[Advice]:
    """Return the frames of which whole views are outliers, by reason."""
    actions = {VIEW: Action.CHECK_VIEWS, FRAME: Action.CHECK_FRAMES}
    if held_out:
        actions = {VIEW: Action.CHECK_HELD_OUT_VIEWS, FRAME: Action.CHECK_HELD_OUT_FRAMES}
    off = {
        reason: sorted(
            {
                int(table.frame[row])
                for row, why in zip(outliers.rows, outliers.why, strict=True)
                if why == reason
            }
        )
        for reason in actions
    }
    return [
        _about_frames(table, actions[reason], frames) for reason, frames in off.items() if frames
    ]


def _about_frames(table: Observations, action: Action, frames: list[int]) -> Advice:
    """Return what to do about frames of a table, with the photographs that they are."""
    known = {frame for frame, _, _ in table.photographs}
    names = [
        name
        for frame in dict.fromkeys(frames)
        if frame in known
        for name in frame_names(table, frame)
    ]
    return Advice(action, frames=frames, photographs=names)


@dataclass(frozen=True)
class Conclusion:
    """The decisions about lens, target, photographs, and what they rest on.

    candidates: effects that are not confirmed; ray_error: of each camera, of the lens as given
    and of the extended one, by range; adequacy: what is wrong with the data.
    """

    decision: dict[str, Decision]
    file: FileFigure
    ray_error: dict[str, dict[str, list[RayError]]]
    candidates: list[Finding]
    adequacy: Adequacy

    def ray_error_mrad(self) -> dict[str, Any]:
        """Return the expected ray errors, mrad, of the worst camera, and of each of several.

        in_use: of the lens that is to be used, in a single frame, with what that has of its own.
        """
        each = {
            camera: {**self.ray_error_of(camera), 'in_use': self._errors_in_use(camera)}
            for camera in self.ray_error
        }
        if len(each) < 2:
            return next(iter(each.values()), {})
        worst = max(each.values(), key=lambda both: both['given'][0]['value'])
        return {**worst, 'cameras': each}

    def ray_error_of(self, camera: str) -> dict[str, list[dict[str, float]]]:
        """Return the expected ray errors, mrad, of a camera's lens as given and as extended."""
        return {
            side: [error.in_mrad() for error in found]
            for side, found in self.ray_error.get(camera, {}).items()
        }

    def _errors_in_use(self, camera: str) -> list[dict[str, float]]:
        own = self.adequacy.frames_error
        return [
            error.in_quadrature(own).in_mrad()
            for error in self.ray_error[camera][used_side(self.decision['lens'])]
        ]

    def with_ray_error(self, lens: Lens, camera: str) -> Lens:
        """Return the extended lens of a camera with its ray errors in its `uncertainty`."""
        found = self.ray_error_of(camera)
        if not found:
            return lens
        return replace(lens, uncertainty={**(lens.uncertainty or {}), 'ray_error_mrad': found})


def used_side(lens: Decision) -> str:
    """Return which lens a decision about it leaves in use: `given` or `extended`."""
    return 'extended' if lens.say in ('use_extended', 'recalibrate') else 'given'


def conclude(
    evaluation: Evaluation,
    causes: Sequence[Cause],
    components: Sequence[Component],
    advice: Sequence[Advice],
    candidates: list[Finding],
    contradicted: bool,
) -> Conclusion:
    """Return what to do; contradicted: whether the cameras of a rig disagree about the target."""
    ray_errors, offset = find_lens_rays(evaluation, evaluation.problem.inputs.lenses)
    file, gain = compare_lens_files(evaluation), evaluation.gains['named']
    open_effects = _open_effects(evaluation, candidates)
    lens = decide_lens(
        LensFacts(
            lens_causes=[c.effect for c in causes if c.stage == 'lens'],
            causes=[c.effect for c in causes if c.stage != 'noise'],
            named_gain=(gain.value, gain.low),
            file=file,
            offset=offset if evaluation.free else None,
            bounds=find_bounds(
                evaluation.null,
                [name for name, chance in open_effects.items() if chance > LIKELY_PROBABILITY],
            ),
            noise_px=evaluation.noise_px,
            falling=evaluation.falling,
            frames=evaluation.frames,
            refuted=[
                candidate.effect for candidate in candidates if candidate.status is Status.REFUTED
            ],
            rays=_worst_rays(ray_errors),
            written=_unexplained_corrections(evaluation),
            open=open_effects,
        )
    )
    scatter = np.hypot.reduce(
        [part.sd_px for part in components if part.stage == 'frame' and not part.named_share]
        + [evaluation.noise_px]
    )
    target = decide_target(_target_facts(evaluation, causes, components, contradicted))
    rays = {name: sides[used_side(lens)] for name, sides in ray_errors.items()}
    photographs = decide_photographs(
        PhotographsFacts(
            frames=evaluation.frames,
            bad=frames_of(advice, RETAKE),
            unlike=frames_of(advice, UNLIKE),
            heldout_px=evaluation.figures.named.heldout_rms_px,
            scatter_px=2**0.5 * float(scatter),
            lens=lens.say,
            is_target_off=target.say == 'measure_again' and target.confidence is not None,
            plannable=evaluation.problem.plannable,
            unit='view' if is_unpaired(evaluation.null.linear.data) else 'frame',
            known=are_rays_known(rays),
        )
    )
    adequacy = judge_data(evaluation, causes, components, rays, candidates)
    decisions = adequacy.revise({'lens': lens, 'target': target, 'photographs': photographs})
    return Conclusion(decisions, file, ray_errors, candidates, adequacy)


def advice_on_lens(advice: Sequence[Advice], conclusion: Conclusion) -> list[Advice]:
    """Return advice that agrees with the decision about the lens, what brings most first."""
    rest = [task for task in advice if task.action is not Action.USE_EXTENDED]
    if conclusion.decision['lens'].say == 'use_extended':
        rest.append(Advice(Action.USE_EXTENDED, gain=conclusion.file.gain))
    return sorted(rest, key=lambda task: -task.gain)


def frames_of(advice: Sequence[Advice], kind: str) -> list[str]:
    """Return the names of the frames of some advice: of their photographs, or their numbers."""
    return list(
        dict.fromkeys(
            name
            for task in advice
            if task.kind == kind
            for name in (task.photographs or [f'frame {n}' for n in task.frames])
        )
    )


def _worst_rays(errors: Mapping[str, Mapping[str, Sequence[RayError]]]) -> tuple[float, float]:
    """Return the rms over ranges, mrad, of the expected errors of a lens as given and extended.

    Of the camera that gains most; zeros where nothing is known.
    """
    each = [
        tuple(
            1e3 * float(np.sqrt(np.mean([error.value**2 for error in sides[side]])))
            for side in ('given', 'extended')
        )
        for sides in errors.values()
    ]
    given, extended = max(each, key=lambda both: both[0] / max(both[1], 1e-12), default=(0.0, 0.0))
    return given, extended


def _unexplained_corrections(evaluation: Evaluation) -> list[str]:
    """Return what the written lens has that no confirmed cause stands for."""
    field = evaluation.written_field
    effects = [one.effect.name for one in evaluation.averaged_model.effects]
    written = ['image_field'] if field is not None and field.fields else []
    return list(dict.fromkeys((*effects, *written)))


def _open_effects(evaluation: Evaluation, candidates: Sequence[Finding]) -> dict[str, float]:
    """Return how probable each effect of the lens is that is neither confirmed nor refuted."""
    found = {
        candidate.effect: candidate.probability
        for candidate in candidates
        if candidate.status is not Status.REFUTED
        and CATALOGUE[candidate.effect].budget_stage() == 'lens'
    }
    averaged = {one.effect.name: one.weight for one in evaluation.averaged_model.effects}
    return found | averaged


def _target_facts(
    evaluation: Evaluation,
    causes: Sequence[Cause],
    components: Sequence[Component],
    contradicted: bool,
) -> TargetFacts:
    mine = [cause for cause in causes if cause.stage == 'target']
    gain = (0.0, 0.0, 0.0)
    if mine:
        both = evaluation.predict([cause.effect for cause in mine]), evaluation.predict()
        found, sure = gain_and_confidence(*both, evaluation.noise_px)
        gain = found.value, found.low, sure
    of_target = [part for part in components if part.stage == 'target']
    local = [part for part in of_target if not part.named_share and part.p_value < SIGNIFICANCE]
    far = np.linalg.norm(evaluation.offsets.offset, axis=1) if local else np.zeros(1)

    return TargetFacts(
        largest=_largest_error(evaluation, mine),
        gain=gain,
        local_px=float(np.sqrt(sum(part.sd_px**2 for part in local))),
        local_m=float(np.sqrt((far**2).mean())),
        local_p=max((p.p_value for p in local), default=0.0),
        pose_error=_pose_error(evaluation) if local else 0.0,
        contradicted=contradicted,
        frames=evaluation.frames,
        **_frame_bend(evaluation, components),
    )


def _frame_bend(evaluation: Evaluation, components: Sequence[Component]) -> dict[str, float]:
    """Return the size, m, of a significant bend by frame, and its share beside noise."""
    found = [part for part in significant_components(components) if part.name == BEND]
    rms = float(np.sqrt((evaluation.fitted.frame_bends() ** 2).mean())) if found else 0.0
    if rms < _MIN_BEND:
        return {}
    rest = sum(part.share for part in components if part.stage != 'noise' and not part.named_share)
    return {'bend_m': MILLIMETRE * rms, 'bend_share': found[0].share / rest}


def _pose_error(evaluation: Evaluation) -> float:
    """Return by how much of its distance each camera is placed wrongly for offsets of landmarks.

    Rms over the frames, rad: of poses on the landmarks as stated, against those on the landmarks
    as they are predicted to be.
    """
    linear = evaluation.null.linear
    offsets = evaluation.offsets._replace(grids=(), views=None)
    stated, predicted = (
        adjust_poses(data, linear.state).pose for data in (linear.data, offsets.apply(linear.data))
    )
    moved = np.linalg.norm(predicted.position - stated.position, axis=-1)
    points = np.nanmean(linear.data.views.points[linear.data.views.used], axis=0)
    away = np.linalg.norm(stated.position - points, axis=-1)
    return float(np.sqrt(((moved / away) ** 2).mean()))


def _largest_error(evaluation: Evaluation, causes: Sequence[Cause]) -> TargetError | None:
    """Return the largest of the target's causes, None without any."""
    if not causes:
        return None
    worst = max(causes, key=lambda cause: cause.share)
    if worst.effect == 'target_shape':
        linear = evaluation.fixed_model
        terms = [term for term in linear.state.terms if term.name == worst.effect]
        maps = board_maps(linear.data.views, terms, linear.state.lens)
        bent = max(maps, key=lambda board: board.peak_to_valley)
        board = bent.board if len(maps) > 1 else None
        return TargetError(worst.effect, bent.peak_to_valley, board)
    if worst.effect == 'landmark_survey':
        return TargetError(worst.effect, len(worst.members))
    if worst.effect == 'landmark_scale':
        size = max((abs(p['value']) for p in worst.parameters.values()), default=0.0)
        return TargetError(worst.effect, size, stretched='relative' not in worst.parameters)
    return TargetError(worst.effect)
