"""Maps of how well the rays of a lens are known, over the whole image."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.reporting.diagnosis_plots import File
from fisheye_svp_ros.reporting.plots import NARROW, panels, picture
from fisheye_svp_ros.reporting.style import INK, error_levels
from fisheye_svp_ros.solve.ray_errors import RayMap

_POINTS = 1500  # drawn, at most
_COLORS = 'YlGnBu'


def draw_uncertainty(file: File, maps: Mapping[str, RayMap], narrow: bool = False) -> None:
    """Draw the standard error of the rays of each camera (its name, '' for one), near and far."""
    sides = [len(ray_map.v) / len(ray_map.u) for ray_map in maps.values()]
    width, columns = (NARROW, 1) if narrow else (9.2, 2)
    height = (width - 1.0) / columns * sum(sides) * 2 / columns + 0.5 * len(sides) * 2 / columns
    with picture(file, width, height) as figure:
        axes = panels(figure, len(maps), narrow, sides)
        for row, (name, each) in zip(axes, maps.items(), strict=True):
            draw_ray_map(figure, row, each, name)


def draw_ray_map(figure: Figure, axes: Any, rays: RayMap, name: str = '', first: int = 0) -> None:
    """Draw the maps of one camera into an axis for each range, with one scale of colors.

    first: the range of the first axis.
    """
    sd = 1e3 * rays.sd
    levels = error_levels(sd)
    norm = BoundaryNorm(levels, 256, extend='both')
    shown_ranges = zip(axes, sd[first:], rays.ranges[first:], strict=False)
    for axis, deviation, range_m in shown_ranges:
        shown = axis.contourf(
            rays.u, rays.v, deviation, levels, cmap=_COLORS, norm=norm, extend='both'
        )
        axis.plot(*_some(rays.uv).T, '.', color=INK, ms=1.0, alpha=0.4)
        axis.set_title(f'{name} at {range_m:g} m'.strip())
        _frame(axis, rays)
    figure.colorbar(
        shown, ax=[*axes], label='standard error of a ray / mrad', ticks=levels, format='{x:g}'
    ).ax.minorticks_off()


def _some(uv: Array) -> Array:
    return uv[:: max(1, len(uv) // _POINTS)]


def _frame(axis: Axes, rays: RayMap) -> None:
    """Show the whole image."""
    axis.set(
        xlim=(rays.u[0], rays.u[-1]),
        ylim=(rays.v[-1], rays.v[0]),
        aspect='equal',
        xlabel='u / px',
        ylabel='v / px',
    )
    axis.grid(visible=False)
