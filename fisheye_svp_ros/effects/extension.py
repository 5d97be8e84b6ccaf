"""A lens extended by effects, each in its place, and the target that some of them belong to.

Corrections of a target are applied where it is seen, and only there.  A view shows the target if
at least half of the landmarks seen in it have the number and the place that they had in the data
the corrections were found on.  Corrections that say nothing of their landmarks, written by hand or
by an older version, are applied to whatever is seen.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.effects.base import ModelTerm, Scene
from fisheye_svp_ros.effects.catalogue import load_effects
from fisheye_svp_ros.effects.target_map import KnownTarget, find_landmarks
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.optics.lens import Lens, curve_limit, monotone_limit
from fisheye_svp_ros.scene.observations import Observations, Views, group_views

LANDMARKS = 'landmarks'
_POSITION_TOLERANCE = 1e-5  # m; no two targets are told apart by less


@dataclass(frozen=True)
class Target:
    """Corrections of one target and its landmarks; None where it is not known by these."""

    terms: tuple[ModelTerm, ...]
    known: KnownTarget | None

    @classmethod
    def from_entries(cls, entries: Mapping[str, Any], where: str) -> Target | None:
        """Return the target of a lens from its `target` mapping; None where that is empty.

        Raises LensError, naming `where` and the entry, for one that is impossible.
        """
        if not entries:
            return None
        effects = {name: entry for name, entry in entries.items() if name != LANDMARKS}
        terms = load_effects(effects, f'{where}: target')
        rows = entries.get(LANDMARKS)
        if rows is None:
            return cls(terms, None)
        try:
            table = np.array(rows, dtype=float).reshape(-1, 5)
        except (TypeError, ValueError) as cause:
            raise LensError(
                f'{where}: target.{LANDMARKS} must be a list of [landmark, board, x, y, z]'
            ) from cause
        ids, first = np.unique(table[:, 0].astype(np.int64), return_index=True)
        return cls(terms, KnownTarget(ids, table[first, 1].astype(np.int64), table[first, 2:]))

    def assign_boards(self, views: Views) -> Views:
        """Return views with the target's landmarks on the boards that they belong to.

        Those that it was found without are where the views say; where these have no boards, or
        others (as on topics), on that of the nearest landmark.
        """
        target = self.known
        if target is None or not len(target.landmark):
            return views
        slot, is_listed, same = _find_same(target, views)
        board = np.where(same, target.board[slot], views.board)
        new = views.used & ~is_listed
        if new.any() and (board != views.board)[same & views.used].any():
            away = np.linalg.norm(views.points[new][:, None] - target.points, axis=-1)
            board[new] = target.board[away.argmin(axis=1)]
        return views._replace(board=board)

    def landmark_mask(self, views: Views) -> Mask:
        """Return which landmarks (S, N) are the target's, or may be, in views that show it."""
        if self.known is None:
            return np.ones(views.landmark.shape, dtype=bool)
        if not len(self.known.landmark):
            return np.zeros(views.landmark.shape, dtype=bool)
        _, is_listed, same = _find_same(self.known, views)
        count = (same & views.used).sum(axis=1)
        shows = (count > 0) & (2 * count >= views.used.sum(axis=1))
        return np.asarray(shows[:, None] & (same | ~is_listed))

    def displacement(self, scene: Scene, stage: str) -> Array | float:
        """Displacement (S, N, D) by the corrections at a stage, in views that show the target."""
        terms = [term for term in self.terms if term.effect.stage == stage]
        if not terms:
            return 0.0
        parts = [term.displacement(scene) for term in terms]
        return np.asarray(np.sum(parts, axis=0) * self.landmark_mask(scene.views)[..., None])


def _find_same(target: KnownTarget, views: Views) -> tuple[Index, Mask, Mask]:
    """Return places in the table (S, N), whether the number is there, whether the place is."""
    slot, is_listed = find_landmarks(target.landmark, views)
    off = np.abs(target.points[slot] - views.points).max(axis=-1)
    return slot, is_listed, is_listed & (off < _POSITION_TOLERANCE)


def landmark_rows(observations: Observations) -> list[list[float]]:
    """Return what a target is known by: [landmark, board, x, y, z] of each of its landmarks, m."""
    ids, first = np.unique(observations.landmark, return_index=True)
    boards, places = observations.board[first].tolist(), observations.xyz[first].tolist()
    return [[*pair, *xyz] for *pair, xyz in zip(ids.tolist(), boards, places, strict=True)]


def on_boards(observations: Observations, rows: Sequence[Sequence[float]] | None) -> Observations:
    """Return observations of a target on the boards that its `landmark_rows` say.

    A recording of topics tells of no boards, another table may call them otherwise.
    """
    if rows is None:
        return observations
    target, views = (
        Target.from_entries({LANDMARKS: rows}, observations.source),
        group_views(observations),
    )
    assert target is not None
    on_target = views.used & target.landmark_mask(views).any(axis=1, keepdims=True)
    board = observations.board.copy()
    board[views.row[on_target]] = target.assign_boards(views).board[on_target]
    return replace(observations, board=board)


def extend_lens(
    lens: Lens, terms: Iterable[ModelTerm], observations: Observations | None = None
) -> Lens:
    """Return a lens with effects added.

    Viewpoint shifts, focal lengths, principal point and, where that is exact, radial coefficients
    are added to the lens's own; others of the lens go to `corrections`, those of the target to
    `target`.  observations: of the target on which the effects were found; another target's
    corrections are given up where there are new ones.  The field ends where the curves do.
    Raises LensError where the lens holds another form of one of the effects.
    """
    terms = (*load_effects(lens.corrections, lens.name), *terms)
    lens = replace(lens, corrections={})
    if observations is not None and any(term.effect.lens_field == 'target' for term in terms):
        rows = landmark_rows(observations)
        if lens.target.get(LANDMARKS) != rows:
            lens = replace(lens, target={LANDMARKS: rows})
    # All effects were found at the same focal length, so that their order does not matter.
    images = [term for term in terms if term.effect.stage == 'image']
    ratio = reduce(_extend_lens, images, lens).focal / lens.focal
    refocused = [replace(t, values=t.effect.rescale_values(t.values, ratio)) for t in terms]
    lens = reduce(
        _extend_lens, sorted(refocused, key=lambda term: term.effect.stage == 'ray'), lens
    )
    if curve_limit(lens) < lens.max_incidence:
        lens = replace(lens, max_incidence=monotone_limit(lens))
    return lens


def curved_lens(lens: Lens, terms: Iterable[ModelTerm]) -> Lens:
    """Return a lens with what effects add to its curves; its field ends where they do."""
    curved = reduce(lambda known, term: term.effect.with_curves(known, term.values), terms, lens)
    if curved is lens:
        return lens
    return replace(curved, max_incidence=min(lens.max_incidence, curve_limit(curved)))


def _extend_lens(lens: Lens, term: ModelTerm) -> Lens:
    return term.effect.extend(lens, term.values)
