"""What undistortion leaves of errors at other ranges: tables, pictures, undistort.json."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.io.image_files import to_color, write_png
from fisheye_svp_ros.rectify.errors import (
    LIMIT,
    RangeErrors,
    image_error,
    pair_error,
    quantiles,
    search_ranges,
    table_ranges,
    tolerated_ranges,
)
from fisheye_svp_ros.rectify.maps import Rectification, RectifiedPair
from fisheye_svp_ros.reporting.terminal import print_table, range_text

_LINES = 16  # across a drawn pair
_MAX_SIZE = 1600  # px, of a drawn pair
_ORANGE = (40, 123, 224)  # BGR


class Remaining(NamedTuple):
    """Errors that are left at ranges: those of a table (R,), m, and of a curve (S,), m.

    table (R, 3), curve (S, 3), px: median, 95 % and largest; tolerated (2,), m: the ranges about
    that of the maps with errors of up to LIMIT; depth (R, 3): of a pair, relative; map_range, m:
    that of errors map_px (N,) at pixels map_uv (N, 2).
    """

    ranges: Array
    table: Array
    curve_ranges: Array
    curve: Array
    tolerated: Array
    map_range: float
    map_uv: Array
    map_px: Array
    depth: Array | None = None


def shift_left(side: Rectification) -> Remaining:
    """Return what the viewpoint shift leaves at other ranges than that of the maps."""
    ranges = table_ranges(side), search_ranges(side)
    return _remaining_errors(side, *(image_error(side, part) for part in ranges))


def rows_left(pair: RectifiedPair) -> Remaining:
    """Return how rows of both images differ at other ranges than that of the maps."""
    ranges = table_ranges(pair.left), search_ranges(pair.left)
    return _remaining_errors(pair.left, *(pair_error(pair, part) for part in ranges))


def _remaining_errors(side: Rectification, error: RangeErrors, curve: RangeErrors) -> Remaining:
    table = quantiles(error.px)
    worst = int(np.nanargmax(table[:, 2]))
    return Remaining(
        error.ranges,
        table,
        curve.ranges,
        quantiles(curve.px),
        tolerated_ranges(curve.ranges, curve.px, side.range),
        float(error.ranges[worst]),
        error.pixels,
        np.abs(error.px[worst]),
        None if error.depth is None else quantiles(error.depth),
    )


def print_remaining(title: str, left: Remaining) -> None:
    """Print the errors by range."""
    header = ['range', 'median, px', '95 %, px', 'largest, px']
    rows = [
        [range_text(r), *(_number(value, 3) for value in row)]
        for r, row in zip(left.ranges, left.table, strict=True)
    ]
    if left.depth is not None:
        header += ['depth error, median, %', '95 %, %']
        for row, depth in zip(rows, left.depth, strict=True):
            row += [_number(100 * value, 2) for value in depth[:2]]
    print_table(title, header, rows)


def tolerated_text(left: Remaining) -> str:
    """Say at which ranges the errors stay below the limit."""
    near, far = left.tolerated
    return f'below {LIMIT:g} px from {range_text(near)} to {range_text(far)}'


def remaining_document(left: Remaining) -> dict[str, Any]:
    """Return the mapping of one part of undistort.json; null is infinity among ranges."""
    names = ('median_px', 'p95_px', 'worst_px')
    document = {
        'ranges_m': left.ranges.tolist(),
        **{name: left.table[:, i].tolist() for i, name in enumerate(names)},
        'below_px': LIMIT,
        'below_m': left.tolerated.tolist(),
    }
    if left.depth is not None:
        document |= {
            'depth_median': left.depth[:, 0].tolist(),
            'depth_p95': left.depth[:, 1].tolist(),
        }
    return document


def draw_remaining(path: Path, side: Rectification, left: Remaining, what: str) -> None:
    """Draw the errors over the range, and over the image where the table has the largest."""
    from fisheye_svp_ros.reporting.plots import picture  # not for --help
    from fisheye_svp_ros.reporting.style import FAINT, OURS, PUBLISHED

    with picture(path, 10.0, 4.0) as figure:
        curve, image = figure.subplots(1, 2)
        near = np.isfinite(left.curve_ranges)
        for i, (name, color, line) in enumerate(
            (('median', FAINT, '-'), ('95 %', OURS, '-'), ('largest', PUBLISHED, '--'))
        ):
            values = left.curve[near, i]
            curve.plot(left.curve_ranges[near], values, line, color=color, label=name)
        curve.axhline(LIMIT, color='#404850', linestyle='--', linewidth=0.9)
        if np.isfinite(side.range):
            curve.axvline(side.range, color='#404850', linestyle=':', linewidth=0.9)
        top = np.fmax.reduce(left.table[:, 2])
        curve.set(
            xscale='log',
            xlabel='range, m',
            ylabel=f'{what}, px',
            ylim=(0, 1.1 * top or 1.0),  # of a camera of one pixel nothing is off
            title=tolerated_text(left),
        )
        curve.legend()
        (u, column), (v, row) = (
            np.unique(places, return_inverse=True) for places in left.map_uv.T
        )
        values = np.full((len(v), len(u)), np.nan)
        values[row, column] = left.map_px
        shown = image.pcolormesh(u, v, values, shading='nearest', cmap='Blues', vmin=0.0)
        figure.colorbar(shown, ax=image, label=f'{what}, px')
        image.set(
            xlim=(-0.5, side.camera.width - 0.5),
            ylim=(side.camera.height - 0.5, -0.5),
            aspect='equal',
            xlabel='u, px',
            ylabel='v, px',
            title=f'over the image, at {range_text(left.map_range)}',
        )
        image.grid(visible=False)


def draw_pair(path: Path, left: NDArray[Any], right: NDArray[Any]) -> None:
    """Draw two rectified images side by side, with rows across both."""
    picture = np.concatenate([to_color(left), to_color(right)], axis=1)
    zoom = min(_MAX_SIZE / picture.shape[1], 1.0)
    picture = cv2.resize(picture, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_AREA)
    for row in np.linspace(0, picture.shape[0] - 1, _LINES + 2)[1:-1].round().astype(int).tolist():
        cv2.line(picture, (0, row), (picture.shape[1] - 1, row), _ORANGE, 1)
    write_png(path, picture)


def _number(value: float, decimals: int) -> str:
    return f'{value:.{decimals}f}' if np.isfinite(value) else '-'
