"""The library's part about lenses: for another image."""

from __future__ import annotations

from dataclasses import replace

from fisheye_svp_ros.effects import resizing
from fisheye_svp_ros.effects.resizing import ImageChange
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.library.checks import check_number, check_size, check_whole_numbers
from fisheye_svp_ros.library.functions import AnyLens, load_lens
from fisheye_svp_ros.optics.lens import Lens


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


def change_image(lens: Lens, change: ImageChange) -> tuple[Lens, tuple[str, ...]]:
    """Return the lens of a changed image, and what of it is lost."""
    resized, lost = resizing.resize_lens(lens, change)
    if lens.uncertainty is None:
        return resized, lost
    if not change.keeps_square_pixels:
        return resized, (*lost, 'uncertainty')
    from fisheye_svp_ros.diagnosis import resize_uncertainty  # which takes a while

    return replace(resized, uncertainty=resize_uncertainty(lens.uncertainty, change)), lost
