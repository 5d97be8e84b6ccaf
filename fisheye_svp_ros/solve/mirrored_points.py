"""Image points or boards that are mirror images of what was seen.

A mirrored view of a flat board is a view of its back: every pose fits, on the wrong side.  Paper
is never seen from behind, but a board whose y points up is seen from the side that its z points
to.  So the lens tells, where it is not symmetric, or else the numbers of the landmarks, which go
row by row away from the first one.
"""

from __future__ import annotations

from enum import Enum

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.scene.boards import MAX_THICKNESS, is_flat
from fisheye_svp_ros.scene.observations import Observations, Views, group_views
from fisheye_svp_ros.solve.measured_poses import rms_px

_MIN_POINTS = 6  # of a view: fewer hardly have a side
_MIN_EXTENT = 0.05  # breadth of a board, or its picture, over its length
_MAX_GAP_RATIO = 1.2  # of neighboring columns: of the corners of tags they differ by more
_MAX_BOARD = 3.0  # m; what is larger is no board
_MIN_GAIN = 2.0  # times smaller must the residual of the mirrored points be
_MIN_RMS = 0.3  # px; what fits better needs no mirror
_VIEWS = 8  # that are enough to tell


class Mirror(Enum):
    """What is mirrored."""

    V_UPWARDS = 1
    UV_EXCHANGED = 2
    IMAGE = 3  # one of these
    Y_REVERSED = 4
    Y_UPWARDS = 5  # y up, z out of the board: a right-handed convention, and the lens is right
    U_LEFTWARDS = 6
    X_REVERSED = 7
    ONE_AXIS = 8  # of the image: as that of a camera upside down, either way


def find_mirror(table: Observations, lens: Lens) -> Mirror | None:
    """Return what is mirrored in the table of one camera; None where nothing tells.

    lens: of the camera, or as it was fitted to the same points.
    """
    views = group_views(table)
    if not _are_all_from_behind(views):
        return None
    return mirror_by_lens(views, lens) or _mirror_by_numbers(table, lens)


def mirror_by_lens(views: Views, lens: Lens) -> Mirror | None:
    """Return which mirror image of views of flat boards a lens fits far better, if one does."""
    if not _are_all_from_behind(views):
        return None
    # Brings SciPy: nodes are to start without it.
    from fisheye_svp_ros.solve.lens_calibration import select_points

    few = select_points(views, _VIEWS)
    images = {
        Mirror.V_UPWARDS: few.uv * [1.0, -1.0] + [0.0, lens.height - 1.0],
        Mirror.U_LEFTWARDS: few.uv * [-1.0, 1.0] + [lens.width - 1.0, 0.0],
        Mirror.UV_EXCHANGED: few.uv[..., ::-1],
    }
    rms_given = _median_rms(lens, few)
    rms = {kind: _median_rms(lens, few._replace(uv=uv)) for kind, uv in images.items()}
    best = min(rms, key=lambda kind: rms[kind])
    return best if rms_given > max(_MIN_RMS, _MIN_GAIN * rms[best]) else None


def _median_rms(lens: Lens, views: Views) -> float:
    from fisheye_svp_ros.solve.lens_calibration import localize_views

    residual = np.where(views.used[..., None], localize_views(lens, views).residual, np.nan)
    rms_by_view = [rms_px(one) if np.isfinite(one).any() else np.inf for one in residual]
    return float(np.median(rms_by_view))


def _are_all_from_behind(views: Views) -> bool:
    """Whether boards with x to the right and y down are seen from behind by all views."""
    sides = [
        _handedness(points[used], uv[used])
        for points, uv, used in zip(views.points, views.uv, views.used, strict=True)
    ]
    told = [side for side in sides if side]
    return bool(told) and max(told) < 0


def _handedness(points: Array, uv: Array) -> int:
    """Return 1 for a board (N, 3) in whose picture (N, 2) y is right of x, -1 where it is left.

    0 where that cannot be told: of what is not flat, or seen edge on.
    """
    if len(points) < _MIN_POINTS or not is_flat(points):
        return 0
    local = points - points.mean(axis=0)
    _, extent, axes = np.linalg.svd(local, full_matrices=False)
    if extent[1] < _MIN_EXTENT * extent[0]:
        return 0
    normal = np.cross(axes[0], axes[1])
    towards = np.sign(normal[np.argmax(np.abs(normal))])
    across = np.linalg.lstsq(local @ axes[:2].T, uv - uv.mean(axis=0), rcond=None)[0]
    stretch = np.linalg.svd(across, compute_uv=False)
    if stretch[1] < _MIN_EXTENT * stretch[0]:
        return 0
    return int(towards * np.sign(np.linalg.det(across)))


def _mirror_by_numbers(table: Observations, lens: Lens) -> Mirror | None:
    """Return what the landmarks of a board tell that are numbered row by row.

    None for the corners of tags, whose y points up, and for the floor of a room.
    """
    landmarks = table.landmarks()
    x, y, z = landmarks.points.T
    across = np.hypot(np.ptp(x), np.ptp(y))
    if across > _MAX_BOARD or np.ptp(z) > MAX_THICKNESS * across:
        return None
    if not (_is_even(x) and _is_even(y)):
        return None
    downwards = np.cov(landmarks.ids, y)[0, 1] > 0
    if downwards:
        rows, row = np.unique(np.round(y, 6), return_inverse=True)
        first = np.array([landmarks.ids[row == i].min() for i in range(len(rows))])
        rightwards = np.cov(landmarks.ids - first[row], x)[0, 1] > 0
        if not rightwards and x.max() <= 0:
            return Mirror.X_REVERSED
        return _mirror_of_image(table.uv, lens)
    return Mirror.Y_REVERSED if y.max() <= 0 else Mirror.Y_UPWARDS


def _is_even(places: Array) -> bool:
    """Whether columns or rows are at equal distances."""
    gaps = np.diff(np.unique(np.round(places, 6)))
    return len(gaps) > 0 and bool(gaps.max() < _MAX_GAP_RATIO * gaps.min())


def _mirror_of_image(uv: Array, lens: Lens) -> Mirror:
    """Return what may have made image points (N, 2), px, a mirror image, by where they lie.

    Exchanged ones, and their principal point, lie in an image of exchanged size.
    """
    if uv[:, 0].max() > lens.height:
        return Mirror.ONE_AXIS
    middle = np.array([lens.width - 1, lens.height - 1]) / 2
    off, exchanged = (
        float(np.linalg.norm(np.array([lens.cx, lens.cy]) - place))
        for place in (middle, middle[::-1])
    )
    return Mirror.UV_EXCHANGED if exchanged < off else Mirror.IMAGE
