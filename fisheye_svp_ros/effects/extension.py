"""A lens extended by effects: each goes to its place in the lens, so that all mean the same."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import reduce

from fisheye_svp_ros.effects.base import Term
from fisheye_svp_ros.effects.catalogue import load_effects
from fisheye_svp_ros.effects.target import LANDMARKS, landmark_rows
from fisheye_svp_ros.optics.lens import Lens, curve_limit, monotone_limit
from fisheye_svp_ros.scene.observations import Observations


def extend_lens(lens: Lens, terms: Iterable[Term], seen: Observations | None = None) -> Lens:
    """Return a lens with effects added.

    Viewpoint shifts, focal lengths, principal point and, where that is exact, radial coefficients
    are added to the lens's own; others of the lens go to `corrections`, those of the target to
    `target`.  seen: observations of the target on which the effects were found; another target's
    corrections are given up where there are new ones.  The field ends where the curves do.
    Raises LensError where the lens holds another form of one of the effects.
    """
    terms = (*load_effects(lens.corrections, lens.name), *terms)
    lens = replace(lens, corrections={})
    if seen is not None and any(effect.place == 'target' for effect, _ in terms):
        rows = landmark_rows(seen)
        if lens.target.get(LANDMARKS) != rows:
            lens = replace(lens, target={LANDMARKS: rows})
    # All effects were found at the same focal length, so that their order does not matter.
    images = [term for term in terms if term[0].stage == 'image']
    ratio = reduce(_extend_lens, images, lens).focal / lens.focal
    refocused = [(effect, effect.rescale_values(values, ratio)) for effect, values in terms]
    lens = reduce(_extend_lens, sorted(refocused, key=lambda term: term[0].stage == 'ray'), lens)
    if curve_limit(lens) < lens.max_incidence:
        lens = replace(lens, max_incidence=monotone_limit(lens))
    return lens


def curved_lens(lens: Lens, terms: Iterable[Term]) -> Lens:
    """Return a lens with what effects add to its curves; its field ends where they do."""
    curved = reduce(lambda one, term: term[0].with_curves(one, term[1]), terms, lens)
    if curved is lens:
        return lens
    return replace(curved, max_incidence=min(lens.max_incidence, curve_limit(curved)))


def _extend_lens(lens: Lens, term: Term) -> Lens:
    return term[0].extend(lens, term[1])
