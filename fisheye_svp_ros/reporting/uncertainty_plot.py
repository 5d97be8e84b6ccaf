"""How far image points by the extended lens may be off, over the image."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.diagnosis.diagnosis import Diagnosis
from fisheye_svp_ros.reporting.plots import picture

_CELLS = 24  # over the longer side of the image
_TITLES = {'noise': 'noise of a point', 'parameters': 'parameters of the lens',
           'misfit': 'what remains without a name'}


def draw_uncertainty(path: Path, diagnosis: Diagnosis) -> None:
    """Draw the standard deviation of a coordinate by noise, parameters and remaining misfit."""
    linear = diagnosis.after
    views, lens = linear.data.views, linear.state.lens
    parts = diagnosis.errors.of_points(linear)._asdict()
    uv = linear.data.blocks(views.uv).reshape(-1, 2)
    with picture(path, 12.0, 3.6) as figure:
        for axis, (name, part) in zip(figure.subplots(1, len(parts)), parts.items(), strict=True):
            square = part.reshape(-1, 2).mean(axis=-1)
            image = np.sqrt(_cells(uv, square, (lens.width, lens.height)))
            shown = axis.imshow(image, extent=(-0.5, lens.width - 0.5, lens.height - 0.5, -0.5),
                                cmap='Blues', vmin=0.0, vmax=np.nanmax(image) or 1.0)
            figure.colorbar(shown, ax=axis, label='px', shrink=0.8)
            rms = np.sqrt(np.nanmean(square))
            axis.set_title(f'{_TITLES[name]}: {rms:.3g} px', fontsize=9.5)
            axis.set(xticks=[], yticks=[])
            axis.grid(visible=False)


def _cells(uv: Array, values: Array, size: tuple[int, int]) -> Array:
    """Return means of values over square cells of the image; NaN where there are none."""
    pitch = max(size) / _CELLS
    known = np.isfinite(values)
    shape = tuple(int(np.ceil(side / pitch)) for side in reversed(size))
    row, column = (np.clip((uv[known, i] / pitch).astype(int), 0, shape[1 - i] - 1)
                   for i in (1, 0))
    count, total = np.zeros(shape), np.zeros(shape)
    np.add.at(count, (row, column), 1.0)
    np.add.at(total, (row, column), values[known])
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
