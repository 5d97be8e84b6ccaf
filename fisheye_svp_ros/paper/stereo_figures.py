"""Figures 9 and 10 of Kita's paper: epipolar curves, their errors, and 3-D points."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.paper.evaluation import Evaluation, Measured
from fisheye_svp_ros.paper.figures import (
    INK,
    NAMES,
    draw_image_frame,
    fixed_grid,
    frame_world,
)
from fisheye_svp_ros.paper.results import Panel
from fisheye_svp_ros.paper.tables import PANELS
from fisheye_svp_ros.reporting.plots import FAINT, picture
from fisheye_svp_ros.scene.rigs import rig
from fisheye_svp_ros.solve.stereo_depth import epipolar_curves

MAGNIFIED = {'fish180': 100, 'fish214': 10}
_TRUE, _MEASURED, _ERROR = '#d23b3b', '#2a9d4a', '#1f5fa8'
_COUNT = 120  # points of a curve


def draw_stereo(path: Path, found: Evaluation, panels: list[Panel]) -> None:
    """Nine rows: left image with epipolar curves and vertical errors; two views of 3-D points."""
    with picture(path, 9.6, 3.2 * len(PANELS)) as figure:
        axes = fixed_grid(figure, len(PANELS), 3)
        for line, (radius, style), measured, panel in zip(
            axes, PANELS, found.measured, panels, strict=True
        ):
            _draw_left_image(line[0], found, measured, style)
            line[0].set_ylabel(f'{style}, {radius} m')
            for axis, (across, up), names in zip(
                line[1:], ((0, 1), (0, 2)), (('x / m', 'y / m'), ('x / m', 'z / m')), strict=True
            ):
                _draw_points(axis, measured, across, up)
                frame_world(axis, radius, *names)
            line[1].set_title(_caption(panel), fontsize=8.5, loc='left')
        name = found.lens.name
        figure.suptitle(f'{NAMES[name]}: vertical errors x {MAGNIFIED[name]}; '
                        'red: true, green: measured', fontsize=10, y=0.997)


def _caption(panel: Panel) -> str:
    text = f'Error2 = {panel.error2:.3f} px, Error3 = {panel.error3:.2f} mm'
    if np.isnan(panel.published_error2):
        return text + '\npublished: no caption kept'
    return (f'{text}\npublished: {panel.published_error2:.3f} px, '
            f'{panel.published_error3:.2f} mm')


def _draw_left_image(axis: Any, found: Evaluation, measured: Measured, style: str) -> None:
    lens = found.lens
    draw_image_frame(axis, lens)
    both = np.isfinite(measured.distance)
    known = ForwardModel(lens.svp())
    curves = epipolar_curves(known, known, rig(style), measured.uv_right[both], _COUNT)
    axis.plot(curves[..., 0].T, curves[..., 1].T, color=FAINT, linewidth=0.6)
    u, v = measured.uv_left[both].T
    axis.plot(u, v, 'o', color=INK, markersize=2)
    ends = v - MAGNIFIED[lens.name] * measured.vertical[both]
    axis.plot([u, u], [v, ends], color=_ERROR, linewidth=1.2)


def _draw_points(axis: Any, measured: Measured, across: int, up: int) -> None:
    known = np.isfinite(measured.measured[:, 0])
    true, solved = measured.true[known], measured.measured[known]
    axis.plot([true[:, across], solved[:, across]], [true[:, up], solved[:, up]], color=FAINT,
              linewidth=0.8)
    axis.plot(true[:, across], true[:, up], 'o', color=_TRUE, markersize=3.2)
    axis.plot(solved[:, across], solved[:, up], 'o', color=_MEASURED, markersize=1.8)
