"""A diagnosis in words and human units: for the terminal, the report and /diagnostics."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

from fisheye_svp_ros.diagnosis import (
    DIAGNOSE_AIR,
    TURNED,
    USE_EXTENDED,
    Advice,
    Cause,
    Comparison,
    Diagnosis,
)
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.reporting.cause_text import (
    bare_probability,
    describe_effect,
    percent,
    probability,
    size,
)
from fisheye_svp_ros.reporting.tables import UNITS, with_error
from fisheye_svp_ros.scene.photograph_names import frame_name

LENS_FILE = 'extended_lens.yaml'
LENS = {
    'keep': 'Keep the lens',
    'use_extended': f'Use {LENS_FILE}',
    'recalibrate': f'Do not use the lens as given; calibrate again, or use {LENS_FILE}',
    'undecided': 'Undecided about the lens; take more photographs',
}
_OF_RIG = {
    'keep': 'Keep the lenses',
    'use_extended': 'Use the extended lenses',
    'recalibrate': 'Do not use these lenses as given; calibrate again, or use the extended lenses',
    'undecided': 'Undecided about the lenses; take more photographs',
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
    'size': 'the residuals do not match the stated sigma',
}
_MEASURES = {
    'position_error_m': ('position error', 1e3, 'mm'),
    'axis_error_rad': ('error of the viewing axis', 180 / math.pi, 'deg'),
    'depth_error_m': ('stereo error', 1e3, 'mm'),
    'rig_translation_m': ('translation of the rig', 1e3, 'mm'),
    'rig_rotation_rad': ('rotation of the rig', 180 / math.pi, 'deg'),
}
_UNCERTAIN = {
    'image_px': ('an image point, u or v', 1.0, 'px'),
    'position_m': ('position from one frame', 1e3, 'mm'),
    'rotation_rad': ('orientation from one frame', 180 / math.pi, 'deg'),
}
COMPONENTS = {
    'named_lens': 'lens, identified', 'named_target': 'target, identified',
    'named_frame': 'frames, identified',
    'image_broad': 'image field, correlated over 1/3 of the width',
    'image_coarse': 'image field, correlated over 1/6 of the width',
    'image_fine': 'image field, correlated over 1/14 of the width',
    'image_finest': 'finer image field',
    'landmark_in_plane': 'landmarks along their board',
    'landmark_normal': 'landmarks off their board', 'landmark': 'landmarks',
    'board_stretch': 'stretch of the board', 'board_in_plane': 'board field along it',
    'board_normal': 'board field off it',
    'frame_focal': 'focal length of each frame', 'frame_centre': 'principal point of each frame',
    'frame_linear': 'linear field of each frame',
    'frame_quadratic': 'quadratic field of each frame',
    'frame_bumps': 'image field of each frame', 'frame_bend': 'bend of the board in each frame',
    'frame_sag': 'bend of the board that follows its tilt',
    'frame_similar': 'landmarks in similar views', 'noise': 'noise of image points',
}
STAGE_WORDS = {
    'lens': 'lens (stays in the image)', 'target': 'target (stays with the board)',
    'frame': 'frames (motion, detector, light)', 'noise': 'noise',
}
_MAX_CAUSES = 3  # causes that one sentence can bear
_MAX_NAMES = 6  # names in one sentence
_NOISE_RATIO = 1.5  # times the noise, from which an error is more than that


def lens_words(d: Diagnosis) -> str:
    """Return what to do about the lens, or the lenses of several cameras."""
    return (_OF_RIG if len(d.lenses) > 1 else LENS)[d.decision['lens'].say]


def refusal_reason(d: Diagnosis) -> str:
    """Return why the extended lens is not to be used, '' where it is."""
    if d.offers_extended:
        return ''
    return f'It is not known to be better than the lens as given: {d.decision["lens"].why}'


def only_gross(d: Diagnosis) -> bool:
    """Say whether all that remains is points that were rejected, by name."""
    return bool(d.gross) and {one.variable for one in d.remaining} == {'outliers'}


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
        which = f'{where} landmark {worst["landmark"]} ({worst["px"]:.3g} px)'
        return (f'{count} points are outliers, the largest {which}' if count > 1 else
                f'one point is an outlier, {which}')
    if variable == 'size':
        ratio = math.sqrt(diagnosis.figures.extended.chi2_per_dof or math.nan)
        return f'the residuals are {ratio:.2g} times as large as sigma states'
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
    table = d.problem.observations
    return join_names([' to '.join(frame_name(table, one) for one in ends) for ends in ranges])


def _field_sentence(d: Diagnosis) -> str:
    """Return what the image field in the lens file gains, and which frames refute it."""
    field = d.evaluation.written_field
    if field is None or not field.fields:
        return ''
    refuted = frame_ranges(d, field.refuted)
    return (f' The lens file holds an image field: it predicts frames left out to '
            f'{field.after:.3g} px rms instead of {field.before:.3g}'
            + (f', but {refuted} worse' if refuted else '') + '.')


def _wrong(d: Diagnosis) -> str:
    noise = f'noise of {d.noise_px:.3g} px a coordinate'
    if d.verdict == 'adequate':
        but = [what for what, told in (('the intrinsics as given', _is_off(d)),
                                       ('the rig', _rig_advice(d))) if told]
        nothing = f'Nothing but {join_names(but)}' if but else 'Nothing'
        return (f'{nothing} is wrong in these data: in {d.observations} points of {d.frames} '
                f'frames the residuals are {noise}, without a pattern.')
    if not d.causes:
        return (f'The simulation leaves residuals of {d.figures.base.rms_px:.3g} px rms, and no '
                'effect of the catalog explains them: '
                f'{remains(d, 7)}{_almost(d)}.')
    causes = '; '.join(
        f'{describe_effect(c.effect)} ({_name(c)}: {size(d, c)}; {probability(c.p_value)})'
        for c in d.causes[:_MAX_CAUSES]
    )
    more = len(d.causes) - _MAX_CAUSES
    rest = f'; the table lists {more} more cause{"s" * (more > 1)}' if more > 0 else ''
    return f'Besides {noise}, these errors are found: {causes}{rest}.'


def _almost(d: Diagnosis) -> str:
    """Return which effect would be named, had it predicted frames that were left out."""
    for step in d.trace:
        if not step.accepted and step.why.endswith('does not predict better'):
            name = step.effect.partition('(')[0]
            return (f'; {name} is significant ({probability(step.corrected)}), but does not '
                    'improve the prediction of left-out frames significantly: take more '
                    'photographs')
    return ''


def _name(cause: Cause) -> str:
    others = join_names(cause.indistinguishable_from, 'or')
    return f'{cause.effect}, confounded with {others}' if others else cause.effect


def _gain_sentence(d: Diagnosis, known: Mapping[str, Comparison]) -> str:
    before, named, best = (quality.heldout_rms_px for quality in (
        d.figures.base, d.figures.named, d.figures.extended))
    moving = [c for c in d.causes if c.effect_class.stage != 'noise']
    local = ''
    if best < 0.99 * named:
        local = f'; with the random effects of single landmarks and of the image, to {best:.3g} px'
    elif best > 1.01 * named:
        local = ('; the random effects of single landmarks and of the image do not transfer to '
                 f'it: with them {best:.3g} px')
    if not moving:
        why, times = 'no extension improved on it', before / max(2**0.5 * d.noise_px, 1e-3)
        if d.verdict == 'adequate':
            why = 'that is the noise' if times < _NOISE_RATIO else (
                f'{times:.1f} times the noise: these frames constrain the lens poorly; --next N '
                'lists the photographs to take')
        if d.causes:
            why = 'the cause is in the image points, not in the lens'
        which = 'The lens, fitted to these data,' if _is_off(d) else 'The lens as it is'
        return f'{which} predicts held-out data to {before:.3g} px rms; {why}{local}.'
    if named >= before:
        return (f'Held-out data do not confirm it: {named:.3g} px rms instead of {before:.3g}; do '
                f'not correct for the causes{local}.')
    text = (f'Corrected, held-out data are predicted to {named:.3g} px rms instead of '
            f'{before:.3g}{local}')
    if d.figures.gain.value > 0:
        value, low, high = map(percent, d.figures.gain.interval.values())
        text += (f'; this removes {value} (95 % interval {low} to {high}) of the error above the '
                 'noise')
    if 'target' in {c.effect_class.budget_stage() for c in moving}:
        text += (f'; on the same corrected target the extended lens leaves '
                 f'{d.file.extended_px:.3g} px, the lens as given {d.file.given_px:.3g} px')
    for (label, base, extended, _), compared in zip(
        known_rows(known), known.values(), strict=True
    ):
        changed = compared.low > 0 or compared.high < 0
        text += f'; the {label} ' + (f'goes from {base} to' if changed else 'stays at') + (
            f' {extended}')
    return text + '.'


def _is_off(d: Diagnosis) -> bool:
    """Say whether the lens as given is another one than the data show."""
    return d.decision['lens'].say == 'recalibrate'


def _rig_advice(d: Diagnosis) -> list[str]:
    """Return what to find out of cameras that no rig holds together."""
    return [f'find out why {join_names(pair.cameras)} have no constant relative pose (check frame '
            'numbers, the end from which points are numbered, exchanged cameras, the mount)'
            for pair in d.cameras if pair.posed_alone and pair.rig]


def _next_step(d: Diagnosis) -> str:
    lens = lens_words(d)
    if d.verdict == 'adequate':
        blind = f'; not testable here: {join_names(list(d.untestable))}' if d.untestable else ''
        turned = [advice_text(one) for one in d.advice if one.kind == TURNED]
        return '; '.join([lens, *_rig_advice(d), *turned]) + f'{blind}.'
    steps = [lens, *_rig_advice(d)]
    steps += [
        f'find out why {join_names(pair.cameras)} contradict each other about the target: check '
        'that it was not bent or exchanged in between, and that both number its landmarks alike. '
        'Use no correction of it until then' for pair in d.cameras if pair.verdict == 'contradict'
    ]
    steps += [advice_text(one) for one in d.advice if one.frames]
    steps += [advice_text(one) for one in d.advice
              if one.gain > 0 and one.what != USE_EXTENDED][:_MAX_CAUSES]
    steps += [advice_text(one) for one in d.advice if one.what == DIAGNOSE_AIR]
    held = [c.effect for c in d.causes
            if c.effect_class.budget_stage() == 'frame' and c.effect in d.lens.corrections]
    if held and d.decision['lens'].say == 'use_extended':
        steps.append(f'it includes {join_names(held)}')
    steps += [f'to confirm {c.effect}: {_remedy(c)}' for c in d.causes
              if c.effect_class.budget_stage() == 'frame' and not c.indistinguishable_from]
    steps += [
        f'to separate {c.effect} from {join_names(c.indistinguishable_from, "and")}: {_remedy(c)}'
        for c in d.causes if c.indistinguishable_from
    ]
    steps += [_remedy(c) for c in d.causes if c.effect_class.stage == 'noise']
    if 'frame' in {one.variable for one in d.remaining}:
        steps += filter(None, (CATALOGUE[name].when_untestable for name in d.untestable))
    if d.remaining:
        steps.append(f'look for the cause of the remaining residuals: {remains(d)}')
    return '; '.join(dict.fromkeys(steps)) + '.'


def advice_text(advice: Advice) -> str:
    """Return one thing to do, with the names of what it is about."""
    frames = [] if advice.photographs else [*dict.fromkeys(advice.frames)]
    about = [join_names(advice.photographs[:_MAX_NAMES])] if advice.photographs else []
    about += [
        f'{name}s {join_names([str(n) for n in numbers[:_MAX_NAMES]])}' if len(numbers) > 1
        else f'{name} {numbers[0]}'
        for name, numbers in (('frame', frames), ('board', advice.boards),
                              ('landmark', advice.landmarks)) if numbers
    ]
    what = advice.what.replace('the extended lens file', LENS_FILE)
    return f'{what} ({", ".join(about)})' if about else what


def budget_rows(diagnosis: Diagnosis) -> Iterable[tuple[str, str, str, str, str]]:
    """Yield the variance budget: part, stage, sd in px, share, p-value."""
    for part in diagnosis.components:
        yield (COMPONENTS[part.name], part.stage, f'{part.sd_px:.3f}', percent(part.share),
               '-' if part.name == 'noise' else bare_probability(part.p_value))


def uncertainty_rows(diagnosis: Diagnosis) -> Iterable[tuple[str, ...]]:
    """Yield what noise, parameters and remaining misfit make uncertain, and all together."""
    for name, parts in diagnosis.uncertainty.items():
        label, factor, unit = _UNCERTAIN[name]
        sizes = (*parts.values(), math.hypot(*parts.values()))
        yield label, *(f'{factor * value:.3g}' for value in sizes), unit


def intrinsic_rows(diagnosis: Diagnosis) -> Iterable[tuple[str, str, str]]:
    """Yield each free intrinsic and its unit, before and after, with its standard error."""
    for name, value in diagnosis.intrinsics.items():
        unit = UNITS.get(name.rpartition('.')[2])
        yield (
            f'{name}, {unit}' if unit else name,
            ' ± '.join(with_error(value.before, value.before_stderr)),
            ' ± '.join(with_error(value.after, value.after_stderr)),
        )


def _remedy(cause: Cause) -> str:
    return cause.to_separate.replace(';', ',')


def known_rows(known: Mapping[str, Comparison]) -> Iterable[tuple[str, str, str, str]]:
    """Return name, mean error before and after, and by how much it is less."""
    return (compared_row(name, compared) for name, compared in known.items())


def compared_row(name: str, compared: Comparison) -> tuple[str, str, str, str]:
    """Return a mean error's name, its value before and after, and by how much it is less."""
    label, factor, unit = _MEASURES[name]
    return (label, f'{factor * compared.before:.3g} {unit}',
            f'{factor * compared.after:.3g} {unit}',
            f'{percent(compared.value)} ({percent(compared.low)} to {percent(compared.high)})')


def join_names(names: Sequence[str], word: str = 'and') -> str:
    """Return names as one enumerates them."""
    return f' {word} '.join(filter(None, (', '.join(names[:-1]), *names[-1:])))
