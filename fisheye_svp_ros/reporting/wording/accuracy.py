"""How good the lens is that is to be used: the line of the accuracy, its part of the headline."""

from __future__ import annotations

from collections.abc import Mapping
from math import degrees, hypot
from typing import NamedTuple

from fisheye_svp_ros.diagnosis import Diagnosis
from fisheye_svp_ros.reporting.wording.causes import COMPONENTS, pixels
from fisheye_svp_ros.reporting.wording.diagnosis import LENS_FILE, RemainingError, remaining_error
from fisheye_svp_ros.solve.ray_errors import MAX_RAY_ERROR

_EXTRAPOLATED_RATIO = 1.1  # of the angle that a lens claims to that of the points
_REMAINING_PARTS = {
    'lens': '{} of that stays in the image ({})',
    'frame': '{} of that changes with the view ({}), not with the lens. `localize --model-error` '
    'includes it in the errors of poses',
}
_NEARLY_ALL, _MOST = 0.8, 0.5  # of the squares


class UsedRays(NamedTuple):
    """Expected ray errors, mrad, of the lens that is to be used, and of the lens as given.

    range_m, reached: where, m and rad; point_mrad: noise of a point, of both coordinates;
    frames_mrad: what the camera changes from frame to frame.
    """

    used: Mapping[str, float]
    given: Mapping[str, float]
    range_m: float
    reached: float
    point_mrad: float
    frames_mrad: float

    @property
    def ratio(self) -> float:
        """How many times the noise of a point a ray is off."""
        return self.used['value'] / self.point_mrad

    @property
    def bound(self) -> float:
        """By how much a ray of a single frame may be off (97.5 %), mrad."""
        return hypot(self.used['high'], self.frames_mrad)

    @property
    def is_accurate(self) -> bool:
        """Whether that is less than what users lose little by."""
        return self.bound <= 1e3 * MAX_RAY_ERROR

    @property
    def error(self) -> str:
        """The bound, what it means at its range, and how sure it is."""
        return f'{self.bound:.2g} mrad ({mrad_in_mm(self.bound, self.range_m)}; 95 % sure)'

    @property
    def accurate_to(self) -> str:
        """The bound, and where it holds."""
        return f'{self.error} out to {degrees(self.reached):.0f} deg off axis'

    @property
    def known_to(self) -> str:
        """The same, as one term of a sentence."""
        return f'{self.error[:-1]}, out to {degrees(self.reached):.0f} deg off axis)'


def mrad_in_mm(mrad: float, range_m: float) -> str:
    """Return what an angle amounts to at a range."""
    return f'{mrad * range_m:.2g} mm at {range_m:g} m'


def used_rays(d: Diagnosis) -> UsedRays | None:
    """Return how far rays are off by the lens that is to be used; None where that is unknown."""
    rays = d.ray_error_mrad()
    if not rays or d.adequacy.is_misfit:
        return None
    asked = d.evaluation.problem.options.range_m or 1.0
    given, extended = (
        next(error for error in rays[side] if error['range_m'] == asked)
        for side in ('given', 'extended')
    )
    lens = next(iter(d.evaluation.problem.inputs.lenses.values()))
    point = 1e3 * max(2**0.5 * d.noise_px, 1e-3) / lens.fx
    used = extended if d.offers_extended else given
    frames = 1e3 * d.adequacy.frames_error
    return UsedRays(used, given, asked, d.adequacy.reached, point, frames)


def accuracy(d: Diagnosis) -> str:
    """Return how far rays are off by the lens that is to be used, where, and what else remains."""
    rays = used_rays(d)
    if rays is None:
        return ''
    used, several = rays.used, len(d.lenses) > 1
    which, other = 'the lens as given', ''
    if d.offers_extended:
        which = 'the extended lenses' if several else LENS_FILE
        other = f', and rays of the lens as given by {rays.given["value"]:.2g} mrad'
    words = (
        f'Within {degrees(rays.reached):.0f} deg, rays of {which}'
        f'{" (the worst camera)" if several else ""} are off by about {used["value"]:.2g} mrad '
        f'at {rays.range_m:g} m{other}. The 95 % interval is {used["low"]:.2g} to '
        f'{used["high"]:.2g} mrad; one point has a noise of {rays.point_mrad:.2g} '
        f'mrad{_whichever(d)}'
    )
    if d.adequacy.frames_error:
        words += (
            f'. In a single frame, they are off by {1e3 * d.adequacy.frames_error:.2g} mrad '
            'more, because the camera changes from frame to frame'
        )
    if d.decision['lens'].say == 'undecided' and not d.adequacy.flaws:
        words += '. Until then, use the lens only where that is good enough'
    claimed = min(lens.max_incidence for lens in d.lenses.values())
    if claimed > _EXTRAPOLATED_RATIO * rays.reached and not d.adequacy.flaws:
        words += (
            f'. From {degrees(rays.reached):.0f} to {degrees(claimed):.0f} deg, the lens is '
            'extrapolated'
        )
    return '. '.join(filter(None, [words, _remains(d)]))


def _whichever(d: Diagnosis) -> str:
    """Return which effects of the lens are not told apart, whose ray errors are averaged."""
    sets = [
        ' and '.join([cause.effect, *cause.indistinguishable_from])
        for cause in d.causes
        if cause.stage == 'lens' and cause.indistinguishable_from
    ]
    return f'. This holds whichever of {"; of ".join(sets)} is present' if sets else ''


def _remains(d: Diagnosis) -> str:
    """Return what is left of held-out points beside noise, mostly of what; '' for nothing."""
    remaining = remaining_error(d)
    if remaining is None:
        return ''
    words = f'Single points are off by {single_points(d, remaining)}'
    # Offsets of landmarks are predicted with either lens.
    squares = {
        part.name: (part.stage, 2 * part.sd_px**2 * (1 - part.named_share / part.share))
        for part in d.components
        if part.stage in _REMAINING_PARTS and part.share > 0
    }
    stages = {
        stage: sum(square for of, square in squares.values() if of == stage)
        for stage in _REMAINING_PARTS
    }
    stage = max(stages, key=stages.__getitem__)
    if not stages[stage]:
        return words
    share = stages[stage] / remaining.px**2
    how_much = f'{stages[stage] ** 0.5:.2g} px'
    if share > _MOST:
        how_much = 'nearly all' if share > _NEARLY_ALL else f'most ({how_much})'
    largest = max((name for name in squares if squares[name][0] == stage), key=squares.__getitem__)
    text = _REMAINING_PARTS[stage].format(how_much, COMPONENTS[largest])
    return f'{words}. {text[0].upper()}{text[1:]}'


def single_points(d: Diagnosis, remaining: RemainingError) -> str:
    """Return by how much single points are off, of both coordinates."""
    focal = next(iter(d.lenses.values())).fx
    return (
        f'{pixels(remaining.px)} px ({1e3 * remaining.px / focal:.2g} mrad), '
        f'{remaining.ratio:.1f} times the noise (1 would be ideal)'
    )
