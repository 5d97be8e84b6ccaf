"""What to do, in the order of what it brings; nothing that held-out data refute."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from fisheye_svp_ros.arrays import Index
from fisheye_svp_ros.diagnosis.causes import Cause
from fisheye_svp_ros.diagnosis.checks.medium import Medium
from fisheye_svp_ros.diagnosis.checks.turned_boards import TurnedFrame
from fisheye_svp_ros.diagnosis.evaluation import Evaluation
from fisheye_svp_ros.diagnosis.fitted_model import RepeatedErrors
from fisheye_svp_ros.diagnosis.random_effects import SAG
from fisheye_svp_ros.diagnosis.variance_budget import Component
from fisheye_svp_ros.scene.observations import Observations, frame_names
from fisheye_svp_ros.solve.outliers import FRAME, VIEW, Outliers

DIAGNOSE_AIR = ('diagnose the photographs in air first, then these with the extended lens of that '
                'run: the lens already has errors in air')
USE_EXTENDED = 'solve with the extended lens file'
RETAKE, UNLIKE, TURNED = 'retake', 'unlike', 'turned'
_OUTSTANDING_RATIO = 2.0  # times the typical one
_MAX_LISTED = 8
_MIN_SAG = 0.05  # mm


@dataclass(frozen=True)
class Advice:
    """One thing to do: what, to which frames, landmarks and boards; gain: of held-out variance.

    photographs: the files of the frames, as far as they are known; kind: RETAKE, UNLIKE where
    the other frames do not predict these, or TURNED where their board is numbered otherwise.
    """

    what: str
    frames: list[int] = field(default_factory=list)
    photographs: list[str] = field(default_factory=list)
    landmarks: list[int] = field(default_factory=list)
    boards: list[int] = field(default_factory=list)
    gain: float = 0.0
    kind: str = ''


def advise(
    evaluation: Evaluation, causes: Sequence[Cause], parts: Sequence[Component]
) -> list[Advice]:
    """Return what to do, what brings most first; parts: the random components that are there."""
    selection, gains = evaluation.selection, evaluation.gains
    advice = _use_causes(evaluation, causes)
    if any(part.stage == 'target' for part in parts):
        advice += _measure_landmarks(evaluation, (1 - gains['named'].value) * gains['local'].value)
    if any(part.name == SAG for part in parts):
        advice += _support_boards(evaluation)
    if evaluation.offsets.views is not None:
        advice.append(_vary_views(evaluation.offsets.views))
    advice += _retake_frames(evaluation)
    advice += _check_photographs(
        selection.null.linear.data.observations, selection.revision.outliers)
    advice += _check_held_out(evaluation)
    advice += [
        Advice(f'{cause.effect}: {cause.to_separate}') for cause in causes
        if cause.effect_class.budget_stage() in ('noise', 'frame') or cause.indistinguishable_from
    ]
    if evaluation.medium is not None:
        advice += _calibrate_in_air(evaluation.medium, causes)
    # Advice without a figure keeps its order, after all that has one.
    return sorted(advice, key=lambda one: -one.gain)


def turn_advice(turned: Sequence[TurnedFrame]) -> list[Advice]:
    """Return what to do about photographs whose board is numbered from another end."""
    words = ((True, 'are', 'they were reordered like the others; number them so'),
             (False, 'may be', 'they were not reordered; check them'))
    advice = []
    for corrected, are, what in words:
        mine = [one for one in turned if one.corrected == corrected]
        if mine:
            least = min(one.odds for one in mine)
            names = [one.photograph for one in mine if not one.photograph.startswith('frame ')]
            advice.append(Advice(
                f'corners {are} numbered from another end of the board (odds {least:.2g} to 1 or '
                f'more): {what}',
                frames=[one.frame for one in mine], photographs=names, kind=TURNED))
    return advice


def _use_causes(evaluation: Evaluation, causes: Sequence[Cause]) -> list[Advice]:
    """Return what to do about causes of lens and target that held-out data confirm."""
    gains, advice = evaluation.gains, []
    stages = {cause.effect_class.budget_stage() for cause in causes}
    if 'lens' in stages and gains['lens'].value > 0:
        advice.append(Advice(USE_EXTENDED, gain=gains['lens'].value))
    target = gains['named'].value - max(gains['lens'].value, 0.0)
    if 'target' in stages and target > 0:
        boards = sorted({board for cause in causes if cause.effect_class.budget_stage() == 'target'
                         for board in _boards(cause)})
        advice.append(Advice(
            'measure the board, or flatten or replace it',
            boards=boards,
            landmarks=[n for c in causes if c.effect_class.target_map == 'single'
                       for n in _landmarks(c)],
            gain=target,
        ))
    return advice


def _support_boards(evaluation: Evaluation) -> list[Advice]:
    """Return what to do about boards that sag by their own weight."""
    boards = evaluation.null.linear.scene.boards
    sizes = np.linalg.norm(evaluation.fitted.board_sags(), ord=2, axis=(1, 2))
    return [Advice(
        f'support the board or hold it upright: it bends by {size:.1f} mm between lying face up '
        'and upright', boards=[board.id])
        for board, size in zip(boards, sizes, strict=True) if size > _MIN_SAG]


def _check_held_out(evaluation: Evaluation) -> list[Advice]:
    """Return what to do about held-out frames that are no measure of a model."""
    test = evaluation.held_out
    if test is None:
        alone = _frame_numbers(evaluation)[~evaluation.counted_frames]
        return [_about_frames(
            evaluation.null.linear.data.observations,
            'take more photographs like these: the others do not predict them. Either only they '
            'cover a part of the image, or they are wrong; the held-out rms excludes them',
            alone.tolist(), UNLIKE)] if len(alone) else []
    table = test.data.observations
    advice = _check_photographs(table, test.outliers, 'held-out ')
    if test.another_target:
        advice.append(Advice(
            'hold out photographs of the same target: in these, landmarks of the same numbers '
            'have other coordinates, so errors of the target are not predicted there'))
    if test.rig_differs:
        advice.append(_about_frames(
            table, 'check these held-out photographs: their relative camera poses differ from the '
                   'others, so each view has its own pose. Check that the rig was not touched, '
                   'the cameras are not exchanged, simultaneous photographs have one number, and '
                   'points are numbered from the same end', _shared_frames(table)))
    return advice


def _calibrate_in_air(medium: Medium, causes: Sequence[Cause]) -> list[Advice]:
    """Return what would make a lens surer that was calibrated in air."""
    advice = []
    others = {cause.effect for cause in causes if cause.effect_class.budget_stage() == 'lens'}
    told = medium.state.lens.uncertainty is not None  # by `diagnose`
    if not told and (medium.moved or len(others) > 1):
        advice.append(Advice(DIAGNOSE_AIR))
    if medium.moved:
        advice.append(Advice(
            'the lens was adjusted within the errors of its calibration in air: take photographs '
            'in air that fill the image, or measure the target better'))
    return advice


def _boards(cause: Cause) -> list[int]:
    heads = [name.partition('.')[0] for name in cause.parameters]
    return [int(head[5:]) for head in heads if head.startswith('board') and head[5:].isdigit()]


def _landmarks(cause: Cause) -> list[int]:
    return list(dict.fromkeys(int(name.partition('.')[0]) for name in cause.parameters))


def _measure_landmarks(evaluation: Evaluation, gain: float) -> list[Advice]:
    """Return the landmarks whose predicted offsets stand out, where predicting them helps."""
    far = np.linalg.norm(evaluation.offsets.offset, axis=1)
    if gain <= 0 or not far.any():
        return []
    typical = float(np.median(far[far > 0]))
    order = np.argsort(-far)[:_MAX_LISTED]
    chosen = [int(evaluation.offsets.landmark[i]) for i in order
              if far[i] > _OUTSTANDING_RATIO * typical]
    what = 'measure the landmarks of the target, first those that are displaced most'
    return [Advice(what, landmarks=chosen, gain=gain)] if chosen else []


def _vary_views(views: RepeatedErrors) -> Advice:
    """Return what to do where landmarks err alike in similar views."""
    soon = f' and taken within {views.lasting:.0f} s' if np.isfinite(views.lasting) else ''
    return Advice(
        'take photographs from more different poses: errors of landmarks repeat in similar '
        f'ones{soon} and do not average out. Check that the paper is flat, nothing reflects, and '
        'nothing is printed near the corners')


def _retake_frames(evaluation: Evaluation) -> list[Advice]:
    """Return the frames that scatter more than the others."""
    squares = evaluation.fitted.standardized_squares()
    used = evaluation.null.linear.row_mask
    size = squares.sum(axis=1) / np.maximum(used.sum(axis=1), 1)
    numbers = _frame_numbers(evaluation)
    bad = size > _OUTSTANDING_RATIO * np.median(size)
    advice = []
    if bad.any():
        order = np.flatnonzero(bad)[np.argsort(-size[bad])][:_MAX_LISTED]
        advice.append(_about_frames(
            evaluation.null.linear.data.observations,
            'take these photographs again: they scatter more than the others',
            [int(numbers[i]) for i in order], RETAKE,
        ))
    return advice


def _frame_numbers(evaluation: Evaluation) -> Index:
    """Return the numbers (F,) of the frames."""
    data = evaluation.null.linear.data
    return data.views.frame[np.unique(data.frame_of, return_index=True)[1]]


def _check_photographs(table: Observations, outliers: Outliers, where: str = '') -> list[Advice]:
    """Return the frames of which whole views are outliers, by reason."""
    off = {reason: sorted({int(table.frame[row]) for row, why in
                           zip(outliers.rows, outliers.why, strict=True) if why == reason})
           for reason in (VIEW, FRAME)}
    return [_about_frames(table, f'check these {where}photographs: {reason}', frames,
                          '' if where else RETAKE)
            for reason, frames in off.items() if frames]


def _about_frames(
    table: Observations, what: str, frames: list[int], kind: str = ''
) -> Advice:
    """Return what to do about frames of a table, with the photographs that they are."""
    known = {frame for frame, _, _ in table.photographs}
    names = [name for frame in dict.fromkeys(frames) if frame in known
             for name in frame_names(table, frame)]
    return Advice(what, frames=frames, photographs=names, kind=kind)


def _shared_frames(table: Observations) -> list[int]:
    views = np.unique(np.stack([table.frame, table.camera]), axis=1)
    frames, count = np.unique(views[0], return_counts=True)
    return [int(frame) for frame in frames[count > 1]]
