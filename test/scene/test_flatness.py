"""What is one flat board, of which photographs can be planned."""

from __future__ import annotations

import numpy as np

from fisheye_svp_ros.scene.boards import is_flat


def test_a_bent_board_is_flat_and_a_cloud_is_not() -> None:
    x, y = np.meshgrid(np.linspace(-0.2, 0.2, 7), np.linspace(-0.15, 0.15, 5))
    bent = np.stack([x, y, 0.05 * x**2], axis=-1).reshape(-1, 3)
    assert is_flat(bent) and is_flat(bent[:2])
    assert not is_flat(np.random.default_rng(0).normal(size=(30, 3)))
