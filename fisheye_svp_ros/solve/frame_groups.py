"""Groups of frames that fit a camera each, where no one camera fits them all.

Lenses are fitted to a few frames; one whose frames are all of one camera fits others as well, and
not those of another camera.  A group is what such a lens fits, and what it fits then.
Source: Fischler and Bolles, Random sample consensus, Communications of the ACM 24 (1981).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.errors import FisheyeSvpError
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.scene.observations import Views
from fisheye_svp_ros.solve.lens_calibration import fit_lens, localize_views, start_lens

MIN_GROUP = 3  # frames
_MAX_GROUPS = 4
_SEED = 3  # frames
_NOISES = 3.0  # times the noise of a point: what a lens leaves in frames of its camera
_SEED_NOISES = 2.0
_CURVE = ('f', 'cx', 'cy', 'k1', 'k2')  # all that few frames determine
_GROWTH_ROUNDS = 3
_MAX_SEEDS = 10
_STRIDES = (1, 2, 3, 4)


def find_frame_groups(
    views: Views, image_size: tuple[int, int], noise_px: float, orders: Sequence[Array] = ()
) -> list[Index]:
    """Return groups of views that fit a camera each, with at least MIN_GROUP; none but of two.

    noise_px: of a coordinate; orders (V,): numbers by which views of one camera may be neighbors.
    No groups are returned where a fifth of the views is in none.
    """
    count, groups = len(views.frame), list[Index]()
    ungrouped = np.arange(count)
    while len(ungrouped) >= MIN_GROUP and len(groups) < _MAX_GROUPS:
        group = _find_group(views, ungrouped, image_size, noise_px, orders)
        if not len(group):
            break
        groups.append(group)
        ungrouped = np.setdiff1d(ungrouped, group)
    return groups if len(groups) > 1 and len(ungrouped) <= count // 5 else []


def _find_group(
    views: Views,
    rest: Index,
    image_size: tuple[int, int],
    noise_px: float,
    orders: Sequence[Array],
) -> Index:
    """Return the views among the rest (R,) that fit one camera; none where no few of them do."""
    limit = 2**0.5 * noise_px
    for seed in _seeds(rest, [order[rest] for order in orders]):
        lens, rms = _fit_lens(views.take(seed), image_size)
        if lens is None or rms > _SEED_NOISES * limit:
            continue
        group = seed
        for _ in range(_GROWTH_ROUNDS):
            with np.errstate(all='ignore'):
                left = _view_rms(lens, views.take(rest))
            grown = rest[left < _NOISES * limit]
            if len(grown) <= len(group):
                break
            group = grown
            lens = _fit_lens(views.take(group), image_size)[0] or lens
        if len(group) > len(seed) or len(rest) == len(seed):
            return np.sort(group)
    return np.zeros(0, dtype=np.int64)


def _seeds(rest: Index, orders: Sequence[Array]) -> Iterator[Index]:
    """Yield few views that may be of one camera: near in some order, in step, or by chance."""
    groups: list[tuple[int, ...]] = []
    for order in orders:
        sorted_views = rest[np.argsort(order, kind='stable')]
        groups += [tuple(sorted_views[:_SEED]), tuple(sorted_views[-_SEED:])]
    groups += [
        tuple(rest[: stride * _SEED : stride])
        for stride in _STRIDES
        if len(rest) > stride * (_SEED - 1)
    ]
    rng = np.random.default_rng(0)
    while len(groups) < _MAX_SEEDS:
        groups.append(tuple(rng.choice(rest, min(_SEED, len(rest)), replace=False)))
    for seed in dict.fromkeys(tuple(sorted(group)) for group in groups):
        yield np.array(seed)


def _fit_lens(views: Views, image_size: tuple[int, int]) -> tuple[Lens | None, float]:
    """Return the lens of some views and what it leaves, px rms; None where none is found.

    The image may be a half of that of a pair: the center is looked for amid the points, too.
    """
    best: tuple[Lens | None, float] = None, np.inf
    bare = start_lens('kannala_brandt', image_size, (), 'group')
    uv = views.uv[views.used]
    middle = (uv.min(axis=0) + uv.max(axis=0)) / 2
    for center in ((bare.cx, bare.cy), middle.tolist()):
        start = replace(bare, cx=center[0], cy=center[1])
        try:
            with np.errstate(all='ignore'):
                fitted = fit_lens(start, views, _CURVE)
        except (FisheyeSvpError, np.linalg.LinAlgError):
            continue
        rms = float(np.sqrt(np.nanmean((fitted.residual**2).sum(axis=-1))))
        if rms < best[1]:
            best = fitted.lens, rms
    return best


def _view_rms(lens: Lens, views: Views) -> Array:
    """Return what a lens leaves of each view (V,), px rms."""
    left = localize_views(lens, views).residual
    return np.asarray(np.sqrt(np.nanmean((left**2).sum(axis=-1), axis=1)))
