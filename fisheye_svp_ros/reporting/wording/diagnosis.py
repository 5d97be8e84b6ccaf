"""A diagnosis in words and human units: for the terminal, the report and /diagnostics."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from fisheye_svp_ros.diagnosis import (
    TURNED,
    Action,
    Advice,
    Cause,
    Comparison,
    Diagnosis,
    FlawKind,
    LensReason,
    Reason,
)
from fisheye_svp_ros.effects.base import NO_TIME
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.reporting.wording.adequacy import flaw_headline, flaw_reason
from fisheye_svp_ros.reporting.wording.causes import (
    describe_effect,
    percent,
    pixels,
    probability,
    size,
    with_odds,
)
from fisheye_svp_ros.reporting.wording.decisions import advised_action, decision_reason, separation
from fisheye_svp_ros.scene.observations import frame_name
from fisheye_svp_ros.solve.rig_checks import is_unpaired

CAPTIONS = {
    'field': 'Residual vectors over the image. The scale is in the upper right corner. Dotted '
    'lines: equal incidence angle. Above: single points. Below: means over cells of the image, '
    'which show errors common to all frames.',
    'theta': 'Residuals against the incidence angle, along the radius from the principal point '
    '(above) and across it (below).',
    'range': 'Residuals against the distance of the landmark. If the viewpoint of the lens moves, '
    'the radial residuals change with the distance.',
    'landmark': 'Residuals of each landmark. A landmark that stands out is displaced.',
    'frame': 'Residuals of each frame. A step or a drift indicates a change of the camera.',
    'phase': 'Residuals against the fractional part of the image point. Waves come from the '
    'detector.',
    'histogram': 'Residuals divided by the noise. The end bins include everything beyond 6. '
    'Wide tails are outliers, or noise that varies.',
}
LENS_FILE = 'extended_lens.yaml'
LENS = {
    'keep': 'Use this lens',
    'use_extended': f'Use {LENS_FILE}',
    'recalibrate': f'Do not use this lens; calibrate again, or use {LENS_FILE}',
    'undecided': 'Use this lens only where its error is acceptable; take more photographs',
}
_OF_RIG = {
    'keep': 'Use these lenses',
    'use_extended': 'Use the extended lenses',
    'recalibrate': 'Do not use these lenses; calibrate again, or use the extended ones',
    'undecided': 'Use these lenses only where their error is acceptable; take more photographs',
}
VARIABLES = {
    'image': 'the position in the image',
    'theta': 'the incidence angle',
    'range': 'the distance of the landmark',
    'landmark': 'the landmark',
    'frame': 'the frame',
    'time': 'the time',
    'pixel_phase': 'the fractional part of the image point',
}
_STRUCTURE_TEXTS = {
    'outliers': 'a few points are outliers',
    'scatter_vs_theta': 'the scatter changes with the incidence angle',
    'scatter_vs_frame': 'the scatter differs from frame to frame',
    'size': 'the residuals do not agree with the stated sigma',
}
_MEASURES = {
    'position_error_m': ('position error', 1e3, 'mm'),
    'axis_error_rad': ('error of the viewing axis', 180 / math.pi, 'deg'),
    'depth_error_m': ('stereo error', 1e3, 'mm'),
    'rig_translation_m': ('translation of the rig', 1e3, 'mm'),
    'rig_rotation_rad': ('rotation of the rig', 180 / math.pi, 'deg'),
}
STAGE_WORDS = {
    'lens': 'lens (stays in the image)',
    'target': 'target (stays with the board)',
    'frame': 'frames (motion, detector, light)',
    'noise': 'noise',
}
_MAX_CAUSES = 3  # causes that one sentence can bear
_MAX_NAMES = 6  # names in one sentence
_NOISE_RATIO = 1.5  # times the noise, from which an error is more than that


class RemainingError(NamedTuple):
    """What predictions of held-out points leave, rms in px, and how many times the noise."""

    px: float
    ratio: float


def lens_words(d: Diagnosis) -> str:
    """Return what to do about the lens, or the lenses of several cameras."""
    several = len(d.lenses) > 1
    words = (_OF_RIG if several else LENS)[d.decision['lens'].say]
    if d.adequacy.flaws and d.decision['lens'].say == 'undecided':
        return _until_data_are_better(d, 'these lenses' if several else 'this lens')
    return words if d.offers_extended or not d.is_lens_off else words.partition(', or ')[0]


def _until_data_are_better(d: Diagnosis, lens: str) -> str:
    """Return what a lens is good for whose data are wrong, or determine too little."""
    worst, kinds = d.adequacy.flaws[0].kind, {flaw.kind for flaw in d.adequacy.flaws}
    if worst.is_misfit and not worst.is_unit:
        return 'Do not use a lens calibrated from these data'
    if is_short_of_angle(d):
        return f'Use {lens} only within the angle of the points'
    if kinds <= {FlawKind.LENS_UNKNOWN, FlawKind.ANGLE_SHORT}:
        return f'Use {lens} only where that error bound is good enough'
    return f'Do not use {lens} yet'


def is_short_of_angle(d: Diagnosis) -> bool:
    """Whether nothing but the angle of the points limits the lens: where they are, it is sound."""
    kinds = {flaw.kind for flaw in d.adequacy.flaws}
    sound = d.decision['lens'].reason is LensReason.NO_CAUSE_CONFIRMED
    return kinds == {FlawKind.ANGLE_SHORT} and sound


def remaining_error(d: Diagnosis) -> RemainingError | None:
    """Return what the lens that is to be used leaves, the target corrected; None for noise."""
    px = d.file.extended_px if d.offers_extended else d.file.given_px
    ratio = px / max(2**0.5 * d.noise_px, 1e-3)
    return RemainingError(px, ratio) if ratio > _NOISE_RATIO else None


def refusal_reason(d: Diagnosis) -> str:
    """Return why the extended lens is not to be used, '' where it is."""
    if d.offers_extended:
        return ''
    if d.is_lens_off:
        return 'It predicts held-out frames worse than the lens as given: calibrate again'
    why = decision_reason(d.decision['lens'])
    return f'It is not known to be better than the lens as given: {why}'


def only_gross(d: Diagnosis) -> bool:
    """Say whether all that remains is points that were rejected, by name."""
    return bool(d.gross) and {structure.variable for structure in d.remaining} == {'outliers'}


def remains(diagnosis: Diagnosis, most: int = 3) -> str:
    """Return what the residuals still show, the variables they depend on most first."""
    order = sorted(diagnosis.remaining, key=lambda structure: -structure.share)
    names = list(dict.fromkeys(structure.variable for structure in order))
    depends = [VARIABLES.get(name, name) for name in names if name not in _STRUCTURE_TEXTS]
    clauses = [f'they depend on {join_names(depends[:most])}'] if depends else []
    others = (remaining_text(diagnosis, name) for name in names if name in _STRUCTURE_TEXTS)
    return '; '.join([*clauses, *others])


def remaining_text(diagnosis: Diagnosis, variable: str) -> str:
    """Return one variable of what remains as a clause."""
    if variable == 'outliers' and diagnosis.gross:
        worst, count = diagnosis.gross[0], len(diagnosis.gross)
        where = worst.get('photograph') or f'frame {worst["frame"]}'
        which = f'{where} landmark {worst["landmark"]} ({pixels(worst["px"])} px)'
        return (
            f'{count} points are outliers; the largest is {which}'
            if count > 1
            else f'one point is an outlier: {which}'
        )
    if variable == 'size':
        ratio = math.sqrt(diagnosis.figures.extended.chi2_per_dof or math.nan)
        return f'the residuals are {ratio:.2g} times as large as sigma'
    depends = f'residuals depend on {VARIABLES.get(variable, variable)}'
    return _STRUCTURE_TEXTS.get(variable, depends)


def verdict_sentences(
    diagnosis: Diagnosis, known: Mapping[str, Comparison] | None = None
) -> tuple[str, str, str]:
    """Return what is wrong, what correcting it gains, and what to do next.

    known: errors where the truth is known, of `diagnosis.known_errors`.
    """
    gain = _gain_sentence(diagnosis, known or {}) + _field_sentence(diagnosis)
    return _wrong(diagnosis), gain, _next_step(diagnosis)


def frame_ranges(d: Diagnosis, ranges: Sequence[tuple[int, int]]) -> str:
    """Return what the first and the last frames of ranges are called; '' for none."""
    table = d.evaluation.problem.observations
    return join_names([' to '.join(frame_name(table, end) for end in ends) for ends in ranges])


def count_frames(d: Diagnosis) -> str:
    """Return how many frames there are; of cameras that no rig holds together, how many views."""
    numbers, plural = d.evaluation.problem.observations.frame, 's' * (d.frames > 1)
    if is_unpaired(d.evaluation.fixed_model.data):
        frames = len({*numbers.tolist()})
        return (
            f'{d.frames} view{plural} of {frames} frame{"s" * (frames > 1)} (each view with '
            'its own pose)'
        )
    pictures = d.evaluation.problem.observations.photographs and len(d.lenses) == 1
    return f'{d.frames} {"photograph" if pictures else "frame"}{plural}'


def lens_contents(d: Diagnosis) -> str:
    """Return what the extended lens has that the lens as given has not."""
    field = d.evaluation.written_field
    parts = ['intrinsics fitted to these data'] if d.evaluation.intrinsics else []
    parts += [c.effect for c in d.causes if c.stage == 'lens']
    averaged = dict.fromkeys(one.effect.name for one in d.evaluation.averaged_model.effects)
    parts += [f'{name}, which is not confirmed' for name in averaged]
    parts += ['an image field'] if field is not None and field.fields else []
    return f'with {join_names(parts)}' if parts else 'as it was fitted'


def _field_sentence(d: Diagnosis) -> str:
    """Return what the image field in the lens file gains, and which frames refute it."""
    field = d.evaluation.written_field
    if field is None or not field.fields:
        return ''
    refuted = frame_ranges(d, field.refuted)
    return (
        ' The lens file holds an image field. With it, held-out frames are predicted to '
        f'{pixels(field.after)} px rms, compared with {pixels(field.before)} px without it'
        + (f', but {refuted} worse' if refuted else '')
        + '.'
    )


def _wrong(d: Diagnosis) -> str:
    if d.adequacy.is_misfit:
        return ' '.join(f'{flaw_headline(flaw)}.' for flaw in d.adequacy.flaws)
    noise = f'noise of {pixels(d.noise_px)} px per coordinate'
    if _shows_no_cause(d):
        but = [
            what
            for what, told in (
                ('the intrinsics as given', d.is_lens_off),
                ('the rig', _rig_advice(d)),
                ('the target', _is_target_off(d)),
            )
            if told
        ]
        nothing = f'Nothing except {join_names(but)}' if but else 'Nothing'
        likely = d.verdict == 'adequate' and d.offers_extended
        wrong = 'confirmed to be wrong' if likely else 'wrong'
        rest = ' and displaced landmarks' if _is_target_off(d) else ', without a pattern'
        return (
            f'{nothing} is {wrong} in these data. The residuals of {d.observations} points in '
            f'{count_frames(d)} are {noise}{rest}.'
        )
    if not d.causes:
        off = 'The intrinsics as given are wrong. Fitted to these data, the lens'
        return (
            f'{off if d.is_lens_off else "The lens"} model leaves residuals of '
            f'{pixels(d.figures.base.rms_px)} px rms. No effect of the catalog explains them: '
            f'{remains(d, 7)}{_almost(d)}.'
        )
    causes = '; '.join(
        f'{describe_effect(c.effect)} ({_name(d, c)}: {size(d, c)}; {probability(c.p_value)})'
        for c in d.causes[:_MAX_CAUSES]
    )
    more = len(d.causes) - _MAX_CAUSES
    rest = f'; the table lists {more} more cause{"s" * (more > 1)}' if more > 0 else ''
    return f'In addition to {noise}, there are these errors: {causes}{rest}.'


def _shows_no_cause(d: Diagnosis) -> bool:
    """Say whether the lens, fitted to these data where it may be, leaves noise."""
    return not d.causes and d.verdict in ('adequate', 'explained')


def _is_target_off(d: Diagnosis) -> bool:
    """Say whether landmarks are displaced, where no cause says how."""
    return d.frames > 1 and (bool(d.remaining) or d.decision['target'].figure.value > 0)


def _almost(d: Diagnosis) -> str:
    """Return which effect would be named, had it predicted frames that were left out."""
    for step in d.trace:
        if step.reason is Reason.NO_CONVINCING_GAIN:
            return (
                f'. {step.effect} is significant ({probability(step.p_corrected)}), but it does '
                'not significantly improve the prediction of held-out frames: take more '
                'photographs'
            )
    return ''


def _name(d: Diagnosis, cause: Cause) -> str:
    others = join_names([with_odds(cause, rival) for rival in cause.indistinguishable_from], 'or')
    assumed = ', assumed by --with' if is_assumed(d, cause) else ''
    return f'{cause.effect}{assumed}' + (f', confounded with {others}' if others else '')


def is_assumed(d: Diagnosis, cause: Cause) -> bool:
    """Say whether a cause was not tested, since the user said that it is there."""
    return cause.effect in d.evaluation.problem.options.included


def _gain_sentence(d: Diagnosis, known: Mapping[str, Comparison]) -> str:
    before, named, best = (
        quality.heldout_rms_px for quality in (d.figures.base, d.figures.named, d.figures.extended)
    )
    moving = [c for c in d.causes if c.effect_class.stage != 'noise']
    local = ''
    if best < 0.99 * named:
        local = (
            '. With the random effects of single landmarks and of the image, the error is '
            f'{pixels(best)} px'
        )
    elif best > 1.01 * named:
        local = (
            '. The random effects of single landmarks and of the image do not transfer to it: '
            f'with them, the error is {pixels(best)} px'
        )
    if not moving:
        why, times = 'no extension improves on that', before / max(2**0.5 * d.noise_px, 1e-3)
        if _shows_no_cause(d):
            why = 'that is the noise' if times < _NOISE_RATIO else _poor_prediction(d, times)
        if d.causes:
            why = 'the cause is in the image points, not in the lens'
        which = (
            'The lens, fitted to these data,' if d.evaluation.intrinsics else 'The lens as given'
        )
        text = f'{which} predicts held-out data to {pixels(before)} px rms: {why}{local}'
        return text + (_file_clause(d) if d.offers_extended else '') + '.'
    if named >= before:
        return (
            f'Held-out data do not confirm this: {pixels(named)} px rms, compared with '
            f'{pixels(before)} px. Do not correct for the causes{local}.'
        )
    text = (
        f'With the correction, held-out data are predicted to {pixels(named)} px rms, compared '
        f'with {pixels(before)} px without it{local}'
    )
    if d.figures.gain.value > 0:
        value, low, high = map(percent, d.figures.gain.interval.values())
        text += (
            f'. The correction removes {value} (95 % interval {low} to {high}) of the error '
            'above the noise'
        )
    if 'target' in {c.stage for c in moving}:
        text += _file_clause(d)
    for (label, base, extended, _), compared in zip(
        known_rows(d, known), known.values(), strict=True
    ):
        changed = compared.low > 0 or compared.high < 0
        text += (
            f'. The {label} '
            + (f'goes from {base} to' if changed else 'stays at')
            + (f' {extended}')
        )
    return text + '.'


def _poor_prediction(d: Diagnosis, times: float) -> str:
    """Return why held-out data leave several times the noise where no cause shows."""
    if d.decision['target'].say == 'measure_again':
        return f'{times:.1f} times the noise: landmarks are displaced'
    if d.decision['photographs'].say == 'enough':
        return f'{times:.1f} times the noise'
    how = '; --next N lists the photographs to take' if d.evaluation.problem.plannable else ''
    return f'{times:.1f} times the noise: these frames constrain the lens poorly{how}'


def _file_clause(d: Diagnosis) -> str:
    return (
        f'. On the same corrected target, the extended lens leaves {pixels(d.file.extended_px)} '
        f'px and the lens as given {pixels(d.file.given_px)} px'
    )


def _rig_advice(d: Diagnosis) -> list[str]:
    """Return what to find out of cameras that no rig holds together."""
    return [
        f'find out why the relative pose of {join_names(pair.cameras)} is not constant (check '
        'the frame numbers, the order of the points, exchanged cameras, and the mount)'
        for pair in d.cameras
        if pair.posed_alone and pair.rig
    ]


def _next_step(d: Diagnosis) -> str:
    lens = lens_words(d)
    if d.adequacy.flaws:
        return '; '.join([lens, flaw_reason(d.adequacy.flaws, 'photographs')]) + '.'
    if d.verdict == 'adequate':
        blind = f'; not testable here: {join_names(list(d.untestable))}' if d.untestable else ''
        turned = [advice_text(advice) for advice in d.advice if advice.kind == TURNED]
        return '; '.join([lens, *_rig_advice(d), *turned]) + f'{blind}.'
    steps = [lens, *_rig_advice(d)]
    steps += [
        f'find out why {join_names(pair.cameras)} disagree about the target. Was it bent or '
        'exchanged in between? Do both number its landmarks in the same way? Do not correct it '
        'until then'
        for pair in d.cameras
        if pair.verdict == 'contradict'
    ]
    steps += [advice_text(advice) for advice in d.advice if advice.frames]
    gaining = [
        advice
        for advice in d.advice
        if advice.gain > 0 and advice.action is not Action.USE_EXTENDED
    ]
    steps += [advice_text(advice) for advice in gaining[:_MAX_CAUSES]]
    steps += [advice_text(advice) for advice in d.advice if advice.action is Action.DIAGNOSE_AIR]
    held = [c.effect for c in d.causes if c.stage == 'frame' and c.effect in d.lens.corrections]
    if held and d.decision['lens'].say == 'use_extended':
        steps.append(f'it includes {join_names(held)}')
    steps += [
        f'to confirm {c.effect}: {_remedy(c)}'
        for c in d.causes
        if c.stage == 'frame' and not c.indistinguishable_from
    ]
    steps += [
        f'to separate {c.effect} from {join_names(c.indistinguishable_from, "and")}: {_remedy(c)}'
        for c in d.causes
        if c.indistinguishable_from
    ]
    steps += [_remedy(c) for c in d.causes if c.effect_class.stage == 'noise']
    if 'frame' in {structure.variable for structure in d.remaining}:
        untimed = [name for name, reason in d.untestable.items() if reason == NO_TIME]
        steps += filter(None, (CATALOGUE[name].when_untestable for name in untimed))
    if d.remaining:
        steps.append(f'look for the cause of the remaining residuals: {remains(d)}')
    return '; '.join(dict.fromkeys(steps)) + '.'


def advice_text(advice: Advice) -> str:
    """Return one thing to do, with the names of what it is about."""
    frames = [] if advice.photographs else [*dict.fromkeys(advice.frames)]
    about = [join_names(advice.photographs[:_MAX_NAMES])] if advice.photographs else []
    about += [
        f'{name}s {join_names([str(n) for n in numbers[:_MAX_NAMES]])}'
        if len(numbers) > 1
        else f'{name} {numbers[0]}'
        for name, numbers in (
            ('frame', frames),
            ('board', advice.boards),
            ('landmark', advice.landmarks),
        )
        if numbers
    ]
    what = advised_action(advice).replace('the extended lens file', LENS_FILE)
    return f'{what} ({", ".join(about)})' if about else what


def _remedy(cause: Cause) -> str:
    return separation(cause).replace(';', ',')


def known_rows(
    d: Diagnosis, known: Mapping[str, Comparison]
) -> Iterable[tuple[str, str, str, str]]:
    """Yield name, mean error before, after ('-': no cause), and by how much it is less."""
    changed = any(cause.effect_class.stage != 'noise' for cause in d.causes)
    for name, compared in known.items():
        label, before, *rest = compared_row(name, compared)
        after, less = rest if changed else ('-', '-')
        yield label, before, after, less


def known_reference(d: Diagnosis) -> str:
    """Return what `known_rows` compare with: true poses, or else the target as stated."""
    return 'the truth' if d.evaluation.fixed_model.data.poses is not None else 'the target'


def compared_row(name: str, compared: Comparison) -> tuple[str, str, str, str]:
    """Return a mean error's name, its value before and after, and by how much it is less."""
    label, factor, unit = _MEASURES[name]
    return (
        label,
        f'{factor * compared.before:.3g} {unit}',
        f'{factor * compared.after:.3g} {unit}',
        f'{percent(compared.value)} ({percent(compared.low)} to {percent(compared.high)})',
    )


def join_names(names: Sequence[str], word: str = 'and') -> str:
    """Return names as one enumerates them."""
    return f' {word} '.join(filter(None, (', '.join(names[:-1]), *names[-1:])))
