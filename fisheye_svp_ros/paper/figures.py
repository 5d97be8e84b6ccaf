"""Figures 4 to 8 of Kita's paper, from our numbers, in the paper's arrangement."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.io.landmark_files import environment
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.paper.evaluation import Evaluation, Localized, shift_at
from fisheye_svp_ros.paper.family import Family, shift_curves
from fisheye_svp_ros.paper.tables import LENSES, STYLE_NAMES
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.reporting.plots import FAINT, OURS, PUBLISHED, legend_below, picture
from fisheye_svp_ros.scene.landmarks import RADII, SPREADS
from fisheye_svp_ros.scene.rigs import calibration_poses, rig

COLOURS = {'fish180': OURS, 'fish214': PUBLISHED}
NAMES = {'fish180': 'Fish180', 'fish214': 'Fish214'}
MAGNIFIED = 100
INK = '#404850'
# Views of the paper's world: axes that run to the right and up, and their names.
_VIEWS = (((0, 1), 'x / m', 'y / m'), ((0, 2), 'x / m', 'z / m'))


def draw_shift(path: Path, lenses: dict[str, Lens], family: Family) -> None:
    """Figure 4: viewpoint shift against incident angle; light: all fits of the family."""
    with picture(path, 6.4, 4.2) as figure:
        axis = figure.subplots()
        for name, lens in lenses.items():
            theta = np.linspace(0, lens.max_incidence, 200)
            curves = 1e3 * shift_curves(family.fits, name, theta)
            axis.plot(np.degrees(theta), curves.T, color=COLOURS[name], alpha=0.18, linewidth=0.8)
            axis.plot(np.degrees(theta), 1e3 * shift_at(lens, theta), color=COLOURS[name],
                      linewidth=2, label=f'{NAMES[name]} (light: all {len(family.fits)} fits)')
        axis.axvline(88, color=FAINT, linestyle=':')
        axis.annotate('outermost landmarks', (88, axis.get_ylim()[1]), ha='right', va='top',
                      rotation=90, color=INK, fontsize=8)
        axis.set(xlabel='incident angle / degree', ylabel='viewpoint shift / mm', xlim=(0, 107))
        axis.legend(loc='upper left')


def draw_height(path: Path, lenses: dict[str, Lens]) -> None:
    """Figure 5: image height against incident angle."""
    with picture(path, 6.4, 4.2) as figure:
        axis = figure.subplots()
        for name, lens in lenses.items():
            theta = np.linspace(0, lens.max_incidence, 200)
            height, _ = lens.image_height.value_and_slope(theta)
            axis.plot(np.degrees(theta), lens.fx * height, color=COLOURS[name], linewidth=2,
                      label=NAMES[name])
            axis.axhline(lens.width / 2, color=COLOURS[name], linestyle=':', linewidth=1)
        axis.annotate('dotted: half the image', (2, 775), color=INK, fontsize=8)
        axis.set(xlabel='incident angle / degree', ylabel='image height / px', xlim=(0, 107),
                 ylim=(0, 820))
        axis.legend(loc='center left')


def draw_localization(path: Path, found: dict[str, Evaluation]) -> None:
    """Figure 6: two views of every environment, and the residuals of both lenses, x 100."""
    rows = [(radius, spread) for radius in range(len(RADII)) for spread in range(len(SPREADS))]
    with picture(path, 10.5, 2.5 * len(rows)) as figure:
        axes = fixed_grid(figure, len(rows), 4)
        for line, (radius, spread) in zip(axes, rows, strict=True):
            points = found[LENSES[0]].localized[spread].views.points[radius]
            for axis, view in zip(line[:2], _VIEWS, strict=True):
                _draw_world(axis, view, points)
            line[0].set_ylabel(f'{SPREADS[spread].title()}, {RADII[radius]} m\ny / m')
            for axis, name in zip(line[2:], LENSES, strict=True):
                one = found[name]
                draw_image_frame(axis, one.lens)
                mean = one.localization[radius, spread, -1]
                _draw_residuals(axis, one.localized[spread], radius, COLOURS[name])
                axis.set_title(f'{NAMES[name]}: {mean:.4f} px', fontsize=9)


def draw_rigs(path: Path) -> None:
    """Figure 7: the stereo configurations, from above."""
    with picture(path, 8.4, 2.3) as figure:
        for axis, style in zip(figure.subplots(1, 3, sharey=True), STYLE_NAMES, strict=True):
            left = rig(style)
            for position, axis_z, name in (
                (np.zeros(3), np.array([0.0, 0.0, 1.0]), 'right'),
                (left.position, left.rotation[:, 2], 'left'),
            ):
                axis.plot(*position[[0, 2]], 's', color=INK, markersize=8)
                axis.annotate('', (position + 0.12 * axis_z)[[0, 2]], position[[0, 2]],
                              arrowprops={'arrowstyle': '->', 'color': OURS, 'linewidth': 1.6})
                axis.annotate(name, position[[0, 2]] - [0, 0.012], ha='center', va='top',
                              color=INK)
            axis.set(title=style, xlabel='x / m', xlim=(-0.24, 0.09), ylim=(-0.05, 0.15))
            axis.set_aspect('equal')
        figure.axes[0].set_ylabel('viewing direction / m')


def draw_calibration_poses(path: Path) -> None:
    """Figure 8: the ten poses of a vergent rig among the Whole landmarks at 0.5 m."""
    points = environment('whole', 0.5).points
    right = calibration_poses()
    count = len(right.position)
    left = right.compose(
        Pose(*(np.broadcast_to(a, (count, *a.shape)) for a in rig('vergent')))
    )
    with picture(path, 9.6, 4.6) as figure:
        for axis, view in zip(figure.subplots(1, 2), _VIEWS, strict=True):
            (across, up), x_name, y_name = view
            axis.plot(points[:, across], points[:, up], 's', color=INK, markersize=3)
            for camera, colour, name in ((right, OURS, 'right'), (left, PUBLISHED, 'left')):
                ends = camera.position + 0.12 * camera.rotation[..., 2]
                for one, end in zip(camera.position, ends, strict=True):
                    axis.plot([one[across], end[across]], [one[up], end[up]], color=colour,
                              linewidth=1)
                axis.plot(camera.position[:, across], camera.position[:, up], 's', color=colour,
                          markersize=4, label=f'{name} camera and its viewing axis')
            axis.set(xlabel=x_name, ylabel=y_name)
            axis.set_aspect('equal')
        legend_below(figure, axis)


def fixed_grid(figure: Figure, rows: int, columns: int) -> Array:
    """Return axes at fixed places: a constrained layout of so many takes seconds."""
    figure.set_layout_engine('none')
    inch = 1 / figure.get_figheight()
    return np.asarray(figure.subplots(rows, columns, gridspec_kw={
        'left': 0.075, 'right': 0.985, 'bottom': 0.5 * inch, 'top': 1 - 0.75 * inch,
        'wspace': 0.28, 'hspace': 0.3,
    }))


def frame_world(axis: Any, radius: float, x_name: str, y_name: str) -> None:
    """Set an axis to a square of the world about the origin that holds a sphere."""
    axis.set(xlim=(-1.15 * radius, 1.15 * radius), ylim=(-1.15 * radius, 1.15 * radius),
             xticks=[-radius, 0, radius], yticks=[-radius, 0, radius])
    axis.set_xlabel(x_name, fontsize=8, labelpad=1)
    axis.set_ylabel(y_name, fontsize=8, labelpad=1)
    axis.tick_params(labelsize=7, length=2)
    axis.set_aspect('equal')


def draw_image_frame(axis: Any, lens: Lens) -> None:
    """Draw the circular field of a lens and set the axis to its image, v down."""
    edge, _ = lens.image_height.value_and_slope(np.asarray(lens.max_incidence))
    axis.add_patch(Circle((lens.cx, lens.cy), lens.fx * float(edge), fill=False, color=FAINT))
    margin = 0.06 * lens.width
    axis.set(xlim=(-margin, lens.width + margin), ylim=(lens.height + margin, -margin),
             xticks=[0, lens.width], yticks=[0, lens.height])
    axis.tick_params(labelsize=7, length=2)
    axis.set_aspect('equal')
    axis.grid(visible=False)


def _draw_world(axis: Any, view: tuple[tuple[int, int], str, str], points: Array) -> None:
    """Draw landmarks and, at the origin, the camera that gazes along -z."""
    (across, up), x_name, y_name = view
    axis.plot(points[:, across], points[:, up], 's', color=INK, markersize=2.5)
    axis.plot(0, 0, 's', markerfacecolor='white', markeredgecolor=OURS, markersize=6)
    radius = float(np.linalg.norm(points[0]).round(6))
    if up == 2:
        axis.plot([0, 0], [0, -radius / 3], color=OURS, linewidth=1.5)
    frame_world(axis, radius, x_name, y_name)


def _draw_residuals(axis: Any, localized: Localized, row: int, colour: str) -> None:
    """Draw image points as circles, residuals (measured less predicted) as lines, magnified."""
    seen = localized.views.used[row]
    uv = localized.views.uv[row][seen]
    ends = uv - MAGNIFIED * localized.solved.residual[row][seen]
    axis.plot(uv[:, 0], uv[:, 1], 'o', fillstyle='none', color=INK, markersize=3,
              markeredgewidth=0.6)
    axis.plot([uv[:, 0], ends[:, 0]], [uv[:, 1], ends[:, 1]], color=colour, linewidth=1.2)
