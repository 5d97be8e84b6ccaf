"""Where the center of a printed circle is in the image, and how sure that is.

The image of a circle is a blurred ellipse, bent as a fisheye bends it: its own center is not the
image of the circle's center.  How the image bends around a circle follows from where its
neighbors are; ellipse, center, blur, brightness, contrast and the gradient of the light are
fitted by least squares.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.special import erf

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.detect.corner_fit import CONTRAST, Corners
from fisheye_svp_ros.detect.patterns import local_axes
from fisheye_svp_ros.detect.photographs import Pixels
from fisheye_svp_ros.detect.windows import (
    IN_SILENCE,
    PIXEL,
    WindowProblem,
    Windows,
    halve_image,
    windows,
)
from fisheye_svp_ros.errors import FisheyeSvpError
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.scene.observations import make_observations
from fisheye_svp_ros.solve.lens_calibration import calibrate

# Of the lens that fits one photograph, as far as that determines it
_FREE = (('f', 'cx', 'cy', 'k1', 'k2', 'k3'), ('f', 'cx', 'cy', 'k1'), ('f', 'k1', 'k2', 'k3'))
_ROUNDS = 2  # the neighbors' centers are fitted, too
_WINDOW_SHARE = 0.7  # of the way from the circle's edge to the next circle's
_MAX_CLEARANCE = 48.0  # px from a center to the next edge; beyond, the image is halved
_MIN_HALF_AXIS = 3.0  # px, of a circle's lesser half axis
_UNKNOWNS = 10  # u, v; ellipse (3); log blur; brightness, contrast, its gradient
_ROOT = float(np.sqrt(2 / np.pi))
_MAX_RMS = 0.6  # px rms; rough places are off by less, as far as no lens explains it


@np.errstate(**IN_SILENCE)
def fit_circles(pixels: Pixels, start: Array, points: Array, censored: bool = True) -> Corners:
    """Fit the circles at start (N, 2), px, in an image (H, W); points (N, 3), m: their centers.

    censored: light at the end of the scale may have been any beyond it.

    Of what is found contrast is above 0 for dark circles; sigma is that of the center, NaN where
    nothing tells how the image bends.
    """
    distance = np.linalg.norm(points[:, None] - points, axis=-1)
    apart = float(np.sort(distance, axis=1)[:, 1].min())
    axes = local_axes(points[:, :2], start)
    longest = np.linalg.norm(axes, axis=(1, 2)).max()
    if 0.5 * apart * longest > _MAX_CLEARANCE:
        return _fit_halved_image(pixels, start, points, censored)
    radius = _radius(pixels, start, axes, 0.5 * apart)
    nothing = np.full(len(start), np.nan)
    found = Corners(start, nothing, nothing, nothing, np.zeros(len(start), dtype=bool))
    if not 0.05 < radius / apart < 0.49:
        return found
    for _ in range(_ROUNDS):
        axes, bend = _bends(points, found.uv, pixels.shape, radius)
        fitted = _fit_circles(pixels, found.uv, axes, bend, radius, apart, censored)
        found = fitted._replace(uv=np.where(fitted.ok[:, None], fitted.uv, found.uv))
    return found


def _fit_halved_image(pixels: Pixels, start: Array, points: Array, censored: bool) -> Corners:
    found = fit_circles(halve_image(pixels), (start + 0.5) / 2 - 0.5, points, censored)
    return found._replace(uv=2 * found.uv + 0.5, sigma=2 * found.sigma, blur=2 * found.blur)


def _bends(points: Array, uv: Array, shape: tuple[int, ...], step: float) -> tuple[Array, Array]:
    """Return derivatives of the image by places on the board: (N, 2, 2), px/m, rows are the axes.

    And second ones (N, 3, 2), px/m^2, of x^2/2, x y and y^2/2: those of the lens that fits this
    one photograph best, by differences over a step, m.
    """
    fits = (imaging(points, uv, shape, free) for free in _FREE)
    image_of = next((fit for fit in fits if fit is not None), None)
    if image_of is None:
        return local_axes(points[:, :2], uv), np.full((len(uv), 3, 2), np.nan)
    around = step * np.array([[x, y, 0.0] for x in (-1, 0, 1) for y in (-1, 0, 1)])
    image = image_of(points[:, None] + around).reshape(-1, 3, 3, 2)
    right, down = (image[:, 2, 1] - image[:, 0, 1]) / 2, (image[:, 1, 2] - image[:, 1, 0]) / 2
    middle = 2 * image[:, 1, 1]
    both = (image[:, 2, 2] - image[:, 2, 0] - image[:, 0, 2] + image[:, 0, 0]) / 4
    second = [
        image[:, 2, 1] + image[:, 0, 1] - middle,
        both,
        image[:, 1, 2] + image[:, 1, 0] - middle,
    ]
    return np.stack([right, down], axis=1) / step, np.stack(second, axis=1) / step**2


def _on_board(offset: Array, axes: Array) -> Array:
    """Return places (N, P, 2), m, on the board of offsets (N, P, 2), px, from a circle."""
    return np.asarray(offset @ np.linalg.inv(axes))


def _radius(pixels: Pixels, start: Array, axes: Array, reach: float) -> float:
    """Return the radius, m, of the circles, from how much of their windows is like the middle."""
    cut = windows(pixels, start, float(reach * np.linalg.norm(axes, axis=(1, 2)).max()))
    offset = cut.offset.T - (start - cut.place)[:, None]
    far = np.linalg.norm(_on_board(offset, axes), axis=-1) / reach
    mine, middle, rim = (
        (far < end) & (far >= begin) & cut.inside
        for begin, end in ((0.0, 1.0), (0.0, 0.2), (0.85, 1.0))
    )
    radii = []
    for data, inside, inner, outer in zip(cut.data, mine, middle, rim, strict=True):
        if inner.any() and outer.any():
            dark, bright = float(np.median(data[inner])), float(np.median(data[outer]))
            alike = np.clip((data[inside] - bright) / (dark - bright or 1.0), 0.0, 1.0)
            radii.append(np.sqrt(alike.mean()) * reach)
    return float(np.median(radii or [0.0]))


def _fit_circles(
    pixels: Pixels,
    start: Array,
    axes: Array,
    bend: Array,
    radius: float,
    apart: float,
    censored: bool,
) -> Corners:
    reach = radius + _WINDOW_SHARE * (apart - 2 * radius)
    longest = np.linalg.norm(axes, axis=(1, 2)).max()
    known = np.isfinite(bend).all()
    bend = np.nan_to_num(bend)
    cut = windows(pixels, start, float(reach * longest))
    if not censored:
        cut = cut._replace(clipped=np.zeros_like(cut.clipped))
    problem = _Problem(cut, start, axes, bend, reach)
    values = problem.solve(problem.start(radius))
    judged = problem.judge(values, symmetric=True)
    # Smoothing a brightness that rises moves edges down the slope.
    uv, contrast = values[:, :2] + PIXEL * values[:, 8:] + cut.place, values[:, 7]
    blur = np.sqrt(np.maximum(np.exp(2 * values[:, 5]) - PIXEL, 0.0))
    least = 1 / np.linalg.norm(_matrix(values), ord=2, axis=(1, 2))
    ok = (
        judged.settled
        & (np.linalg.norm(uv - start, axis=1) < 1 + 0.7 * least)
        & (blur < 2 * least)
        & (least > _MIN_HALF_AXIS)
        & (np.abs(contrast) > CONTRAST * judged.noise)
        & ((problem.weight * cut.inside).sum(axis=1) > 0.95 * problem.weight.sum(axis=1))
    )
    sigma, ok = judged.shrink_sigma(ok)
    return Corners(uv, sigma if known else sigma + np.nan, blur, -contrast, ok)


def _matrix(values: Array) -> Array:
    """Return symmetric matrices (N, 2, 2) that turn an ellipse into the unit circle."""
    return np.asarray(values[:, [2, 3, 3, 4]].reshape(-1, 2, 2))


class _Problem(WindowProblem):
    """Circles; state (N, 10)."""

    slack = 5e-4

    def __init__(self, cut: Windows, start: Array, axes: Array, bend: Array, reach: float) -> None:
        self._first, self._axes, self._bend = start - cut.place, axes, bend
        offset = cut.offset.T - self._first[:, None]
        far = np.linalg.norm(_on_board(offset, axes), axis=-1)
        scale = np.sqrt(np.abs(np.linalg.det(axes)))[:, None]
        super().__init__(cut, np.clip((reach - far) * scale + 0.5, 0.0, 1.0) * cut.inside)

    def start(self, radius: float) -> Array:
        """Return a start (N, 10): circles of a radius, m, as their neighbors have it."""
        values = np.zeros((len(self._first), _UNKNOWNS))
        values[:, :2] = self._first
        # (A A^T)^(-1/2), A from the unit circle to the image
        turn, size, _ = np.linalg.svd(radius * np.swapaxes(self._axes, -1, -2))
        matrix = (turn / size[:, None]) @ np.swapaxes(turn, -1, -2)
        values[:, 2:5] = matrix.reshape(-1, 4)[:, [0, 1, 3]]
        return self.fit_brightness(values, 6)

    def outside_domain(self, values: Array) -> Mask:
        return np.asarray((np.abs(values[:, 5]) > 3) | (np.linalg.det(_matrix(values)) <= 0))

    def model(self, values: Array, index: Index) -> tuple[Array, Array]:
        offset = self.cut.offset[:, None] - values[:, :2].T[..., None]
        place, by_place = self._unbent(offset, index)
        blur = np.exp(values[:, 5:6])
        distance, by_distance = _distance(place, values[:, 2:5])
        distance = distance / blur
        shape = erf(distance / np.sqrt(2))
        level, contrast, gradient = values[:, 6:7], values[:, 7:8], values[:, 8:].T[..., None]
        light = 1 + (gradient * offset).sum(axis=0)
        face = level + contrast * shape
        rise = contrast * light * _ROOT * np.exp(-0.5 * distance * distance)
        slope = by_distance * (rise / blur)
        jacobian = np.empty((_UNKNOWNS, *shape.shape))
        jacobian[:2] = -(slope[0] * by_place[0] + slope[1] * by_place[1]) - face * gradient
        jacobian[2:5] = slope[2:]
        jacobian[5] = -rise * distance
        jacobian[6], jacobian[7] = light, shape * light
        jacobian[8:] = face * offset
        return face * light, np.moveaxis(jacobian, 0, -1)

    def _unbent(self, offset: Array, index: Index) -> tuple[Array, Array]:
        """Return offsets (2, A, P), px, as they were without the bend, and derivatives.

        These (2, 2, A, P) are of the place's coordinates, in rows, by the offset's, in columns.
        Planes of coordinates: a product of matrices for every pixel takes several times as long.
        """
        (uu, uv), (vu, vv) = np.moveaxis(np.linalg.inv(self._axes[index]), 0, -1)[..., None]
        x, y = offset[0] * uu + offset[1] * vu, offset[0] * uv + offset[1] * vv
        xx, xy, yy = self._bend[index].transpose(1, 2, 0)[..., None]
        by_x, by_y = xx * x + xy * y, xy * x + yy * y
        change = np.stack([by_x * uu + by_y * uv, by_x * vu + by_y * vv], axis=1)
        return offset - (by_x * x + by_y * y) / 2, np.eye(2)[..., None, None] - change


def _distance(place: Array, matrix: Array) -> tuple[Array, Array]:
    """Return distances (A, P), px, to first order, of places (2, A, P) from ellipses (A, 3).

    And derivatives (5, A, P) by the place and by the ellipse's matrix: xx, xy, yy.
    """
    xx, xy, yy = matrix.T[..., None]

    def apply_matrix(at: Array) -> Array:
        return np.stack([at[0] * xx + at[1] * xy, at[0] * xy + at[1] * yy])

    x = apply_matrix(place)  # on the unit circle at the edge
    y = apply_matrix(x)
    far = np.sqrt((x * x).sum(axis=0) + 1e-12)
    steep = np.sqrt((y * y).sum(axis=0) + 1e-12)  # far over the slope of far
    by_far, by_steep = (2 * far - 1) / (steep * far), far * (1 - far) / steep**3
    z = apply_matrix(y)
    derivatives = np.empty((5, *far.shape))
    derivatives[:2] = by_far * y + by_steep * apply_matrix(z)
    for k, (i, j) in enumerate(((0, 0), (0, 1), (1, 1))):
        both = 0.5 if i == j else 1.0
        by_x = x[i] * place[j] + x[j] * place[i]
        by_y = y[i] * x[j] + y[j] * x[i] + z[i] * place[j] + z[j] * place[i]
        derivatives[2 + k] = both * (by_far * by_x + by_steep * by_y)
    return far * (far - 1) / steep, derivatives


def imaging(
    points: Array, uv: Array, shape: tuple[int, ...], free: Sequence[str]
) -> Callable[[Array], Array] | None:
    """Return what takes places (..., 3), m, on a board to their images (..., 2), px, or None.

    By the Kannala-Brandt lens, with so many of its parameters, that fits one photograph (H, W)
    best, of points (N, 3), m, at uv (N, 2), px; None where they do not determine it, or it does
    not fit.
    """
    table = make_observations(np.zeros(len(uv), dtype=np.int64), np.arange(len(uv)), uv, points)
    try:
        fitted = calibrate(table, 'kannala_brandt', (shape[1], shape[0]), free).adjusted
    except FisheyeSvpError:
        return None
    if np.sqrt((fitted.residual**2).sum(axis=-1).mean()) > _MAX_RMS:
        return None
    pose = fitted.pose.take(0)
    return lambda places: project(fitted.lens, pose.into_body(places), limited=False).uv
