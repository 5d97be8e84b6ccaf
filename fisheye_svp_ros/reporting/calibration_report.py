"""The report of a calibration: coverage, residuals, uncertainty and warnings on one page."""

from __future__ import annotations

from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.optics.lens import Lens, parameter_values
from fisheye_svp_ros.reporting.blocks import page, png_uri
from fisheye_svp_ros.reporting.calibrated_camera import CalibratedCamera
from fisheye_svp_ros.reporting.diagnosis_plots import draw_arrows
from fisheye_svp_ros.reporting.plots import NARROW, OURS, PUBLISHED, drawing, panels
from fisheye_svp_ros.reporting.ray_plots import draw_ray_map
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

_WIDTH = 9.2  # in
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
        'coverage': _picture_uris('coverage', 2, _draw_coverage, camera),
        'residuals': _picture_uris('residuals', 2, _residuals, camera),
        'frames_picture': _picture_uris('residuals by frame', 1, _frames, camera),
        'uncertainty': _picture_uris('uncertainty', 2, _uncertainty, ray_map, tight=False),
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


def _picture_uris(
    name: str, count: int, draw: Any, *arguments: Any, tight: bool = True
) -> tuple[str, str]:
    """Return a picture as part of the page, wide and narrow; '' where it cannot be drawn.

    count: of its panels; draw: takes a figure, the arguments, and whether the figure is narrow;
    tight: see `drawing`.
    """
    wide, narrow = BytesIO(), BytesIO()

    def draw_figures(_: Path) -> None:
        with drawing(wide, _WIDTH, 3.6, tight=tight) as figure:
            draw(figure, *arguments, False)
        with drawing(narrow, NARROW, 3.3 * count, tight=tight) as figure:
            draw(figure, *arguments, True)

    if not draw_or_note(Path(name), draw_figures):
        return '', ''
    return png_uri(wide.getvalue()), png_uri(narrow.getvalue())


def _draw_image(axis: Any, lens: Lens) -> None:
    axis.set(
        xlim=(-0.5, lens.width - 0.5),
        ylim=(lens.height - 0.5, -0.5),
        aspect='equal',
        xlabel='u / px',
        ylabel='v / px',
    )


def _draw_coverage(figure: Any, camera: CalibratedCamera, narrow: bool) -> None:
    image, field = panels(figure, 1, narrow)[0]
    views = camera.result.views
    image.plot(*views.uv[views.used].T, '.', color=OURS, ms=2)
    _draw_image(image, camera.lens)
    image.set_title('image points')
    points = camera.result.adjusted.pose.into_body(views.points)[views.used]
    distance = np.linalg.norm(points, axis=-1)
    field.plot(np.degrees(np.arccos(points[:, 2] / distance)), distance, '.', color=OURS, ms=2)
    field.axvline(np.degrees(camera.lens.max_incidence), color=PUBLISHED, lw=1)
    field.set(
        xlabel='incidence angle / deg',
        ylabel='distance / m',
        xlim=(0, None),
        ylim=(0, None),
        title='angles and distances (line: max_incidence_deg)',
    )


def _residuals(figure: Any, camera: CalibratedCamera, narrow: bool) -> None:
    image, angles = panels(figure, 1, narrow)[0]
    views, lens = camera.result.views, camera.lens
    uv, residual = views.uv[views.used], camera.result.adjusted.residual[views.used]
    step = max(1, len(uv) // _ARROWS)
    size = np.linalg.norm(residual, axis=1)
    typical = max(float(np.quantile(size, 0.9)), 1e-9)
    draw_arrows(image, uv[::step], residual[::step], typical, _ARROW_LENGTH * lens.width, OURS)
    _draw_image(image, lens)
    image.set_title('residuals')
    arm = uv - (lens.cx, lens.cy)
    radial = (residual * arm).sum(axis=1) / np.maximum(np.linalg.norm(arm, axis=1), 1e-9)
    points = camera.result.adjusted.pose.into_body(views.points)[views.used]
    theta = np.degrees(np.arccos(points[:, 2] / np.linalg.norm(points, axis=-1)))
    angles.plot(theta, radial, '.', color=OURS, ms=2, alpha=0.4)
    parts = np.array_split(np.argsort(theta), max(1, min(16, len(theta) // 8)))
    angles.plot(
        [theta[p].mean() for p in parts],
        [radial[p].mean() for p in parts],
        'o-',
        color=PUBLISHED,
        ms=4,
        label='means',
    )
    angles.set(xlabel='incidence angle / deg', ylabel='radial residual / px')
    angles.legend(loc='upper right')


def _frames(figure: Any, camera: CalibratedCamera, narrow: bool) -> None:
    axis, views = figure.subplots(), camera.result.views
    squares = np.where(views.used, (camera.result.adjusted.residual**2).sum(axis=-1), 0.0)
    rms = np.sqrt(squares.sum(axis=1) / views.used.sum(axis=1))
    place = np.arange(len(rms))
    axis.bar(place, rms, color=OURS)
    axis.axhline(float(np.median(rms)), color=PUBLISHED, lw=1, label='median')
    step = -(-len(rms) // (_TICKS // 2 if narrow else _TICKS))
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


def _uncertainty(figure: Any, rays: RayMap, narrow: bool) -> None:
    draw_ray_map(figure, panels(figure, 1, narrow)[0], rays)
