"""What to do, in the order of what it brings; nothing that held-out data refute."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from fisheye_svp_ros.arrays import Index
from fisheye_svp_ros.diagnosis.budget import Component, stage_of
from fisheye_svp_ros.diagnosis.causes import Cause
from fisheye_svp_ros.diagnosis.measured import Measured
from fisheye_svp_ros.diagnosis.medium import Medium
from fisheye_svp_ros.diagnosis.noise import FRAME, VIEW, Gross
from fisheye_svp_ros.diagnosis.residuals import standardised_squares
from fisheye_svp_ros.diagnosis.search import Found
from fisheye_svp_ros.diagnosis.similar_views import SimilarViews
from fisheye_svp_ros.scene.observations import Observations
from fisheye_svp_ros.scene.photograph_names import frame_names

DIAGNOSE_AIR = ('diagnose the photographs in air, too, and these anew with the extended lens of '
                'that: the lens was off in air')
_STANDS_OUT = 2.0  # times the typical one
_MOST = 8


@dataclass(frozen=True)
class Advice:
    """One thing to do: what, to which frames, landmarks and boards; gain: of held-out misfit.

    photographs: the files of the frames, as far as they are known.
    """

    what: str
    frames: list[int] = field(default_factory=list)
    photographs: list[str] = field(default_factory=list)
    landmarks: list[int] = field(default_factory=list)
    boards: list[int] = field(default_factory=list)
    gain: float = 0.0


def advise(
    found: Found, causes: Sequence[Cause], measured: Measured, parts: Sequence[Component]
) -> list[Advice]:
    """Return what to do, what brings most first; parts: the random components that are there."""
    gains = measured.gains()
    advice = []
    stages = {stage_of(cause.effect) for cause in causes}
    if 'lens' in stages and gains['lens'].value > 0:
        advice.append(Advice('solve with the extended lens file', gain=gains['lens'].value))
    target = gains['named'].value - max(gains['lens'].value, 0.0)
    if 'target' in stages and target > 0:
        boards = sorted({b for c in causes if stage_of(c.effect) == 'target' for b in _boards(c)})
        advice.append(Advice(
            'measure the target again (the extended lens file corrects it for this target alone)',
            boards=boards,
            landmarks=[n for c in causes if c.effect == 'landmark_survey' for n in _landmarks(c)],
            gain=target,
        ))
    if any(part.stage == 'target' for part in parts):
        advice += _local(measured, (1 - gains['named'].value) * gains['local'].value)
    if measured.local.views is not None:
        advice.append(_differ(measured.local.views))
    advice += _frames(found)
    advice += _set_aside(found.evidence.linear.data.observations, found.gross)
    if measured.test is None:
        alone = _numbers(found)[~measured.predicted]
        if len(alone):
            advice.append(_about_frames(
                found.evidence.linear.data.observations,
                'take more photographs like these: the others do not predict them, since they '
                'alone show some of the image, or since something is wrong with them; the '
                'held-out rms is that of the others', alone.tolist()))
    else:
        table = measured.test.observations
        advice += _set_aside(table, measured.test_gross, 'held-out ')
        if measured.another_target:
            advice.append(Advice(
                'hold out photographs of the same target: these have landmarks of the same '
                'numbers in other places, so that nothing of what stays with the target is '
                'predicted there'))
        if measured.test_moved:
            advice.append(_about_frames(
                table, 'look at these held-out photographs: their cameras do not stand as in the '
                'others, so that each view was posed by itself; was the rig touched, are the '
                'cameras exchanged, are photographs of one moment numbered alike, and the points '
                'from the same end?',
                _seen_by_several(table)))
    advice += [
        Advice(f'{cause.effect}: {cause.to_separate}') for cause in causes
        if stage_of(cause.effect) in ('noise', 'frame') or cause.indistinguishable_from
    ]
    if measured.medium is not None:
        advice += _in_air(measured.medium, causes)
    # Advice without a figure keeps its order, after all that has one.
    return sorted(advice, key=lambda one: -one.gain)


def _in_air(medium: Medium, causes: Sequence[Cause]) -> list[Advice]:
    """Return what would make a lens surer that was calibrated in air."""
    advice = []
    others = {cause.effect for cause in causes if stage_of(cause.effect) == 'lens'}
    told = medium.state.lens.uncertainty is not None  # by `diagnose`
    if not told and (medium.moved or len(others) > 1):
        advice.append(Advice(DIAGNOSE_AIR))
    if medium.moved:
        advice.append(Advice(
            'the lens was moved within what its calibration in air leaves open: take photographs '
            'in air that fill the image, or of a target that is better known'))
    return advice


def _boards(cause: Cause) -> list[int]:
    heads = [name.partition('.')[0] for name in cause.parameters]
    return [int(head[5:]) for head in heads if head.startswith('board') and head[5:].isdigit()]


def _landmarks(cause: Cause) -> list[int]:
    return list(dict.fromkeys(int(name.partition('.')[0]) for name in cause.parameters))


def _local(measured: Measured, gain: float) -> list[Advice]:
    """Return the landmarks whose predicted offsets stand out, where predicting them helps."""
    far = np.linalg.norm(measured.local.offset, axis=1)
    if gain <= 0 or not far.any():
        return []
    typical = float(np.median(far[far > 0]))
    order = np.argsort(-far)[:_MOST]
    chosen = [int(measured.local.landmark[i]) for i in order if far[i] > _STANDS_OUT * typical]
    what = 'measure single landmarks: they lie off by more than the others'
    return [Advice(what, landmarks=chosen, gain=gain)] if chosen else []


def _differ(views: SimilarViews) -> Advice:
    """Return what to do where landmarks err alike in similar views."""
    soon = f' and taken within {views.lasting:.0f} s' if np.isfinite(views.lasting) else ''
    return Advice(
        f'take photographs that differ from each other: landmarks err alike in those that are '
        f'alike{soon}, so that more of the same average nothing out; does the paper lie anew each '
        'time, does light reflect, is something printed near the corners?')


def _frames(found: Found) -> list[Advice]:
    """Return the frames that scatter more than the others."""
    squares = standardised_squares(found.fitted)
    used = found.evidence.linear.used
    size = squares.sum(axis=1) / np.maximum(used.sum(axis=1), 1)
    numbers = _numbers(found)
    bad = size > _STANDS_OUT * np.median(size)
    advice = []
    if bad.any():
        order = np.flatnonzero(bad)[np.argsort(-size[bad])][:_MOST]
        advice.append(_about_frames(
            found.evidence.linear.data.observations,
            'take these photographs again: they scatter more than the others',
            [int(numbers[i]) for i in order],
        ))
    return advice


def _numbers(found: Found) -> Index:
    """Return the numbers (F,) of the frames."""
    data = found.evidence.linear.data
    return data.views.frame[np.unique(data.frame_of, return_index=True)[1]]


def _set_aside(table: Observations, gross: Gross, where: str = '') -> list[Advice]:
    """Return the frames of which whole views are gross errors, by reason."""
    off = {reason: sorted({int(table.frame[row]) for row, why in
                           zip(gross.rows, gross.why, strict=True) if why == reason})
           for reason in (VIEW, FRAME)}
    return [_about_frames(table, f'look at these {where}photographs: {reason}', frames)
            for reason, frames in off.items() if frames]


def _about_frames(table: Observations, what: str, frames: list[int]) -> Advice:
    """Return what to do about frames of a table, with the photographs that they are."""
    known = {frame for frame, _, _ in table.photographs}
    names = [name for frame in dict.fromkeys(frames) if frame in known
             for name in frame_names(table, frame)]
    return Advice(what, frames=frames, photographs=names)


def _seen_by_several(table: Observations) -> list[int]:
    views = np.unique(np.stack([table.frame, table.camera]), axis=1)
    frames, count = np.unique(views[0], return_counts=True)
    return [int(frame) for frame in frames[count > 1]]
