"""What Kita's text says, statement by statement, held against our numbers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.paper.lens_evaluation import LensEvaluation, shift_at
from fisheye_svp_ros.paper.tables import ERROR2_RANGE, ERROR3_RANGE, LENSES, NAMES
from fisheye_svp_ros.scene.landmarks import RADII, SPREADS

HOLDS, IN_PART, FAILS = 'holds', 'holds in part', 'does not hold'
_Z, _AXIS = 2, 3
_FACTOR = 2.0  # within which a published range counts as met
# Section 3: z errors by spread, lowest and highest, mm, with the decimals that are printed.
_Z_RANGES = {
    'fish180': ((-0.16, -0.11, 2), (0.24, 0.24, 2), (-1.69, -1.57, 2)),
    'fish214': ((-5.9, -5.4, 1), (0.22, 0.22, 2), (-7.7, -7.1, 1)),
}
_SIDEWAYS = {'fish180': 0.1, 'fish214': 0.3}  # mm
_AXES = {'fish180': (0.04, 2), 'fish214': (0.15, 2)}  # degree, with its decimals


class Claim(NamedTuple):
    """A statement of the paper (section 3, 4 or 5), our verdict, and the numbers behind it."""

    section: int
    statement: str
    verdict: str
    numbers: dict[str, float]


def claims(found: Mapping[str, LensEvaluation]) -> list[Claim]:
    """Check every statement on the evaluations of both lenses with the SVP solver."""
    pair = [found[name] for name in LENSES]
    return [
        *(claim for one in pair for claim in _localization_bounds(one)),
        *_localization(*pair), *_calibration(*pair), *_stereo(*pair),
    ]


def _verdict(*holds: bool | Mask) -> str:
    flat = np.concatenate([np.ravel(part) for part in holds])
    return HOLDS if flat.all() else IN_PART if flat.any() else FAILS


def _localization_bounds(one: LensEvaluation) -> Iterator[Claim]:
    lens, table = one.lens.name, one.localization
    name = NAMES[lens]
    worst = float(np.abs(table[..., :2]).max())
    yield Claim(
        3, f'{name}: position errors in x and y are less than {_SIDEWAYS[lens]} mm.',
        _verdict(worst < _SIDEWAYS[lens]), {'largest |x| or |y|, mm': worst},
    )
    for z, spread, (low, high, decimals) in zip(
        table[..., _Z].T, SPREADS, _Z_RANGES[lens], strict=True
    ):
        between = f'{low} to {high}' if low != high else f'{low}'
        rounded = z.round(decimals)
        yield Claim(
            3, f'{name}: position errors in z for {spread.title()} are {between} mm.',
            _verdict((rounded >= low) & (rounded <= high)),
            {f'z at {radius} m, mm': float(v) for radius, v in zip(RADII, z, strict=True)},
        )
    bound, decimals = _AXES[lens]
    worst = float(table[..., _AXIS].max())
    yield Claim(
        3, f'{name}: axis errors are very small, at most {bound} degree.',
        _verdict(round(worst, decimals) <= bound), {'largest axis error, degree': worst},
    )


def _localization(one: LensEvaluation, other: LensEvaluation) -> Iterator[Claim]:
    z = [found.localization[..., _Z] for found in (one, other)]
    size = [float(np.abs(values).mean()) for values in z]
    spans = [
        float(1e3 * np.ptp(shift_at(found.lens, np.radians(np.linspace(0, 88, 89)))))
        for found in (one, other)
    ]
    yield Claim(
        3, 'The z errors of Fish214 are fairly large, those of Fish180 much smaller, because the '
        'viewpoint shift of Fish214 is much larger.',
        _verdict(size[1] > 2 * size[0], spans[1] > 2 * spans[0]),
        _by_lens('mean |z|, {}, mm', size)
        | _by_lens('shift range to 88 degree, {}, mm', spans),
    )
    change = [float((np.ptp(v, axis=0) / np.abs(v).mean(axis=0)).max()) for v in z]
    axis = [found.localization[..., _AXIS] for found in (one, other)]
    growth = float(min((a[-1] / a[0]).min() for a in axis))
    yield Claim(
        3, 'The distance between camera and landmarks does not affect the localization errors.',
        _verdict(max(change) < 0.15, growth < 1.15),
        _by_lens('largest change of z over the radii, {}, %', [100 * c for c in change])
        | {'least growth of the axis error from 2.0 to 0.2 m, times': growth},
    )
    far = [values[0] for values in z]
    ratios = [float(np.ptp(values) / np.abs(values).min()) for values in far]
    yield Claim(
        3, 'The range of the landmarks (Whole, Inner, Outer) affects the localization errors.',
        _verdict(min(ratios) > 1.0), _by_lens('spread of z over least |z|, {}', ratios),
    )
    # Whole beside Inner and Outer, in what noise does to z and in what SVP does.
    numbers: dict[str, float] = {}
    best: list[bool] = []
    for found, values in zip((one, other), far, strict=True):
        noise = [1e3 * float(np.sqrt(s.solved.covariance[0, 2, 2])) for s in found.localized]
        for spread, deviation, error in zip(SPREADS, noise, np.abs(values), strict=True):
            where = f'{NAMES[found.lens.name]} {spread.title()} 2.0 m, mm'
            numbers |= {f'z for 1 px of noise, {where}': deviation,
                        f'|z| from SVP, {where}': float(error)}
        best += [noise[0] == min(noise), bool(np.abs(values).argmin() == 0)]
    yield Claim(
        3, 'Landmarks over the whole field of view give stable localization results.',
        _verdict(np.array(best)), numbers,
    )


def _calibration(one: LensEvaluation, other: LensEvaluation) -> Iterator[Claim]:
    position = [np.linalg.norm(f.calibration[..., :3], axis=-1) for f in (one, other)]
    axis = [found.calibration[..., _AXIS] for found in (one, other)]
    worst, worst_axis = float(position[0].max()), float(axis[0].max())
    yield Claim(
        4, 'Fish180: position and axis errors of the three stereo styles are very small '
        '(published: at most 0.19 mm and 0.027 degree).',
        _verdict(worst < 0.19, worst_axis <= 0.027),
        {'largest position error, mm': worst, 'largest axis error, degree': worst_axis},
    )
    yield Claim(
        4, 'Fish214: position and axis errors are rather larger than those of Fish180.',
        _verdict(position[1] > position[0], axis[1] > axis[0]),
        {'median ratio of position errors': float(np.median(position[1] / position[0])),
         'median ratio of axis errors': float(np.median(axis[1] / axis[0]))},
    )


def _stereo(one: LensEvaluation, other: LensEvaluation) -> Iterator[Claim]:
    # Lens, radius, style.
    error2, largest, error3 = (
        np.stack([found.panels(name).reshape(3, 3) for found in (one, other)])
        for name in ('error2_px', 'error2_max_px', 'error3_m')
    )
    growth = error2[:, 1:] / error2[:, :-1]
    yield Claim(
        5, 'Vertical errors of epipolar lines increase when the targets come close.',
        _verdict(growth > 1),
        {'least growth from one radius to the next, times': float(growth.min()),
         'largest growth, times': float(growth.max())},
    )
    ordered = int(np.all(np.diff(error2, axis=2) > 0, axis=2).sum())
    yield Claim(
        5, 'In most cases the errors increase in the order parallel, vergent, divergent.',
        _verdict(ordered > 3),
        {'cases in this order, of 6': float(ordered),
         'cases where divergent is worst, of 6': float((error2.argmax(axis=2) == 2).sum())},
    )
    yield from _ranges_met(error2, ERROR2_RANGE, 'vertical errors', 'px')
    yield Claim(
        5, 'The vertical errors of Fish214 are much larger than those of Fish180.',
        _verdict(error2[1] / error2[0] > 2),
        {'least ratio': float((error2[1] / error2[0]).min()),
         'largest ratio': float((error2[1] / error2[0]).max())},
    )
    ratio = largest / error2
    yield Claim(
        5, 'In every case the error size greatly varies with the position in the left image.',
        _verdict(ratio > 2),
        {'largest over mean error, least case': float(ratio.min()),
         'largest over mean error, most extreme case': float(ratio.max())},
    )
    yield from _ranges_met(1e3 * error3, ERROR3_RANGE, '3-D position errors', 'mm')
    # A relation would be a style or a radius that is worst throughout.
    farther, worst = error3[:, 0] > error3[:, 2], error3.argmax(axis=2)
    yield Claim(
        5, 'There is no clear relation of the 3-D error to the distance or the stereo style.',
        _verdict(bool((worst != worst[0, 0]).any()), not farther.all()),
        {'cases of 6 in which 2.0 m is worse than 0.2 m': float(farther.sum()),
         'median ratio of 2.0 m to 0.2 m': float(np.median(error3[:, 0] / error3[:, 2])),
         'cases of 6 in which parallel is not the worst style': float((worst != 0).sum())},
    )
    over = error2 > 1
    yield Claim(
        6, 'For a target close to a stereo camera of Fish214 the viewpoint shift must be '
        'considered (more than one pixel off the epipolar line).',
        _verdict(over[1, 2]),
        {'panels above 1 px, Fish214, of 9': float(over[1].sum()),
         'panels above 1 px, Fish180, of 9': float(over[0].sum())},
    )


def _ranges_met(
    errors: Array, published: Mapping[str, tuple[float, float]], what: str, unit: str
) -> Iterator[Claim]:
    for lens, values in zip(LENSES, errors, strict=True):
        low, high = published[lens]
        off = np.abs(np.log([values.min() / low, values.max() / high]))
        yield Claim(
            5, f'{NAMES[lens]}: the averages of the {what} are between {low} and {high} {unit} '
            f'(met within a factor of {_FACTOR:g} at both ends).',
            _verdict(off < np.log(_FACTOR)),
            {f'least, {unit}': float(values.min()), f'largest, {unit}': float(values.max())},
        )


def _by_lens(what: str, values: list[float]) -> dict[str, float]:
    return {what.format(NAMES[lens]): v for lens, v in zip(LENSES, values, strict=True)}
