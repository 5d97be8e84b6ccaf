"""Wanted photographs, drawn: as the camera sees them, over live images."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from fisheye_svp_ros.detect.photographs import Pixels
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.image_files import to_color
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.planning.guide import MIN_SCORE, DetectedBoard, Guide
from fisheye_svp_ros.planning.plan import NextViews
from fisheye_svp_ros.reporting.plots import picture
from fisheye_svp_ros.reporting.style import FAINT, OURS, PUBLISHED
from fisheye_svp_ros.reporting.wording.shots import (
    expected_error,
    guide_words,
    instruction,
    purpose,
)
from fisheye_svp_ros.simulate.simulation import blank_views

_COLUMNS, _PANEL = 3, 3.4  # inches
_WANTED, _SEEN, _READY, _TEXT = (40, 123, 224), (230, 160, 60), (80, 200, 80), (245, 245, 245)
_MAX_WIDTH = 1280  # px, of the picture
_BAND, _LETTER = 0.034, 0.00075  # height of a line over the width of the picture; size of its text
_FRACTION_BITS = 4  # binary places of a pixel that OpenCV draws to


def draw_shots(
    file: Path | BytesIO, model: ForwardModel, wanted: NextViews, narrow: bool = False
) -> None:
    """Draw each wanted view through the present lens: PNG, or PDF to be printed."""
    board, shots = wanted.board, wanted.shots
    count, first = len(shots.distance), int(np.argmin(board.landmark))
    views = blank_views(board.landmark, board.points, count, board=board.board)
    uv = model.predict(shots.camera, views).uv
    columns = 1 if narrow else _COLUMNS
    lines = -(-count // columns)
    with picture(file, columns * _PANEL, lines * _PANEL + 0.3) as figure:
        axes = np.ravel(figure.subplots(lines, columns, squeeze=False))
        for axis in axes[count:]:
            axis.axis('off')
        for i, axis in enumerate(axes[:count]):
            _frame(axis, model.lens)
            hull = uv[i][ConvexHull(uv[i]).vertices]
            axis.fill(*hull.T, facecolor=FAINT, edgecolor=OURS, alpha=0.5)
            axis.plot(*uv[i].T, '.', color=OURS, markersize=2.5)
            axis.plot(*uv[i][first], 'o', color=PUBLISHED, markersize=6, fillstyle='none')
            away, where, tilt, roll = instruction(shots, i)
            axis.set_title(
                f'{i + 1}: {away}, {where}\ntilt {tilt}, turn {roll}; '
                f'{expected_error(wanted, i + 1)}',
                fontsize=7.5,
            )
        figure.suptitle(purpose(wanted), fontsize=9)


def _frame(axis: Any, lens: Lens) -> None:
    """Draw the border of the image and the edge of the field."""
    turn = np.linspace(0, 2 * np.pi, 181)
    edge = float(lens.image_height.value_and_slope(np.array(lens.max_incidence))[0])
    axis.plot(
        lens.cx + lens.fx * edge * np.cos(turn),
        lens.cy + lens.fy * edge * np.sin(turn),
        ':',
        color=FAINT,
    )
    axis.set(
        xlim=(-0.5, lens.width - 0.5),
        ylim=(lens.height - 0.5, -0.5),
        aspect='equal',
        xticks=[],
        yticks=[],
    )
    axis.grid(visible=False)
    for side in axis.spines.values():
        side.set_visible(True)


def draw_guide(pixels: Pixels, guide: Guide, board: DetectedBoard | None) -> NDArray[np.uint8]:
    """Return the picture (H, W, 3), blue, green, red, of an image with the guide over it."""
    zoom = min(1.0, _MAX_WIDTH / max(pixels.shape))
    picture, outline = to_color(pixels, zoom), guide.outline
    if outline is not None:
        color = _READY if guide.score >= MIN_SCORE else _WANTED
        wanted = _to_fixed_point(outline[np.isfinite(outline).all(axis=1)], zoom)
        hull = cv2.convexHull(wanted)
        filled = cv2.fillConvexPoly(picture.copy(), hull, color, cv2.LINE_AA, _FRACTION_BITS)
        picture = np.asarray(cv2.addWeighted(filled, 0.25, picture, 0.75, 0))
        cv2.polylines(picture, [hull], True, color, 2, cv2.LINE_AA, _FRACTION_BITS)
        _dots(picture, wanted, color, 2)
        cv2.circle(
            picture,
            wanted[0].tolist(),
            9 << _FRACTION_BITS,
            color,
            2,
            cv2.LINE_AA,
            _FRACTION_BITS,
        )
    if board is not None:
        corners = _to_fixed_point(board.uv, zoom)
        _dots(picture, corners, _SEEN, 3)
        first = corners[int(np.argmin(board.ids))].tolist()
        cv2.circle(picture, first, 9 << _FRACTION_BITS, _SEEN, 2, cv2.LINE_AA, _FRACTION_BITS)
    _draw_texts(picture, guide)
    return picture


def _to_fixed_point(uv: NDArray[np.float64], zoom: float) -> NDArray[np.int32]:
    """Return image points in the fixed point numbers of OpenCV's drawing."""
    places = np.clip((uv + 0.5) * zoom - 0.5, -1e4, 1e4)
    return np.round(places * (1 << _FRACTION_BITS)).astype(np.int32)


def _dots(
    picture: NDArray[np.uint8], places: NDArray[np.int32], color: tuple[int, int, int], size: int
) -> None:
    for place in places.tolist():
        cv2.circle(picture, place, size << _FRACTION_BITS, color, -1, cv2.LINE_AA, _FRACTION_BITS)


def _draw_texts(picture: NDArray[np.uint8], guide: Guide) -> None:
    """Write what to do above, with the score as a bar, and where matters stand below."""
    height, width = picture.shape[:2]
    line, size = round(_BAND * width), _LETTER * width
    todo, where, progress = guide_words(guide)
    for top, bottom in ((0, round(2.6 * line)), (height - round(1.3 * line), height)):
        picture[top:bottom] //= 4
    for text, base in ((todo, 1.0), (where, 2.0)):
        _write_words(picture, text, round(base * line), size)
    _write_words(picture, progress, height - round(0.4 * line), size)
    left, right, top = round(0.6 * width), round(0.98 * width), round(0.3 * line)
    ready = guide.score >= MIN_SCORE
    cv2.rectangle(
        picture,
        (left, top),
        (left + round(guide.score * (right - left)), line),
        _READY if ready else _WANTED,
        -1,
    )
    cv2.rectangle(picture, (left, top), (right, line), _TEXT, 1)
    mark = left + round(MIN_SCORE * (right - left))
    cv2.line(picture, (mark, top), (mark, line), _TEXT, 2)


def _write_words(picture: NDArray[np.uint8], text: str, base: int, size: float) -> None:
    cv2.putText(
        picture,
        text,
        (round(0.012 * picture.shape[1]), base),
        cv2.FONT_HERSHEY_SIMPLEX,
        size,
        _TEXT,
        max(1, round(1.6 * size)),
        cv2.LINE_AA,
    )
