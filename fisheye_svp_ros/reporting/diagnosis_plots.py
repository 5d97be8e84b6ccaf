"""Residuals of every observation before and after the model was extended, and their pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from scipy import special

from fisheye_svp_ros.arrays import Array, Index, Mask
from fisheye_svp_ros.diagnosis import Evaluation
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.reporting.plots import NARROW, panels, picture
from fisheye_svp_ros.reporting.style import INK, round_number
from fisheye_svp_ros.scene.observations import Observations, frame_name
from fisheye_svp_ros.solve.measured_poses import rms_px

BEFORE, AFTER, NOISE = '#c2410c', '#1d4ed8', '#94a3b8'
_SIDES = (('before', BEFORE), ('after', AFTER))
_WIDTH = 9.2  # in
_BINS = 16
_ARROWS = 2500
_TICKS = 60  # names along an axis
_LEGEND = 0.25  # in, height
_CELLS = 18  # of the mean field, along the image
_KEY = (0.72, 0.905, 0.27, 0.085)  # of arrows, inside the axes: left, bottom, width, height


File = Path | BytesIO
Picture = tuple[str, Callable[..., None], tuple[Any, ...]]


class PointResiduals(NamedTuple):
    """K observations by frame and camera.

    frame, camera, landmark (K,); t (K,), s, NaN where unknown; uv (K, 2), px; before and after
    (K, 2), px: measured minus predicted by the fitted base and the fitted extended model; theta
    (K,), rad, and range (K,), m, under the latter; outlier (K,): an outlier, left out of fits.
    """

    frame: Index
    camera: Index
    landmark: Index
    t: Array
    uv: Array
    before: Array
    after: Array
    theta: Array
    range: Array
    outlier: Mask


def point_residuals(evaluation: Evaluation) -> PointResiduals:
    """Return the residuals of the simulation and of the causes, each as it was fitted."""
    before, after = evaluation.simulation, evaluation.cause_fit
    views = after.data.views
    seen = views.landmark >= 0
    per_point = np.ones_like(seen, dtype=np.int64)
    distance = np.linalg.norm(after.scene.pose.into_body(views.points), axis=-1)
    return PointResiduals(
        frame=(views.frame[:, None] * per_point)[seen],
        camera=(views.camera[:, None] * per_point)[seen],
        landmark=views.landmark[seen],
        t=views.t[seen],
        uv=views.uv[seen],
        before=(views.uv - before.linear.uv)[seen],
        after=(views.uv - after.linear.uv)[seen],
        theta=after.scene.theta[seen],
        range=distance[seen],
        outlier=~views.used[seen],
    )


class PlotData(NamedTuple):
    """What the pictures are of: observations without outliers, lenses by camera, noise (px).

    lenses: '' is that of all cameras; table: the observations, which name photographs.
    """

    points: PointResiduals
    lenses: dict[str, Lens]
    noise: float
    table: Observations

    @classmethod
    def from_evaluation(cls, evaluation: Evaluation) -> PlotData:
        """Leave out outliers: they have a table of their own."""
        points = point_residuals(evaluation)
        vectors = np.concatenate([points.before, points.after], axis=1)
        kept = ~points.outlier & np.isfinite(vectors).all(axis=1)
        shown = PointResiduals._make(array[kept] for array in points)
        state = evaluation.fixed_model.state
        lenses = dict(zip(state.labels, state.lenses, strict=True))
        return cls(shown, lenses, evaluation.scatter_px, evaluation.fixed_model.data.observations)

    def of_camera(self, camera: int) -> PointResiduals:
        """Return the points that were seen through one of the lenses."""
        if len(self.lenses) == 1:
            return self.points
        of_camera = self.points.camera == camera
        return PointResiduals._make(array[of_camera] for array in self.points)


def draw_field(file: File, shown: PlotData, narrow: bool = False) -> None:
    """Residual vectors over the image: of single points, and means over cells of the image."""
    lenses = list(shown.lenses.items())
    sides = [lens.height / lens.width for _, lens in lenses for _ in range(2)]
    width, columns = (NARROW, 1) if narrow else (_WIDTH, 2)
    height = (width - 1) / columns * sum(sides) * (2 / columns) + 0.55 * len(sides) * 2 / columns
    with picture(file, width, height) as figure:
        axes = panels(figure, len(sides), narrow, sides)
        for camera, (name, lens) in enumerate(lenses):
            _draw_field(axes[2 * camera :][:2], shown.of_camera(camera), name, lens, narrow)


def _draw_field(axes: Any, points: PointResiduals, name: str, lens: Lens, narrow: bool) -> None:
    """Draw what one camera saw: single points above, means below, before and after."""
    cell, step = lens.width / _CELLS, max(1, len(points.uv) // _ARROWS)
    fields = [
        ((points.uv[::step], residual[::step]), _cell_means(points.uv, residual, cell))
        for residual in (points.before, points.after)
    ]
    for kind, row in enumerate(axes):
        typical = float(np.quantile(np.linalg.norm(fields[0][kind][1], axis=1), 0.9))
        for axis, field, (_, color) in zip(row, fields, _SIDES, strict=True):
            draw_image_frame(axis, lens)
            draw_arrows(axis, *field[kind], typical, cell, color)
            if not narrow:
                axis.label_outer()
    for axis, (side, color) in zip(axes[0], _SIDES, strict=True):
        rms = rms_px(getattr(points, side))
        axis.set_title(f'{name} {side}: {rms:.3f} px rms'.strip(), color=color)
    for row, what in zip(axes, ('single points', f'means over {cell:.0f} px'), strict=True):
        for axis in row if narrow else row[:1]:
            axis.set_ylabel(f'{what}\nv / px')
    for axis in axes[1, 1:] if narrow else axes[1]:
        axis.tick_params(labelbottom=True)
        axis.set_xlabel('u / px')


def draw_against(
    file: File, shown: PlotData, x: Array, label: str, log: bool = False, narrow: bool = False
) -> None:
    """Radial and tangential residuals against a variable (K,), with binned means."""
    rows = [('radial / px', 0), ('tangential / px', 1)]
    polar = {side: _polar(shown, getattr(shown.points, side)) for side, _ in _SIDES}
    _draw_grid(
        file,
        shown,
        [(name, x, {side: values[:, i] for side, values in polar.items()}) for name, i in rows],
        label,
        log,
        narrow,
    )


def draw_phase(file: File, shown: PlotData, narrow: bool = False) -> None:
    """Residuals of u and v against the place of u and v within its pixel."""
    phase = np.mod(shown.points.uv + 0.5, 1.0) - 0.5
    _draw_grid(
        file,
        shown,
        [
            (
                f'{name} residual / px',
                phase[:, i],
                {side: getattr(shown.points, side)[:, i] for side, _ in _SIDES},
            )
            for i, name in enumerate('uv')
        ],
        'fractional part of u (above) and v (below) / px',
        False,
        narrow,
    )


def draw_histogram(file: File, shown: PlotData, narrow: bool = False) -> None:
    """Residuals of both coordinates over the noise, beside the normal distribution."""
    bins = np.linspace(-6, 6, 73)
    middle = (bins[:-1] + bins[1:]) / 2
    size = (NARROW, 5.0) if narrow else (_WIDTH, 3.0)
    with picture(file, *size, tight=True) as figure:
        axes = panels(figure, 1, narrow)[0]
        for axis, (side, color) in zip(axes, _SIDES, strict=True):
            z = getattr(shown.points, side).ravel() / shown.noise
            expected = z.size * np.diff(bins)[0] * np.exp(-(middle**2) / 2) / np.sqrt(2 * np.pi)
            axis.hist(np.clip(z, -6, 6), bins, color=color, alpha=0.55, label='u and v')
            axis.plot(middle, expected, color=INK, lw=1.4, label='noise alone')
            axis.set(yscale='log', xlabel='residual / noise', ylabel='image coordinates')
            axis.set_title(side, color=color)
            axis.minorticks_off()
            axis.legend(loc='upper right')
        highest = max(axis.get_ylim()[1] for axis in axes)
        for axis in axes:
            axis.set_ylim(0.5, highest)
            axis.label_outer()


def _draw_grid(
    file: File,
    shown: PlotData,
    rows: list[tuple[str, Array, dict[str, Array]]],
    label: str,
    log: bool,
    narrow: bool,
) -> None:
    size = (NARROW, 8.0) if narrow else (_WIDTH, 4.4)
    with picture(file, *size, tight=True) as figure:
        axes = panels(figure, 2, narrow)
        for number, (row, (name, x, values)) in enumerate(zip(axes, rows, strict=True)):
            highest = 2.2 * shown.noise
            for axis, (side, color) in zip(row, _SIDES, strict=True):
                highest = max(highest, _plot_bins(axis, x, values[side], shown.noise, color))
            for axis, (side, color) in zip(row, _SIDES, strict=True):
                axis.set(ylabel=name, xlabel=label, ylim=(-1.2 * highest, 1.2 * highest))
                if log:
                    axis.set_xscale('log')
                if narrow or number == 0:
                    axis.set_title(side, color=color)
                axis.label_outer()
        _legend(figure, axes[0, 1], narrow)


def _plot_bins(axis: Axes, x: Array, y: Array, noise: float, color: str) -> float:
    """Draw points and bins: means, errors, scatter; return the largest mean and error, px."""
    axis.plot(x, y, '.', ms=1.5, color=color, alpha=0.15, zorder=1)
    order = np.argsort(x, kind='stable')
    parts = np.array_split(order, max(min(_BINS, len(x) // 8), 1))
    center, mean, rms, error, count = np.array(
        [
            (x[p].mean(), y[p].mean(), y[p].std(), y[p].std() / np.sqrt(p.size), p.size)
            for p in parts
        ]
    ).T
    band = 2 * noise / np.sqrt(count)
    axis.fill_between(
        center,
        -band,
        band,
        color=NOISE,
        alpha=0.6,
        lw=0,
        zorder=2,
        label='95 % of the means if there is only noise',
    )
    axis.errorbar(
        center,
        mean,
        error,
        fmt='o-',
        ms=4,
        lw=1.3,
        color=color,
        zorder=3,
        mec='white',
        mew=0.5,
        label='mean of a bin and its standard error',
    )
    for sign in (-1, 1):
        axis.plot(
            center,
            mean + sign * rms,
            ':',
            lw=1.2,
            color=color,
            zorder=3,
            label='scatter within a bin' if sign > 0 else None,
        )
    return float((np.abs(mean) + error).max())


def _legend(figure: Figure, axis: Axes, narrow: bool) -> None:
    """Put the legend of an axis above all of them."""
    handles, labels = axis.get_legend_handles_labels()
    layout: Any = figure.get_layout_engine()
    layout.set(above=_LEGEND * (len(labels) if narrow else 1))
    columns = 1 if narrow else len(labels)
    figure.legend(handles, labels, loc='upper right', ncols=columns, fontsize=8)


def draw_groups(
    file: File,
    shown: PlotData,
    group: Index,
    x: Array | None,
    label: str,
    ticks: Sequence[str] = (),
    narrow: bool = False,
) -> None:
    """Rms of the residuals of each group (K,), or over a variable (K,); ticks: their names."""
    names, label_of, count = np.unique(group, return_inverse=True, return_counts=True)
    place = names if x is None else np.bincount(label_of, weights=x) / count
    order = np.argsort(place, kind='stable')
    low, high = (
        np.sqrt(special.chdtri(2 * count, 1 - p) / count) * shown.noise for p in (0.025, 0.975)
    )
    width = NARROW if narrow else _WIDTH
    with picture(file, width, 3.6 if ticks or narrow else 2.8, tight=True) as figure:
        axis = figure.subplots()
        axis.fill_between(
            place[order],
            low[order],
            high[order],
            color=NOISE,
            alpha=0.4,
            lw=0,
            step='mid',
            label='95 % if there is only noise',
        )
        for side, color in _SIDES:
            squares = (getattr(shown.points, side) ** 2).sum(axis=1)
            rms = np.sqrt(np.bincount(label_of, weights=squares) / count)
            axis.plot(
                place[order],
                rms[order],
                'o' if len(names) > 60 else 'o-',
                ms=3.5,
                lw=1,
                color=color,
                label=side,
            )
        axis.set(xlabel=label, ylabel='rms residual / px', ylim=(0, None))
        if ticks:
            step = -(-len(ticks) // int(_TICKS * width / _WIDTH))
            axis.set_xticks(range(0, len(ticks), step), ticks[::step], rotation=90, fontsize=7)
        elif x is None:
            axis.locator_params('x', integer=True)
        _legend(figure, axis, narrow)


def draw_image_frame(axis: Axes, lens: Lens) -> None:
    """Draw the border of the image and circles of equal incidence angle."""
    axis.set_aspect('equal')
    axis.grid(visible=False)
    axis.add_patch(Rectangle((-0.5, -0.5), lens.width, lens.height, fill=False, ec=NOISE))
    turn = np.linspace(0, 2 * np.pi, 181)
    for degrees in range(30, int(np.degrees(lens.max_incidence)) + 1, 30):
        height, _ = lens.image_height.value_and_slope(np.radians(np.array([degrees])))
        u, v = lens.cx + lens.fx * height * np.cos(turn), lens.cy + lens.fy * height * np.sin(turn)
        inside = (u > 0) & (u < lens.width) & (v > 0) & (v < lens.height)
        axis.plot(np.where(inside, u, np.nan), v, ':', color=NOISE, lw=0.8)
        if inside.any():
            place = int(np.argmax(np.where(inside, np.sin(turn - 0.6), -2)))
            axis.annotate(f'{degrees}°', (u[place], v[place]), color=NOISE, fontsize=8)
    axis.set(xlim=(-1, lens.width), ylim=(lens.height, -1))


def draw_arrows(
    axis: Axes, uv: Array, residual: Array, typical: float, cell: float, color: str
) -> None:
    """Draw residuals, the typical one (px) as long as a cell, and the key to their scale."""
    arrows = axis.quiver(
        *uv.T,
        *residual.T,
        angles='xy',
        scale_units='xy',
        scale=typical / cell,
        color=color,
        alpha=0.45 if len(uv) > 600 else 0.9,
        width=0.0018,
    )
    length = round_number(typical)
    x, y, width, height = _KEY
    axis.add_patch(
        Rectangle((x, y), width, height, transform=axis.transAxes, color='white', zorder=4)
    )
    axis.quiverkey(
        arrows,
        x + 0.25 * width,
        y + 0.5 * height,
        length,
        f'{length:g} px',
        labelpos='E',
        color=INK,
        zorder=5,
    )


def _cell_means(uv: Array, residual: Array, cell: float) -> tuple[Array, Array]:
    """Return places and means of the cells that hold three points or more (or the most)."""
    _, label, count = np.unique(
        np.floor(uv / cell), axis=0, return_inverse=True, return_counts=True
    )
    means = [
        np.bincount(label.reshape(-1), weights=column) / count for column in (*uv.T, *residual.T)
    ]
    table = np.stack(means, axis=-1)[count >= min(3, count.max())]
    return table[:, :2], table[:, 2:]


def _polar(shown: PlotData, residual: Array) -> Array:
    """Return residuals (K, 2) along the radius and across it."""
    centers = np.array([(lens.cx, lens.cy) for lens in shown.lenses.values()])
    arm = shown.points.uv - (centers[shown.points.camera] if len(centers) > 1 else centers[0])
    radial = arm / np.maximum(np.linalg.norm(arm, axis=1, keepdims=True), 1e-9)
    across = np.stack([-radial[:, 1], radial[:, 0]], axis=-1)
    return np.stack([(residual * way).sum(axis=1) for way in (radial, across)], axis=-1)


def _by_photograph(shown: PlotData) -> tuple[Index, None, str, list[str]]:
    """Return the view of each point, no variable, a label, and the photographs' names."""
    views, which = np.unique(
        np.stack([shown.points.camera, shown.points.frame]), axis=1, return_inverse=True
    )
    names = [
        frame_name(shown.table, frame, shown.table.cameras[camera])
        for camera, frame in views.T.tolist()
    ]
    return which.reshape(-1), None, 'photograph', names


def residual_pictures(shown: PlotData) -> Iterator[Picture]:
    """Yield name, function and arguments of every picture of residuals."""
    points = shown.points
    spread = points.range.max() > 4 * points.range.min()
    yield 'field', draw_field, (shown,)
    yield 'theta', draw_against, (shown, np.degrees(points.theta), 'incidence angle / deg')
    yield 'range', draw_against, (shown, points.range, 'distance of the landmark / m', spread)
    yield 'landmark', draw_groups, (shown, points.landmark, None, 'landmark')
    if shown.table.photographs:
        yield 'frame', draw_groups, (shown, *_by_photograph(shown))
    elif np.isfinite(points.t).all():
        yield 'frame', draw_groups, (shown, points.frame, points.t - points.t.min(), 'time / s')
    else:
        yield 'frame', draw_groups, (shown, points.frame, None, 'frame')
    yield 'phase', draw_phase, (shown,)
    yield 'histogram', draw_histogram, (shown,)
