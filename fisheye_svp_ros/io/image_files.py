"""Image files: PNG, and maps for cv2.remap, with K, R and P."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.io.files import replacing, write_bytes

_NAMES = ('map1', 'map2', 'mask', 'K', 'R', 'P')


def save_maps(
    folder: Path,
    u: NDArray[np.float32],
    v: NDArray[np.float32],
    mask: Mask,
    k: Array,
    r: Array,
    p: Array,
) -> None:
    """Write maps.npz and maps.yml: map1, map2 and mask (H, W), K (3, 3), R (3, 3), P (3, 4).

    The second is of OpenCV, with numbers in base 64, which cv2.FileStorage reads by itself.
    """
    arrays: dict[str, Any] = dict(zip(_NAMES, (u, v, mask.astype(np.uint8), k, r, p), strict=True))
    with replacing(folder / 'maps.npz') as file:
        np.savez_compressed(file, **arrays)
    with replacing(folder / 'maps.yml') as file:
        storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_BASE64)
        for name, array in arrays.items():
            storage.write(name, array)
        storage.release()


def write_png(path: Path, pixels: NDArray[Any]) -> None:
    """Write an image (H, W) or (H, W, 3) whole or not at all."""
    write_bytes(path, cv2.imencode('.png', pixels)[1].tobytes())


def to_color(pixels: NDArray[Any], zoom: float = 1.0) -> NDArray[np.uint8]:
    """Return an image of any depth as 8 bits of blue, green and red, resized."""
    scale = 255 / max(float(pixels.max()), 1.0) if pixels.dtype != np.uint8 else 1.0
    image = cv2.resize(
        cv2.convertScaleAbs(pixels, alpha=scale),
        None,
        fx=zoom,
        fy=zoom,
        interpolation=cv2.INTER_AREA,
    )
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image)
