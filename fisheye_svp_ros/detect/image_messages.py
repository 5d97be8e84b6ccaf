"""The raw images of sensor_msgs in grey or in color, whatever their encoding."""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fisheye_svp_ros.errors import ObservationError


class _Encoding(NamedTuple):
    """Numbers of a pixel, what makes grey of them, and the bytes of the planes behind them.

    planes: bytes that follow for each byte of the grey plane; bgr: what makes colors of samples
    that are none by themselves.
    """

    kind: type
    channels: int
    grey: int | None = None
    planes: float = 0.0
    bgr: int | None = None


def _encodings() -> dict[str, _Encoding]:
    """Return all that show brightness; those without an order of colors have OpenCV's."""
    known = {
        f'nv{number}': _Encoding(np.uint8, 1, None, planes)
        for number, planes in (('12', 0.5), ('21', 0.5), ('24', 2.0))
    }
    for name, kind in (('8', np.uint8), ('16', np.uint16)):
        known |= {
            f'mono{name}': _Encoding(kind, 1),
            f'{name}UC1': _Encoding(kind, 1),
            f'{name}UC3': _Encoding(kind, 3, cv2.COLOR_BGR2GRAY),
            f'{name}UC4': _Encoding(kind, 4, cv2.COLOR_BGRA2GRAY),
            f'rgb{name}': _Encoding(kind, 3, cv2.COLOR_RGB2GRAY),
            f'bgr{name}': _Encoding(kind, 3, cv2.COLOR_BGR2GRAY),
            f'rgba{name}': _Encoding(kind, 4, cv2.COLOR_RGBA2GRAY),
            f'bgra{name}': _Encoding(kind, 4, cv2.COLOR_BGRA2GRAY),
        }
        # OpenCV calls a pattern by its second row.
        for pattern, grey, bgr in (
            ('rggb', cv2.COLOR_BayerBG2GRAY, cv2.COLOR_BayerBG2BGR),
            ('bggr', cv2.COLOR_BayerRG2GRAY, cv2.COLOR_BayerRG2BGR),
            ('gbrg', cv2.COLOR_BayerGR2GRAY, cv2.COLOR_BayerGR2BGR),
            ('grbg', cv2.COLOR_BayerGB2GRAY, cv2.COLOR_BayerGB2BGR),
        ):
            known[f'bayer_{pattern}{name}'] = _Encoding(kind, 1, grey, bgr=bgr)
    uyvy = _Encoding(np.uint8, 2, cv2.COLOR_YUV2GRAY_UYVY, bgr=cv2.COLOR_YUV2BGR_UYVY)
    yuyv = _Encoding(np.uint8, 2, cv2.COLOR_YUV2GRAY_YUY2, bgr=cv2.COLOR_YUV2BGR_YUY2)
    return (
        known
        | dict.fromkeys(('yuv422', 'uyvy'), uyvy)
        | dict.fromkeys(('yuv422_yuy2', 'yuyv'), yuyv)
    )


_ENCODINGS = _encodings()
# What others are: signed, of 32 or 64 bit, or of two channels
_NO_BRIGHTNESS = ('8SC', '16SC', '32SC', '32FC', '64FC', '8UC', '16UC')


def image_pixels(message: Any, name: str) -> NDArray[Any]:
    """Return a sensor_msgs Image in grey (H, W), uint8 or uint16.

    Raises ObservationError for an encoding without brightness, or data that are too short.
    """
    encoding, samples = _samples(message, name)
    return samples if encoding.grey is None else np.asarray(cv2.cvtColor(samples, encoding.grey))


def color_image(message: Any, name: str) -> tuple[NDArray[Any], str]:
    """Return a sensor_msgs Image (H, W) or (H, W, C) that can be interpolated, and its encoding.

    Colors stay as they are; of Bayer patterns and YUV 4:2:2 bgr8 or bgr16 is made, of NV12, NV21
    and NV24 mono8.  Raises ObservationError as `image_pixels` does.
    """
    encoding, samples = _samples(message, name)
    depth = '8' if encoding.kind is np.uint8 else '16'
    if encoding.bgr is not None:
        return np.asarray(cv2.cvtColor(samples, encoding.bgr)), f'bgr{depth}'
    return samples, f'mono{depth}' if encoding.planes else message.encoding


def _samples(message: Any, name: str) -> tuple[_Encoding, NDArray[Any]]:
    """Return the encoding of an Image and its numbers, (H, W) or (H, W, C)."""
    encoding = _ENCODINGS.get(message.encoding)
    if encoding is None:
        raise ObservationError(f'{name}: encoding {_encoding_error(message.encoding)}')
    dtype = np.dtype(encoding.kind).newbyteorder('>' if message.is_bigendian else '<')
    data, height, step = bytes(message.data), message.height, message.step
    width = message.width * encoding.channels * dtype.itemsize
    if not 0 < width <= step or not 0 < step * height * (1 + encoding.planes) <= len(data):
        raise ObservationError(
            f'{name}: {len(data)} bytes do not hold an image of '
            f'{message.width}x{height} {message.encoding}'
        )
    rows = np.frombuffer(data, np.uint8)[: step * height]
    rows = np.ascontiguousarray(rows.reshape(height, step)[:, :width])
    pixels: NDArray[Any] = rows.view(dtype).astype(encoding.kind, copy=False)
    if encoding.channels > 1:
        pixels = pixels.reshape(height, message.width, encoding.channels)
    return encoding, pixels


def _encoding_error(encoding: str) -> str:
    reason = 'unknown'
    if encoding.rstrip('0123456789') in _NO_BRIGHTNESS:
        reason = 'not one of brightness'
    return (
        f'{encoding[:40]!r} is {reason}; have the driver send mono8, bgr8 or another of '
        f'{", ".join(_ENCODINGS)}'
    )
