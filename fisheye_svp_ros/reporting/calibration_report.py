"""The report of a calibration: coverage, residuals, uncertainty and warnings on one page."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.optics.lens import Lens, parameter_values
from fisheye_svp_ros.reporting.blocks import page, png_uri
from fisheye_svp_ros.reporting.calibrated_camera import CalibratedCamera
from fisheye_svp_ros.reporting.diagnosis_plots import draw_arrows
from fisheye_svp_ros.reporting.plots import NARROW, drawing
from fisheye_svp_ros.reporting.ray_plots import draw_ray_map
from fisheye_svp_ros.reporting.style import OURS, PUBLISHED
from fisheye_svp_ros.reporting.terminal import draw_or_note
from fisheye_svp_ros.reporting.wording.calibration import (
    ANY_TARGET,
    ANY_TARGET_NOTE,
    STANDARD_ERRORS,
    calibration_warnings,
    estimate_sentence,
)
from fisheye_svp_ros.scene.observations import frame_name
from fisheye_svp_ros.solve.ray_errors import (
    RANGES,
    RayMap,
    RayModel,
    map_rays,
    ray_model,
    typical_points,
)

_WIDE, _HEIGHT = 9.2, 3.3  # in
_ARROWS, _TICKS = 2500, 60
_ARROW_LENGTH = 0.03  # of the image, the typical residual


def write_calibration_report(
    path: Path, cameras: Mapping[str, CalibratedCamera], command: str
) -> None:
    """Write the page; cameras: by name, '' where there is one alone; command: to go on with.

    Raises OutputError where it cannot be written.
    """
    write_text(
        path,
        page(
            'calibration.html',
            command=command,
            standard_errors=STANDARD_ERRORS,
            any_target=ANY_TARGET,
            any_target_note=ANY_TARGET_NOTE,
            cameras=[_camera_section(name, camera) for name, camera in cameras.items()],
        ),
    )


def _camera_section(name: str, camera: CalibratedCamera) -> dict[str, Any]:
    rays, ray_map = _rays(camera)
    figures = camera.lens.calibration or {}
    return {
        'name': name,
        'lens': camera.lens.name,
        'source': camera.table.source,
        'points': figures['observations'],
        'frames': figures['frames'],
        'photographs': bool(camera.table.photographs),
        'rms': figures['rms_px'],
        'estimate': estimate_sentence(figures),
        'noise': camera.result.sigma,
        'warnings': calibration_warnings(camera),
        'rows': camera.parameter_rows(),
        'ranged': any(row[3] for row in camera.parameter_rows()),
        'reached': float(np.degrees(camera.result.reached)),
        'errors': [
            (f'{e.range_m:g}', f'{1e3 * e.value:.2g}', f'{1e3 * e.low:.2g}', f'{1e3 * e.high:.2g}')
            for e in rays.errors()
        ],
        'coverage': _panel_uris('coverage', [_draw_image_points, _draw_field], camera),
        'residuals': _panel_uris('residuals', [_draw_residuals, _draw_radial_residuals], camera),
        'frames_picture': _panel_uris('residuals by frame', [_draw_frames], camera, _WIDE),
        'uncertainty': _panel_uris(
            'uncertainty', [_draw_near_rays, _draw_far_rays], ray_map, tight=False
        ),
    }


def _rays(camera: CalibratedCamera) -> tuple[RayModel, RayMap]:
    """Return how the fitted parameters move the rays of image points, and of the whole image."""
    names = camera.result.adjusted.names
    values = parameter_values(camera.lens, names)

    def perturb_lens(step: Array) -> Lens:
        return camera.lens.with_parameters(names, [*np.add(values, step).tolist()])

    def rays_of(
        uv: Array, ranges: tuple[float, ...] = RANGES, datum: int | None = None
    ) -> tuple[RayModel, Mask]:
        return ray_model(perturb_lens, camera.trust.covariance, uv, ranges, datum=datum)

    views = camera.result.views
    uv = views.uv[views.used]
    model, _ = rays_of(typical_points(uv))
    return model, map_rays(rays_of, uv, (camera.lens.width, camera.lens.height))


def _panel_uris(
    name: str,
    draw: Sequence[Callable[[Figure, Any], None]],
    shown: Any,
    width: float = NARROW,
    tight: bool = True,
) -> list[str]:
    """Return the panels of a picture as parts of the page; none where they cannot be drawn.

    draw: each takes a figure of a width, in, and what is shown; tight: see `drawing`.  A panel is
    drawn once, as wide as a telephone; the page places them side by side or below each other.
    """
    files = [BytesIO() for _ in draw]

    def draw_panels(_: Path) -> None:
        for file, draw_panel in zip(files, draw, strict=True):
            with drawing(file, width, _HEIGHT, tight=tight) as figure:
                draw_panel(figure, shown)

    if not draw_or_note(Path(name), draw_panels):
        return []
    return [png_uri(file.getvalue()) for file in files]


def _show_image(axis: Any, lens: Lens) -> None:
    axis.set(
        xlim=(-0.5, lens.width - 0.5),
        ylim=(lens.height - 0.5, -0.5),
        aspect='equal',
        xlabel='u / px',
        ylabel='v / px',
    )


def _draw_image_points(figure: Figure, camera: CalibratedCamera) -> None:
    axis, views = figure.subplots(), camera.result.views
    axis.plot(*views.uv[views.used].T, '.', color=OURS, ms=2)
    _show_image(axis, camera.lens)
    axis.set_title('image points')


def _draw_field(figure: Figure, camera: CalibratedCamera) -> None:
    axis = figure.subplots()
    theta, distance = _angles(camera)
    axis.plot(theta, distance, '.', color=OURS, ms=2)
    axis.axvline(np.degrees(camera.lens.max_incidence), color=PUBLISHED, lw=1)
    axis.set(
        xlabel='incidence angle / deg',
        ylabel='distance / m',
        xlim=(0, None),
        ylim=(0, None),
        title='angles and distances (line: max_incidence_deg)',
    )


def _angles(camera: CalibratedCamera) -> tuple[Array, Array]:
    """Return incidence angles, deg, and distances, m, of all points (N,)."""
    views = camera.result.views
    points = camera.result.adjusted.pose.into_body(views.points)[views.used]
    distance = np.linalg.norm(points, axis=-1)
    return np.degrees(np.arccos(points[:, 2] / distance)), distance


def _draw_residuals(figure: Figure, camera: CalibratedCamera) -> None:
    axis, views = figure.subplots(), camera.result.views
    uv, residual = views.uv[views.used], camera.result.adjusted.residual[views.used]
    step = max(1, len(uv) // _ARROWS)
    typical = max(float(np.quantile(np.linalg.norm(residual, axis=1), 0.9)), 1e-9)
    length = _ARROW_LENGTH * camera.lens.width
    draw_arrows(axis, uv[::step], residual[::step], typical, length, OURS)
    _show_image(axis, camera.lens)
    axis.set_title('residuals')


def _draw_radial_residuals(figure: Figure, camera: CalibratedCamera) -> None:
    axis, views, lens = figure.subplots(), camera.result.views, camera.lens
    arm = views.uv[views.used] - (lens.cx, lens.cy)
    residual = camera.result.adjusted.residual[views.used]
    radial = (residual * arm).sum(axis=1) / np.maximum(np.linalg.norm(arm, axis=1), 1e-9)
    theta, _ = _angles(camera)
    axis.plot(theta, radial, '.', color=OURS, ms=2, alpha=0.4)
    parts = np.array_split(np.argsort(theta), max(1, min(16, len(theta) // 8)))
    means = np.array([(theta[part].mean(), radial[part].mean()) for part in parts])
    axis.plot(*means.T, 'o-', color=PUBLISHED, ms=4, label='means')
    axis.set(xlabel='incidence angle / deg', ylabel='radial residual / px')
    axis.legend(loc='upper right')


def _draw_frames(figure: Figure, camera: CalibratedCamera) -> None:
    axis, views = figure.subplots(), camera.result.views
    squares = np.where(views.used, (camera.result.adjusted.residual**2).sum(axis=-1), 0.0)
    rms = np.sqrt(squares.sum(axis=1) / views.used.sum(axis=1))
    place, step = np.arange(len(rms)), -(-len(rms) // _TICKS)
    axis.bar(place, rms, color=OURS)
    axis.axhline(float(np.median(rms)), color=PUBLISHED, lw=1, label='median')
    names = [
        frame_name(camera.table, frame).removeprefix('frame ')
        for frame in views.frame[::step].tolist()
    ]
    axis.set_xticks(place[::step], names, rotation=90, fontsize=7)
    highest = 1.15 * float(rms.max())  # room for the legend
    axis.set(
        ylabel='rms residual / px',
        xlabel='' if camera.table.photographs else 'frame',
        ylim=(0, highest or None),
    )
    axis.legend(loc='upper right')


def _draw_near_rays(figure: Figure, rays: RayMap) -> None:
    draw_ray_map(figure, [figure.subplots()], rays)


def _draw_far_rays(figure: Figure, rays: RayMap) -> None:
    draw_ray_map(figure, [figure.subplots()], rays, first=1)
