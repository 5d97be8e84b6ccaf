"""The library's part about lenses for other images: resized, and views of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects import resizing
from fisheye_svp_ros.effects.resizing import ImageChange
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.io.lens_formats import models
from fisheye_svp_ros.library.checks import (
    check_number,
    check_numbers,
    check_size,
    check_whole_numbers,
)
from fisheye_svp_ros.library.functions import AnyLens, load_lens
from fisheye_svp_ros.library.results import Compared
from fisheye_svp_ros.optics.curves import Perspective
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.optics.pinhole import RadialPinhole
from fisheye_svp_ros.rectify.maps import RANGE, Rectification
from fisheye_svp_ros.rectify.views import (
    cube_views,
    face_size,
    perspective_view,
    rectify_views,
)
from fisheye_svp_ros.solve.lens_comparison import compare_lenses
from fisheye_svp_ros.solve.ray_errors import RANGES


def resize_lens(
    lens: AnyLens,
    *,
    scale: float | None = None,
    crop: tuple[int, int, int, int] | None = None,
    size: tuple[int, int] | None = None,
) -> Lens:
    """Return the lens of images that are cut, scaled or both, in this order.

    crop: (x, y, width, height), px; scale: of both axes, or size: (width, height), px, of the
    new image.  Pixel centers are at whole numbers: cx becomes (cx + 0.5 - x) scale - 0.5.
    Raises ParameterError for a part outside the image, or a size that is no whole number.
    """
    known = load_lens(lens)
    if scale is not None and size is not None:
        raise ParameterError('scale and size are both given; one of them is needed')
    part = None
    if crop is not None:
        numbers = check_whole_numbers(crop, 'crop').ravel().tolist()
        if len(numbers) != 4:
            raise ParameterError(f'crop is {crop!r}; (x, y, width, height) in px is needed')
        part = numbers[0], numbers[1], numbers[2], numbers[3]
    change = ImageChange.of(
        (known.width, known.height),
        part,
        None if scale is None else check_number(scale, 'scale', 'a number above 0'),
        None if size is None else check_size(size, 'size'),
    )
    return change_image(known, change)[0]


def opencv_matrices(lens: AnyLens) -> tuple[Array, Array]:
    """Return K (3, 3), px, and D of a lens for OpenCV; a viewpoint shift stays behind.

    D (4,) is for cv2.fisheye; of a pinhole lens D (5,), (8,), (12,) or (14,) is for cv2 itself.
    Raises LensError for a curve that these do not hold to a hundredth of a pixel.
    """
    known = load_lens(lens)
    if isinstance(known.image_height, RadialPinhole | Perspective):
        return models.camera_matrix(known), np.array(models.opencv_coefficients(known))
    near = models.nearest_kannala_brandt(known)
    return models.camera_matrix(near), np.array(models.coefficients(near))


def compare(one: AnyLens, other: AnyLens) -> Compared:
    """Compare what two lenses of one camera see at the same image points, 0.3, 1 and 5 m away.

    Where a lens has its camera frame is a convention: the motion of it that fits best is taken
    out.  `plot_comparison` draws the result.
    Raises LensError for lenses of two image sizes (`resize_lens`), or without common rays.
    """
    lenses = load_lens(one), load_lens(other)
    found = compare_lenses(*lenses)
    return Compared(*lenses, np.array(RANGES), found.uv, found.theta, found.angle, found.motion)


def undistort_views(
    lens: AnyLens,
    views: Sequence[tuple[float, float, float]] | None = None,
    *,
    size: tuple[int, int] | None = None,
    range_m: float = RANGE,
) -> dict[str, Rectification]:
    """Return what maps photographs to several pinhole views of the lens, by name.

    views: yaw (to the right), pitch (upwards) and field of view over the width, rad; None: the
    faces of a cube that the lens sees (front, right, back, left, up, down).  size: width, height,
    px, of each.  Each is as of `undistort_maps`; its `rotation` (3, 3) is from camera to view.
    Raises ParameterError for views that the lens does not see, or that are no plane image.
    """
    known = load_lens(lens)
    wanted = None if size is None else check_size(size, 'size')
    if views is None:
        return rectify_views(known, cube_views(), wanted or face_size(known), range_m)
    rows = check_numbers(views, 'views', '(V, 3)')
    if rows.ndim != 2 or rows.shape[1] != 3 or not np.isfinite(rows).all():
        raise ParameterError(f'views has the shape {rows.shape}; (V, 3) finite rad are needed')
    turned = [perspective_view(yaw, pitch, field) for yaw, pitch, field in rows.tolist()]
    return rectify_views(known, turned, wanted, range_m)


def change_image(lens: Lens, change: ImageChange) -> tuple[Lens, tuple[str, ...]]:
    """Return the lens of a changed image, and what of it is lost."""
    resized, lost = resizing.transform_lens(lens, change)
    if lens.uncertainty is None:
        return resized, lost
    if not change.keeps_square_pixels:
        return resized, (*lost, 'uncertainty')
    from fisheye_svp_ros.diagnosis import resize_uncertainty  # which takes a while

    return replace(resized, uncertainty=resize_uncertainty(lens.uncertainty, change)), lost
