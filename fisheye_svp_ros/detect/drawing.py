"""Images with what was found in them."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.detect.photographs import Pixels
from fisheye_svp_ros.detect.points import eight_bit

_COLOR = (0, 220, 0)  # blue, green, red
_SHARE = 0.006  # of the width: the radius of a point
_SHIFT = 4  # binary digits of a pixel that OpenCV draws by


def draw_points(pixels: Pixels, ids: Index, uv: Array) -> NDArray[np.uint8]:
    """Return an image (H, W, 3), blue, green, red, with points (N,) at uv (N, 2), px, and ids."""
    image = cv2.cvtColor(eight_bit(pixels), cv2.COLOR_GRAY2BGR)
    radius = max(3, round(_SHARE * image.shape[1]))
    for number, (u, v) in zip(ids.tolist(), uv, strict=True):
        center = round(float(u) * 2**_SHIFT), round(float(v) * 2**_SHIFT)
        cv2.circle(image, center, radius << _SHIFT, _COLOR, 1, cv2.LINE_AA, _SHIFT)
        place = int(u) + radius, int(v) - radius
        cv2.putText(image, str(number), place, cv2.FONT_HERSHEY_PLAIN, radius / 6, _COLOR, 1)
    return np.asarray(image, dtype=np.uint8)
