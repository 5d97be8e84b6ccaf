"""What Kita's text says, statement by statement, held against our numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Mask
from fisheye_svp_ros.paper.evaluation import Evaluation, shift_at
from fisheye_svp_ros.paper.tables import ERROR2_RANGE, ERROR3_RANGE, LENSES
from fisheye_svp_ros.scene.landmarks import RADII

HOLDS, IN_PART, FAILS = 'holds', 'holds in part', 'does not hold'
_X, _Y, _Z, _AXIS = range(4)
_WHOLE, _INNER, _OUTER = range(3)
_FACTOR = 2.0  # within which a published range counts as met
_NAMES = {'fish180': 'Fish180', 'fish214': 'Fish214'}


class Claim(NamedTuple):
    """A statement of the paper (section 3, 4 or 5), our verdict, and the numbers behind it."""

    section: int
    statement: str
    verdict: str
    numbers: dict[str, float]


def claims(found: Mapping[str, Evaluation]) -> list[Claim]:
    """Check every statement on the evaluations of both lenses with the SVP solver."""
    one, other = (found[name] for name in LENSES)
    return [
        _sideways(one, 0.1),
        _z(one, _WHOLE, 'Whole', -0.16, -0.11),
        _z(one, _INNER, 'Inner', 0.24, 0.24),
        _z(one, _OUTER, 'Outer', -1.69, -1.57),
        _axis(one, 0.04),
        _sideways(other, 0.3),
        _z(other, _WHOLE, 'Whole', -5.9, -5.4),
        _z(other, _INNER, 'Inner', 0.22, 0.22),
        _z(other, _OUTER, 'Outer', -7.7, -7.1),
        _axis(other, 0.15),
        _because_of_the_shift(one, other),
        _distance_does_not_matter(one, other),
        _spread_matters(one, other),
        _whole_field_is_stable(one, other),
        _calibration_small(one),
        _calibration_larger(one, other),
        _error2_grows(one, other),
        _order_of_styles(one, other),
        *(_range_met(e, 'error2_px', 1.0, 'vertical errors', 'px', ERROR2_RANGE)
          for e in (one, other)),
        _error2_larger(one, other),
        _varies_over_the_image(one, other),
        *(_range_met(e, 'error3_m', 1e3, '3-D position errors', 'mm', ERROR3_RANGE)
          for e in (one, other)),
        _no_relation(one, other),
        _matching_suffers(one, other),
    ]


def _verdict(*holds: bool | Mask) -> str:
    flat = np.concatenate([np.ravel(part) for part in holds])
    return HOLDS if flat.all() else IN_PART if flat.any() else FAILS


def _sideways(found: Evaluation, bound: float) -> Claim:
    worst = float(np.abs(found.localization[..., [_X, _Y]]).max())
    return Claim(
        3, f'{_NAMES[found.lens.name]}: position errors in x and y are less than {bound} mm.',
        _verdict(worst < bound), {'largest |x| or |y|, mm': worst},
    )


def _z(found: Evaluation, spread: int, name: str, low: float, high: float) -> Claim:
    z = found.localization[:, spread, _Z]
    decimals = 1 if found.lens.name == 'fish214' and spread != _INNER else 2
    between = f'{low} to {high}' if low != high else f'{low}'
    rounded = z.round(decimals)
    return Claim(
        3, f'{_NAMES[found.lens.name]}: position errors in z for {name} are {between} mm.',
        _verdict((rounded >= low) & (rounded <= high)),
        {f'z at {radius} m, mm': float(value) for radius, value in zip(RADII, z, strict=True)},
    )


def _axis(found: Evaluation, bound: float) -> Claim:
    worst = float(found.localization[..., _AXIS].max())
    decimals = len(str(bound).partition('.')[2])
    return Claim(
        3, f'{_NAMES[found.lens.name]}: axis errors are very small, at most {bound} degree.',
        _verdict(round(worst, decimals) <= bound), {'largest axis error, degree': worst},
    )


def _because_of_the_shift(one: Evaluation, other: Evaluation) -> Claim:
    spans = [_shift_span(found) for found in (one, other)]
    errors = [np.abs(found.localization[..., _Z]).mean() for found in (one, other)]
    return Claim(
        3, 'The z errors of Fish214 are fairly large, those of Fish180 much smaller, because the '
        'viewpoint shift of Fish214 is much larger.',
        _verdict(errors[1] > 2 * errors[0], spans[1] > 2 * spans[0]),
        {'mean |z|, Fish180, mm': float(errors[0]), 'mean |z|, Fish214, mm': float(errors[1]),
         'shift range to 88 degree, Fish180, mm': spans[0],
         'shift range to 88 degree, Fish214, mm': spans[1]},
    )


def _shift_span(found: Evaluation) -> float:
    return float(1e3 * np.ptp(shift_at(found.lens, np.radians(np.linspace(0, 88, 89)))))


def _distance_does_not_matter(one: Evaluation, other: Evaluation) -> Claim:
    z = [found.localization[..., _Z] for found in (one, other)]
    change = [float((np.ptp(v, axis=0) / np.abs(v).mean(axis=0)).max()) for v in z]
    axis = [found.localization[..., _AXIS] for found in (one, other)]
    growth = float(min((a[-1] / a[0]).min() for a in axis))
    return Claim(
        3, 'The distance between camera and landmarks does not affect the localization errors.',
        _verdict(max(change) < 0.15, growth < 1.15),
        {'largest change of z over the radii, Fish180, %': 100 * change[0],
         'largest change of z over the radii, Fish214, %': 100 * change[1],
         'least growth of the axis error from 2.0 to 0.2 m, times': growth},
    )


def _spread_matters(one: Evaluation, other: Evaluation) -> Claim:
    ratios = [
        float(np.ptp(found.localization[0, :, _Z]) / np.abs(found.localization[0, :, _Z]).min())
        for found in (one, other)
    ]
    return Claim(
        3, 'The range of the landmarks (Whole, Inner, Outer) affects the localization errors.',
        _verdict(min(ratios) > 1.0),
        {'spread of z over least |z|, Fish180': ratios[0],
         'spread of z over least |z|, Fish214': ratios[1]},
    )


def _whole_field_is_stable(one: Evaluation, other: Evaluation) -> Claim:
    """Compare Whole with Inner and Outer, in what noise does to z and in what SVP does."""
    numbers, steadier, nearer = {}, [], []
    for found in (one, other):
        deviation = [1e3 * float(np.sqrt(s.solved.covariance[0, 2, 2])) for s in found.localized]
        z = np.abs(found.localization[0, :, _Z])
        for label, noise, error in zip(('Whole', 'Inner', 'Outer'), deviation, z, strict=True):
            numbers[f'z for 1 px of noise, {_NAMES[found.lens.name]} {label} 2.0 m, mm'] = noise
            numbers[f'|z| from SVP, {_NAMES[found.lens.name]} {label} 2.0 m, mm'] = float(error)
        steadier.append(deviation[_WHOLE] == min(deviation))
        nearer.append(bool(z[_WHOLE] == z.min()))
    return Claim(
        3, 'Landmarks over the whole field of view give stable localization results.',
        _verdict(np.array(steadier), np.array(nearer)), numbers,
    )


def _calibration_small(one: Evaluation) -> Claim:
    position = np.linalg.norm(one.calibration[..., :3], axis=-1)
    worst_axis = float(one.calibration[..., _AXIS].max())
    return Claim(
        4, 'Fish180: position and axis errors of the three stereo styles are very small '
        '(published: at most 0.19 mm and 0.027 degree).',
        _verdict(position.max() < 0.19, worst_axis <= 0.027),
        {'largest position error, mm': float(position.max()),
         'largest axis error, degree': worst_axis},
    )


def _calibration_larger(one: Evaluation, other: Evaluation) -> Claim:
    position = [np.linalg.norm(f.calibration[..., :3], axis=-1) for f in (one, other)]
    axis = [found.calibration[..., _AXIS] for found in (one, other)]
    return Claim(
        4, 'Fish214: position and axis errors are rather larger than those of Fish180.',
        _verdict(position[1] > position[0], axis[1] > axis[0]),
        {'median ratio of position errors': float(np.median(position[1] / position[0])),
         'median ratio of axis errors': float(np.median(axis[1] / axis[0]))},
    )


def _error2_grows(one: Evaluation, other: Evaluation) -> Claim:
    error2 = np.stack([f.panels('error2_px').reshape(3, 3) for f in (one, other)])
    growth = error2[:, 1:] / error2[:, :-1]
    return Claim(
        5, 'Vertical errors of epipolar lines increase when the targets come close.',
        _verdict(growth > 1),
        {'least growth from one radius to the next, times': float(growth.min()),
         'largest growth, times': float(growth.max())},
    )


def _order_of_styles(one: Evaluation, other: Evaluation) -> Claim:
    """Six lens and radius pairs: is the order parallel, vergent, divergent?"""
    error2 = np.concatenate([f.panels('error2_px').reshape(3, 3) for f in (one, other)])
    ordered = np.all(np.diff(error2, axis=1) > 0, axis=1)
    most = int(ordered.sum()) > len(ordered) / 2
    return Claim(
        5, 'In most cases the errors increase in the order parallel, vergent, divergent.',
        _verdict(most),
        {'cases in this order, of 6': float(ordered.sum()),
         'cases where divergent is worst, of 6': float((error2.argmax(axis=1) == 2).sum())},
    )


def _range_met(
    found: Evaluation, metric: str, scale: float, what: str, unit: str,
    published: Mapping[str, tuple[float, float]],
) -> Claim:
    low, high = published[found.lens.name]
    values = scale * found.panels(metric)
    off = np.abs(np.log([values.min() / low, values.max() / high]))
    return Claim(
        5, f'{_NAMES[found.lens.name]}: the averages of the {what} are between {low} and {high} '
        f'{unit} (met within a factor of {_FACTOR:g} at both ends).',
        _verdict(off < np.log(_FACTOR)),
        {f'least, {unit}': float(values.min()), f'largest, {unit}': float(values.max())},
    )


def _error2_larger(one: Evaluation, other: Evaluation) -> Claim:
    ratio = other.panels('error2_px') / one.panels('error2_px')
    return Claim(
        5, 'The vertical errors of Fish214 are much larger than those of Fish180.',
        _verdict(ratio > 2),
        {'least ratio': float(ratio.min()), 'largest ratio': float(ratio.max())},
    )


def _varies_over_the_image(one: Evaluation, other: Evaluation) -> Claim:
    ratio = np.concatenate(
        [f.panels('error2_max_px') / f.panels('error2_px') for f in (one, other)]
    )
    return Claim(
        5, 'In every case the error size greatly varies with the position in the left image.',
        _verdict(ratio > 2),
        {'largest over mean error, least case': float(ratio.min()),
         'largest over mean error, most extreme case': float(ratio.max())},
    )


def _matching_suffers(one: Evaluation, other: Evaluation) -> Claim:
    over = [found.panels('error2_px') > 1 for found in (one, other)]
    return Claim(
        6, 'For a target close to a stereo camera of Fish214 the viewpoint shift must be '
        'considered (more than one pixel off the epipolar line).',
        _verdict(over[1][6:]),
        {'panels above 1 px, Fish214, of 9': float(over[1].sum()),
         'panels above 1 px, Fish180, of 9': float(over[0].sum())},
    )


def _no_relation(one: Evaluation, other: Evaluation) -> Claim:
    """A relation would be a style or a radius that is worst throughout."""
    error3 = np.stack([f.panels('error3_m').reshape(3, 3) for f in (one, other)])
    farther = error3[:, 0] > error3[:, 2]
    ranks = error3.argmax(axis=2)
    one_style = bool((ranks == ranks[0, 0]).all())
    return Claim(
        5, 'There is no clear relation of the 3-D error to the distance or the stereo style.',
        _verdict(not one_style, not farther.all()),
        {'cases of 6 in which 2.0 m is worse than 0.2 m': float(farther.sum()),
         'median ratio of 2.0 m to 0.2 m': float(np.median(error3[:, 0] / error3[:, 2])),
         'cases of 6 in which parallel is not the worst style': float((ranks != 0).sum())},
    )
