"""What Kita's text says, statement by statement, held against our numbers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.paper.lens_evaluation import LensEvaluation
from fisheye_svp_ros.paper.tables import ERROR2_RANGE, ERROR3_RANGE, LENSES, NAMES
from fisheye_svp_ros.scene.observations import RADII, SPREADS

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


def claims(evaluations: Mapping[str, LensEvaluation]) -> list[Claim]:
    """Check every statement on the evaluations of both lenses with the SVP solver."""
    pair = [evaluations[name] for name in LENSES]
    return [
        *(claim for result in pair for claim in _localization_bounds(result)),
        *_localization(*pair),
        *_calibration(*pair),
        *_stereo(*pair),
    ]


def _make_claim(
    section: int, statement: str, holds: Sequence[Any], numbers: Mapping[str, Any]
) -> Claim:
    flat = np.concatenate([np.ravel(part) for part in holds])
    verdict = HOLDS if flat.all() else IN_PART if flat.any() else FAILS
    return Claim(section, statement, verdict, {name: float(v) for name, v in numbers.items()})


def _localization_bounds(evaluation: LensEvaluation) -> Iterator[Claim]:
    lens, table = evaluation.lens.name, evaluation.localization
    name = NAMES[lens]
    worst = np.abs(table[..., :2]).max()
    yield _make_claim(
        3,
        f'{name}: position errors in x and y are less than {_SIDEWAYS[lens]} mm.',
        [worst < _SIDEWAYS[lens]],
        {'largest |x| or |y|, mm': worst},
    )
    for z, spread, (low, high, decimals) in zip(
        table[..., _Z].T, SPREADS, _Z_RANGES[lens], strict=True
    ):
        between = f'{low} to {high}' if low != high else f'{low}'
        rounded = z.round(decimals)
        yield _make_claim(
            3,
            f'{name}: position errors in z for {spread.title()} are {between} mm.',
            [(rounded >= low) & (rounded <= high)],
            {f'z at {radius} m, mm': v for radius, v in zip(RADII, z, strict=True)},
        )
    bound, decimals = _AXES[lens]
    worst = float(table[..., _AXIS].max())
    yield _make_claim(
        3,
        f'{name}: axis errors are very small, at most {bound} degree.',
        [round(worst, decimals) <= bound],
        {'largest axis error, degree': worst},
    )


def _localization(evaluation: LensEvaluation, other: LensEvaluation) -> Iterator[Claim]:
    z = [result.localization[..., _Z] for result in (evaluation, other)]
    size = [np.abs(values).mean() for values in z]
    angles = np.radians(np.linspace(0, 88, 89))
    spans = [1e3 * np.ptp(result.lens.shift_at(angles)) for result in (evaluation, other)]
    yield _make_claim(
        3,
        'The z errors of Fish214 are fairly large, those of Fish180 much smaller, because the '
        'viewpoint shift of Fish214 is much larger.',
        [size[1] > 2 * size[0], spans[1] > 2 * spans[0]],
        _by_lens('mean |z|, {}, mm', size) | _by_lens('shift range to 88 degree, {}, mm', spans),
    )
    change = [(np.ptp(v, axis=0) / np.abs(v).mean(axis=0)).max() for v in z]
    axis = [result.localization[..., _AXIS] for result in (evaluation, other)]
    growth = min((a[-1] / a[0]).min() for a in axis)
    yield _make_claim(
        3,
        'The distance between camera and landmarks does not affect the localization errors.',
        [max(change) < 0.15, growth < 1.15],
        _by_lens('largest change of z over the radii, {}, %', [100 * c for c in change])
        | {'least growth of the axis error from 2.0 to 0.2 m, times': growth},
    )
    far = [values[0] for values in z]
    ratios = [np.ptp(values) / np.abs(values).min() for values in far]
    yield _make_claim(
        3,
        'The range of the landmarks (Whole, Inner, Outer) affects the localization errors.',
        [min(ratios) > 1.0],
        _by_lens('spread of z over least |z|, {}', ratios),
    )
    # Whole beside Inner and Outer, in what noise does to z and in what SVP does.
    numbers: dict[str, float] = {}
    best: list[bool] = []
    for result, values in zip((evaluation, other), far, strict=True):
        noise = [1e3 * np.sqrt(s.solved.covariance[0, 2, 2]) for s in result.localized]
        for spread, deviation, error in zip(SPREADS, noise, np.abs(values), strict=True):
            where = f'{NAMES[result.lens.name]} {spread.title()} 2.0 m, mm'
            numbers |= {
                f'z for 1 px of noise, {where}': deviation,
                f'|z| from SVP, {where}': error,
            }
        best += [noise[0] == min(noise), bool(np.abs(values).argmin() == 0)]
    yield _make_claim(
        3,
        'Landmarks over the whole field of view give stable localization results.',
        [np.array(best)],
        numbers,
    )


def _calibration(evaluation: LensEvaluation, other: LensEvaluation) -> Iterator[Claim]:
    position = [np.linalg.norm(f.calibration[..., :3], axis=-1) for f in (evaluation, other)]
    axis = [result.calibration[..., _AXIS] for result in (evaluation, other)]
    worst, worst_axis = position[0].max(), axis[0].max()
    yield _make_claim(
        4,
        'Fish180: position and axis errors of the three stereo styles are very small '
        '(published: at most 0.19 mm and 0.027 degree).',
        [worst < 0.19, worst_axis <= 0.027],
        {'largest position error, mm': worst, 'largest axis error, degree': worst_axis},
    )
    yield _make_claim(
        4,
        'Fish214: position and axis errors are rather larger than those of Fish180.',
        [position[1] > position[0], axis[1] > axis[0]],
        {
            'median ratio of position errors': np.median(position[1] / position[0]),
            'median ratio of axis errors': np.median(axis[1] / axis[0]),
        },
    )


def _stereo(evaluation: LensEvaluation, other: LensEvaluation) -> Iterator[Claim]:
    # Lens, radius, style.
    error2, largest, error3 = (
        np.stack([result.panels(name).reshape(3, 3) for result in (evaluation, other)])
        for name in ('error2_px', 'error2_max_px', 'error3_m')
    )
    growth = error2[:, 1:] / error2[:, :-1]
    yield _make_claim(
        5,
        'Vertical errors of epipolar lines increase when the targets come close.',
        [growth > 1],
        {
            'least growth from one radius to the next, times': growth.min(),
            'largest growth, times': growth.max(),
        },
    )
    ordered = np.all(np.diff(error2, axis=2) > 0, axis=2).sum()
    yield _make_claim(
        5,
        'In most cases the errors increase in the order parallel, vergent, divergent.',
        [ordered > 3],
        {
            'cases in this order, of 6': ordered,
            'cases where divergent is worst, of 6': (error2.argmax(axis=2) == 2).sum(),
        },
    )
    yield from _ranges_met(error2, ERROR2_RANGE, 'vertical errors', 'px')
    ratio = error2[1] / error2[0]
    yield _make_claim(
        5,
        'The vertical errors of Fish214 are much larger than those of Fish180.',
        [ratio > 2],
        {'least ratio': ratio.min(), 'largest ratio': ratio.max()},
    )
    ratio = largest / error2
    yield _make_claim(
        5,
        'In every case the error size greatly varies with the position in the left image.',
        [ratio > 2],
        {
            'largest over mean error, least case': ratio.min(),
            'largest over mean error, most extreme case': ratio.max(),
        },
    )
    yield from _ranges_met(1e3 * error3, ERROR3_RANGE, '3-D position errors', 'mm')
    # A relation would be a style or a radius that is worst throughout.
    farther, worst = error3[:, 0] > error3[:, 2], error3.argmax(axis=2)
    yield _make_claim(
        5,
        'There is no clear relation of the 3-D error to the distance or the stereo style.',
        [(worst != worst[0, 0]).any(), not farther.all()],
        {
            'cases of 6 in which 2.0 m is worse than 0.2 m': farther.sum(),
            'median ratio of 2.0 m to 0.2 m': np.median(error3[:, 0] / error3[:, 2]),
            'cases of 6 in which parallel is not the worst style': (worst != 0).sum(),
        },
    )
    over = error2 > 1
    yield _make_claim(
        6,
        'For a target close to a stereo camera of Fish214 the viewpoint shift must be '
        'considered (more than one pixel off the epipolar line).',
        [over[1, 2]],
        {
            'panels above 1 px, Fish214, of 9': over[1].sum(),
            'panels above 1 px, Fish180, of 9': over[0].sum(),
        },
    )


def _ranges_met(
    errors: Array, published: Mapping[str, tuple[float, float]], what: str, unit: str
) -> Iterator[Claim]:
    for lens, values in zip(LENSES, errors, strict=True):
        low, high = published[lens]
        off = np.abs(np.log([values.min() / low, values.max() / high]))
        yield _make_claim(
            5,
            f'{NAMES[lens]}: the averages of the {what} are between {low} and {high} {unit} '
            f'(met within a factor of {_FACTOR:g} at both ends).',
            [off < np.log(_FACTOR)],
            {f'least, {unit}': values.min(), f'largest, {unit}': values.max()},
        )


def _by_lens(what: str, values: Sequence[float]) -> dict[str, float]:
    return {what.format(NAMES[lens]): v for lens, v in zip(LENSES, values, strict=True)}
