"""Covariances of poses that hold where the linearized one does not.

A small target tilted to one side looks nearly like one tilted to the other: the likelihood has two
minima, or one that is long and bent (Schweighofer and Pinz, PAMI 2006).  There the likelihood is
integrated over the tilt, with the other four parameters eliminated at each node by their normal
equations (nested Laplace: Rue, Martino, Chopin, JRSS B 2009), around both minima.  Nodes are drawn
around either (Veach and Guibas, SIGGRAPH 1995).  Views of strong geometry pay for none of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.pose import Pose, rotation_from_vector, vector_from_rotation
from fisheye_svp_ros.scene.observations import Views
from fisheye_svp_ros.solve.least_squares import never_singular, with_unit_diagonal
from fisheye_svp_ros.solve.localization import Localization, pose_equations, squared_distances

DOF = 6
CHI2_95, CHI2_999 = 12.5916, 22.4577  # of DOF degrees of freedom
MIN_ODDS = 1e-3  # of a second minimum: what is less likely is excluded
_MAX_GAP = -2 * np.log(1e-4)  # of the costs, beyond which a second minimum is not integrated
_MIN_CURVATURE = 0.2  # sigmas by which one sigma of rotation departs from its tangent
_MIN_TILT = 0.004  # rad, a standard error of rotation below which no geometry is weak
_MAX_TILT = 0.5  # rad, the largest standard error of tilt that nodes are drawn by
_NODES, _MANY_NODES = 10, 26  # around a minimum
# Curvature from which on there are many; so there are around each of two minima.
_MANY_CURVATURE = 2.0
_INFLATION = 2.0  # spread of nodes over the standard error of tilt
_FOURTH_SHARE = 0.7  # of the covariance by fourth moments in the one that is given
_TAIL, _MAX_TAIL = 1e-3, 3.0  # share of a mixture outside, and a factor on its covariance
_HALF_DRAWS = np.random.default_rng(0).normal(size=(24, DOF))
_DRAWS = np.concatenate([_HALF_DRAWS, -_HALF_DRAWS])  # of a normal distribution
_MAX_SQUARE = 30.0  # Mahalanobis squared beyond which fourth moments grow no further
_VIEWS_AT_ONCE = 64


def hold_weak_geometry(
    model: ForwardModel, views: Views, localization: Localization, scale: Array | float = 1.0
) -> Localization:
    """Return poses with covariances that hold for weak geometry and for a neglected shift.

    scale (S,): standard deviation of a whitened residual, which the covariances are scaled by
    already.  `gap` is returned in units of it, too.
    """
    deviation = np.broadcast_to(np.asarray(scale, dtype=float), localization.cost.shape)
    if not (deviation == 1.0).all():
        localization = localization._replace(gap=localization.gap / deviation**2)
    covariance, neglected = localization.covariance, model.neglecting()
    tail = localization.tail.copy()
    weak, curvature = _weak_views(views, localization)
    if not weak.size and neglected is None:
        return localization
    if weak.size:
        covariance = covariance.copy()
        double = localization.gap[weak] < _MAX_GAP
        at_once = _VIEWS_AT_ONCE
        if views.landmark_covariance is not None:  # whose noise is a full matrix
            at_once = max(1, at_once // views.weight.shape[1])
        many = double | (curvature > _MANY_CURVATURE)
        for two, nodes in ((True, _MANY_NODES), (False, _MANY_NODES), (False, _NODES)):
            group = weak[(double == two) & (many == (nodes == _MANY_NODES))]
            for start in range(0, len(group), at_once):
                rows = group[start : start + at_once]
                poses, seen = localization.take(rows), views.take(rows)
                minima = (poses.pose, poses.other)[: 1 + two]
                covariance[rows], tail[rows] = _integrate(
                    model, seen, minima, deviation[rows], nodes
                )
    if neglected is not None:
        covariance = covariance + _squared_bias(model, neglected, views, localization)
    return localization._replace(
        covariance=covariance,
        added=localization.added + covariance - localization.covariance,
        tail=tail,
    )


def pose_odds(localization: Localization) -> Array:
    """Return the likelihood (S,) of the second minimum over that of the pose; 0: there is none."""
    return np.asarray(np.exp(-0.5 * localization.gap))


def is_ambiguous(localization: Localization) -> Mask:
    """Say of which poses (S,) a second one, outside their ellipsoids, is not excluded (99.9 %)."""
    likely = np.flatnonzero(pose_odds(localization) > MIN_ODDS)
    apart = np.zeros(localization.cost.shape, dtype=bool)
    if likely.size:
        poses = localization.take(likely)
        away = squared_distances(
            poses.other.difference(poses.pose)[:, None], poses.covariance - poses.added
        )
        apart[likely] = away[:, 0] > CHI2_999
    return apart


def share_outside(square: Array | float) -> Array:
    """Return how probably poses are outside their 99.9 % ellipsoids.

    square: the mean of the Mahalanobis square, in place of DOF.
    """
    from scipy.special import chdtrc  # takes a third of the time that `--help` may take

    return np.asarray(chdtrc(DOF, CHI2_999 * DOF / square))


def _weak_views(views: Views, localization: Localization) -> tuple[Index, Array]:
    """Return the views (W,) whose linearized covariance does not hold, and their curvature."""
    turn = np.trace(localization.covariance[:, 3:, 3:], axis1=1, axis2=2)
    likely = localization.gap < _MAX_GAP
    rows = np.flatnonzero(localization.converged & ((turn > _MIN_TILT**2) | likely))
    if not rows.size:
        return rows, np.zeros(0)
    poses = localization.take(rows)
    # A camera that turns about the target leaves the tangent of its path.
    distance = np.linalg.norm(poses.pose.position - _centers(views.take(rows)), axis=-1)
    precision = np.linalg.eigvalsh(np.linalg.inv(poses.covariance)[:, :3, :3])[:, -1]
    turn = np.linalg.eigvalsh(poses.covariance[:, 3:, 3:])[:, -1]
    curvature = 0.5 * turn * distance * np.sqrt(precision)
    weak = (curvature > _MIN_CURVATURE) | likely[rows]
    return rows[weak], curvature[weak]


def _integrate(
    model: ForwardModel, views: Views, minima: Sequence[Pose], scale: Array, nodes: int
) -> tuple[Array, Array]:
    """Return covariances (S, 6, 6) about the first of some minima (S,), integrated over the tilt.

    nodes: around each of these.  Also by what factors (S,) they would hold in 99.9 %.
    """
    center, systems = _centers(views), len(views.frame)
    node, density = _tilted_poses(model, views, minima, scale, center, nodes)
    count = density.shape[1]
    repeated, flat = np.repeat(np.arange(systems), count), node.reshape(-1)
    cost, (hessian, gradient) = pose_equations(model, flat, views.take(repeated))
    # The other four: a turn about the line of sight and the place of the target.
    free_columns = _tilt_columns(flat, center[repeated])[1][..., 2:]
    turned = np.swapaxes(free_columns, -1, -2)
    relative, unit = with_unit_diagonal(turned @ hessian @ free_columns, 0.0)
    inverse = never_singular(np.linalg.inv, relative) / (unit[:, :, None] * unit[:, None, :])
    slope = turned @ gradient[..., None]
    step = -inverse @ slope
    lowest = cost + (slope * step).sum(axis=(1, 2))
    flat = flat.retract((free_columns @ step)[..., 0])
    volume = np.linalg.slogdet(relative)[1] + 2 * np.log(unit).sum(axis=-1)
    exponent = (-0.5 * lowest / scale[repeated] ** 2 - 0.5 * volume).reshape(systems, count)
    exponent = np.where(np.isfinite(exponent), exponent, -np.inf) - np.log(density)
    weight = np.exp(exponent - exponent.max(axis=1, keepdims=True))
    weight /= weight.sum(axis=1, keepdims=True)
    change = flat.difference(minima[0].take(repeated)).reshape(systems, count, 6)
    spread = free_columns @ inverse @ turned * scale[repeated, None, None] ** 2
    own = spread.reshape(systems, count, 6, 6)
    scatter = _mixture_scatter(weight, change, own)
    return scatter, _tail_factors(weight, change, own, scatter)


def _tilted_poses(
    model: ForwardModel,
    views: Views,
    minima: Sequence[Pose],
    scale: Array,
    center: Array,
    nodes: int,
) -> tuple[Pose, Array]:
    """Return poses (S, K) tilted from some minima (S,) each, and the density (S, K) of these."""
    drawn, proposals, spiral = [], [], _spiral(nodes)
    for pose in minima:
        hessian = pose_equations(model, pose, views)[1][0]
        axes, columns = _tilt_columns(pose, center)
        relative, unit = with_unit_diagonal(np.swapaxes(columns, -1, -2) @ hessian @ columns, 0.0)
        inverse = never_singular(np.linalg.inv, relative) / (unit[:, :, None] * unit[:, None, :])
        values, vectors = np.linalg.eigh(inverse[:, :2, :2] * scale[:, None, None] ** 2)
        error = np.sqrt(np.clip(values, 1e-16, _MAX_TILT**2))
        root = _INFLATION * vectors * error[:, None, :]
        turn = rotation_from_vector(spiral @ np.swapaxes(axes[..., :2] @ root, -1, -2))
        rotation = pose.rotation[:, None] @ np.swapaxes(turn, -1, -2)
        sight = pose.into_body(center[:, None])[:, :, :, None]
        drawn.append(Pose(rotation, center[:, None] - (rotation @ sight)[..., 0]))
        proposals.append((pose, axes, root))
    node = Pose(*(np.concatenate(parts, axis=1) for parts in zip(*drawn, strict=True)))
    density = np.zeros(node.shape)
    for pose, axes, root in proposals:
        turn = vector_from_rotation(np.swapaxes(node.rotation, -1, -2) @ pose.rotation[:, None])
        unit_turn = (turn @ axes[..., :2]) @ np.swapaxes(np.linalg.inv(root), -1, -2)
        density += (
            np.exp(-0.5 * (unit_turn**2).sum(axis=-1)) / np.abs(np.linalg.det(root))[:, None]
        )
    return node, np.maximum(density, 1e-300)


def _mixture_scatter(weight: Array, change: Array, own: Array) -> Array:
    """Return scatter matrices (S, 6, 6) of mixtures of normal distributions around zero.

    weight (S, K), change (S, K, 6), own (S, K, 6, 6): of the parts.  Between the second moments
    and the fourth ones, E[m x x'] / (DOF + 2) with m the Mahalanobis square: of a normal
    distribution both are its covariance, of one with long tails the latter is larger, and so
    ellipsoids hold in 95 and in 99.9 % of cases.
    """
    outer = change[..., :, None] * change[..., None, :]
    second = (weight[..., None, None] * (outer + own)).sum(axis=1)
    relative, unit = with_unit_diagonal(second, 0.0)
    inverse = never_singular(np.linalg.inv, relative) / (unit[:, :, None] * unit[:, None, :])
    turned = inverse[:, None] @ own
    along = (inverse[:, None] @ change[..., None])[..., 0]
    mixed = change[..., :, None] * (own @ along[..., None])[..., None, :, 0]
    square = (change * along).sum(axis=-1) + np.trace(turned, axis1=-2, axis2=-1)
    fourth = square[..., None, None] * (outer + own) + 2 * (
        mixed + np.swapaxes(mixed, -1, -2) + own @ turned
    )
    limit = weight * np.minimum(1.0, _MAX_SQUARE / np.maximum(square, 1e-12))
    fourth = (limit[..., None, None] * fourth).sum(axis=1) / (DOF + 2)
    return np.asarray((1 - _FOURTH_SHARE) * second + _FOURTH_SHARE * fourth)


def _tail_factors(weight: Array, change: Array, own: Array, covariance: Array) -> Array:
    """Return factors (S,), 1 to _MAX_TAIL, on covariances that leave .1 % of a mixture outside.

    weight (S, K), change (S, K, 6), own (S, K, 6, 6): of the parts, from each of which the same
    points are drawn.  Its moments alone leave .6 % of two far tags outside.
    """
    values, vectors = np.linalg.eigh(own)
    root = vectors * np.sqrt(np.clip(values, 0.0, None))[..., None, :]
    drawn = change[:, :, None] + _DRAWS @ np.swapaxes(root, -1, -2)
    square = squared_distances(drawn.reshape(len(weight), -1, DOF), covariance)
    each = np.repeat(weight, len(_DRAWS), axis=1) / len(_DRAWS)
    order = np.argsort(-square, axis=1)
    outside = np.take_along_axis(each, order, axis=1).cumsum(axis=1) <= _TAIL
    limit = np.take_along_axis(square, order, axis=1)[np.arange(len(square)), outside.sum(axis=1)]
    return np.asarray(np.clip(limit / CHI2_999, 1.0, _MAX_TAIL))


def _squared_bias(
    model: ForwardModel, true: ForwardModel, views: Views, localization: Localization
) -> Array:
    """Return what neglecting part of a lens moves poses by, as outer products (S, 6, 6)."""
    image = true.predict(localization.pose, views, limited=False).uv
    finite = np.asarray(np.isfinite(image).all(axis=-1))
    seen = views._replace(
        uv=np.where(finite[:, :, None], image, views.uv),
        weight=np.where(finite, views.weight, 0.0),
    )
    _, (hessian, gradient) = pose_equations(model, localization.pose, seen)
    relative, unit = with_unit_diagonal(hessian, 0.0)
    step = (never_singular(np.linalg.inv, relative) @ (gradient / unit)[..., None])[..., 0] / unit
    return np.asarray(step[:, :, None] * step[:, None, :])


def _centers(views: Views) -> Array:
    """Return the centers (S, 3), m, of the points that count."""
    used = (views.weight > 0)[..., None]
    return np.asarray((views.points * used).sum(axis=1) / np.maximum(used.sum(axis=1), 1))


def _tilt_columns(pose: Pose, center: Array) -> tuple[Array, Array]:
    """Return axes (S, 3, 3) in the camera frame, and how turns and shifts of the target move it.

    axes: two across the line of sight to `center` (S, 3), and that line.  columns (S, 6, 6), of
    the change in `Pose.retract`: turns of the target about these, and shifts of it, m.
    """
    sight = pose.into_body(center[:, None])[:, 0]
    along = sight / np.maximum(np.linalg.norm(sight, axis=-1, keepdims=True), 1e-12)
    side = np.where(np.abs(along[:, :1]) < 0.7, np.eye(3)[0], np.eye(3)[1])
    first = np.cross(along, side)
    first /= np.maximum(np.linalg.norm(first, axis=-1, keepdims=True), 1e-12)
    axes = np.stack([first, np.cross(along, first), along], axis=-1)
    turn = -pose.rotation @ axes
    columns = np.zeros((len(sight), 6, 6))
    columns[:, 3:, :3] = turn
    columns[:, :3, :3] = np.cross(turn, (pose.position - center)[:, :, None], axis=1)
    columns[:, :3, 3:] = np.eye(3)
    return axes, columns


@cache
def _spiral(count: int) -> Array:
    """Return points (count, 2) that stand for a normal distribution: a golden spiral."""
    number = np.arange(count)
    radius = np.sqrt(-2 * np.log(1 - (number + 0.5) / count))
    angle = number * np.pi * (3 - np.sqrt(5))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
