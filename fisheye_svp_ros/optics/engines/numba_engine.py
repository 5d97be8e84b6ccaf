"""The fast engine: the same formulas, compiled by Numba (extra `fast`).

What it leaves aside (a point near the lens, a lens with a curve that is not in `formulas`, a
singular system) goes to the reference, `numpy_engine`.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, TypeVar

import numpy as np

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.optics.engines import entries, kernels, numpy_engine
from fisheye_svp_ros.optics.engines.adjustment import NORMAL, POSE
from fisheye_svp_ros.optics.engines.marquardt import MAX_ITERATIONS
from fisheye_svp_ros.optics.engines.results import Localization, Rigs, Seen
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.optics.rays import caustic_range, edge, search_limit
from fisheye_svp_ros.pose import Pose

T = TypeVar('T')

_SHARE = 20_000  # points below which a thread of their own does not pay
_BLOCKS = 4  # a thread: one that is held up leaves more of them to the others
_CACHE_SIZE = 64  # lenses

_lenses: dict[int, tuple[Lens, Array | None]] = {}


def project(lens: Lens, points: Array, limited: bool) -> tuple[Array, Mask]:
    """See `engines.project`."""
    numbers = pack_lens(lens)
    if numbers is None:
        return numpy_engine.project(lens, points, limited)
    points, limit = np.ascontiguousarray(points, dtype=float), edge(lens, limited)
    uv, state = np.empty((len(points), 2)), np.empty(len(points))

    def run(part: slice) -> None:
        entries.project(points[part], numbers, limit, uv[part], state[part])

    _run_threaded(run, len(points), len(points))
    unsettled = _rays_to_repeat(state, numbers)
    if unsettled is not None:
        uv[unsettled], state[unsettled] = numpy_engine.project(lens, points[unsettled], limited)
    return uv, state > 0


def linearize_views(
    lens: Lens, rotation: Array, position: Array, points: Array, limited: bool
) -> tuple[Array, Mask, Array]:
    """See `engines.linearize_views`."""
    numbers = pack_lens(lens)
    if numbers is None:
        return numpy_engine.linearize_views(lens, rotation, position, points, limited)
    systems, count = points.shape[:2]
    rotation, position, points = _contiguous(rotation, position, points)
    uv, state = np.empty((systems, count, 2)), np.empty((systems, count))
    d_pose, limit = np.empty((systems, 2, 6, count)), edge(lens, limited)

    def run(part: slice) -> None:
        entries.linearize_views(
            rotation[part],
            position[part],
            points[part],
            numbers,
            limit,
            uv[part],
            state[part],
            d_pose[part],
        )

    _run_threaded(run, systems, systems * count)
    by_pose = np.moveaxis(d_pose, -1, 1)
    unsettled = _rays_to_repeat(state, numbers)
    if unsettled is not None:
        rows, _ = unsettled
        again = numpy_engine.linearize_views(
            lens, rotation[rows], position[rows], points[unsettled][:, None], limited
        )
        uv[unsettled], state[unsettled], by_pose[unsettled] = (part[:, 0] for part in again)
    return uv, state > 0, by_pose


def localize(
    lens: Lens, seen: Seen, row: Index, minimum: int, start: Pose, limit: int = MAX_ITERATIONS
) -> tuple[Localization, int, int] | None:
    """See `engines.localize`; limit: of the iterations."""
    numbers = pack_lens(lens)
    if numbers is None:
        return None
    systems, count = row.shape
    localization = Localization.of_one_minimum(
        Pose(start.rotation.copy(), start.position.copy()),
        np.empty((systems, 6, 6)),
        np.empty((systems, count, 2)),
        np.empty(systems),
        np.empty(systems, dtype=np.bool_),
        np.empty(systems, dtype=np.int64),
    )
    arrays = (*_contiguous(*seen, row), *localization.pose, *localization[1:6])
    if systems == 1:  # by the shortest way: it is called for every frame of a camera
        return localization, *entries.localize(numbers, minimum, limit, *arrays)

    def run(part: slice) -> tuple[int, int]:
        counts: tuple[int, int] = entries.localize(
            numbers, minimum, limit, *(array[part] for array in arrays)
        )
        return counts

    remaining, flat = map(sum, zip(*_run_threaded(run, systems, 4 * systems * count), strict=True))
    return localization, remaining, flat


def adjust_rigs(
    lenses: tuple[Lens, Lens], seen: tuple[Seen, Seen], state: tuple[Array, ...]
) -> Rigs | None:
    """See `engines.adjust_rigs`."""
    left, right = map(pack_lens, lenses)
    if left is None or right is None:
        return None
    systems, views = state[0].shape[:2]
    poses = np.empty((systems, views + 1, *POSE))
    parts = poses[:, :-1, :3], poses[:, :-1, 3], poses[:, -1, :3], poses[:, -1, 3]
    for part, start in zip(parts, state, strict=True):
        part[...] = start
    normal, cost = np.empty((systems, views + 1, *NORMAL)), np.empty(systems)
    iterations = np.empty(systems, dtype=np.int64)
    if entries.adjust_rigs(
        *_contiguous(*seen[0]),
        left,
        *_contiguous(*seen[1]),
        right,
        poses,
        normal,
        cost,
        iterations,
    ):
        return None
    block, shared = normal[:, :-1], normal[:, -1]
    return Rigs(
        parts,
        cost,
        iterations,
        (block[:, :, :6], block[:, :, 6:12], shared[:, :6], block[:, :, 12], shared[:, 12]),
    )


def pack_lens(lens: Lens) -> Array | None:
    """Return a lens as the kernels know it, None where it has a curve that they do not."""
    kept = _lenses.get(id(lens))
    if kept is None:
        if len(_lenses) >= _CACHE_SIZE:
            _lenses.clear()
        # A lens that is kept keeps its id to itself.
        kept = _lenses[id(lens)] = lens, _pack(lens)
    return kept[1]


def _pack(lens: Lens) -> Array | None:
    height, shift = lens.image_height, lens.viewpoint_shift
    numbers = np.zeros(kernels.LENS)
    numbers[kernels.FX : kernels.CY + 1] = lens.fx, lens.fy, lens.cx, lens.cy
    numbers[kernels.SHIFT_KIND] = -1
    curves: list[tuple[Any, Any, int, int]] = [
        (height, kernels.HEIGHTS, kernels.HEIGHT_KIND, kernels.HEIGHT_K)
    ]
    if shift is not None:
        curves.append((shift, kernels.SHIFTS, kernels.SHIFT_KIND, kernels.SHIFT_K))
        numbers[kernels.NEAR] = caustic_range(shift, search_limit(shift, lens.max_incidence))
    for curve, formulas, kind, first in curves:
        if not _is_compiled(curve, formulas):
            return None
        numbers[kind] = formulas.index(curve.formula)
        numbers[first : first + len(curve.coefficients)] = curve.coefficients
    return numbers


def _is_compiled(curve: Any, known: tuple[Any, ...]) -> bool:
    """Say whether a curve is a formula of the kernels, and not what a subclass makes of it."""
    if getattr(curve, 'formula', None) not in known:
        return False
    of = {name: _depth(curve, name) for name in ('formula', 'value_and_slope', 'coefficients')}
    return of['formula'] <= min(of['value_and_slope'], of['coefficients'])


def _depth(curve: Any, name: str) -> int:
    """Return how many classes above that of a curve an attribute is defined."""
    return next(i for i, kind in enumerate(type(curve).__mro__) if name in vars(kind))


def _contiguous(*arrays: Any) -> list[Any]:
    return [np.ascontiguousarray(array) for array in arrays]


def _rays_to_repeat(state: Array, numbers: Array) -> tuple[Index, ...] | None:
    if numbers[kernels.SHIFT_KIND] < 0:
        return None
    places = np.nonzero(state == kernels.UNSETTLED)
    return places if places[0].size else None


def _run_threaded(run: Callable[[slice], T], count: int, points: int) -> list[T]:
    """Run over `count` rows, on as many threads as there are and as `points` make worth while."""
    threads = min(_threads(), count, points // _SHARE)
    if threads < 2:
        return [run(slice(0, count))]
    edges = np.linspace(0, count, min(_BLOCKS * threads, count) + 1).astype(int).tolist()
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(run, (slice(*pair) for pair in itertools.pairwise(edges))))


@cache
def _threads() -> int:
    """Return how many threads to use: OMP_NUM_THREADS, as everywhere, or one a core."""
    told = os.environ.get('OMP_NUM_THREADS', '')
    return int(told) if told.isdigit() else len(os.sched_getaffinity(0))
