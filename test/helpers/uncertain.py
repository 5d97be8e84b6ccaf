"""A lens whose file says of what kind and size its own errors are."""

from __future__ import annotations

import numpy as np

from fisheye_svp_ros.optics.curves import Gennery, KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens

NAMES = ['fx', 'fy', 'cx', 'cy', 'k1', 'e0']
STDERR = np.array([0.5, 0.5, 0.3, 0.3, 1e-3, 3e-4])
LOW, HIGH = np.array([100.0, 60.0]), np.array([900.0, 740.0])
COARSE, BUMPS, LINEAR, OFFSET = 0.15, 0.2, 0.2, 0.3  # px, px, px, mm
BOARD = (
    np.stack([*np.meshgrid(np.arange(7.0), np.arange(5.0)), np.zeros((5, 7))], -1).reshape(-1, 3)
    * 0.04
)
NOISE = 0.1  # px


def uncertain(**components: float) -> Lens:
    """Return a lens that says it errs: fx and fy together, the rest each for itself."""
    covariance = np.diag(STDERR**2)
    covariance[0, 1] = covariance[1, 0] = 0.9 * STDERR[0] * STDERR[1]
    sizes = components or {'image_coarse': COARSE, 'frame_bumps': BUMPS, 'frame_linear': LINEAR}
    return Lens(
        'lens',
        1000,
        800,
        300.0,
        300.0,
        500.0,
        400.0,
        KannalaBrandt(-0.01),
        1.5,
        Gennery(e0=0.002),
        uncertainty={
            'noise_px': NOISE,
            'misfit_px': 0.3,
            'parameters': NAMES,
            'covariance': covariance.tolist(),
            'components': sizes,
            'extent_px': [LOW.tolist(), HIGH.tolist()],
            'finest_px': None,
            'landmarks': [
                [i, 0, *place, *[1e-3 * OFFSET] * 3] for i, place in enumerate(BOARD.tolist())
            ],
        },
    )
