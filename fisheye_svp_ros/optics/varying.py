"""Numbers and vectors with their derivatives: what a chain of refractions is traced with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fisheye_svp_ros.arrays import Array


@dataclass(frozen=True)
class Varying:
    """Numbers (1, M) or vectors (3, M), and their derivatives by T variables (T, 1 or 3, M).

    Coordinates come first, so that every operation runs along the rays.
    Source: forward-mode differentiation (Griewank and Walther, Evaluating Derivatives, chapter 3).
    """

    value: Array
    slope: Array

    def __add__(self, other: Varying) -> Varying:
        return Varying(self.value + other.value, self.slope + other.slope)

    def __sub__(self, other: Varying) -> Varying:
        return Varying(self.value - other.value, self.slope - other.slope)

    def __mul__(self, other: Varying) -> Varying:
        return Varying(self.value * other.value,
                       self.slope * other.value + self.value * other.slope)

    def __truediv__(self, other: Varying) -> Varying:
        ratio = self.value / other.value
        return Varying(ratio, (self.slope - ratio * other.slope) / other.value)

    def __rsub__(self, constant: float) -> Varying:
        return Varying(constant - self.value, -self.slope)

    def dot(self, other: Varying) -> Varying:
        """Return the inner product of two vectors, (1, M)."""
        both = self * other
        return Varying(both.value.sum(axis=-2, keepdims=True),
                       both.slope.sum(axis=-2, keepdims=True))

    def root(self) -> Varying:
        """Return the square root; NaN below 0."""
        root = np.sqrt(self.value)
        return Varying(root, self.slope / (2 * root))

    def tan(self) -> Varying:
        """Return the tangent."""
        tan = np.tan(self.value)
        return Varying(tan, self.slope * (1 + tan * tan))

    def unit(self) -> Varying:
        """Return the vector over its length."""
        return self / self.dot(self).root()


def stack_vector(x: Varying, y: Varying, z: Varying) -> Varying:
    """Return the vector (3, M) of three numbers."""
    return Varying(np.concatenate([x.value, y.value, z.value], axis=-2),
                   np.concatenate([x.slope, y.slope, z.slope], axis=-2))


def constant(value: float, variables: int) -> Varying:
    """Return a number that depends on nothing."""
    return Varying(np.full((1, 1), value), np.zeros((variables, 1, 1)))
