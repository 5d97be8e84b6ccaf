"""Tags whose corners stand or fall together, and which of them agree on a pose.

Corners of one tag are wrong together: where it hangs elsewhere, or was given another's number.
So tags are left out as wholes, as few as possible, until the others agree (multiple hypothesis
solution separation of satellite navigation: Blanch et al., IEEE TAES 2015).  Where several choices
remain, one image cannot tell which is right, and the covariance covers each.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.scene.observations import Views
from fisheye_svp_ros.solve.landmark_errors import whiten
from fisheye_svp_ros.solve.least_squares import FALSE_ALARM, misfit_fails
from fisheye_svp_ros.solve.localization import MIN_POINTS, Localization, localize
from fisheye_svp_ros.solve.weak_geometry import DOF, MIN_ODDS, share_outside

_MAX_REJECTED_SHARE = 0.5  # of the tags, by number
_RANK = 1e-9  # relative eigenvalue of the residuals of a tag, below which the pose takes them up
_BEAM = 10  # choices that are followed, of those that leave out as many tags
MOVED = 0.05  # odds that a tag hangs elsewhere than the map has it, before an image
_MOVES = 0.03, 0.1, 0.3  # m and rad, standard deviations of how far, each as likely
_MAX_EXPONENT = 50.0  # of odds
_MIN_ODDS = 0.1  # of a choice that passes the test beside the best one: tags move in any way


class TagChoices(NamedTuple):
    """Choices (K,) of the tags of a view that agree on a pose, the likeliest first.

    views: K times the view, the points of these tags alone with weight; solution: poses by them;
    odds (K,): over the first choice.
    """

    views: Views
    solution: Localization
    odds: Array

    @property
    def inliers(self) -> Localization:
        """The first choice (1,), its residuals NaN for the points of other tags."""
        first = self.solution.take([0])
        first.residual[self.views.weight[:1] == 0] = np.nan
        return first

    @property
    def rejected(self) -> list[list[int]]:
        """The tags that each choice leaves out, by number."""
        board, kept = self.views.board[0], self.views.weight > 0
        used = np.unique(board[self.views.used[0]])
        return [np.setdiff1d(used, board[one]).tolist() for one in kept]


def holds_tags(views: Views) -> bool:
    """Say whether boards of a view (1,) are tags with several points each."""
    board = views.board[views.weight > 0]
    return len(board) > len(np.unique(board))


def tags_agree(
    model: ForwardModel, views: Views, localization: Localization, allowed: float
) -> Mask:
    """Say of which views (S,) each tag is where the others of the view have it.

    Its boards are the tags; allowed: variance of a whitened row.  The cost falls by chi-square of
    the rows of a tag where it is left out; of linearized rows, that needs no further solution.
    """
    from scipy.special import chdtri  # takes a third of the time that `--help` may take

    cost = np.where(localization.converged, localization.cost / allowed, np.inf)
    agree = ~misfit_fails(cost, 2 * (views.weight > 0).sum(axis=1) - 6)
    tested = np.flatnonzero(agree)
    for i, fit in zip(tested, _fits(model, views, localization, tested), strict=True):
        for tag in fit.tags if len(fit.tags) > 1 else ():
            own = fit.board == tag
            pull = fit.pull[own] / np.sqrt(allowed)
            inverse = np.linalg.pinv(fit.precision[np.ix_(own, own)], _RANK, hermitian=True)
            limit = chdtri(int(own.sum()), FALSE_ALARM / len(fit.tags))
            agree[i] &= pull @ inverse @ pull < limit
    return agree


class _Fit(NamedTuple):
    """Linearized rows (R,) of a view at its pose.

    board (R,): the tag of each, -1 for none; jacobian (R, 6), gain (6, R): of the pose by them;
    precision (R, R), pull (R,): of their residuals, and times these, the pose being unknown.
    """

    board: Index
    jacobian: Array
    gain: Array
    precision: Array
    pull: Array

    @property
    def tags(self) -> Index:
        """The tags that have rows, by number."""
        return np.unique(self.board[self.board >= 0])


def _fits(
    model: ForwardModel, views: Views, localization: Localization, rows: Index
) -> Iterator[_Fit]:
    """Yield how the poses of some views follow from their points, each of weight 1 / sigma."""
    if not rows.size:
        return
    views, localization = views.take(rows), localization.take(rows)
    linear = model.linearize(localization.pose, views)
    jacobian, noise = whiten(model.d_pose(linear, views), views)
    residual = np.nan_to_num(localization.residual) * views.weight[..., None]
    information = np.zeros((len(rows), 6, 6))
    if views.prior is not None:
        information = views.prior.equations(localization.pose)[1]
    for i, used in enumerate(views.weight > 0):
        precision = np.linalg.inv(noise[i])
        weighted = precision @ jacobian[i]
        inner = np.linalg.pinv(jacobian[i].T @ weighted + information[i], hermitian=True)
        precision = precision - weighted @ inner @ weighted.T
        board = np.repeat(np.where(used, views.board[i], -1), 2)
        pull = precision @ residual[i].ravel()
        yield _Fit(board, jacobian[i], inner @ weighted.T, precision, pull)


def suspect_tags(
    model: ForwardModel, views: Views, localization: Localization
) -> Mapping[int, float]:
    """Return the tags of a view (1,) by whose motion its pose may be wrong, and how probably.

    Its boards are the tags; localization: with the covariance as it is stated.  A tag may have
    moved, with the odds of MOVED before an image, by any of _MOVES.  The image changes the odds
    by how much better it fits so (Bayes factor, the motion integrated over), and another pose
    follows.  Named is what puts that outside the stated 99.9 % ellipsoid, where it is likelier
    than MIN_ODDS that the tag moved and the pose is outside.
    """
    stated = localization.covariance[0]
    if not np.isfinite(stated).all():
        return {}
    (fit,) = _fits(model, views, localization, np.array([0]))
    sizes, suspects = np.array(_MOVES)[:, None, None], {}
    for tag in fit.tags:
        own = fit.board == tag
        moved = _moved_rows(fit.jacobian[own], views.points[0, fit.board[::2] == tag])
        information = moved.T @ fit.precision[np.ix_(own, own)] @ moved
        gradient, arm = moved.T @ fit.pull[own], fit.gain[:, own] @ moved
        inner = np.linalg.inv(information + np.eye(6) / sizes**2)
        step = inner @ gradient
        volume = np.linalg.slogdet(np.eye(6) + sizes**2 * information)[1]
        exponent = np.minimum(0.5 * (step @ gradient - volume), _MAX_EXPONENT)
        odds = MOVED * np.exp(exponent) / len(_MOVES)
        change = arm @ (inner + step[:, :, None] * step[:, None, :]) @ arm.T
        square = DOF + np.trace(np.linalg.solve(stated, change), axis1=-2, axis2=-1)
        if (odds * share_outside(square)).sum() > MIN_ODDS:
            suspects[int(tag)] = float(odds.sum() / (1 + odds.sum()))
    return suspects


def _moved_rows(jacobian: Array, points: Array) -> Array:
    """Return what moves of a tag, m and rad, do to its rows (2N, 6); points (N, 3), m.

    jacobian (2N, 6): by the pose; a point moves the image as the camera moves it the other way.
    """
    arm = np.repeat(points - points.mean(axis=0), 2, axis=0)
    return np.hstack([-jacobian[:, :3], np.cross(jacobian[:, :3], arm)])


def choose_tags(model: ForwardModel, view: Views, allowed: float) -> TagChoices | None:
    """Return the largest choices of the tags of a view (1,) that agree on a pose, not of all.

    Its boards are the tags; allowed: variance of a whitened row.  None where the view holds one
    tag alone, or more than _MAX_REJECTED_SHARE would have to be left out.
    """
    used = view.weight[0] > 0
    inside = used & model.back_project(view.uv).valid[0]
    tags = np.unique(view.board[0, used])
    choices = [tags]
    for _ in range(int(_MAX_REJECTED_SHARE * len(tags))):
        smaller = {tuple(np.delete(tags, i)) for tags in choices for i in range(len(tags))}
        choices = [np.array(choice) for choice in sorted(smaller)]
        kept = np.stack([np.isin(view.board[0], choice) & used for choice in choices])
        rich = np.flatnonzero((kept & inside).sum(axis=1) >= MIN_POINTS)
        if not rich.size:
            return None
        kept, choices = kept[rich], [choices[i] for i in rich]
        views = view.take(np.zeros(len(kept), dtype=int))
        views = views._replace(weight=np.where(kept, views.weight, 0.0))
        solution = localize(model, views)
        agree = tags_agree(model, views, solution, allowed)
        if agree.any():
            return _order(views.take(agree), solution.take(agree), allowed)
        cost = np.where(solution.converged, solution.cost, np.inf)
        choices = [choices[i] for i in np.argsort(cost, kind='stable')[:_BEAM]]
    return None


def _order(views: Views, solution: Localization, allowed: float) -> TagChoices:
    odds = np.exp(-0.5 * (solution.cost - solution.cost.min()) / allowed)
    order = np.argsort(-odds, kind='stable')
    odds = np.maximum(odds[order], _MIN_ODDS)
    return TagChoices(views.take(order), solution.take(order), odds)


def cover_choices(choices: TagChoices, solution: Localization) -> Localization:
    """Return the pose (1,) of the first choice, with a covariance that covers all.

    solution: poses (K,) of the choices, their covariances as they are to be stated.  The second
    choice is the second minimum.
    """
    first = solution.take([0])
    weight = choices.odds / choices.odds.sum()
    change = solution.pose.difference(first.pose.take(np.zeros(len(weight), dtype=int)))
    spread = solution.covariance + change[:, :, None] * change[:, None, :]
    covariance = (weight[:, None, None] * spread).sum(axis=0)[None]
    if len(weight) == 1:
        return first
    gap = np.minimum(first.gap, -2 * np.log(choices.odds[1:2]))
    other = solution.pose.take([1]).where(gap < first.gap, first.other)
    return first._replace(
        covariance=covariance,
        added=first.added + covariance - first.covariance,
        other=other,
        gap=gap,
        tail=solution.tail.max(keepdims=True),
    )
