"""The lens: an image-height curve, an optional viewpoint-shift curve, an image."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.optics.curve_base import ImageHeight, ViewpointShift

INTRINSICS = ('fx', 'fy', 'cx', 'cy')
_INSIDE = 1 - 1e-6  # of the monotone range: at its very end the curve cannot be inverted


@dataclass(frozen=True)
class Lens:
    """One fisheye lens on its camera; SVP is the same lens without its viewpoint shift.

    fx, fy, cx, cy in px (pixel centres at whole numbers); max_incidence in rad.  viewpoint_shift
    is all of it, whatever it is made of.  corrections: effects of the lens's own that have no
    other place in it, by name, as `effects.base.Effect.to_dict` gives them; target: those of the
    target that they were found on, and its landmarks, see `effects.target`; both are changed by
    `effects.extension.extend_lens`.  calibration: where a fit came from.
    """

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    image_height: ImageHeight
    max_incidence: float
    viewpoint_shift: ViewpointShift | None = None
    corrections: Mapping[str, Any] = field(default_factory=dict)
    target: Mapping[str, Any] = field(default_factory=dict)
    calibration: Mapping[str, Any] | None = None

    @property
    def parameters(self) -> dict[str, float]:
        """Intrinsics and the coefficients of both curves, by name."""
        values: dict[str, float] = {name: getattr(self, name) for name in INTRINSICS}
        for curve in (self.image_height, self.viewpoint_shift):
            if curve is not None:
                values.update(zip(curve.coefficient_names, curve.coefficients, strict=True))
        return values

    def with_parameters(self, names: Sequence[str], values: Sequence[float]) -> Lens:
        """Return a copy with some parameters changed; `f` changes fx and fy together.

        Raises LensError for a name this lens does not have.
        """
        changes: dict[str, Any] = {}
        curves: dict[str, dict[str, float]] = {'image_height': {}, 'viewpoint_shift': {}}
        for name, value in zip(names, map(float, values), strict=True):
            if name in INTRINSICS:
                changes[name] = value
            elif name == 'f':
                changes['fx'] = changes['fy'] = value
            elif name in self.image_height.coefficient_names:
                curves['image_height'][name] = value
            elif self.viewpoint_shift and name in self.viewpoint_shift.coefficient_names:
                curves['viewpoint_shift'][name] = value
            else:
                known = ', '.join(self.parameters)
                raise LensError(f'lens {self.name!r} has no parameter {name!r}; it has {known}')
        for curve, coefficients in curves.items():
            if coefficients:
                changes[curve] = getattr(self, curve).changed(**coefficients)
        return replace(self, **changes)

    def svp(self) -> Lens:
        """Return the same lens under the single-viewpoint approximation."""
        return replace(self, viewpoint_shift=None)

    def with_shift(self, shift: ViewpointShift) -> Lens:
        """Return the lens with a viewpoint shift added to its own."""
        own = self.viewpoint_shift
        return replace(self, viewpoint_shift=shift if own is None else own.plus(shift))

    @property
    def focal(self) -> float:
        """Mean of fx and fy, px."""
        return (self.fx + self.fy) / 2

    def check(self) -> str:
        """Say what is wrong with the numbers of the lens, its field apart; empty if nothing is."""
        for name, value in self.parameters.items():
            if not np.isfinite(value):
                return f'{name} is {value}; a finite number is needed'
        for name in ('fx', 'fy', 'width', 'height'):
            if getattr(self, name) <= 0:
                return f'{name} is {getattr(self, name)}; it must be above 0'
        wrong = self.image_height.check()
        return wrong if wrong or self.viewpoint_shift is None else self.viewpoint_shift.check()


def curve_limit(lens: Lens) -> float:
    """Return the angle, rad, up to which both curves of a lens hold."""
    limit = lens.image_height.limit
    return limit if lens.viewpoint_shift is None else min(limit, lens.viewpoint_shift.limit)


def monotone_limit(lens: Lens) -> float:
    """Return the angle, rad, just inside which both curves of the lens can be used."""
    return curve_limit(lens) * _INSIDE


def field_of_view(lens: Lens) -> float:
    """Return the incidence angle of the farthest image corner, rad, within the monotone range."""
    u = max(lens.cx + 0.5, lens.width - 0.5 - lens.cx) / lens.fx
    v = max(lens.cy + 0.5, lens.height - 0.5 - lens.cy) / lens.fy
    corner = float(lens.image_height.angle(np.asarray(np.hypot(u, v))))
    return min(corner, monotone_limit(lens))


def check_lens(lens: Lens, where: str) -> Lens:
    """Return the lens; raise LensError, naming `where` and the field, if it is impossible."""
    wrong, limit = lens.check(), curve_limit(lens)
    if not wrong and not 0 < lens.max_incidence <= limit + 1e-9:
        wrong = (f'max_incidence_deg is {np.degrees(lens.max_incidence):.6g}; '
                 f'these curves allow a value above 0 and up to {np.degrees(limit):.6g}')
    if wrong:
        raise LensError(f'{where}: {wrong}')
    return lens
