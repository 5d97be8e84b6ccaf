"""Tables of observations beside each other: copies, cameras of a rig, targets, rounding."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np

from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.errors import ObservationError, ParameterError
from fisheye_svp_ros.scene.observations import Observations, rig_cameras, select_cameras

ROUNDING = 1e-7  # px: what is simulated without noise scatters by less, nothing measured does
MAX_TARGET_SIZE = 20.0  # m; a target larger than this was measured in other units
MAX_NOISE = 1e3  # px, of an image point: beyond it nothing is measured
_MIN_NOISE = 1e-6  # px: of less, errors over noise, or their squares, overflow
_MIN_SIGMA, _MIN_SIGMA_SHARE = 1e-6, 1e-3  # px, and of the median
SIGMA_BOUND = f'{_MIN_SIGMA:g} px or more, and {_MIN_SIGMA_SHARE:g} of the median or more'
_COPIED_SHARE = 0.5  # of the image points: no two photographs have so many alike
_PLACE_TOLERANCE = 1e-3  # of a target's extent: more than places that are written less exactly
MIN_ASPECT = 1.9  # width over height: of two square images 2, of one sensor 1.78 at most
_MIN_VIEWS = 3  # on either side of the middle
_CHANCE = 0.05  # of frames of one camera to stay away from the middle so far
_MIN_RIGIDITY = 0.05  # random points leave 0.03 at most; a fifth of wild ones 0.2 and more
_RIGID_LANDMARKS, _RIGID_PAIRS = 60, 100  # to look at, the most often seen; that say something
_RIGID_VIEWS = 8  # of fewer, wild points are not told from random ones
_COINCIDENT = 1e-3  # px, of two image points
_MANY_POINTS, _MIN_POINTS = 1500, 24  # of a thinned table, and of a view that stays whole


def target_size(table: Observations) -> float:
    """Return the largest extent of the landmarks along x, y or z, m."""
    return float((table.xyz.max(axis=0) - table.xyz.min(axis=0)).max())


def check_noise(noise: float) -> None:
    """Raise ParameterError for a standard deviation of u and of v, px, that nobody means."""
    if not 0 < noise <= MAX_NOISE:
        raise ParameterError(f'noise is {noise:g} px; above 0 and up to {MAX_NOISE:g} is needed')
    if noise < _MIN_NOISE:
        raise ParameterError(f'noise is {noise:g} px; at least {_MIN_NOISE:g} px is needed')


def implausible_sigma(sigma: Array) -> Mask:
    """Return which standard deviations (N,), px, no detector has beside the others.

    So large a weight leaves nothing else to be seen.
    """
    stated = sigma[np.isfinite(sigma)]
    typical = float(np.median(stated)) if len(stated) else 0.0
    return np.asarray(sigma < max(_MIN_SIGMA, _MIN_SIGMA_SHARE * typical))


def check_sigma(table: Observations) -> Observations:
    """Return the table; raise ObservationError for a sigma that no detector has."""
    bad = np.flatnonzero(implausible_sigma(table.sigma))
    if len(bad):
        raise ObservationError(
            f'{table.source}: sigma of frame {table.frame[bad[0]]}, landmark '
            f'{table.landmark[bad[0]]} is {table.sigma[bad[0]]:g} px; {SIGMA_BOUND} is needed'
        )
    return table


def order_cameras(table: Observations, cameras: tuple[str, ...]) -> Observations:
    """Return observations of a rig in the order of these cameras, or raise ObservationError."""
    if len(cameras) == 1:
        return table
    if set(table.cameras) != set(cameras):
        held = ', '.join(filter(None, table.cameras)) or 'one without a name'
        raise ObservationError(
            f'{table.source}: its cameras ({held}) are not those of the rig, ' + ', '.join(cameras)
        )
    return select_cameras(table, cameras)


def put_right_camera_first(table: Observations) -> Observations:
    """Return observations of a rig with its right camera first: true poses are of that one."""
    names = rig_cameras(table.cameras)
    if names is None or len(np.unique(table.camera)) < 2:
        return table
    return order_cameras(table, (names[1], *(name for name in table.cameras if name != names[1])))


def check_distinct(observations: Observations, other: Observations) -> None:
    """Raise ObservationError where most of other observations are these once more."""
    seen, again = (
        set(zip(table.landmark.tolist(), *table.uv.T.tolist(), strict=True))
        for table in (observations, other)
    )
    if len(seen & again) > _COPIED_SHARE * len(again):
        raise ObservationError(
            f'{other.source}: these image points are those of '
            f'{observations.source}; other photographs are needed'
        )


def check_frames_differ(observations: Observations) -> None:
    """Raise ObservationError where all frames of a camera repeat the image points of one."""
    kept, again = remove_copies(observations)
    if again and len(kept.frames) == 1:
        raise ObservationError(
            f'{observations.source}: {len(again)} frames repeat the image points of frame '
            f'{kept.frames[0]}; take photographs of the target from other sides'
        )


def check_rigid(observations: Observations) -> None:
    """Raise ObservationError where image points are not those of one rigid target.

    Landmarks that lie close together in one view then do so in others too, wherever the table says
    that they are and whatever the lens.  This needs no fit: of random image points none ends soon.
    """
    rigidity = _rigidity(observations)
    if rigidity is not None and rigidity < _MIN_RIGIDITY:
        raise ObservationError(
            f'{observations.source}: landmarks that are close in one frame are not close in '
            f'others (correlation {rigidity:.2f}; of any rigid target at least '
            f'{_MIN_RIGIDITY:g}). Check that image points and landmark numbers belong together '
            'in every frame'
        )


def _rigidity(table: Observations) -> float | None:
    """Return how far distances between image points agree with those in other views.

    A correlation of logarithms, clipped, each view's mean taken out; None of too few views or
    pairs.
    """
    ids, place, count = np.unique(table.landmark, return_inverse=True, return_counts=True)
    often = np.sort(np.argsort(-count, kind='stable')[:_RIGID_LANDMARKS])
    slot = np.full(len(ids), -1)
    slot[often] = np.arange(len(often))
    slot = slot[place.reshape(-1)]
    views, view = np.unique(np.stack([table.frame, table.camera]), axis=1, return_inverse=True)
    if views.shape[1] < _RIGID_VIEWS:
        return None
    counted = slot >= 0
    uv = np.full((views.shape[1], len(often), 2), np.nan)
    uv[view.reshape(-1)[counted], slot[counted]] = table.uv[counted]
    one, other = np.triu_indices(len(often), 1)
    length = np.log(np.maximum(np.linalg.norm(uv[:, one] - uv[:, other], axis=-1), _COINCIDENT))
    measured = np.isfinite(length)
    length = np.where(measured, length, 0.0)
    length -= measured * (length.sum(axis=1) / np.maximum(measured.sum(axis=1), 1))[:, None]
    length = np.clip(length, -1.0, 1.0)  # few points that coincide, or are far off, decide nothing
    elsewhere = (length.sum(axis=0) - length) / np.maximum(measured.sum(axis=0) - 1, 1)
    shared = measured & (measured.sum(axis=0) > 1)
    if shared.sum() < _RIGID_PAIRS or not np.ptp(elsewhere[shared]):
        return None
    return float(np.corrcoef(length[shared], elsewhere[shared])[0, 1])


def is_another_target(observations: Observations, other: Observations) -> bool:
    """Whether landmarks of one number stand in different places of two tables."""
    landmarks, other_landmarks = observations.landmarks(), other.landmarks()
    _, rows, theirs = np.intersect1d(landmarks.ids, other_landmarks.ids, return_indices=True)
    apart = np.abs(landmarks.points[rows] - other_landmarks.points[theirs])
    return bool(apart.max(initial=0.0) > _PLACE_TOLERANCE * np.ptp(landmarks.points, axis=0).max())


def dither(table: Observations) -> Observations:
    """Return observations with noise that nobody can measure, the same every time.

    Where nothing else is left over, as of simulated points without noise, rounding is: it depends
    on place and frame, and would be taken for a cause.
    """
    noise = 10 * ROUNDING * np.random.default_rng(0).standard_normal(table.uv.shape)
    return replace(table, uv=table.uv + noise)


def remove_copies(observations: Observations) -> tuple[Observations, tuple[int, ...]]:
    """Return the frames whose image points no earlier one has, to the last digit, and the others.

    A copy knows nothing new, and what is noise in it seems to come again.
    """
    table = observations
    order = np.lexsort((table.landmark, table.camera, table.frame))
    rows = np.column_stack([table.camera, table.landmark, table.uv])[order]
    seen: set[bytes] = set()
    again = []
    for part in np.split(np.arange(len(order)), np.flatnonzero(np.diff(table.frame[order])) + 1):
        points = rows[part].tobytes()
        if points in seen:
            again.append(int(table.frame[order[part[0]]]))
        seen.add(points)
    return table.take(~np.isin(table.frame, again)), tuple(again)


def check_cameras(observations: Observations) -> None:
    """Raise ObservationError where two cameras of a rig hold the same image points."""
    tables = [
        replace(
            observations.take(observations.camera == camera),
            source=f'{observations.source}, camera {name}',
        )
        for camera, name in enumerate(observations.cameras)
    ]
    for one, other in combinations(tables, 2):
        check_distinct(one, other)


def thin_out(observations: Observations) -> Observations:
    """Return about _MANY_POINTS points of more: every second landmark, every third ...

    A view that would be left with less than _MIN_POINTS stays whole.
    """
    step = max(len(observations) // _MANY_POINTS, 1)
    views = np.stack([observations.frame, observations.camera])
    _, view, points = np.unique(views, axis=1, return_inverse=True, return_counts=True)
    place = np.unique(observations.landmark, return_inverse=True)[1].reshape(-1)
    whole = points[view.reshape(-1)] < _MIN_POINTS * step
    return observations.take(whole | (place % step == 0))


def quantization_step(uv: Array) -> float:
    """Return the largest step of which all coordinates (M, 2) are multiples, px; 0 for none."""
    values = np.unique(uv.ravel())
    gaps = np.diff(values)
    if len(values) < 8 or not len(gaps):
        return 0.0
    step = float(gaps[gaps > 1e-9].min(initial=np.inf))
    offsets = (values - values[0]) / step
    return step if np.abs(offsets - np.round(offsets)).max() < 0.02 else 0.0


def looks_side_by_side(table: Observations, size: tuple[int, int]) -> bool:
    """Whether no frame of one camera lies across the middle of wide images, or near it."""
    width, height = size
    if width < MIN_ASPECT * height or not len(table):
        return False
    views = [table.uv[table.frame == frame, 0] for frame in table.frames]
    low, high = (np.array([end(view) for view in views]) for end in (np.min, np.max))
    middle = (width - 1) / 2
    left, right = high < middle, low > middle
    if (left ^ right).all() and min(left.sum(), right.sum()) >= _MIN_VIEWS:
        return _chance((low + high) / 2 / width, left) < _CHANCE
    return False


def _chance(center: Array, left: Mask) -> float:
    """Return how often places (F,), spread evenly over 0 to 1, leave such a gap at a half."""
    gap, count = center[~left].min() - center[left].max(), len(center) - 1
    return float((1 - gap) ** count * (1 + count * gap))
