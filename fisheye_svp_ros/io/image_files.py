"""Files of maps for cv2.remap: NumPy's .npz and OpenCV's FileStorage, with K, R and P."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.io.files import replacing

_NAMES = ('map1', 'map2', 'mask', 'K', 'R', 'P')


def save_maps(
    folder: Path, u: NDArray[np.float32], v: NDArray[np.float32], mask: Mask, k: Array, r: Array,
    p: Array,
) -> None:
    """Write maps.npz and maps.yml: map1, map2 and mask (H, W), K (3, 3), R (3, 3), P (3, 4).

    In the second numbers are in base 64, which cv2.FileStorage reads by itself.
    """
    arrays: dict[str, Any] = dict(zip(_NAMES, (u, v, mask.astype(np.uint8), k, r, p), strict=True))
    with replacing(folder / 'maps.npz') as file:
        np.savez_compressed(file, **arrays)
    with replacing(folder / 'maps.yml') as file:
        storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_BASE64)
        for name, array in arrays.items():
            storage.write(name, array)
        storage.release()
