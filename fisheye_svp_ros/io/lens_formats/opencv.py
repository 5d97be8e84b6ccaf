"""OpenCV FileStorage (YAML or XML) of cv2.fisheye: a matrix and four coefficients."""

from __future__ import annotations

from typing import Any

import numpy as np

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.lens_formats import Foreign, radial
from fisheye_svp_ros.optics.lens import Lens

_MATRIX = ('camera_matrix', 'cameraMatrix', 'Camera_Matrix', 'K', 'K1', 'M1')
_COEFFICIENTS = ('distortion_coefficients', 'Distortion_Coefficients', 'distCoeffs', 'D', 'D1')
_WIDTH, _HEIGHT = ('image_width', 'width', 'image_Width'), ('image_height', 'height')
_SIZE = ('image_size', 'imageSize', 'size')


def recognises(text: str) -> bool:
    """Say whether a text is such a file."""
    return text.lstrip().startswith('%YAML') or '<opencv_storage>' in text


def read(text: str, where: str) -> Foreign:
    """Read the lens; raises LensError, naming what is missing."""
    import cv2  # takes a while, and other formats do without

    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        keys = storage.root().keys()
    except (cv2.error, SystemError) as cause:
        raise LensError(f'{where}: not a whole OpenCV file') from cause

    def node(names: tuple[str, ...]) -> Any:
        for name in names:
            if name in keys:
                return storage.getNode(name)
        raise LensError(f'{where}: it has none of {", ".join(names)}')

    if any(name in keys for name in _SIZE):
        pair = node(_SIZE)
        size = [float(pair.at(i).real()) for i in (0, 1)]
    else:
        size = [float(node(names).real()) for names in (_WIDTH, _HEIGHT)]
    k, d = node(_MATRIX).mat(), node(_COEFFICIENTS).mat()
    if k is None or k.shape != (3, 3) or d is None or d.size != 4:
        raise LensError(f'{where}: a matrix of 3 x 3 and the four coefficients of cv2.fisheye are '
                        'needed')
    lens = radial.kannala_brandt(
        'camera', size, (k[0, 0], k[1, 1], k[0, 2], k[1, 2]), d.ravel().tolist(), where)
    return Foreign('opencv', {'camera': lens}, (), {})


def write(lens: Lens) -> str:
    """Return the lens in this form, YAML."""
    import cv2

    near = radial.nearest(lens)
    storage = cv2.FileStorage('.yml', cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write('image_width', near.width)
    storage.write('image_height', near.height)
    storage.write('camera_matrix', np.array(
        [[near.fx, 0, near.cx], [0, near.fy, near.cy], [0, 0, 1]]))
    storage.write('distortion_coefficients', np.array([radial.coefficients(near)]))
    text: str = storage.releaseAndGetString()
    return text
