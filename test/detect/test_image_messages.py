"""Raw images of sensor_msgs: every encoding that ROS names becomes grey, or is refused."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from fisheye_svp_ros.detect.image_messages import color_image
from fisheye_svp_ros.detect.photographs import message_pixels
from fisheye_svp_ros.errors import ObservationError

# Jazzy's sensor_msgs/image_encodings.hpp, and nv12, which later ones name
NAMED = [
    'rgb8',
    'rgba8',
    'rgb16',
    'rgba16',
    'bgr8',
    'bgra8',
    'bgr16',
    'bgra16',
    'mono8',
    'mono16',
    'uyvy',
    'yuv422',
    'yuyv',
    'yuv422_yuy2',
    'nv21',
    'nv24',
    'nv12',
    *(
        f'bayer_{pattern}{bits}'
        for pattern in ('rggb', 'bggr', 'gbrg', 'grbg')
        for bits in (8, 16)
    ),
    *(
        f'{kind}C{channels}'
        for kind in ('8U', '8S', '16U', '16S', '32S', '32F', '64F')
        for channels in range(1, 5)
    ),
]
REFUSED = [name for name in NAMED if re.fullmatch(r'(8SC|16SC|32SC|32FC|64FC)\d|(8|16)UC2', name)]
GREY = np.linspace(100, 146, 24).astype(np.uint8).reshape(4, 6)


def image(encoding: str, grey: NDArray[np.uint8] = GREY, padding: int = 3) -> Any:
    """Return an Image whose pixels are grey, its rows padded; of 16 bit with 256 times as much."""
    wide = encoding.endswith('16') or encoding.startswith('16')
    pixels = grey.astype(np.uint16) * 256 if wide else grey
    if encoding in ('uyvy', 'yuv422', 'yuyv', 'yuv422_yuy2'):
        neutral = np.full_like(grey, 128)
        pixels = np.stack(
            [neutral, grey] if encoding in ('uyvy', 'yuv422') else [grey, neutral], axis=-1
        )
    elif channels := re.search(r'^(?:rgb|bgr)(a?)|C(\d)$', encoding):
        count = int(channels[2] or 3 + bool(channels[1]))
        pixels = np.repeat(pixels[..., None], count, axis=-1)
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(grey), -1)
    padded = np.pad(rows, ((0, 0), (0, padding)))
    chroma = {'nv12': 0.5, 'nv21': 0.5, 'nv24': 2.0}.get(encoding, 0.0)
    data = padded.tobytes() + b'\x80' * int(chroma * padded.size)
    return SimpleNamespace(
        height=len(grey),
        width=grey.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=padded.shape[1],
        data=data,
    )


def pixels(message: Any) -> Any:
    return message_pixels(message, 'sensor_msgs/msg/Image', 'one')


def test_the_list_is_that_of_the_installed_ros() -> None:
    headers = [
        *Path(sys.prefix).glob('include/**/image_encodings.hpp'),
        *Path('/opt/ros').glob('*/include/**/image_encodings.hpp'),
    ]
    if not headers:
        pytest.skip('sensor_msgs is not installed with its headers')
    named = set(re.findall(r'\[\] = "(\w+)"', headers[0].read_text()))
    assert len(named) > 40 and named <= set(NAMED)


@pytest.mark.parametrize('encoding', [name for name in NAMED if name not in REFUSED])
def test_what_shows_brightness_becomes_grey(encoding: str) -> None:
    found = pixels(image(encoding))
    wide = '16' in encoding
    assert found.shape == GREY.shape and found.dtype == (np.uint16 if wide else np.uint8)
    limit = 15 if encoding.startswith('bayer') else 1  # which blurs
    assert np.abs(found / (256 if wide else 1) - GREY).max() <= limit


@pytest.mark.parametrize('encoding', [*REFUSED, '', 'jpeg', 'rgb'])
def test_what_does_not_is_refused_with_the_reason_and_what_to_send(encoding: str) -> None:
    with pytest.raises(ObservationError) as caught:
        pixels(SimpleNamespace(**{**vars(image('mono8')), 'encoding': encoding}))
    reason = 'not one of brightness' if encoding in REFUSED else 'unknown'
    assert f'one: encoding {encoding!r} is {reason}' in str(caught.value)
    assert 'have the driver send mono8, bgr8' in str(caught.value)


@pytest.mark.parametrize('encoding', ['mono8', 'rgb16', 'bayer_rggb8', 'yuyv', 'nv21', 'nv24'])
def test_data_that_are_too_short_are_refused(encoding: str) -> None:
    message = image(encoding)
    for empty in ('width', 'height'):
        with pytest.raises(ObservationError, match='do not hold'):
            pixels(SimpleNamespace(**{**vars(message), empty: 0}))
    message.data = message.data[:-8]
    with pytest.raises(ObservationError, match='do not hold'):
        pixels(message)


@pytest.mark.parametrize('bits', [8, 16])
def test_colors_are_in_the_order_of_their_name(bits: int) -> None:
    red = np.zeros((2, 2, 3), np.uint8 if bits == 8 else np.uint16)
    red[..., 0] = 200
    want = cv2.cvtColor(red, cv2.COLOR_RGB2GRAY)
    for encoding, rows in (
        (f'rgb{bits}', red),
        (f'bgr{bits}', red[..., ::-1]),
        (f'{bits}UC3', red[..., ::-1]),
    ):
        data = np.ascontiguousarray(rows).tobytes()
        message = SimpleNamespace(
            height=2, width=2, encoding=encoding, is_bigendian=0, step=len(data) // 2, data=data
        )
        assert np.array_equal(pixels(message), want), encoding


@pytest.mark.parametrize('bits', [8, 16])
@pytest.mark.parametrize(
    ('pattern', 'red'),
    [
        ('rggb', (0, 0)),
        ('grbg', (0, 1)),
        ('gbrg', (1, 0)),
        ('bggr', (1, 1)),
    ],
)
def test_a_bayer_pattern_begins_where_its_name_says(
    pattern: str, red: tuple[int, int], bits: int
) -> None:
    mosaic = np.zeros((8, 8), np.uint8 if bits == 8 else np.uint16)
    mosaic[red[0] :: 2, red[1] :: 2] = 200
    message = SimpleNamespace(
        height=8,
        width=8,
        encoding=f'bayer_{pattern}{bits}',
        step=bits,
        is_bigendian=0,
        data=mosaic.tobytes(),
    )
    assert np.abs(pixels(message)[2:-2, 2:-2].astype(int) - 0.299 * 200).max() <= 1
    color, encoding = color_image(message, 'one')
    assert encoding == f'bgr{bits}' and color.dtype == mosaic.dtype
    assert (color[2:-2, 2:-2] == [0, 0, 200]).all()


@pytest.mark.parametrize('encoding', [name for name in NAMED if name not in REFUSED])
def test_colors_stay_or_become_bgr_where_pixels_have_none_of_their_own(encoding: str) -> None:
    message = image(encoding)
    found, stated = color_image(message, 'one')
    mixed = encoding.startswith(('bayer', 'uyvy', 'yuv', 'yuyv'))
    wide = '16' in encoding
    assert stated == (
        f'bgr{16 if wide else 8}' if mixed else 'mono8' if encoding.startswith('nv') else encoding
    )
    assert found.dtype == (np.uint16 if wide else np.uint8)
    grey = found if found.ndim == 2 else found[..., 0]
    assert np.abs(grey / (256 if wide else 1) - GREY).max() <= (15 if mixed else 0)


def test_big_endian_numbers() -> None:
    data = (GREY.astype('>u2') * 256).astype('>u2').tobytes()
    message = SimpleNamespace(
        height=4, width=6, encoding='mono16', is_bigendian=1, step=12, data=data
    )
    assert np.array_equal(pixels(message), GREY.astype(np.uint16) * 256)
