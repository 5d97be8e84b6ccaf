"""The lens of an image that is cut and scaled: binned, cropped or resized.

Pixel centers are at whole numbers, so that an image begins at -0.5: u comes to
(u + 0.5 - offset) scale - 0.5.  Resizing by a factor is averaging of pixels then (cv2.INTER_AREA,
binning on the sensor), and taking every second one is something else, half a pixel away.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, Self

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.effects.catalogue import CATALOGUE, load_effects
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.optics.image_field import ImageField
from fisheye_svp_ros.optics.lens import INTRINSICS, Lens, field_of_view

_MAX_SIZE = 1_000_000  # px


class ImageChange(NamedTuple):
    """A cut and then a scaling: offset (2,), px of the old image; scale (2,); size of the new."""

    offset: Array
    scale: Array
    size: tuple[int, int]

    @classmethod
    def of(
        cls,
        old: tuple[int, int],
        crop: tuple[int, int, int, int] | None = None,
        scale: float | None = None,
        size: tuple[int, int] | None = None,
    ) -> Self:
        """Return the change of an image (width, height): crop (x, y, width, height), scale, size.

        Raises ParameterError for a part that is not in the image, or a size that is not whole.
        """
        x, y, width, height = crop or (0, 0, *old)
        if min(x, y) < 0 or min(width, height) < 1 or x + width > old[0] or y + height > old[1]:
            raise ParameterError(
                f'crop {x},{y},{width},{height} is not within the image of {old[0]}x{old[1]} px; '
                'it is X,Y,WIDTH,HEIGHT in px'
            )
        if size is None:
            wanted = np.array([width, height]) * (1.0 if scale is None else scale)
            whole = np.round(wanted)
            if not (np.abs(wanted - whole) < 1e-9 * wanted).all() or whole.min() < 1:
                raise ParameterError(
                    f'{width}x{height} px times {scale:.6g} is not a whole number of pixels; '
                    'give the size of the image, for example '
                    f'{max(int(whole[0]), 1)}x{max(int(whole[1]), 1)}'
                )
            size = int(whole[0]), int(whole[1])
        if not 0 < min(size) <= max(size) <= _MAX_SIZE:
            raise ParameterError(f'size is {size[0]}x{size[1]}; 1 to {_MAX_SIZE} px are needed')
        return cls(np.array([x, y], dtype=float), np.array(size) / (width, height), size)

    @property
    def keeps_square_pixels(self) -> bool:
        """Whether both axes are scaled alike."""
        return bool(np.isclose(self.scale[0], self.scale[1], rtol=1e-12))

    @property
    def mean_scale(self) -> float:
        """The geometric mean of both scales."""
        return float(np.sqrt(np.prod(self.scale)))

    def apply(self, uv: Array) -> Array:
        """Return image points (..., 2), px, of those in the old image."""
        return np.asarray((uv + 0.5 - self.offset) * self.scale - 0.5)


def transform_lens(lens: Lens, change: ImageChange) -> tuple[Lens, tuple[str, ...]]:
    """Return the lens of a changed image without `uncertainty`, and which corrections are lost.

    Lost are those that belong to the pixels of the old image, where these have another size.
    """
    fx, fy = change.scale * (lens.fx, lens.fy)
    cx, cy = change.apply(np.array([lens.cx, lens.cy]))
    ratio = float((fx + fy) / (lens.fx + lens.fy))
    width, height = change.size
    rows = height / (lens.height * float(change.scale[1]))
    held, lost = {}, []
    for term in load_effects(lens.corrections, lens.name):
        values = term.effect.resize_values(term.values, ratio, rows)
        if values is None:
            lost.append(term.name)
        else:
            held[term.name] = term.effect.to_dict(values)
    resized = replace(
        lens,
        width=width,
        height=height,
        fx=float(fx),
        fy=float(fy),
        cx=float(cx),
        cy=float(cy),
        image_field=lens.image_field and _resize_field(lens.image_field, change),
        corrections=held,
        calibration=lens.calibration and _resize_calibration(lens.calibration, change),
        uncertainty=None,
        neglected=None,
    )
    if not np.allclose(change.scale * (lens.width, lens.height), (width, height)):
        # Of a part, whose corners are not those of the image
        reach = field_of_view(ForwardModel(resized).lens)
        resized = replace(resized, max_incidence=min(lens.max_incidence, reach))
    return resized, tuple(lost)


def resize_covariance(names: Sequence[str], covariance: Array, change: ImageChange) -> Array:
    """Return the covariance (K, K) of named parameters of a lens and of its corrections."""
    by = dict(zip(INTRINSICS, (*change.scale, *change.scale), strict=True))
    factors = np.array(
        [by.get(name, change.mean_scale if _is_px(name) else 1.0) for name in names]
    )
    return np.asarray(covariance * np.outer(factors, factors))


def _is_px(name: str) -> bool:
    """Say whether a parameter of a lens, or EFFECT.PARAMETER, is in px."""
    effect = name.partition('.')[0]
    if effect not in CATALOGUE:
        return name == 'f'
    return any(parameter.unit == 'px' for parameter in CATALOGUE[effect]().parameters)


def _resize_field(field: ImageField, change: ImageChange) -> ImageField:
    return ImageField(
        change.apply(field.low),
        field.pitch * change.scale,
        field.values * change.scale,
        None if field.stderr is None else field.stderr * change.mean_scale,
    )


def _resize_calibration(block: Mapping[str, Any], change: ImageChange) -> dict[str, Any]:
    """Return the figures of a calibration, px of the new image."""
    found = {
        name: change.mean_scale * value
        if name.endswith('_px') and isinstance(value, float)
        else value
        for name, value in block.items()
    }
    if isinstance(block.get('stderr'), dict) and 'covariance' in block:
        names = tuple(block['stderr'])
        old = np.array(block['covariance'], dtype=float)
        new = resize_covariance(names, old, change)
        found['covariance'] = new.tolist()
        found['stderr'] = dict(zip(names, np.sqrt(np.diag(new)).tolist(), strict=True))
    return found
