"""What to do about target and photographs, in a sentence that says how."""

from __future__ import annotations

from fisheye_svp_ros.diagnosis import (
    MIN_FRAMES,
    Action,
    Diagnosis,
    FlawKind,
    PhotographsReason,
    TargetFacts,
)
from fisheye_svp_ros.reporting.wording.adequacy import remedy
from fisheye_svp_ros.reporting.wording.causes import capital
from fisheye_svp_ros.reporting.wording.decisions import COVERAGE, decision_reason
from fisheye_svp_ros.reporting.wording.diagnosis import LENS_FILE, count_frames
from fisheye_svp_ros.scene.table_checks import target_size

PLANNED_VIEWS = 6  # photographs that a plan lists, at least
_STIFF_PLATE = 'mount it on a stiff plate'
_FINEST_RULER = 0.3  # mm that one reads from a ruler; less takes calipers
_COARSEST = 0.5  # mm: to this, anything is measured
_PRECISION = 3.0  # times finer than what is to be measured
_OF_VIEWS = (FlawKind.LENS_UNKNOWN, FlawKind.ANGLE_SHORT, FlawKind.FEW_FRAMES)


def target_words(d: Diagnosis) -> str:
    """Return what to do about the target."""
    decision = d.decision['target']
    facts, say = decision.facts, decision.say
    assert isinstance(facts, TargetFacts)
    if say == 'undecided':
        return 'Leave it as it is'
    if say == 'keep':
        return f'{capital(_STIFF_PLATE)} before you take more' if facts.bend_m else 'Keep it'
    if say == 'correct' and d.offers_extended:
        flatten = ', or flatten it' if _is_bent(d) else ''
        use = f'Use it with {LENS_FILE}, which corrects its errors{flatten}'
        return f'{use}. The lens in it works with any target; these corrections do not'
    return f'For better poses, {_remedy(d, facts)}'


def _is_bent(d: Diagnosis) -> bool:
    return any(cause.effect == 'target_shape' for cause in d.causes)


def _remedy(d: Diagnosis, facts: TargetFacts) -> str:
    """Return how to correct a target: what to measure, how precisely, with what tool."""
    if facts.contradicted:
        return 'find out whether it was bent or exchanged between the photographs of two cameras'
    stiff = [_STIFF_PLATE] if facts.bend_m else []
    largest = facts.largest
    if largest is None or largest.effect == 'landmark_survey':
        how = f'measure the distances between its landmarks {_tool(1e3 * facts.local_m)}'
    elif largest.effect == 'target_shape':
        how = (
            'flatten or replace it; a straightedge laid across it shows the gap of '
            f'{1e3 * largest.size:.2g} mm'
        )
    elif largest.effect == 'landmark_scale':
        across = 1e3 * largest.size * target_size(d.evaluation.problem.observations)
        how = f'measure its {"width and height" if largest.stretched else "width"} {_tool(across)}'
    elif largest.effect == 'board_pose':
        how = 'measure how its boards are mounted to each other, with a steel ruler'
    else:
        how = 'measure it, or replace it'
    of_shape = largest is None or largest.effect == 'target_shape'
    return ', and '.join(stiff if stiff and of_shape else [*stiff, how])


def _tool(error_mm: float) -> str:
    """Return with what, and to what precision, an error of the target is measured."""
    precision = min(error_mm / _PRECISION, _COARSEST)
    tool = 'a steel ruler' if precision >= _FINEST_RULER else 'calipers'
    return f'with {tool}, to {precision:.1g} mm'


def photographs_words(d: Diagnosis) -> str:
    """Return what to do about the photographs."""
    say, flaws = d.decision['photographs'].say, d.adequacy.flaws
    if d.adequacy.is_misfit:
        if flaws[0].kind.is_unit or flaws[0].kind is FlawKind.MIRRORED:
            return 'Correct the table'
        if flaws[0].kind is FlawKind.NO_FIT:
            return 'Check them'
        return 'Do not use them' + (' together' if flaws[0].kind is FlawKind.CAMERAS_MIXED else '')
    if flaws and flaws[0].kind.is_of_table:
        return 'Correct their points, or retake them'
    moved = any(advice.action is Action.HOLD_STILL for advice in d.advice)
    if say == 'more':
        still = ', with camera and target held still' if moved else ''
        return f'Take {views_to_take(d)} more{still}'
    if say == 'enough':
        return f'Enough for this answer: {count_frames(d)}'
    return 'For a better answer, retake some'


def views_to_take(d: Diagnosis) -> int:
    """Return how many photographs to take before the next diagnosis."""
    return max(MIN_FRAMES - d.frames, PLANNED_VIEWS)


def photographs_reason(d: Diagnosis) -> str:
    """Return which photographs to take, or why these are enough, as a clause."""
    decision = d.decision['photographs']
    if decision.reason is PhotographsReason.LENS_UNDECIDED and not decision.flaws:
        return COVERAGE
    if not decision.flaws:
        return decision_reason(decision)
    kinds = [flaw.kind for flaw in decision.flaws]
    others = [kind for kind in kinds if kind not in _OF_VIEWS]
    if others:
        return '; '.join(map(remedy, others))
    # One way to take photographs: where the rays are unknown, the most is asked for.
    asked = FlawKind.ANGLE_SHORT if {*kinds} == {FlawKind.ANGLE_SHORT} else FlawKind.LENS_UNKNOWN
    return remedy(asked)
