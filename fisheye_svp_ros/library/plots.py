"""The library's part about pictures: each function returns a matplotlib figure.

A notebook shows it; `figure.savefig('picture.png')` writes it.
"""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.library.checks import check_type
from fisheye_svp_ros.library.functions import (
    AnyLens,
    AnyObservations,
    load_lens,
    localize,
    table_and_lens,
)
from fisheye_svp_ros.library.results import Budgeted, Compared
from fisheye_svp_ros.reporting.budget_report import DISPLAY_UNITS
from fisheye_svp_ros.reporting.diagnosis_plots import draw_arrows, draw_image_frame
from fisheye_svp_ros.solve.measured_poses import rms_px
from fisheye_svp_ros.study.budget import UNITS

_ANGLES = 181
_CELLS = 16  # over the width of the image: the typical arrow is as long as one


def plot_lens(*lenses: AnyLens) -> Figure:
    """Draw image height (px) and viewpoint shift (mm) of lenses over the incidence angle.

    Raises ParameterError without a lens.
    """
    if not lenses:
        raise ParameterError('no lens to draw; give at least one')
    figure = Figure(figsize=(10, 4), layout='constrained')
    height, shift = figure.subplots(1, 2)
    for lens in map(load_lens, lenses):
        theta = np.linspace(0, lens.max_incidence, _ANGLES)
        degrees = np.degrees(theta)
        height.plot(
            degrees, lens.fx * lens.image_height.value_and_slope(theta)[0], label=lens.name
        )
        shift.plot(degrees, 1e3 * lens.shift_at(theta), label=lens.name)
    height.set(xlabel='incidence angle / degree', ylabel='image height / px')
    shift.set(xlabel='incidence angle / degree', ylabel='viewpoint shift / mm')
    height.legend()
    return figure


def plot_residuals(observations: AnyObservations, lens: AnyLens) -> Figure:
    """Draw the residuals of one camera over the image, every frame localized with the lens.

    Outliers are not drawn.  Raises what `localize` raises.
    """
    table, lens = table_and_lens(observations, lens)
    residual = localize(table, lens).residual
    used = np.isfinite(residual).all(axis=1)
    figure = Figure(figsize=(8, 1 + 8 * lens.height / lens.width), layout='constrained')
    axis = figure.subplots()
    draw_image_frame(axis, lens)
    typical = float(np.quantile(np.linalg.norm(residual[used], axis=1), 0.9))
    draw_arrows(axis, table.uv[used], residual[used], typical, lens.width / _CELLS, 'C0')
    axis.set(xlabel='u / px', ylabel='v / px')
    axis.set_title(f'{lens.name}: {rms_px(residual[used]):.3g} px rms', loc='left')
    return figure


def plot_budget(budget: Budgeted, quantity: str = 'position') -> Figure:
    """Draw an SVP error over the range, one line for each spread of landmarks; dashed: noise.

    quantity: position, axis, residual, epipolar or depth.
    Raises ParameterError for another one.
    """
    check_type(budget, Budgeted, 'budget', 'the result of fsvp.budget')
    if quantity not in budget.error:
        raise ParameterError(
            f'{quantity!r} is not a quantity of a budget; choose from {", ".join(budget.error)}'
        )
    unit, factor = DISPLAY_UNITS[UNITS[quantity]]
    figure = Figure(figsize=(8, 5), layout='constrained')
    axis = figure.subplots()
    for spread, error, noise in zip(
        np.degrees(budget.spreads), budget.error[quantity], budget.noise[quantity], strict=True
    ):
        (line,) = axis.loglog(budget.ranges, factor * error, label=f'{spread:.0f}°')
        axis.loglog(budget.ranges, factor * noise, '--', color=line.get_color())
    axis.set(xlabel='range / m', ylabel=f'{quantity} error / {unit}')
    axis.legend(title='spread; dashed: noise', ncols=2)
    return figure


def plot_comparison(compared: Compared) -> Figure:
    """Draw by what angle two lenses differ, mrad: over the incidence angle and over the image."""
    check_type(compared, Compared, 'compared', 'the result of fsvp.compare')
    figure = Figure(figsize=(11, 4), layout='constrained')
    by_angle, image = figure.subplots(1, 2)
    table = compared.table()
    middle = np.degrees(np.add(table['from'], table['to']) / 2)
    for range_m, rms in zip(compared.ranges, compared.rms, strict=True):
        row = 1e3 * np.array(table[f'rms_{range_m:g}m'])
        by_angle.plot(middle, row, 'o-', label=f'{range_m:g} m: {1e3 * rms:.3g} mrad rms')
    by_angle.set(xlabel='incidence angle / degree', ylabel='difference / mrad')
    by_angle.set_ylim(bottom=0)
    by_angle.legend()
    draw_image_frame(image, compared.one)
    at = len(compared.ranges) // 2
    shown = image.scatter(*compared.uv.T, c=1e3 * compared.angle[at], s=14, marker='s', zorder=0)
    figure.colorbar(shown, ax=image, label=f'difference at {compared.ranges[at]:g} m / mrad')
    image.set(xlabel='u / px', ylabel='v / px')
    figure.suptitle(f'{compared.other.name} against {compared.one.name}')
    return figure
