"""The lens: an image-height curve, an optional viewpoint-shift curve, an image."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.optics.curve_base import ImageHeight, ViewpointShift
from fisheye_svp_ros.optics.image_field import ImageField
from fisheye_svp_ros.optics.pinhole import TangentialDistortion
from fisheye_svp_ros.optics.ports import Port

INTRINSICS = ('fx', 'fy', 'cx', 'cy')
PORT = 'port'  # before the names of a port's coefficients, among those of a lens
IMAGE_FIELD = 'image_field'
TANGENTIAL = 'tangential'
_RANGE_MARGIN = 1 - 1e-6  # of the monotone range: at its very end the curve cannot be inverted
_MIN_FOCAL = 1e-3  # px: less than any lens has, and far from where squares overflow


@dataclass(frozen=True)
class Lens:
    """One fisheye lens on its camera; SVP is the same lens without shift and port.

    fx, fy, cx, cy in px (pixel centers at whole numbers); max_incidence in rad.  viewpoint_shift
    is all of it, whatever it is made of, but for what a port brings.  tangential: what moves
    image points of a pinhole otherwise than along the radius; image_field: what moves them beside
    all of this.  corrections: effects of the
    lens's own that have no other place in it, by name, as `effects.base.Effect.to_dict` gives
    them; target: those of the target that they were found on, and its landmarks, see
    `effects.extension`; both are changed by `effects.extension.extend_lens`.  calibration: where a
    fit came from; uncertainty: of what a diagnosis found, see `diagnosis.lens_errors`; neglected:
    the lens that this one approximates on purpose, see `approximate`.
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
    port: Port | None = None
    tangential: TangentialDistortion | None = None
    image_field: ImageField | None = field(default=None, repr=False, hash=False)
    corrections: Mapping[str, Any] = field(default_factory=dict, hash=False)
    target: Mapping[str, Any] = field(default_factory=dict, repr=False, hash=False)
    calibration: Mapping[str, Any] | None = field(default=None, repr=False, hash=False)
    uncertainty: Mapping[str, Any] | None = field(default=None, repr=False, hash=False)
    neglected: Lens | None = field(default=None, repr=False, compare=False)

    @property
    def parameters(self) -> dict[str, float]:
        """Intrinsics and the coefficients of both curves and of the port, by name."""
        values: dict[str, float] = {name: getattr(self, name) for name in INTRINSICS}
        for curve in (self.image_height, self.viewpoint_shift):
            if curve is not None:
                values.update(zip(curve.coefficient_names, curve.coefficients, strict=True))
        if self.port is not None:
            values.update(zip(self.port_names, self.port.coefficients, strict=True))
        return values

    @property
    def port_names(self) -> tuple[str, ...]:
        """Names of the port's coefficients among the parameters."""
        names = () if self.port is None else self.port.coefficient_names
        return tuple(f'{PORT}_{name}' for name in names)

    def with_parameters(self, names: Sequence[str], values: Sequence[float]) -> Lens:
        """Return a copy with some parameters changed; `f` changes fx and fy together.

        Raises LensError for a name this lens does not have.
        """
        changes: dict[str, Any] = {}
        curves: dict[str, dict[str, float]] = {'image_height': {}, 'viewpoint_shift': {}, PORT: {}}
        for name, value in zip(names, map(float, values), strict=True):
            if name in INTRINSICS:
                changes[name] = value
            elif name == 'f':
                changes['fx'] = changes['fy'] = value
            elif name in self.image_height.coefficient_names:
                curves['image_height'][name] = value
            elif self.viewpoint_shift and name in self.viewpoint_shift.coefficient_names:
                curves['viewpoint_shift'][name] = value
            elif name in self.port_names:
                curves[PORT][name.removeprefix(f'{PORT}_')] = value
            else:
                known = ', '.join(self.parameters)
                raise LensError(f'lens {self.name!r} has no parameter {name!r}; it has {known}')
        for curve, coefficients in curves.items():
            if coefficients:
                changes[curve] = getattr(self, curve).with_values(**coefficients)
        return replace(self, **changes)

    def svp(self) -> Lens:
        """Return the same lens under the single-viewpoint approximation, in air."""
        return replace(self, viewpoint_shift=None, port=None)

    def approximate(self) -> Lens:
        """Return the lens as `svp` does, to be solved with by who knows what it neglects."""
        return self if self.is_svp else replace(self.svp(), neglected=self)

    def with_shift(self, shift: ViewpointShift) -> Lens:
        """Return the lens with a viewpoint shift added to its own."""
        own = self.viewpoint_shift
        return replace(self, viewpoint_shift=shift if own is None else own.plus(shift))

    def shift_at(self, theta: Array) -> Array:
        """Return the viewpoint shift at incidence angles (...), rad, m; 0 of an SVP lens."""
        shift = self.viewpoint_shift
        if shift is None:
            return np.zeros_like(theta)
        return shift.value_and_slope(theta, np.tan(theta / 2))[0]

    @property
    def is_svp(self) -> bool:
        """Whether it has a single viewpoint, so that its image is the same at every range."""
        return self.viewpoint_shift is None and self.port is None

    @property
    def is_bare(self) -> bool:
        """Whether its curves are all there is, so that an engine solves with it by itself."""
        return self.port is None and not self.displaces

    @property
    def displaces(self) -> bool:
        """Whether image points are not where the curve of the image height puts them."""
        return self.tangential is not None or self.image_field is not None

    def displace(self, uv: Array) -> Array:
        """Return image points (..., 2), px, of those that the curve alone gives."""
        uv = self.displace_tangentially(uv)
        return uv if self.image_field is None else self.image_field.apply(uv)

    def displace_tangentially(self, uv: Array) -> Array:
        """See `displace`; without the image field."""
        if self.tangential is None:
            return uv
        return self._in_pixels(self.tangential.apply(self.image_height, self._for_unit_focal(uv)))

    def undo_displacement(self, uv: Array) -> Array:
        """Return the image points (..., 2), px, that the curve alone gives; NaN for none."""
        uv = uv if self.image_field is None else self.image_field.invert(uv)
        if self.tangential is None:
            return uv
        return self._in_pixels(self.tangential.invert(self.image_height, self._for_unit_focal(uv)))

    def carry(self, uv: Array, columns: Array, of_ray: bool = True) -> Array:
        """Return derivatives (..., 2, P) of image points from those of the curve's alone at uv.

        of_ray: these move with the ray; otherwise with the curve.
        """
        if self.tangential is not None:
            place = self._for_unit_focal(uv)
            slope = self.tangential.slope(self.image_height, place, of_ray)
            focal = np.array([[self.fx], [self.fy]])
            columns = focal * (slope @ (columns / focal))
        if self.image_field is None:
            return columns
        return self.image_field.carry(self.displace_tangentially(uv), columns)

    def _for_unit_focal(self, uv: Array) -> Array:
        return np.asarray((uv - (self.cx, self.cy)) / (self.fx, self.fy))

    def _in_pixels(self, place: Array) -> Array:
        return np.asarray(place * (self.fx, self.fy) + (self.cx, self.cy))

    @property
    def focal(self) -> float:
        """Mean of fx and fy, px."""
        return (self.fx + self.fy) / 2

    @property
    def calibrated_angle(self) -> float | None:
        """The incidence angle up to which it was calibrated, rad; None if unknown, or by a port.

        Past it the curve is a guess, and where the image of the lens ends is not known.
        """
        match (self.calibration or {}).get('reached_deg'):
            case float(degrees) | int(degrees) if self.port is None:
                return float(np.radians(degrees))
        return None

    def check(self) -> str:
        """Say what is wrong with the numbers of the lens, its field apart; empty if nothing is."""
        for name, value in self.parameters.items():
            if not np.isfinite(value):
                return f'{name} is {value}; a finite number is needed'
        for name in ('fx', 'fy', 'width', 'height'):
            if getattr(self, name) <= 0:
                return f'{name} is {getattr(self, name)}; it must be above 0'
        for name in ('fx', 'fy'):
            if getattr(self, name) < _MIN_FOCAL:
                return (
                    f'{name} is {getattr(self, name):g} px; at least {_MIN_FOCAL:g} px is needed'
                )
        parts = (self.image_height, self.viewpoint_shift, self.port, self.tangential)
        wrong = next((wrong for part in parts if part is not None and (wrong := part.check())), '')
        if wrong or self.image_field is None:
            return wrong
        return self.image_field.check(self.width, self.height)


def parameter_values(lens: Lens, names: Sequence[str]) -> list[float]:
    """Return the values of named parameters; `f` is that of fx."""
    return [lens.fx if name == 'f' else lens.parameters[name] for name in names]


def intrinsic_names(lens: Lens) -> tuple[str, ...]:
    """Return the intrinsics that a calibration frees: the four, and the height's coefficients."""
    return (*INTRINSICS, *lens.image_height.coefficient_names)


def inside_image(lens: Lens, uv: Array) -> Mask:
    """Say which image points (..., 2), px, lie in the image, to the edges of its outer pixels."""
    size = np.array([lens.width, lens.height])
    return np.asarray(np.all((uv >= -0.5) & (uv <= size - 0.5), axis=-1))


def curve_limit(lens: Lens) -> float:
    """Return the angle, rad, up to which both curves of a lens hold."""
    limit = lens.image_height.limit
    return limit if lens.viewpoint_shift is None else min(limit, lens.viewpoint_shift.limit)


def monotone_limit(lens: Lens) -> float:
    """Return the angle, rad, just inside which both curves of the lens can be used."""
    return curve_limit(lens) * _RANGE_MARGIN


def field_of_view(lens: Lens) -> float:
    """Return the incidence angle of the farthest image corner, rad, within the monotone range."""
    ends = np.array([[-0.5, lens.width - 0.5], [-0.5, lens.height - 0.5]])
    corners = np.stack(np.meshgrid(*ends), axis=-1)
    if lens.tangential is not None:
        ideal = replace(lens, image_field=None).undo_displacement(corners)
        corners = np.where(np.isnan(ideal), corners, ideal)
    place = np.abs((corners - (lens.cx, lens.cy)) / (lens.fx, lens.fy))
    corner = float(lens.image_height.angle(np.hypot(*np.moveaxis(place, -1, 0)).max()))
    return min(corner, monotone_limit(lens))


def check_lens(lens: Lens, where: str) -> Lens:
    """Return the lens; raise LensError, naming `where` and the field, if it is impossible."""
    wrong, limit = lens.check(), curve_limit(lens)
    if not lens.name.isprintable():
        wrong = f'name is {lens.name!r}; printable characters are needed'
    if not wrong and not 0 < lens.max_incidence <= limit + 1e-9:
        wrong = (
            f'max_incidence_deg is {np.degrees(lens.max_incidence):.6g}; '
            f'these curves allow a value above 0 and up to {np.degrees(limit):.6g}'
        )
    if wrong:
        raise LensError(f'{where}: {wrong}')
    return lens
