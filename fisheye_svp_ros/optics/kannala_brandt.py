"""The lens that a user of the SVP model would be given: Kannala-Brandt, OpenCV's fisheye."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fisheye_svp_ros.optics.curves import KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens

_SAMPLES = 512


def kannala_brandt_equivalent(lens: Lens) -> Lens:
    """Return the SVP Kannala-Brandt lens nearest to the image-height curve of a lens.

    Exact where the lens is Kannala-Brandt or equidistant; otherwise the least-squares fit of the
    five odd powers of theta over the field of view.  Corrections have no place in it.
    """
    curve = lens.image_height
    bare = replace(lens.svp(), image_field=None, corrections={}, target={})
    exact = curve.with_powers(())
    if exact is not None:
        return replace(bare, image_height=exact)
    theta = np.linspace(0.0, lens.max_incidence, _SAMPLES)
    scaled = theta / lens.max_incidence
    powers = np.arange(1, 10, 2)
    height, _ = curve.value_and_slope(theta)
    fitted = np.linalg.lstsq(scaled[:, None] ** powers, height, rcond=None)[0]
    scale, *k = fitted / lens.max_incidence**powers
    return replace(
        bare,
        fx=lens.fx * float(scale),
        fy=lens.fy * float(scale),
        image_height=KannalaBrandt(*(float(value / scale) for value in k)),
    )
