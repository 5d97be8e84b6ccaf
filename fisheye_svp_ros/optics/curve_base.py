"""What a lens curve is: image height h(theta)/f or viewpoint shift s(theta), with derivatives.

All angles in rad, shifts in m.  Curves take arrays of any shape and return arrays of that shape.
A curve whose `formula` is in `formulas` is faster: it need not start from theta alone, and it can
be compiled.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from typing import ClassVar, Protocol, Self

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.optics import formulas

# Of a height, (theta, *coefficients) or (sin, cos) -> value and slope; of a shift, (theta, sin,
# cos, *coefficients) -> value and slope times sin
Formula = Callable[..., tuple[Array, Array]]

_GRID = 4097  # angles at which a sum of curves is looked at for where it turns back


class Curve:
    """A curve with named coefficients, the fields of its dataclass."""

    coefficient_names: ClassVar[tuple[str, ...]] = ()

    @property
    def limit(self) -> float:
        """Largest angle, rad, up to which a height grows or a ray gets through."""
        return np.pi

    @cached_property
    def coefficients(self) -> tuple[float, ...]:
        """Values of the coefficients, in the order of `coefficient_names`."""
        return tuple(getattr(self, name) for name in self.coefficient_names)

    def with_values(self, **coefficients: float) -> Self:
        """Return the curve with some coefficients replaced."""
        return replace(self, **coefficients)  # type: ignore[type-var]

    def check(self) -> str:
        """Say what is wrong with the coefficients; empty if nothing is."""
        return ''


class HeightChange(Protocol):
    """A change of h/f; `powers`: its factors of theta^3, theta^5, ... if that is all of it."""

    @property
    def powers(self) -> tuple[float, ...] | None: ...

    def value_and_slope(self, theta: Array) -> tuple[Array, Array]: ...


class ImageHeight(Curve):
    """An image-height curve for unit focal length; monotone from 0 up to `limit`.

    A new curve gives its `limit` (the height is finite there, or the curve has an `angle` of its
    own) and either `formula` or `value_and_slope`; `columns` where its coefficients are to be
    fitted.
    """

    formula: ClassVar[Formula]

    def value_and_slope(self, theta: Array) -> tuple[Array, Array]:
        """Return h/f and its derivative with respect to theta, in arrays of their own."""
        return self.formula(theta, *self.coefficients)

    def from_sine(
        self, theta: Array, sine: Callable[[], tuple[Array, Array]]
    ) -> tuple[Array, Array]:
        """See `value_and_slope`; sine: gives sine and cosine of theta faster than theta does."""
        return self.value_and_slope(theta)

    def angle(self, height: Array) -> Array:
        """Return theta of heights h/f within the monotone range; anything beyond it."""
        return invert_height(self, height)

    def columns(self, theta: Array) -> Array:
        """Return the derivatives of h/f with respect to the coefficients, shape (..., K)."""
        return np.empty((*np.shape(theta), 0))

    def with_powers(self, powers: tuple[float, ...]) -> ImageHeight | None:
        """Return theta + k1 theta^3 + ... as Kannala-Brandt, factors added; None if it is not."""
        return None

    def plus(self, change: HeightChange) -> ImageHeight:
        """Return the sum with a change, as a curve of the registry where there is one."""
        powers = change.powers
        with_powers = None if powers is None else self.with_powers(powers)
        return SumOfHeights(self, (change,)) if with_powers is None else with_powers


class Trigonometric(ImageHeight):
    """An image height whose formula has sine and cosine of theta alone."""

    def value_and_slope(self, theta: Array) -> tuple[Array, Array]:
        return self.formula(np.sin(theta), np.cos(theta))

    def from_sine(
        self, theta: Array, sine: Callable[[], tuple[Array, Array]]
    ) -> tuple[Array, Array]:
        return self.formula(*sine())


@dataclass(frozen=True)
class SumOfHeights(ImageHeight):
    """The image height of a lens, plus changes; its coefficients are those of the lens."""

    base: ImageHeight
    changes: tuple[HeightChange, ...]

    @property
    def coefficient_names(self) -> tuple[str, ...]:  # type: ignore[override]
        return self.base.coefficient_names

    @property
    def coefficients(self) -> tuple[float, ...]:
        return self.base.coefficients

    def with_values(self, **coefficients: float) -> Self:
        return replace(self, base=self.base.with_values(**coefficients))

    @cached_property
    def limit(self) -> float:
        """The incidence angle, rad, up to which the sum grows: changes may turn it back early."""
        theta = np.linspace(0.0, self.base.limit, _GRID)
        falls = self.value_and_slope(theta)[1][:-1] <= 0
        return float(theta[max(int(np.argmax(falls)) - 1, 0)]) if falls.any() else self.base.limit

    def value_and_slope(self, theta: Array) -> tuple[Array, Array]:
        height, slope = self.base.value_and_slope(theta)
        for change in self.changes:
            more, steeper = change.value_and_slope(theta)
            height, slope = height + more, slope + steeper
        return height, slope

    def columns(self, theta: Array) -> Array:
        return self.base.columns(theta)


class ViewpointShift(Curve):
    """A viewpoint-shift curve s(theta), m; hashable.

    A new curve gives either `formula` or `value_and_slope`; `columns` where its coefficients are
    to be fitted.  lengths: the coefficients in which s is linear; None: all of them.
    """

    formula: ClassVar[Formula]
    lengths: ClassVar[tuple[str, ...] | None] = None

    @classmethod
    def neutral(cls) -> ViewpointShift:
        """Return the curve of this kind from which a fit starts: it shifts nothing."""
        return cls()

    def value_and_slope(self, theta: Array, half_tan: Array) -> tuple[Array, Array]:
        """Return s and ds/dtheta; `half_tan` is tan(theta / 2), which the caller has at hand."""
        # The guards only matter on the axis, where the slope of every shift vanishes.
        t = np.maximum(half_tan, formulas.AXIS_EPS)
        theta = np.maximum(theta, 2 * formulas.AXIS_EPS)
        scale = 1 / (1 + t * t)
        sin, cos = 2 * t * scale, (1 - t * t) * scale
        value, rise = self.formula(theta, sin, cos, *self.coefficients)
        return value, np.where(theta > 1e-9, rise / sin, 0.0)

    def columns(self, theta: Array) -> Array:
        """Return the derivatives of s with respect to the coefficients, shape (..., K)."""
        return np.empty((*np.shape(theta), 0))

    def scale_by(self, factor: float) -> ViewpointShift:
        """Return the curve times a factor."""
        lengths = {name: factor * value for name, value in self._lengths().items()}
        return self.with_values(**lengths)

    def plus(self, other: ViewpointShift) -> ViewpointShift:
        """Return the sum, as one curve where both are of one kind."""
        return reduce(SumOfShifts.add, other.summands(), SumOfShifts(self.summands())).simplest()

    def summands(self) -> tuple[ViewpointShift, ...]:
        """Return the curves whose sum this is."""
        return (self,)

    def _lengths(self) -> dict[str, float]:
        names = self.coefficient_names if self.lengths is None else self.lengths
        return {name: getattr(self, name) for name in names}

    def merge(self, other: ViewpointShift) -> ViewpointShift | None:
        """Return the sum with a curve of the same kind; None for another kind."""
        if type(self) is not type(other):
            return None
        lengths, more = self._lengths(), other._lengths()
        if self.with_values(**more) != other:
            return None
        return self.with_values(**{name: value + more[name] for name, value in lengths.items()})


@dataclass(frozen=True)
class SumOfShifts(ViewpointShift):
    """Several viewpoint shifts added, each of another kind.

    A coefficient whose name an earlier part has too is called by the number of its part, name_2.
    """

    parts: tuple[ViewpointShift, ...]

    @property
    def limit(self) -> float:
        return min(part.limit for part in self.parts)

    @property
    def coefficient_names(self) -> tuple[str, ...]:  # type: ignore[override]
        names: list[str] = []
        for number, part in enumerate(self.parts, start=1):
            names += [f'{n}_{number}' if n in names else n for n in part.coefficient_names]
        return tuple(names)

    @property
    def coefficients(self) -> tuple[float, ...]:
        return tuple(value for part in self.parts for value in part.coefficients)

    def with_values(self, **coefficients: float) -> Self:
        values = dict(zip(self.coefficient_names, self.coefficients, strict=True)) | coefficients
        left, parts = list(values.values()), []
        for part in self.parts:
            names = part.coefficient_names
            parts.append(part.with_values(**dict(zip(names, left, strict=False))))
            left = left[len(names) :]
        return replace(self, parts=tuple(parts))

    def check(self) -> str:
        return next((wrong for part in self.parts if (wrong := part.check())), '')

    def value_and_slope(self, theta: Array, half_tan: Array) -> tuple[Array, Array]:
        value, slope = np.sum([p.value_and_slope(theta, half_tan) for p in self.parts], axis=0)
        return value, slope

    def columns(self, theta: Array) -> Array:
        return np.concatenate([part.columns(theta) for part in self.parts], axis=-1)

    def scale_by(self, factor: float) -> SumOfShifts:
        return SumOfShifts(tuple(part.scale_by(factor) for part in self.parts))

    def summands(self) -> tuple[ViewpointShift, ...]:
        return self.parts

    def simplest(self) -> ViewpointShift:
        """Return the only part itself where there is one."""
        return self if len(self.parts) > 1 else self.parts[0]

    def add(self, other: ViewpointShift) -> SumOfShifts:
        """Return the sum with one more curve, within the part of its kind if there is one."""
        for number, part in enumerate(self.parts):
            merged = part.merge(other)
            if merged is not None:
                return SumOfShifts((*self.parts[:number], merged, *self.parts[number + 1 :]))
        return SumOfShifts((*self.parts, other))


def shift_at(curve: ViewpointShift, theta: Array, sin: Array, cos: Array) -> tuple[Array, Array]:
    """Return s and sin ds/dtheta where sine and cosine are at hand; theta above 0."""
    formula: Formula | None = getattr(curve, 'formula', None)
    if formula is None:
        value, slope = curve.value_and_slope(theta, sin / (1 + cos))
        return value, slope * sin
    return formula(theta, sin, cos, *curve.coefficients)


def invert_height(curve: ImageHeight, height: Array) -> Array:
    """Return theta of heights h/f by Newton's method from a table of the monotone range."""
    limit = curve.limit  # not always a constant
    grid = np.linspace(0.0, limit, 1025)
    heights, _ = curve.value_and_slope(grid)
    theta = np.interp(height, heights, grid)
    for _ in range(4):
        value, slope = curve.value_and_slope(theta)
        # The slope vanishes at the limit, where the table is already the answer.
        step = np.where(slope > 1e-9, (height - value) / np.maximum(slope, 1e-9), 0.0)
        theta = np.clip(theta + step, 0.0, limit)
    return theta
