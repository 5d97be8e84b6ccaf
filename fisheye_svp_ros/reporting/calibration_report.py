"""The report of a calibration: coverage, residuals, uncertainty and warnings on one page."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.optics.lens import Lens, parameter_values
from fisheye_svp_ros.reporting.blocks import page
from fisheye_svp_ros.reporting.calibrated_camera import CalibratedCamera
from fisheye_svp_ros.reporting.style import INK, OURS, PUBLISHED, error_levels, round_number
from fisheye_svp_ros.reporting.svg import WIDE, WIDTH, Axis, Panel
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

_ARROWS, _DOTS = 2500, 1500  # drawn, at most
_TICKS = 30  # named frames of a panel of the usual width, at most
_ARROW_LENGTH = 0.03  # of the image, the typical residual
_MARGIN = 0.05  # of an axis, beyond what is drawn
# From pale yellow to dark blue. Source: Brewer, ColorBrewer 2.0, YlGnBu.
_COLORS = [
    '#ffffd9',
    '#edf8b1',
    '#c7e9b4',
    '#7fcdbb',
    '#41b6c4',
    '#1d91c0',
    '#225ea8',
    '#253494',
    '#081d58',
    '#040e2c',
]


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
        'coverage': _draw('coverage', _coverage, camera),
        'residuals': _draw('residuals', _residuals, camera),
        'frames_picture': _draw('residuals by frame', _frames, camera),
        'uncertainty': _draw('uncertainty', _uncertainty, ray_map),
        'scale': _scale(error_levels(1e3 * ray_map.sd)),
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


def _draw(name: str, draw: Callable[..., list[Panel]], *arguments: Any) -> list[str]:
    """Return the panels of a picture as parts of the page; none where they cannot be drawn."""
    drawn: list[str] = []

    def keep(_: Path) -> None:
        drawn.extend(panel.to_svg() for panel in draw(*arguments))

    return drawn if draw_or_note(Path(name), keep) else []


def _image_panel(title: str, lens: Lens) -> Panel:
    """Return axes that show the image."""
    x = Axis('u / px', -0.5, lens.width - 0.5)
    y = Axis('v / px', lens.height - 0.5, -0.5)
    return Panel(title, x, y, lens.height / lens.width)


def _range(values: Array) -> tuple[float, float]:
    """Return the ends of an axis around values."""
    low, high = float(values.min()), float(values.max())
    margin = _MARGIN * (high - low) or 1.0
    return low - margin, high + margin


def _coverage(camera: CalibratedCamera) -> list[Panel]:
    views, limit = camera.result.views, float(np.degrees(camera.lens.max_incidence))
    image = _image_panel('image points', camera.lens)
    image.dots(views.uv[views.used], OURS)
    theta, distance = _angles(camera)
    field = Panel(
        'angles and distances (line: max_incidence_deg)',
        Axis('incidence angle / deg', 0.0, (1 + _MARGIN) * max(limit, float(theta.max()))),
        Axis('distance / m', 0.0, (1 + _MARGIN) * float(distance.max())),
    )
    field.dots(np.stack([theta, distance], axis=-1), OURS)
    field.line(np.array([(limit, field.y.first), (limit, field.y.last)]), PUBLISHED)
    return [image, field]


def _angles(camera: CalibratedCamera) -> tuple[Array, Array]:
    """Return incidence angles, deg, and distances, m, of all points (N,)."""
    views = camera.result.views
    points = camera.result.adjusted.pose.into_body(views.points)[views.used]
    distance = np.linalg.norm(points, axis=-1)
    return np.degrees(np.arccos(points[:, 2] / distance)), distance


def _residuals(camera: CalibratedCamera) -> list[Panel]:
    views, lens = camera.result.views, camera.lens
    uv, residual = views.uv[views.used], camera.result.adjusted.residual[views.used]
    step = max(1, len(uv) // _ARROWS)
    typical = max(float(np.quantile(np.linalg.norm(residual, axis=1), 0.9)), 1e-9)
    zoom, known = _ARROW_LENGTH * lens.width / typical, round_number(typical)
    image = _image_panel('residuals', lens)
    opacity = 0.55 if len(uv) > 600 * step else 0.9
    image.arrows(uv[::step], zoom * residual[::step], OURS, opacity)
    image.key(f'{known:g} px', OURS, round(zoom * known / lens.width * image.size[0]))
    arm = uv - (lens.cx, lens.cy)
    radial = (residual * arm).sum(axis=1) / np.maximum(np.linalg.norm(arm, axis=1), 1e-9)
    theta, _ = _angles(camera)
    angles = Panel(
        'radial residuals',
        Axis('incidence angle / deg', *_range(theta)),
        Axis('radial residual / px', *_range(radial)),
    )
    angles.dots(np.stack([theta, radial], axis=-1), OURS, 22, 0.5)
    parts = np.array_split(np.argsort(theta), max(1, min(16, len(theta) // 8)))
    means = np.array([(theta[part].mean(), radial[part].mean()) for part in parts])
    angles.line(means, PUBLISHED, 20, 60)
    angles.key('means', PUBLISHED, dot=60)
    return [image, angles]


def _frames(camera: CalibratedCamera) -> list[Panel]:
    """Return the residuals of all frames, for a wide page and for a narrow one."""
    views = camera.result.views
    squares = np.where(views.used, (camera.result.adjusted.residual**2).sum(axis=-1), 0.0)
    rms = np.sqrt(squares.sum(axis=1) / views.used.sum(axis=1))
    ends = -0.6, len(rms) - 0.4
    highest = 1.2 * float(rms.max()) or 1.0  # room for the key
    panels = []
    for width, ticks in ((WIDE, 2 * _TICKS), (WIDTH, _TICKS)):
        step = -(-len(rms) // ticks)
        names = [
            (float(at), frame_name(camera.table, frame).removeprefix('frame '))
            for at, frame in [*enumerate(views.frame.tolist())][::step]
        ]
        panel = Panel(
            'residuals by photograph' if camera.table.photographs else 'residuals by frame',
            Axis('' if camera.table.photographs else 'frame', *ends, names),
            Axis('rms residual / px', 0.0, highest),
            width=width,
        )
        panel.bars(rms, OURS)
        panel.line(np.array([(end, np.median(rms)) for end in ends]), PUBLISHED)
        panel.key('median', PUBLISHED)
        panels.append(panel)
    return panels


def _uncertainty(rays: RayMap) -> list[Panel]:
    levels, panels = error_levels(1e3 * rays.sd), []
    uv = rays.uv[:: max(1, len(rays.uv) // _DOTS)]
    for deviation, range_m in zip(1e3 * rays.sd, rays.ranges, strict=True):
        x, y = Axis('u / px', rays.u[0], rays.u[-1]), Axis('v / px', rays.v[-1], rays.v[0])
        aspect = float(rays.v[-1] / rays.u[-1])
        panel = Panel(f'standard error at {range_m:g} m', x, y, aspect)
        panel.map(deviation, levels, _colors(len(levels) + 1))
        panel.dots(uv, INK, 16, 0.4)
        panels.append(panel)
    return panels


def _colors(count: int) -> list[str]:
    """Return colors, from the first to the last of all there are."""
    return [_COLORS[i] for i in np.linspace(0, len(_COLORS) - 1, count).round().astype(int)]


def _scale(levels: list[float]) -> list[tuple[str, str]]:
    """Return the colors of a map and what each stands for."""
    middle = (f'{low:g} to {high:g}' for low, high in pairwise(levels))
    texts = [f'below {levels[0]:g}', *middle, f'above {levels[-1]:g}']
    return list(zip(_colors(len(texts)), texts, strict=True))
