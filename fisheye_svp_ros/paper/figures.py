"""Figures 4 to 10 of Kita's paper, in its arrangement, and pictures of what lies past it."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import LogLocator

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.paper.extensions import NOISES, Crossings
from fisheye_svp_ros.paper.lens_evaluation import (
    LensEvaluation,
    LocalizedSpread,
    StereoMeasurement,
    landmarks_at,
)
from fisheye_svp_ros.paper.results import Panel
from fisheye_svp_ros.paper.studies import Family, shift_curves
from fisheye_svp_ros.paper.tables import LENSES, NAMES, STYLE_NAMES
from fisheye_svp_ros.reporting.plots import legend_below, picture
from fisheye_svp_ros.reporting.style import FAINT, OURS, PUBLISHED
from fisheye_svp_ros.scene.observations import RADII, SPREADS
from fisheye_svp_ros.scene.rigs import calibration_poses, rig
from fisheye_svp_ros.solve.stereo_depth import epipolar_curves

_COLORS = {'fish180': OURS, 'fish214': PUBLISHED}
_RESIDUAL_MAGNIFICATION = 100  # residuals of figure 6
_VERTICAL_MAGNIFIED = {'fish180': 100, 'fish214': 10}
_TRUE, _MEASURED = PUBLISHED, OURS
_CURVE = 120  # points of an epipolar curve
_ZERO = 1e-6  # an error below it is rounding
_INK = '#404850'
_LINES = ('-', '--', ':')
# Views of the paper's world: axes that run to the right and up, and their names.
_VIEWS = (((0, 1), 'x / m', 'y / m'), ((0, 2), 'x / m', 'z / m'))
_SUMMARIES: dict[str, Callable[[LensEvaluation], float]] = {
    'Localization: mean |z| / mm': lambda e: float(np.abs(e.localization[..., 2]).mean()),
    'Stereo calibration:\nmean position error / mm': lambda e: float(
        np.linalg.norm(e.calibration[..., :3], axis=-1).mean()
    ),
    'Epipolar curves: mean Error2 / px': lambda e: float(e.panels('error2_px').mean()),
    'Stereo depth: mean Error3 / mm': lambda e: float(1e3 * e.panels('error3_m').mean()),
}


def draw_shift(path: Path, lenses: dict[str, Lens], family: Family) -> None:
    """Figure 4: viewpoint shift against incident angle; light: all fits of the family."""
    with picture(path, 6.4, 4.2) as figure:
        axis = figure.subplots()
        for name, lens in lenses.items():
            theta = np.linspace(0, lens.max_incidence, 200)
            curves = 1e3 * shift_curves(family.matching, name, theta)
            axis.plot(np.degrees(theta), curves.T, color=_COLORS[name], alpha=0.18, linewidth=0.8)
            axis.plot(
                np.degrees(theta),
                1e3 * lens.shift_at(theta),
                color=_COLORS[name],
                linewidth=2,
                label=f'{NAMES[name]} (light: all {len(family.matching)} fits)',
            )
        axis.axvline(88, color=FAINT, linestyle=':')
        axis.annotate(
            'outermost landmarks',
            (88, axis.get_ylim()[1]),
            ha='right',
            va='top',
            rotation=90,
            color=_INK,
            fontsize=8,
        )
        axis.set(xlabel='incident angle / degree', ylabel='viewpoint shift / mm', xlim=(0, 107))
        axis.legend(loc='upper left')


def draw_height(path: Path, lenses: dict[str, Lens]) -> None:
    """Figure 5: image height against incident angle."""
    with picture(path, 6.4, 4.2) as figure:
        axis = figure.subplots()
        for name, lens in lenses.items():
            theta = np.linspace(0, lens.max_incidence, 200)
            height, _ = lens.image_height.value_and_slope(theta)
            axis.plot(
                np.degrees(theta),
                lens.fx * height,
                color=_COLORS[name],
                linewidth=2,
                label=NAMES[name],
            )
            axis.axhline(lens.width / 2, color=_COLORS[name], linestyle=':', linewidth=1)
        axis.annotate('dotted: half the image', (2, 775), color=_INK, fontsize=8)
        axis.set(
            xlabel='incident angle / degree',
            ylabel='image height / px',
            xlim=(0, 107),
            ylim=(0, 820),
        )
        axis.legend(loc='center left')


def draw_localization(path: Path, evaluations: dict[str, LensEvaluation]) -> None:
    """Figure 6: two views of every environment, and the residuals of both lenses, x 100."""
    rows = [(radius, spread) for radius in range(len(RADII)) for spread in range(len(SPREADS))]
    with picture(path, 10.5, 2.5 * len(rows)) as figure:
        axes = _fixed_grid(figure, len(rows), 4)
        for line, (radius, spread) in zip(axes, rows, strict=True):
            points = evaluations[LENSES[0]].localized[spread].views.points[radius]
            for axis, view in zip(line[:2], _VIEWS, strict=True):
                _draw_world(axis, view, points)
            line[0].set_ylabel(f'{SPREADS[spread].title()}, {RADII[radius]} m\ny / m')
            for axis, name in zip(line[2:], LENSES, strict=True):
                evaluation = evaluations[name]
                _draw_image_frame(axis, evaluation.lens)
                mean = evaluation.localization[radius, spread, -1]
                _draw_residuals(axis, evaluation.localized[spread], radius, _COLORS[name])
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
                axis.plot(*position[[0, 2]], 's', color=_INK, markersize=8)
                axis.annotate(
                    '',
                    (position + 0.12 * axis_z)[[0, 2]],
                    position[[0, 2]],
                    arrowprops={'arrowstyle': '->', 'color': OURS, 'linewidth': 1.6},
                )
                axis.annotate(
                    name, position[[0, 2]] - [0, 0.012], ha='center', va='top', color=_INK
                )
            axis.set(title=style, xlabel='x / m', xlim=(-0.24, 0.09), ylim=(-0.05, 0.15))
            axis.set_aspect('equal')
        figure.axes[0].set_ylabel('viewing direction / m')


def draw_calibration_poses(path: Path) -> None:
    """Figure 8: the ten poses of a vergent rig among the Whole landmarks at 0.5 m."""
    points = landmarks_at('whole', 0.5)
    right = calibration_poses()
    left = right.compose(rig('vergent').take(None))
    with picture(path, 9.6, 4.6) as figure:
        for axis, view in zip(figure.subplots(1, 2), _VIEWS, strict=True):
            (across, up), x_name, y_name = view
            axis.plot(points[:, across], points[:, up], 's', color=_INK, markersize=3)
            for camera, color, name in ((right, OURS, 'right'), (left, PUBLISHED, 'left')):
                ends = camera.position + 0.12 * camera.rotation[..., 2]
                for start, end in zip(camera.position, ends, strict=True):
                    axis.plot(
                        [start[across], end[across]],
                        [start[up], end[up]],
                        color=color,
                        linewidth=1,
                    )
                axis.plot(
                    camera.position[:, across],
                    camera.position[:, up],
                    's',
                    color=color,
                    markersize=4,
                    label=f'{name} camera and its viewing axis',
                )
            axis.set(xlabel=x_name, ylabel=y_name)
            axis.set_aspect('equal')
        legend_below(figure, axis)


def draw_stereo(path: Path, evaluation: LensEvaluation, panels: list[Panel]) -> None:
    """Nine rows: left image with epipolar curves and vertical errors; two views of 3-D points."""
    with picture(path, 9.6, 3.2 * len(panels)) as figure:
        axes = _fixed_grid(figure, len(panels), 3)
        for line, measured, panel in zip(axes, evaluation.measured, panels, strict=True):
            _draw_left_image(line[0], evaluation, measured, panel.style)
            line[0].set_ylabel(f'{panel.style}, {panel.radius} m')
            for axis, ((across, up), *names) in zip(line[1:], _VIEWS, strict=True):
                _draw_points(axis, measured, across, up)
                _frame_world(axis, panel.radius, *names)
            line[1].set_title(_caption(panel), fontsize=8.5, loc='left')
        name = evaluation.lens.name
        figure.suptitle(
            f'{NAMES[name]}: vertical errors x {_VERTICAL_MAGNIFIED[name]}; orange: true, blue: '
            'measured\nError2: mean distance from the epipolar curve; Error3: mean distance of '
            'points in space',
            fontsize=10,
            y=0.998,
        )


def draw_solvers(path: Path, evaluations: Mapping[str, Mapping[str, LensEvaluation]]) -> None:
    """Draw mean errors of all solvers, a line a solver, a mark a lens."""
    place = np.arange(len(evaluations))[::-1]
    with picture(path, 11.0, 4.2) as figure:
        axes = figure.subplots(1, len(_SUMMARIES), sharey=True)
        for axis, (title, summary) in zip(axes, _SUMMARIES.items(), strict=True):
            for k, name in enumerate(LENSES):
                values = np.array([summary(by_lens[name]) for by_lens in evaluations.values()])
                drawn = np.where(values > _ZERO, values, np.nan)
                axis.plot(drawn, place, 'os'[k], color=_COLORS[name], label=NAMES[name])
            axis.set_title(title, fontsize=9)
            axis.set_xscale('log')
            axis.xaxis.set_major_locator(LogLocator(numticks=6))
            low = axis.get_xlim()[0]
            exact = list(evaluations).index('ShiftVP')
            axis.annotate(
                'none',
                (low, place[exact]),
                xytext=(4, 0),
                va='center',
                color=_INK,
                textcoords='offset points',
                fontsize=8,
            )
        axes[0].set_yticks(place, list(evaluations))
        legend_below(figure, axes[0])


def draw_crossings(path: Path, crossings: Sequence[Crossings]) -> None:
    """Draw the range at which an SVP error drops under the noise, against the noise."""
    quantities = list(dict.fromkeys(c.quantity for c in crossings))
    titles = {
        'position': 'z of localization',
        'residual': 'residual of localization',
        'Error2': 'Error2',
    }
    with picture(path, 11.0, 4.2) as figure:
        axes = figure.subplots(1, len(quantities), sharey=True)
        for axis, quantity in zip(axes, quantities, strict=True):
            for name in LENSES:
                lens_crossings = [c for c in crossings if (c.lens, c.quantity) == (name, quantity)]
                for line, crossing in zip(_LINES, lens_crossings, strict=True):
                    axis.plot(
                        NOISES,
                        np.where(crossing.ranges > 0, crossing.ranges, np.nan),
                        line,
                        color=_COLORS[name],
                        label=f'{NAMES[name]}, {crossing.where}',
                        marker='o',
                        markersize=3,
                    )
            axis.set(title=titles[quantity], xlabel='noise of u and of v / px', yscale='log')
            axis.legend(fontsize=7.5)
        axes[0].set_ylabel('SVP error is under the noise beyond / m')


def _fixed_grid(figure: Figure, rows: int, columns: int) -> Array:
    """Return axes at fixed places: a constrained layout of so many takes seconds."""
    figure.set_layout_engine('none')
    inch = 1 / figure.get_figheight()
    return np.asarray(
        figure.subplots(
            rows,
            columns,
            gridspec_kw={
                'left': 0.075,
                'right': 0.985,
                'bottom': 0.5 * inch,
                'top': 1 - 0.75 * inch,
                'wspace': 0.28,
                'hspace': 0.3,
            },
        )
    )


def _frame_world(axis: Any, radius: float, x_name: str, y_name: str) -> None:
    """Set an axis to a square of the world about the origin that holds a sphere."""
    axis.set(
        xlim=(-1.15 * radius, 1.15 * radius),
        ylim=(-1.15 * radius, 1.15 * radius),
        xticks=[-radius, 0, radius],
        yticks=[-radius, 0, radius],
    )
    axis.set_xlabel(x_name, fontsize=8, labelpad=1)
    axis.set_ylabel(y_name, fontsize=8, labelpad=1)
    axis.tick_params(labelsize=7, length=2)
    axis.set_aspect('equal')


def _draw_image_frame(axis: Any, lens: Lens) -> None:
    """Draw the circular field of a lens and set the axis to its image, v down."""
    edge, _ = lens.image_height.value_and_slope(np.asarray(lens.max_incidence))
    axis.add_patch(Circle((lens.cx, lens.cy), lens.fx * float(edge), fill=False, color=FAINT))
    margin = 0.06 * lens.width
    axis.set(
        xlim=(-margin, lens.width + margin),
        ylim=(lens.height + margin, -margin),
        xticks=[0, lens.width],
        yticks=[0, lens.height],
    )
    axis.tick_params(labelsize=7, length=2)
    axis.set_aspect('equal')
    axis.grid(visible=False)


def _draw_world(axis: Any, view: tuple[tuple[int, int], str, str], points: Array) -> None:
    """Draw landmarks and, at the origin, the camera that gazes along -z."""
    (across, up), x_name, y_name = view
    axis.plot(points[:, across], points[:, up], 's', color=_INK, markersize=2.5)
    axis.plot(0, 0, 's', markerfacecolor='white', markeredgecolor=OURS, markersize=6)
    radius = float(np.linalg.norm(points[0]).round(6))
    if up == 2:
        axis.plot([0, 0], [0, -radius / 3], color=OURS, linewidth=1.5)
    _frame_world(axis, radius, x_name, y_name)


def _draw_residuals(axis: Any, localized: LocalizedSpread, row: int, color: str) -> None:
    """Draw image points as circles, residuals (measured less predicted) as lines, magnified."""
    seen = localized.views.used[row]
    uv = localized.views.uv[row][seen]
    ends = uv - _RESIDUAL_MAGNIFICATION * localized.solved.residual[row][seen]
    axis.plot(
        uv[:, 0], uv[:, 1], 'o', fillstyle='none', color=_INK, markersize=3, markeredgewidth=0.6
    )
    axis.plot([uv[:, 0], ends[:, 0]], [uv[:, 1], ends[:, 1]], color=color, linewidth=1.2)


def _caption(panel: Panel) -> str:
    text = f'Error2 = {panel.error2:.3f} px, Error3 = {panel.error3:.2f} mm'
    if np.isnan(panel.published_error2):
        return text + '\npublished: no caption kept'
    return f'{text}\npublished: {panel.published_error2:.3f} px, {panel.published_error3:.2f} mm'


def _draw_left_image(
    axis: Any, evaluation: LensEvaluation, measured: StereoMeasurement, style: str
) -> None:
    lens = evaluation.lens
    _draw_image_frame(axis, lens)
    measurable = np.isfinite(measured.distance)
    model = ForwardModel(lens.svp())
    curves = epipolar_curves(model, model, rig(style), measured.uv_right[measurable], _CURVE)
    axis.plot(curves[..., 0].T, curves[..., 1].T, color=FAINT, linewidth=0.6)
    u, v = measured.uv_left[measurable].T
    axis.plot(u, v, 'o', color=_INK, markersize=2)
    ends = v - _VERTICAL_MAGNIFIED[lens.name] * measured.vertical[measurable]
    axis.plot([u, u], [v, ends], color=OURS, linewidth=1.2)


def _draw_points(axis: Any, measured: StereoMeasurement, across: int, up: int) -> None:
    finite = np.isfinite(measured.measured[:, 0])
    true, solved = measured.true[finite], measured.measured[finite]
    axis.plot(
        [true[:, across], solved[:, across]],
        [true[:, up], solved[:, up]],
        color=FAINT,
        linewidth=0.8,
    )
    axis.plot(true[:, across], true[:, up], 'o', color=_TRUE, markersize=3.2)
    axis.plot(solved[:, across], solved[:, up], 'o', color=_MEASURED, markersize=1.8)
