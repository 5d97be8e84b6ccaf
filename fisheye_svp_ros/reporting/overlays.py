"""What was found in photographs, drawn: corners on each, and the part of the image covered."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from fisheye_svp_ros.detect.detection import Detection, SearchedPhotograph
from fisheye_svp_ros.detect.photographs import Photograph
from fisheye_svp_ros.errors import FisheyeSvpError
from fisheye_svp_ros.io.image_files import to_color, write_png
from fisheye_svp_ros.reporting.plots import picture
from fisheye_svp_ros.reporting.style import FAINT, OURS
from fisheye_svp_ros.solve.lens_calibration import calibrate

_BLUE, _ORANGE = (168, 95, 31), (40, 123, 224)  # BGR
_MAX_SIZE = 1600  # px, of an overlay


def write_overlays(photographs: Iterable[Photograph], detection: Detection, folder: Path) -> None:
    """Draw each photograph with its corners in order, the first ringed, or raise OutputError."""
    for photograph, searched in zip(photographs, detection.searched, strict=True):
        try:
            pixels = photograph.pixels()
        except FisheyeSvpError:
            continue
        name = '_'.join(filter(None, (searched.camera, photograph.key.replace('/', '_'))))
        write_png(folder / f'{name}.png', _overlay(np.asarray(pixels), searched))


def _overlay(pixels: np.ndarray, searched: SearchedPhotograph) -> np.ndarray:
    zoom = _MAX_SIZE / max(pixels.shape)
    image, points = to_color(pixels, zoom), searched.points
    if points is None:
        cv2.putText(image, searched.reason, (20, 40), cv2.FONT_HERSHEY_SIMPLEX, 1.0, _ORANGE, 2)
        return image
    # In sixteenths of a pixel; the center of the first pixel is at half a pixel of the picture.
    places = np.round(((points.uv + 0.5) * zoom - 0.5) * 16).astype(int)
    cv2.polylines(image, [places.astype(np.int32)], False, _BLUE, 1, cv2.LINE_AA, 4)
    for i, (u, v) in enumerate(places.tolist()):
        cv2.circle(image, (u, v), 16 * (14 if i == 0 else 5), _ORANGE, 2, cv2.LINE_AA, 4)
    return image


def write_coverage(path: Path, detection: Detection) -> None:
    """Draw all corners on the image, and, as a first calibration has them, angles and ranges."""
    table = detection.observations
    searched_count = sum(photograph.points is not None for photograph in detection.searched)
    shown = f'{searched_count} photographs of {len(detection.searched)}'
    width, height = np.max([*detection.image_sizes.values()], axis=0).tolist()
    with picture(path, 10.0, 4.5) as figure:
        image, field = figure.subplots(1, 2)
        image.plot(table.uv[:, 0], table.uv[:, 1], '.', color=OURS, markersize=2)
        image.set(
            xlim=(-0.5, width - 0.5),
            ylim=(height - 0.5, -0.5),
            aspect='equal',
            xlabel='u, px',
            ylabel='v, px',
            title=f'{len(table)} corners in {shown}',
        )
        for camera, name in enumerate(table.cameras):
            _draw_angles(field, detection, camera, name)
        field.set(
            xlabel='incidence angle, deg',
            ylabel='range, m',
            title='angles and ranges from a first calibration',
        )


def _draw_angles(axes: object, detection: Detection, camera: int, name: str) -> None:
    table = detection.observations
    try:
        fitted = calibrate(
            table.take(table.camera == camera), 'kannala_brandt', detection.image_sizes[name]
        )
    except FisheyeSvpError:
        return
    views, lens = fitted.views, fitted.adjusted.lens
    points = fitted.adjusted.pose.into_body(views.points)[views.used]
    distance = np.linalg.norm(points, axis=-1)
    theta = np.degrees(np.arccos(points[:, 2] / distance))
    axes.plot(  # type: ignore[attr-defined]
        theta,
        distance,
        '.',
        markersize=2,
        color=(OURS, FAINT)[camera % 2],
        label=name or lens.name,
    )
