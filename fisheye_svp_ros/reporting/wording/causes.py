"""Figures of a diagnosis in words, rows and human units: causes, variances, errors, outliers.

And why an effect was accepted, is not confirmed, or is not needed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from fisheye_svp_ros.diagnosis import Cause, Diagnosis, Finding, Reason, Status
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.reporting.terminal import UNITS, with_error, without_minus_zero

_CERTAIN = 0.99  # more cannot be said of models and bootstraps

_REASONS = {
    Reason.PREDICTS_BETTER: 'significant and predicts better',
    Reason.BEYOND_BULK: 'farther off than most landmarks',
    Reason.NO_CONVINCING_GAIN: 'does not predict better',
    Reason.EXPLAINED_BY_OTHER_CAUSES: 'removed: the other causes explain it',
    Reason.NO_LASTING_GAIN: 'removed: it no longer predicts better',
    Reason.REFUTED_BY_FRAMES: 'held-out frames refute it',
    Reason.REFUTED_BY_FILE: 'the held-out file refutes it',
    Reason.NO_GAIN: 'does not improve the prediction of held-out frames',
    Reason.NO_OTHER_FRAME: 'there is no other frame to confirm it',
    Reason.NEEDLESS_BESIDE_RIVAL: 'not significant if {effect} replaces {replaced}',
    Reason.NO_GAIN_BESIDE_RIVAL: 'no significant gain on held-out frames if {effect} replaces '
    '{replaced}',
}
HUMAN_UNITS = {
    'm': (1e3, 'mm'),
    'm^2': (1e6, 'mm²'),
    'rad': (180 / math.pi, 'deg'),
    's': (1e3, 'ms'),
    '1': (1e2, '%'),
    '1/rad^2': (1.0, '/rad²'),
}
_UNDETERMINED_RATIO = 1e-6  # of its standard error: a parameter of which the data know nothing
_ZERO_TOLERANCE = 1e-12  # what rounding leaves of a parameter that does nothing
_MAX_PARAMETERS = 4  # parameters that are read one by one
_MAX_DECIMALS = 2  # of a percentage that is nearly 0 or 100
_UNCERTAIN = {
    'image_px': ('an image point, u or v', 1.0, 'px'),
    'position_m': ('position from one frame', 1e3, 'mm'),
    'rotation_rad': ('orientation from one frame', 180 / math.pi, 'deg'),
}
COMPONENTS = {
    'named_lens': 'lens, identified',
    'named_target': 'target, identified',
    'named_frame': 'frames, identified',
    'image_broad': 'smooth image error, correlation length 1/3 of the width',
    'image_coarse': 'smooth image error, correlation length 1/6 of the width',
    'image_fine': 'smooth image error, correlation length 1/14 of the width',
    'image_finest': 'finer image error',
    'landmark_in_plane': 'landmarks, in the plane of their board',
    'landmark_normal': 'landmarks, out of the plane of their board',
    'landmark': 'landmarks',
    'board_stretch': 'stretch of the board',
    'board_in_plane': 'smooth error of the board, in its plane',
    'board_normal': 'smooth error of the board, out of its plane',
    'frame_focal': 'focal length of each frame',
    'frame_centre': 'principal point of each frame',
    'frame_linear': 'linear image error of each frame',
    'frame_quadratic': 'quadratic image error of each frame',
    'frame_bumps': 'smooth image error of each frame',
    'frame_bend': 'bend of the board in each frame',
    'frame_sag': 'bend of the board that follows its tilt',
    'frame_motion': 'motion while the rows of an image are read',
    'frame_similar': 'landmarks in similar views',
    'noise': 'noise of image points',
}
# Of a confounded set: with another one in its place, each may be nothing.
ONE_IS_THERE, SIZE_OPEN = 'one of them is present', 'the size of each is unknown'
_MAX_LANDMARKS = 6  # landmarks named in a row


def chance(probability: float) -> str:
    """Return a probability in percent."""
    if probability > _CERTAIN:
        return f'more than {100 * _CERTAIN:.0f} %'
    if probability < 1 - _CERTAIN:
        return f'less than {100 * (1 - _CERTAIN):.0f} %'
    return f'{100 * probability:.0f} %'


def capital(text: str) -> str:
    """Return the start of a sentence."""
    return text[:1].upper() + text[1:]


def pixels(value: float) -> str:
    """Return an error without its unit: three decimals, or three digits where these say less."""
    return f'{value:.3f}' if 0.0005 <= value < 9.9995 else f'{value:.3g}'


def belief(status: Status, probability: float) -> str:
    """Return status and probability, as the terminal, the report and the node show them."""
    return f'{status.value}, {chance(probability)}'


def with_odds(cause: Cause, name: str, words: str = '') -> str:
    """Return one of a confounded set, by name or in words, with its share in the probability."""
    odds = f' ({chance(cause.odds[name])})' if name in cause.odds else ''
    return f'{words or name}{odds}'


def finding_reason(finding: Finding) -> str:
    """Return why, as a clause that begins in lower case and ends without a stop."""
    if finding.reason is Reason.IMPLAUSIBLE:
        size = next(abs(entry['value']) for entry in finding.parameters.values())
        return f'a shift of {1e3 * size:.0f} mm is larger than in any real lens: are lengths in m?'
    rival = finding.rival._asdict() if finding.rival else {}
    return _REASONS[finding.reason].format(**rival)


def describe_effect(effect: str) -> str:
    """Return what an effect is, as the end of a sentence."""
    text = CATALOGUE[effect].summary()
    return text[0].lower() + text[1:].rstrip('.')


def quantity(entry: Mapping[str, Any]) -> str:
    """Return a parameter's value and standard error in the unit that people read."""
    factor, unit = HUMAN_UNITS.get(entry['unit'], (1.0, entry['unit']))
    value, error = with_error(factor * entry['value'], factor * entry['stderr'])
    return (f'{value} {unit}' if error == '-' else f'{value} ± {error} {unit}').rstrip()


def size(diagnosis: Diagnosis, cause: Cause) -> str:
    """Return how large a cause is: its parameters, or what many of them amount to."""
    target_map = cause.effect_class.target_map
    if target_map == 'smooth':
        maps = diagnosis.board_maps((cause.effect,))
        return '; '.join(
            (f'board {m.board}: ' if len(maps) > 1 else '')
            + f'{1e3 * m.peak_to_valley:.2f} mm peak to valley'
            for m in maps
            if m.peak_to_valley > 0
        )
    if target_map == 'single':
        return _landmarks(diagnosis, cause)
    shown = {name: entry for name, entry in cause.parameters.items() if _is_determined(entry)}
    largest = sorted(shown, key=lambda name: -significance(shown[name]))[:_MAX_PARAMETERS]
    text = ', '.join(f'{name} = {quantity(shown[name])}' for name in shown if name in largest)
    text += f' and {len(shown) - len(largest)} more' if len(shown) > len(largest) else ''
    errors = [entry['stderr'] for entry in shown.values()]
    if not any(errors) or any(significance(entry) >= 1 for entry in shown.values()):
        return text
    if cause.indistinguishable_from:
        return f'{ONE_IS_THERE}, {SIZE_OPEN}: {text}'
    return f'its size is within its error: {text}'


def _is_determined(entry: Mapping[str, Any]) -> bool:
    limit = _ZERO_TOLERANCE
    if not math.isnan(entry['stderr']):
        limit = max(limit, _UNDETERMINED_RATIO * entry['stderr'])
    return bool(abs(entry['value']) > limit)


def significance(entry: Mapping[str, Any]) -> float:
    """Return a parameter in standard errors; 0 where it was not estimated."""
    ratio = abs(entry['value']) / entry['stderr'] if entry['stderr'] else math.nan
    return 0.0 if math.isnan(ratio) else float(ratio)


def _landmarks(diagnosis: Diagnosis, cause: Cause) -> str:
    names = list(dict.fromkeys(name.partition('.')[0] for name in cause.parameters))
    if len(names) <= _MAX_PARAMETERS:
        values = np.array([entry['value'] for entry in cause.parameters.values()]).reshape(-1, 3)
        far = 1e3 * np.linalg.norm(values, axis=1)
        return ', '.join(f'landmark {n} by {d:.2f} mm' for n, d in zip(names, far, strict=True))
    maps = diagnosis.board_maps((cause.effect,))
    squares = np.concatenate([m.height**2 + (m.slide**2).sum(axis=1) for m in maps])
    return f'{len(names)} landmarks by {1e3 * np.sqrt(squares.mean()):.2f} mm rms'


def probability(p_value: float) -> str:
    """Return a p-value; the smallest ones rest on more normal tails than any data have."""
    return f'p = {p_value:.1g}' if p_value > 1e-12 else 'p < 1e-12'


def bare_probability(p_value: float) -> str:
    """Return a p-value under a head that says p."""
    return probability(p_value).removeprefix('p ').removeprefix('= ')


def percent(share: float) -> str:
    """Return a share in percent; neither a little nor nearly all is rounded to nothing or all."""
    value = 100 * share
    texts = [f'{value:.{decimals}f}' for decimals in range(_MAX_DECIMALS + 1)]
    text = next((text for text in texts if float(text) not in (0, 100)), texts[0])
    return f'{without_minus_zero(text)} %'


def cause_rows(diagnosis: Diagnosis) -> Iterable[tuple[str, ...]]:
    """Yield the table of causes: effect, size, p-value, share, held-out rms, gain, its class."""
    for c in diagnosis.causes:
        rms = '-' if math.isnan(c.heldout_rms_px) else f'{c.heldout_rms_px:.4f}'
        same = ', '.join(with_odds(c, name) for name in c.indistinguishable_from) or '-'
        p_value = bare_probability(c.p_value)
        same += '' if c.survives else '; significant only together with another cause'
        share = percent(c.share) if c.share else '-'
        gain = '-' if math.isnan(c.heldout_rms_px) else percent(c.gain)
        yield c.effect, size(diagnosis, c), p_value, share, rms, gain, same


def budget_rows(diagnosis: Diagnosis) -> Iterable[tuple[str, str, str, str, str]]:
    """Yield the variance budget: part, stage, sd in px, share, p-value."""
    for part in diagnosis.components:
        yield (
            COMPONENTS[part.name],
            part.stage,
            f'{part.sd_px:.3f}',
            percent(part.share),
            '-' if part.name == 'noise' else bare_probability(part.p_value),
        )


def uncertainty_rows(diagnosis: Diagnosis) -> Iterable[tuple[str, ...]]:
    """Yield what noise, parameters and remaining misfit make uncertain, and all together."""
    for name, parts in diagnosis.evaluation.uncertainty.items():
        label, factor, unit = _UNCERTAIN[name]
        sizes = (*parts.values(), math.hypot(*parts.values()))
        yield label, *(f'{factor * value:.3g}' for value in sizes), unit


def intrinsic_rows(diagnosis: Diagnosis) -> Iterable[tuple[str, str, str]]:
    """Yield each free intrinsic and its unit, before and after, with its standard error."""
    for name, value in diagnosis.evaluation.intrinsics.items():
        unit = UNITS.get(name.rpartition('.')[2])
        yield (
            f'{name}, {unit}' if unit else name,
            ' ± '.join(with_error(value.before, value.before_stderr)),
            ' ± '.join(with_error(value.after, value.after_stderr)),
        )


class OutlierRow(NamedTuple):
    """Outliers of one view for one reason: its name, camera, landmarks, largest error in px."""

    where: str
    camera: str
    landmarks: str
    points: int
    px: float
    why: str


def outlier_rows(gross: Sequence[Mapping[str, Any]]) -> list[OutlierRow]:
    """Return a row for each view and reason, most points first; gross: as in diagnosis.json."""
    groups: dict[tuple[str, str, str], list[Mapping[str, Any]]] = {}
    for point in gross:
        where = point.get('photograph') or f'frame {point["frame"]}'
        groups.setdefault((where, point.get('camera', ''), point['why']), []).append(point)
    rows = [
        OutlierRow(
            where,
            camera,
            _numbers([point['landmark'] for point in points]),
            len(points),
            max(point['px'] for point in points),
            why,
        )
        for (where, camera, why), points in groups.items()
    ]
    return sorted(rows, key=lambda row: (-row.points, -row.px))


def _numbers(landmarks: Sequence[int]) -> str:
    """Return landmark numbers, ascending, at most so many and the count of the others."""
    names = [str(number) for number in sorted(landmarks)]
    more = f' and {len(names) - _MAX_LANDMARKS} more' if len(names) > _MAX_LANDMARKS else ''
    return ', '.join(names[:_MAX_LANDMARKS]) + more
