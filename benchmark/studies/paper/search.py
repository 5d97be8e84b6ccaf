"""The inverse problem: the lens curves and the landmark layout that Kita's paper does not print.

Tables 1 and 2 are fitted with the exact solver.  Unknowns: the directions of 33 landmarks, shared
by both lenses, and per lens f and the four numbers of its Gennery curve.  Many fits from different
starts show what the tables determine and what they leave open (`paper.studies.Family`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.errors import FisheyeSvpError
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.paper.lens_evaluation import LocalizedSpread, localize_environments
from fisheye_svp_ros.paper.studies import NAMES
from fisheye_svp_ros.paper.tables import LOCALIZATION
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.scene.observations import RADII
from fisheye_svp_ros.solve.least_squares import Arrays, dense_step, levenberg_marquardt

STARTS, ITERATIONS = 32, 30
INNER, OUTER = 15, 18
START = np.array([[3.194, -1.14, 0.865, -0.307, 0.162], [3.807, -2.77, 1.152, 0.755, -0.079]])
_SCALE = np.array([100.0, 1e-3, 1e-2, 1e-2, 1e-2])  # px and m for one unit of an unknown
_LARGEST_F = np.array([3.20, 4.11])  # the circular fields must fit the images
_COUNT = INNER + OUTER
_GROUPS: tuple[Index, ...] = (
    np.arange(_COUNT),
    np.arange(INNER),
    np.arange(INNER, _COUNT),
)
# Inner stays inside, Outer outside 64 degrees; past 88 the shift would push it out of Fish180.
_LIMITS = np.radians([[0.0, 62.0]] * INNER + [[66.0, 88.0]] * OUTER)
_WALL = 1e-3  # sigma of stepping over an angle's limit, rad
_F_WALL = 1e-3  # and over the largest f, units
_IRREGULAR = np.radians(8.0)  # sigma of a landmark about its ring
_LENS_SIGMA = 3.0  # units; only keeps the family of curves from running away
_STEP = 1e-4  # for numeric derivatives, rad or units


class Recovered(NamedTuple):
    """One solution.

    layout (33, 2): incidence and azimuth about -z, rad, Inner first; lens_numbers (2, 5): f, px,
    s0, e0, e1, e2, m; misfit: sum of squares over the 90 cells of tables 1 and 2, each in its own
    sigma; cost: the same with the priors; tables (2, 3, 3, 5).
    """

    seed: int
    layout: Array
    lens_numbers: Array
    misfit: float
    cost: float
    tables: Array


def recover(lenses: tuple[Lens, Lens], seed: int, iterations: int = ITERATIONS) -> Recovered:
    """Fit tables 1 and 2 from rings of landmarks and lens curves that are drawn from `seed`.

    lenses: Fish180 and Fish214, whose field of view, image and kind of curves are kept.
    """
    rng = np.random.default_rng(seed)
    rings = _rings(rng)
    lens_start = START * (1 + 0.2 * rng.standard_normal(START.shape))
    lens_start[:, 0] = np.minimum(lens_start[:, 0], _LARGEST_F)
    layout_start = rings + np.radians(2.0) * rng.standard_normal(rings.shape)
    fit = _TableFit(lenses, rings)
    solved = levenberg_marquardt(
        fit, (np.concatenate([layout_start, lens_start.ravel()])[None],), iterations
    )
    x = solved.state[0][0]
    numbers = x[2 * _COUNT :].reshape(2, -1)
    numbers[:, 0] = np.minimum(numbers[:, 0], _LARGEST_F)
    tables, misfit = fit.tables_and_misfit(x)
    flat = x[: 2 * _COUNT].reshape(_COUNT, 2)
    layout = np.stack([np.hypot(*flat.T), np.arctan2(flat[:, 1], flat[:, 0])], axis=-1)
    return Recovered(seed, layout, numbers * _SCALE, misfit, float(solved.cost[0]), tables)


def lens_with(lens: Lens, numbers: Array) -> Lens:
    """Return the lens with other f (px), s0, e0, e1, e2 (m)."""
    return lens.with_parameters(NAMES, numbers.tolist())


class _TableFit:
    """One system of 76 unknowns, see least_squares.LeastSquares.

    Unknowns: of each landmark its angle from -z (rad) times cosine and sine of its azimuth, which
    is regular on the axis; of each lens its numbers over `_SCALE`.
    """

    def __init__(self, lenses: tuple[Lens, Lens], rings: Array) -> None:
        self._lenses = lenses
        self._rings = rings

    def tables_and_misfit(self, x: Array) -> tuple[Array, float]:
        """Return tables 1 and 2, (2, 3, 3, 5), and their sum of squared whitened misfits."""
        tables, _ = self._tables(x)
        return tables, float((self._whitened(tables) ** 2).sum())

    def linearize(self, state: Arrays, index: Index) -> tuple[Array, Arrays]:
        x = state[0][0]
        try:
            tables, localized = self._tables(x)
        except FisheyeSvpError:  # no lens, or too few landmarks in view
            return np.array([np.inf]), (np.eye(len(x))[None], np.zeros((1, len(x))))
        residual = np.concatenate([self._whitened(tables), self._priors(x)])
        cost = float(residual @ residual)
        if not np.isfinite(cost):
            return np.array([np.inf]), (np.eye(len(x))[None], np.zeros((1, len(x))))
        jacobian = np.concatenate(
            [
                self._cell_columns(x, tables, localized),
                np.stack(
                    [
                        (self._priors(x + step) - self._priors(x)) / _STEP
                        for step in _STEP * np.eye(len(x))
                    ],
                    axis=1,
                ),
            ]
        )
        return np.array([cost]), ((jacobian.T @ jacobian)[None], (jacobian.T @ residual)[None])

    def step(self, normal: Arrays, damping: Array) -> tuple[Arrays, Array]:
        return dense_step(normal, damping)

    def retract(self, state: Arrays, step: Arrays) -> Arrays:
        return (state[0] + step[0],)

    def _lens(self, which: int, numbers: Array) -> Lens:
        return lens_with(self._lenses[which], numbers * _SCALE)

    def _tables(self, x: Array) -> tuple[Array, list[list[LocalizedSpread]]]:
        """Return tables (2, 3, 3, 5) and what was localized, by lens and spread."""
        directions = _directions(x[: 2 * _COUNT].reshape(1, _COUNT, 2))
        numbers = x[2 * _COUNT :].reshape(2, -1)
        localized = [
            [_at_all_radii(self._lens(k, numbers[k]), directions[:, group]) for group in _GROUPS]
            for k in range(2)
        ]
        return np.stack([np.stack([g.rows for g in one], axis=1) for one in localized]), localized

    def _cell_columns(
        self, x: Array, tables: Array, localized: list[list[LocalizedSpread]]
    ) -> Array:
        """Differentiate the whitened misfits (90, 76), each solve starting from its neighbor."""
        moved = x[: 2 * _COUNT] + _STEP * np.eye(2 * _COUNT)
        moved_directions = _directions(moved.reshape(-1, _COUNT, 2))
        directions = _directions(x[: 2 * _COUNT].reshape(1, _COUNT, 2))
        change = np.zeros((len(x), *tables.shape))
        for k in range(2):
            numbers = x[2 * _COUNT :].reshape(2, -1)[k]
            lens = self._lens(k, numbers)
            for spread, group in enumerate(_GROUPS):
                start = localized[k][spread].solved.pose
                own = np.ravel(2 * group[:, None] + [0, 1])
                there = _at_all_radii(lens, moved_directions[own][:, group], start).rows
                change[own, k, :, spread] = there.reshape(len(own), len(RADII), -1)
                change[own, k, :, spread] -= tables[k, :, spread]
                for i, step in enumerate(_STEP * np.eye(len(NAMES))):
                    other = _at_all_radii(
                        self._lens(k, numbers + step), directions[:, group], start
                    )
                    row = 2 * _COUNT + k * len(NAMES) + i
                    change[row, k, :, spread] = other.rows - tables[k, :, spread]
        columns: Array = (change / _sigma() / _STEP).reshape(len(x), -1).T
        return columns

    def _whitened(self, tables: Array) -> Array:
        whitened: Array = ((tables - LOCALIZATION) / _sigma()).ravel()
        return whitened

    def _priors(self, x: Array) -> Array:
        layout, numbers = x[: 2 * _COUNT], x[2 * _COUNT :].reshape(2, -1)
        angle = np.hypot(*layout.reshape(_COUNT, 2).T)
        over = np.maximum(angle - _LIMITS[:, 1], 0) + np.minimum(angle - _LIMITS[:, 0], 0)
        return np.concatenate(
            [
                (layout - self._rings) / _IRREGULAR,
                ((numbers - START) / _LENS_SIGMA).ravel(),
                over / _WALL,
                np.maximum(numbers[:, 0] - _LARGEST_F, 0) / _F_WALL,
            ]
        )


def _sigma() -> Array:
    """Return the standard deviations (2, 3, 3, 5) that the cells are fitted with."""
    size = np.abs(LOCALIZATION)
    sigma = 0.01 * size
    sigma[..., :2] = 0.03 * size[..., :2] + 0.002
    sigma[..., 3] = 0.03 * size[..., 3] + 0.0002
    # Fish180 at 2.0 m, Whole and Outer: the positions are out of line with the rows below them.
    sigma[0, 0, ::2, :4] = np.inf
    return sigma


def _at_all_radii(lens: Lens, directions: Array, start: Pose | None = None) -> LocalizedSpread:
    """Localize among layouts (B, N, 3) at the three radii, B * 3 environments."""
    points = (np.array(RADII)[:, None, None] * directions[:, None]).reshape(
        -1, *directions.shape[1:]
    )
    if start is not None:
        start = start.broadcast_to(len(directions), *start.shape).reshape(-1)
    return localize_environments(lens, points, start=start)


def _rings(rng: np.random.Generator) -> Array:
    """Draw two rings or three inside and two outside, as unknowns (66,)."""
    angles = [0.0, *rng.uniform([18, 45, 68, 81], [32, 60, 76, 87])]
    counts = [(1, 6, 8, 8, 10), (1, 5, 9, 8, 10), (1, 4, 10, 9, 9), (3, 5, 7, 8, 10)]
    chosen = counts[rng.integers(len(counts))]
    angles[0] = 8.0 if chosen[0] > 1 else 0.0
    offsets = rng.uniform(size=len(angles))
    polar = np.array(
        [
            (np.radians(angle), 2 * np.pi * (i + offset) / count)
            for angle, count, offset in zip(angles, chosen, offsets, strict=True)
            for i in range(count)
        ]
    )
    return np.stack(
        [polar[:, 0] * np.cos(polar[:, 1]), polar[:, 0] * np.sin(polar[:, 1])], axis=-1
    ).ravel()


def _directions(flat: Array) -> Array:
    """Return unit directions (..., 3) of unknowns (..., 2): the exponential map about -z."""
    angle = np.hypot(flat[..., 0], flat[..., 1])
    scale = np.sinc(angle / np.pi)
    return np.stack([scale * flat[..., 0], scale * flat[..., 1], -np.cos(angle)], axis=-1)
