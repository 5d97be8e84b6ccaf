"""The lens: an image-height curve, an optional viewpoint-shift curve, an image."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.optics.curves import (
    ImageHeight,
    ViewpointShift,
)

INTRINSICS = ('fx', 'fy', 'cx', 'cy')
_MOVE_VIEWPOINT = ('viewpoint_shift', 'flat_port')  # effects that the approximation neglects


@dataclass(frozen=True)
class Lens:
    """One fisheye lens on its camera; SVP is the same lens without its viewpoint shift.

    fx, fy, cx, cy in px (pixel centres at whole numbers); max_incidence in rad; `effects` holds
    what model criticism added (parameters by effect name), `calibration` where a fit came from.
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
    effects: Mapping[str, Any] = field(default_factory=dict)
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
                changes[curve] = replace(getattr(self, curve), **coefficients)
        return replace(self, **changes)

    def svp(self) -> Lens:
        """Return the same lens under the single-viewpoint approximation."""
        effects = {k: v for k, v in self.effects.items() if k not in _MOVE_VIEWPOINT}
        return replace(self, viewpoint_shift=None, effects=effects)


def check_lens(lens: Lens, where: str) -> Lens:
    """Return the lens; raise LensError, naming `where` and the field, if it is impossible."""
    for name, value in lens.parameters.items():
        if not np.isfinite(value):
            raise LensError(f'{where}: {name} is {value}; a finite number is needed')
    for name in ('fx', 'fy', 'width', 'height'):
        if getattr(lens, name) <= 0:
            raise LensError(f'{where}: {name} is {getattr(lens, name)}; it must be above 0')
    limit = lens.image_height.limit
    if lens.viewpoint_shift is not None:
        limit = min(limit, lens.viewpoint_shift.limit)
    index = lens.parameters.get('refractive_index', 2.0)
    if index <= 1.0:
        raise LensError(f'{where}: refractive_index is {index}; it must be above 1')
    if not 0 < lens.max_incidence <= limit + 1e-9:
        raise LensError(
            f'{where}: max_incidence_deg is {np.degrees(lens.max_incidence):.6g}; '
            f'these curves allow a value above 0 and up to {np.degrees(limit):.6g}'
        )
    return lens
