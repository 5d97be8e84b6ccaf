"""Mixed models of every kind of column, small enough for dense algebra, and that algebra.

The oracle inverts the covariance V of y itself; the package never makes it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, sparse

from fisheye_svp_ros.mixed_model import (
    LAMBDA_ABSENT,
    Components,
    Equations,
    FactoredEquations,
    RandomColumns,
    factor_equations,
    make_equations,
)

GROUP, TURN, PLACE, SIDE, SHARED, FIELD = KINDS = range(6)
LAM = np.array([2.0, 0.5, 3.0, 0.8, 4.0, 1.5])


@dataclass(frozen=True)
class DenseModel:
    """A model, its columns as whole matrices, and what theory says of it.

    lam (K,): sigma^2 / tau^2 of the components, LAMBDA_ABSENT for none; weight (U,): of units.
    Rows are those of all groups, also the padding.
    """

    random: RandomColumns
    group_fixed: np.ndarray
    border: np.ndarray
    lam: np.ndarray
    weight: np.ndarray

    def with_lam(self, *kinds, value=LAMBDA_ABSENT):
        lam = self.lam.copy()
        lam[list(kinds)] = value
        return replace(self, lam=lam)

    @property
    def alive(self):
        return self.lam < LAMBDA_ABSENT

    def equations(self) -> Equations:
        return make_equations(self.random, self.group_fixed, self.border).select(self.alive)

    def factored(self) -> FactoredEquations:
        return factor_equations(self.equations(), self.lam, self.weight)

    @property
    def flat(self):
        """The border (n, X)."""
        return self.border.reshape(-1, self.border.shape[-1])

    @property
    def y(self):
        return self.flat[:, -1]

    def _spread(self, own):
        """Return columns (G, M, C) of groups as columns of all rows (n, G C)."""
        return linalg.block_diag(*own)

    def columns(self):
        """Return Z (n, q), the component of each column, and its factor on the precision."""
        r = self.random
        units, width = r.unit_label.shape
        offsets = np.zeros((*r.offset.shape[:3], units, width))
        for g, n in np.argwhere(r.unit >= 0):
            offsets[g, n, :, r.unit[g, n]] = r.offset[g, n]
        offsets = offsets.reshape(-1, units * width)
        z = np.concatenate(
            [self._spread(r.group), offsets, r.shared.toarray(), offsets @ r.fields.toarray()],
            axis=1,
        )
        label = np.concatenate(
            [np.tile(r.group_label, len(r.group)), r.unit_label.ravel(), r.shared_label]
        )
        weight = np.ones(len(label))
        weight[len(r.group) * len(r.group_label) :][: units * width] = np.repeat(
            self.weight, width
        )
        return z, label, weight

    def of(self, kind):
        """Return the columns (n, q_k) of a component and the factors on their precisions."""
        z, label, weight = self.columns()
        return z[:, label == kind], weight[label == kind]

    def covariance(self):
        """Return V over the noise variance."""
        v = np.eye(self.y.size)
        for kind in np.flatnonzero(self.alive):
            z, weight = self.of(kind)
            v += z / (self.lam[kind] * weight) @ z.T
        return v

    def fixed(self, shared=True):
        """Return the fixed columns of groups, normalized, none that is zero, and shared ones."""
        g = self._spread(self.group_fixed)
        g = g[:, np.linalg.norm(g, axis=0) > 0]
        g = g / np.linalg.norm(g, axis=0)
        return np.concatenate([g, self.flat[:, :-1]], axis=1) if shared else g

    def projector(self, shared=True):
        """Return P: inv(V) without what fixed columns take up."""
        inverse, x = np.linalg.inv(self.covariance()), self.fixed(shared)
        return inverse - inverse @ x @ np.linalg.inv(x.T @ inverse @ x) @ x.T @ inverse

    @property
    def used(self):
        """Which rows are no padding."""
        return np.concatenate([self._spread(self.group_fixed), self.flat], axis=1).any(axis=1)

    @property
    def freedom(self):
        return int(self.used.sum()) - self.fixed().shape[1]

    @property
    def variance(self):
        return float(self.y @ self.projector() @ self.y) / self.freedom

    def log_determinant(self, shared=True):
        """Return the log determinant of V once fixed columns are projected out."""
        v, x = self.covariance(), self.fixed(shared)
        return np.linalg.slogdet(v)[1] + np.linalg.slogdet(x.T @ np.linalg.solve(v, x))[1]

    @property
    def deviance(self):
        """-2 log restricted likelihood, the noise variance profiled out, less a constant."""
        return self.freedom * np.log(self.variance) + self.log_determinant()

    def posterior(self, kind):
        """Return mean and covariance, over the noise variance, of a component's coefficients."""
        z, weight = self.of(kind)
        prior, p = np.diag(1 / (self.lam[kind] * weight)), self.projector()
        return prior @ z.T @ p @ self.y, prior - prior @ z.T @ p @ z @ prior


def mixed_model(by_group=True, seed=0, groups=6, points=6, sigma=0.5):
    """Return a model of all kinds of columns, with padding, missing units and columns of zeros.

    by_group: of so few units that groups are the eliminated blocks.
    """
    rng = np.random.default_rng(seed)
    units, width = (7 if by_group else 4 * groups), 2
    unit = rng.integers(-1, units, (groups, points))
    unit_label = np.tile([PLACE, SIDE], (units, 1))
    unit_label[1, 1] = unit_label[3] = -1
    rows = groups * points * 2
    there = np.ones((groups, points), dtype=bool)
    there[1, -2:] = there[4, -1] = False
    unit[~there] = -1
    row = np.repeat(there, 2, axis=1)
    group = rng.normal(size=(groups, 2 * points, 2)) * row[..., None]
    group_fixed = rng.normal(size=(groups, 2 * points, 2)) * row[..., None]
    group_fixed[2, :, 1] = 0.0
    shared = rng.normal(size=(rows, 3)) * (rng.random((rows, 3)) < 0.4) * row.ravel()[:, None]
    fields = rng.normal(size=(units * width, 2)) * (rng.random((units * width, 2)) < 0.6)
    of_units = np.isin(KINDS, (PLACE, SIDE))
    random = RandomColumns(
        group,
        np.array([GROUP, TURN]),
        rng.normal(size=(groups, points, 2, width)) * there[..., None, None],
        unit,
        unit_label,
        sparse.csr_array(shared),
        sparse.csr_array(fields),
        np.array([SHARED, SHARED, SHARED, FIELD, FIELD]),
        Components(of_units, np.zeros(len(KINDS), dtype=bool)),
    )
    fixed = rng.normal(size=(groups, 2 * points, 2)) * row[..., None]
    model = DenseModel(
        random,
        group_fixed,
        np.concatenate([fixed, np.zeros((*row.shape, 1))], axis=-1),
        LAM.copy(),
        rng.uniform(0.3, 2.0, units),
    )
    return drawn(model, rng, sigma)


def drawn(model, rng, sigma):
    """Return the model with y drawn by its variances, the noise of so much."""
    y = model.flat[:, :-1] @ rng.normal(size=model.flat.shape[1] - 1)
    y = y + model._spread(model.group_fixed) @ rng.normal(
        size=len(model.group_fixed) * model.group_fixed.shape[-1]
    )
    y += sigma * rng.normal(size=y.size)
    for kind in np.flatnonzero(model.alive):
        z, weight = model.of(kind)
        y += z @ (rng.normal(size=len(weight)) * sigma / np.sqrt(model.lam[kind] * weight))
    border = model.border.copy()
    border[..., -1] = (y * model.used).reshape(border.shape[:2])
    return replace(model, border=border)
