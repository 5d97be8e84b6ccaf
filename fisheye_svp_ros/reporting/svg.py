"""Panels of a page as SVG: points, lines, arrows, bars and maps on axes with numbers.

For pages of commands that are done before Matplotlib is imported.  Whole numbers throughout: a
unit is a tenth of a pixel of a screen.
"""

from __future__ import annotations

import base64
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape

import numpy as np
from numpy.typing import NDArray

from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.reporting.style import INK, tick_places

WIDTH, WIDE = 4600, 9600
_SIDES, _HEIGHT = (640, 140, 340, 480), 2600  # left, right, above, below; of the axes, at most
_FONT, _SMALL, _NARROW_LETTER = 130, 95, 60  # sizes of letters; width of a small one
_INTERVALS = 6  # of an axis, at most
_SAME_DOT = 10  # points nearer than that are drawn once
_HEAD, _HEAD_ANGLE = 0.3, 0.4  # of an arrow: over its length; rad from it
_KEY = 0.55  # of the width of the axes: where the key begins
_BAR = 0.8  # of the distance of two bars: the width of one
_AXIS, _GRID, _NUMBERS = '#808890', '#e6e9ec', '#404850'


@dataclass(frozen=True)
class Axis:
    """What an axis shows, from the left end or the lower one to the other.

    names: labels at places, instead of numbers.
    """

    label: str
    first: float
    last: float
    names: Sequence[tuple[float, str]] | None = None

    def place(self, values: Array | float, length: int) -> Array:
        """Return the distances of values from the first end of an axis of a length."""
        return np.asarray((np.asarray(values) - self.first) / (self.last - self.first) * length)

    def ticks(self) -> list[tuple[float, str]]:
        """Return places and their labels."""
        if self.names is not None:
            return list(self.names)
        low, high = sorted((self.first, self.last))
        places = tick_places(low, high, _INTERVALS)
        return [(place, f'{place + 0.0:g}'.replace('-', '−')) for place in places]


@dataclass
class Panel:
    """Axes with a title, and what is drawn into them, first things below later ones.

    aspect: height over width of the axes, as high as is usual without; width: of the panel.
    """

    title: str
    x: Axis
    y: Axis
    aspect: float | None = None
    width: int = WIDTH
    parts: list[str] = field(default_factory=list)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the axes."""
        width = self.width - _SIDES[0] - _SIDES[1]
        if self.aspect is None:
            return width, _HEIGHT
        height = min(width * self.aspect, 1.5 * _HEIGHT)
        return round(height / self.aspect), round(height)

    def _places(self, points: Array) -> NDArray[np.int64]:
        """Return where points (N, 2) stand, from the upper left corner of the axes."""
        (width, height), (x, y) = self.size, points.T
        where = np.stack([self.x.place(x, width), height - self.y.place(y, height)], axis=-1)
        return np.round(where).astype(np.int64)

    def dots(self, points: Array, color: str, diameter: int = 26, opacity: float = 1.0) -> None:
        """Draw points (N, 2)."""
        places = np.unique(self._places(points) // _SAME_DOT, axis=0) * _SAME_DOT
        marks = ''.join(f'M{a} {b}h0' for a, b in places.tolist())
        self._stroke(marks, color, diameter, opacity)

    def line(self, points: Array, color: str, width: int = 15, dot: int = 0) -> None:
        """Draw a line through points (N, 2); dot: the diameter of these."""
        places = self._places(points)
        self._stroke('M' + 'L'.join(f'{a} {b}' for a, b in places.tolist()), color, width)
        if dot:
            self.dots(points, color, dot)

    def arrows(self, start: Array, step: Array, color: str, opacity: float) -> None:
        """Draw arrows from points (N, 2) along steps (N, 2)."""
        tail, tip = self._places(start), self._places(start + step)
        cos, sin = _HEAD * np.cos(_HEAD_ANGLE), _HEAD * np.sin(_HEAD_ANGLE)
        back = tail - tip
        across = np.stack([-back[:, 1], back[:, 0]], axis=-1)
        sides = [np.round(tip + cos * back + sign * sin * across) for sign in (-1, 1)]
        lines = np.concatenate([tail, tip, sides[0], tip, sides[1]], axis=-1).astype(np.int64)
        path = ''.join('M{} {}L{} {}M{} {}L{} {} {} {}'.format(*row) for row in lines.tolist())
        self._stroke(path, color, 6, opacity)

    def bars(self, heights: Array, color: str) -> None:
        """Draw bars (N,) from zero to heights, at 0, 1, 2 ..."""
        at = np.arange(len(heights))
        top, base = (
            self._places(np.stack([at, values], axis=-1)) for values in (heights, 0.0 * heights)
        )
        wide = max(1, round(_BAR * self.size[0] / abs(self.x.last - self.x.first)))
        path = ''.join(
            f'M{a - wide // 2} {b}h{wide}V{c}h{-wide}z'
            for (a, b), c in zip(top.tolist(), base[:, 1].tolist(), strict=True)
        )
        self.parts.append(f'<path d="{path}" fill="{color}"/>')

    def map(self, values: Array, levels: Sequence[float], colors: Sequence[str]) -> None:
        """Fill the axes with values (R, C), of a grid from end to end, NaN: nothing there.

        levels: where colors change, one color more than there are of them.
        """
        width, height = self.size
        fine = _interpolate(values, height // 10, width // 10)
        png = palette_png(np.searchsorted(levels, fine), np.isfinite(fine), colors)
        uri = base64.b64encode(png).decode('ascii')
        self.parts.append(
            f'<image width="{width}" height="{height}" preserveAspectRatio="none" '
            f'href="data:image/png;base64,{uri}"/>'
        )

    def key(self, text: str, color: str, length: int = 300, dot: int = 0) -> None:
        """Explain what a line of a color and length is, in the upper right corner."""
        x, y = round(_KEY * self.size[0]), 120
        self.parts.append(
            f'<rect x="{x}" width="{self.size[0]}" height="240" fill="#fff" opacity=".85"/>'
        )
        self._stroke(f'M{x + 80} {y}h{length}', color, 15)
        if dot:
            self._stroke(f'M{x + 80 + length // 2} {y}h0', color, dot)
        self.parts.append(_text(x + 180 + length, y + 45, text, INK))

    def _stroke(self, path: str, color: str, width: int, opacity: float = 1.0) -> None:
        faint = '' if opacity == 1 else f' opacity="{opacity:g}"'
        self.parts.append(
            f'<path d="{path}" stroke="{color}" stroke-width="{width}"{faint} fill="none" '
            'stroke-linecap="round" stroke-linejoin="round"/>'
        )

    def to_svg(self) -> str:
        """Return the panel as a part of a page."""
        (width, height), (left, _, above, below) = self.size, _SIDES
        ticks = [self._horizontal_ticks(), self._vertical_ticks()]
        if self.x.names is not None:
            below += _NARROW_LETTER * max(len(name) for _, name in self.x.names)
        grid = ''.join(path for path, _ in ticks)
        return (
            f'<svg viewBox="0 0 {self.width} {above + height + below}" role="img" '
            f'aria-label="{escape(self.title)}" font-size="{_FONT}">'
            + _text(left + width // 2, above - 110, self.title, '#000', 'middle')
            + f'<path transform="translate({left} {above})" d="{grid}" stroke="{_GRID}" '
            'stroke-width="12"/>'
            f'<svg x="{left}" y="{above}" width="{width}" height="{height}">'
            + ''.join(self.parts)
            + f'</svg><path d="M{left} {above}v{height}h{width}" stroke="{_AXIS}" '
            'stroke-width="12" fill="none"/>'
            + ''.join(label for _, labels in ticks for label in labels)
            + _text(
                left + width // 2, above + height + below - 110, self.x.label, '#000', 'middle'
            )
            + _turned(130, above + height // 2, self.y.label, '#000', 'middle')
            + '</svg>'
        )

    def _horizontal_ticks(self) -> tuple[str, list[str]]:
        """Return the path of the grid lines of the x axis, and its labels."""
        (width, height), (left, _, above, _) = self.size, _SIDES
        places = [(round(float(self.x.place(at, width))), text) for at, text in self.x.ticks()]
        bottom = above + height
        if self.x.names is not None:
            return '', [
                _turned(left + at + 35, bottom + 60, text, _NUMBERS, 'end', _SMALL)
                for at, text in places
            ]
        return ''.join(f'M{at} 0v{height}' for at, _ in places), [
            _text(left + at, bottom + 180, text, _NUMBERS, 'middle') for at, text in places
        ]

    def _vertical_ticks(self) -> tuple[str, list[str]]:
        """Return the path of the grid lines of the y axis, and its labels."""
        (width, height), (left, _, above, _) = self.size, _SIDES
        places = [
            (height - round(float(self.y.place(at, height))), text) for at, text in self.y.ticks()
        ]
        return ''.join(f'M0 {at}h{width}' for at, _ in places), [
            _text(left - 60, above + at + 45, text, _NUMBERS, 'end') for at, text in places
        ]


def _text(
    x: int, y: int, text: str, color: str, anchor: str = 'start', size: int = _FONT, turn: str = ''
) -> str:
    """Return a text of a size that begins, ends or has its middle at a place."""
    if not text:
        return ''
    small = '' if size == _FONT else f' font-size="{size}"'
    return (
        f'<text x="{x}" y="{y}" fill="{color}" text-anchor="{anchor}"{small}{turn}>'
        f'{escape(text)}</text>'
    )


def _turned(x: int, y: int, text: str, color: str, anchor: str, size: int = _FONT) -> str:
    """Return the same, read upwards."""
    return _text(x, y, text, color, anchor, size, f' transform="rotate(-90 {x} {y})"')


def _interpolate(values: Array, rows: int, columns: int) -> Array:
    """Return values (R, C) of a grid at a finer one (rows, columns) with the same ends."""
    found = values
    for axis, count in enumerate((rows, columns)):
        at = np.linspace(0, values.shape[axis] - 1, count)
        low = np.minimum(at.astype(np.int64), max(values.shape[axis] - 2, 0))
        share = np.expand_dims(at - low, 1 - axis)
        first, second = (np.take(found, low + i, axis, mode='clip') for i in (0, 1))
        found = np.where(share == 0, first, (1 - share) * first + share * second)
    return np.asarray(found)


def palette_png(index: NDArray[np.int64], shown: Mask, colors: Sequence[str]) -> bytes:
    """Return a PNG file of indices (H, W) into colors, `#rrggbb`, transparent where not shown.

    Source: Portable Network Graphics (PNG) Specification, W3C (2003), color type 3.
    """
    pixels = np.where(shown, index + 1, 0).astype(np.uint8)
    rows = np.pad(pixels, ((0, 0), (1, 0)))  # each begins with its filter: none
    palette = bytes(3) + b''.join(bytes.fromhex(color[1:]) for color in colors)
    header = struct.pack('>IIBBBBB', pixels.shape[1], len(pixels), 8, 3, 0, 0, 0)
    chunks = {
        b'IHDR': header,
        b'PLTE': palette,
        b'tRNS': b'\0',
        b'IDAT': zlib.compress(rows.tobytes(), 3),
        b'IEND': b'',
    }
    return b'\x89PNG\r\n\x1a\n' + b''.join(
        struct.pack('>I', len(data)) + name + data + struct.pack('>I', zlib.crc32(name + data))
        for name, data in chunks.items()
    )
