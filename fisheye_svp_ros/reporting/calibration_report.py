"""The report of a calibration: coverage, residuals, uncertainty and warnings on one page."""

from __future__ import annotations

from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.optics.lens import Lens, parameter_values
from fisheye_svp_ros.reporting.blocks import page, png_uri
from fisheye_svp_ros.reporting.calibrated_camera import CalibratedCamera
from fisheye_svp_ros.reporting.diagnosis_plots import draw_arrows
from fisheye_svp_ros.reporting.plots import FAINT, OURS, PUBLISHED, drawing
from fisheye_svp_ros.reporting.terminal import draw_or_note
from fisheye_svp_ros.reporting.wording.calibration import (
    ANY_TARGET,
    ANY_TARGET_NOTE,
    STANDARD_ERRORS,
    calibration_warnings,
    estimate_sentence,
)
from fisheye_svp_ros.scene.observations import frame_name
from fisheye_svp_ros.solve.ray_errors import RANGES, RayModel, ray_model, typical_points

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
            cameras=[_camera(name, camera) for name, camera in cameras.items()],
        ),
    )


def _camera(name: str, camera: CalibratedCamera) -> dict[str, Any]:
    rays = _rays(camera)
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
            for e in rays[1].errors()
        ],
        'coverage': _drawn('coverage', _coverage, camera),
        'residuals': _drawn('residuals', _residuals, camera),
        'frames_picture': _drawn('residuals by frame', _frames, camera),
        'uncertainty': _drawn('uncertainty', _uncertainty, camera, *rays),
    }


def _rays(camera: CalibratedCamera) -> tuple[Array, RayModel]:
    """Return image points (G, 2) and how the fitted parameters move their rays."""
    names = camera.result.adjusted.names
    values = parameter_values(camera.lens, names)

    def perturb_lens(step: Array) -> Lens:
        return camera.lens.with_parameters(names, [*np.add(values, step).tolist()])

    views = camera.result.views
    uv = typical_points(views.uv[views.used])
    model, there = ray_model(perturb_lens, camera.trust.covariance, uv)
    return uv[there], model


def _drawn(name: str, draw: Any, *arguments: Any) -> str:
    """Return a picture as part of the page, '' where it cannot be drawn."""
    drawn = BytesIO()

    def draw_figure(_: Path) -> None:
        with drawing(drawn, _WIDTH, 3.6) as figure:
            draw(figure, *arguments)

    return png_uri(drawn.getvalue()) if draw_or_note(Path(name), draw_figure) else ''


def _image(axis: Any, lens: Lens) -> None:
    axis.set(
        xlim=(-0.5, lens.width - 0.5),
        ylim=(lens.height - 0.5, -0.5),
        aspect='equal',
        xlabel='u / px',
        ylabel='v / px',
    )


def _coverage(figure: Any, camera: CalibratedCamera) -> None:
    image, field = figure.subplots(1, 2)
    views = camera.result.views
    image.plot(*views.uv[views.used].T, '.', color=OURS, ms=2)
    _image(image, camera.lens)
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


def _residuals(figure: Any, camera: CalibratedCamera) -> None:
    image, angles = figure.subplots(1, 2)
    views, lens = camera.result.views, camera.lens
    uv, residual = views.uv[views.used], camera.result.adjusted.residual[views.used]
    step = max(1, len(uv) // _ARROWS)
    size = np.linalg.norm(residual, axis=1)
    typical = max(float(np.quantile(size, 0.9)), 1e-9)
    draw_arrows(image, uv[::step], residual[::step], typical, _ARROW_LENGTH * lens.width, OURS)
    _image(image, lens)
    image.set_title('residuals', loc='left')  # and room for the key to their scale
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


def _frames(figure: Any, camera: CalibratedCamera) -> None:
    axis, views = figure.subplots(), camera.result.views
    squares = np.where(views.used, (camera.result.adjusted.residual**2).sum(axis=-1), 0.0)
    rms = np.sqrt(squares.sum(axis=1) / views.used.sum(axis=1))
    place = np.arange(len(rms))
    axis.bar(place, rms, color=OURS)
    axis.axhline(float(np.median(rms)), color=PUBLISHED, lw=1, label='median')
    step = -(-len(rms) // _TICKS)
    names = [
        frame_name(camera.table, frame).removeprefix('frame ')
        for frame in views.frame[::step].tolist()
    ]
    axis.set_xticks(place[::step], names, rotation=90, fontsize=7)
    axis.set(ylabel='rms residual / px', xlabel='' if camera.table.photographs else 'frame')
    axis.legend(loc='upper right')


def _uncertainty(figure: Any, camera: CalibratedCamera, uv: Array, rays: RayModel) -> None:
    image, angles = figure.subplots(1, 2)
    shown = image.scatter(*uv.T, c=1e3 * rays.sd[-1], s=9, cmap='viridis')
    figure.colorbar(shown, ax=image, label=f'standard error at {RANGES[-1]:g} m / mrad')
    _image(image, camera.lens)
    axis = rays.points[-1] / np.linalg.norm(rays.points[-1], axis=-1, keepdims=True)
    theta = np.degrees(np.arccos(np.clip(axis[:, 2], -1, 1)))
    for sd, range_m, color in zip(rays.sd, RANGES, (PUBLISHED, FAINT, OURS), strict=True):
        angles.plot(theta, 1e3 * sd, '.', ms=3, color=color, label=f'at {range_m:g} m')
    angles.set(
        xlabel='incidence angle / deg', ylabel='standard error of a ray / mrad', ylim=(0, None)
    )
    angles.legend()
