"""Lens files: the lens YAML both ways."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.files import read_yaml, write_text
from fisheye_svp_ros.optics.curves import (
    IMAGE_HEIGHTS,
    VIEWPOINT_SHIFTS,
    ViewpointShift,
    curve_name,
)
from fisheye_svp_ros.optics.lens import INTRINSICS, Lens, check_lens


def load_lens(path: str | Path) -> Lens:
    """Read a lens YAML.  Raises LensError, naming file and field, for anything impossible."""
    return lens_from_dict(read_yaml(path, LensError), str(path))


def save_lens(lens: Lens, path: str | Path) -> None:
    """Write a lens YAML that `load_lens` reads back to the same lens."""
    write_text(path, yaml.safe_dump(lens_to_dict(lens), sort_keys=False))


def lens_from_dict(document: Mapping[str, Any], where: str = 'lens') -> Lens:
    """Build a lens from the mapping of its YAML.  Raises LensError naming `where` and field."""
    known = {'name', 'image', 'projection', 'max_incidence_deg', 'viewpoint_shift', 'effects',
             'calibration', 'provenance'}
    _refuse_unknown(document, known, where)
    image = _section(document, 'image', where)
    projection = dict(_section(document, 'projection', where))
    kind = _registered(projection.pop('model', None), IMAGE_HEIGHTS, f'{where}: projection')
    if 'f' in projection:
        if 'fx' in projection or 'fy' in projection:
            raise LensError(f'{where}: projection has both f and fx or fy; keep one of them')
        projection['fx'] = projection['fy'] = projection.pop('f')
    height_names = kind.coefficient_names
    coefficients = _vector(projection.pop('k', []), f'{where}: projection.k')
    if len(coefficients) > len(height_names):
        raise LensError(f'{where}: projection.k has {len(coefficients)} values; '
                        f'this model takes {len(height_names)}')
    _refuse_unknown(projection, set(INTRINSICS), f'{where}: projection')
    numbers = {name: _number(projection, name, f'{where}: projection') for name in INTRINSICS}
    lens = Lens(
        name=str(document.get('name', Path(where).stem)),
        width=_pixels(image, 'width', f'{where}: image'),
        height=_pixels(image, 'height', f'{where}: image'),
        image_height=kind(**dict(zip(height_names, coefficients, strict=False))),
        max_incidence=np.radians(_number(document, 'max_incidence_deg', where)).item(),
        viewpoint_shift=_viewpoint_shift(document.get('viewpoint_shift'), where),
        effects=_effects(document.get('effects'), where),
        calibration=_calibration(document.get('calibration'), where),
        **numbers,
    )
    return check_lens(lens, where)


def lens_to_dict(lens: Lens) -> dict[str, Any]:
    """Return the mapping of the lens's YAML."""
    projection: dict[str, Any] = {'model': curve_name(lens.image_height)}
    if lens.fx == lens.fy:
        projection['f'] = lens.fx
    else:
        projection.update(fx=lens.fx, fy=lens.fy)
    projection.update(cx=lens.cx, cy=lens.cy)
    if lens.image_height.coefficients:
        projection['k'] = list(lens.image_height.coefficients)
    document: dict[str, Any] = {
        'name': lens.name,
        'image': {'width': lens.width, 'height': lens.height},
        'projection': projection,
        'max_incidence_deg': float(np.degrees(lens.max_incidence)),
    }
    if lens.viewpoint_shift is not None:
        document['viewpoint_shift'] = _shift_to_dict(lens.viewpoint_shift)
    document['effects'] = dict(lens.effects)
    if lens.calibration is not None:
        document['calibration'] = dict(lens.calibration)
    return document


def _viewpoint_shift(section: Any, where: str) -> ViewpointShift | None:
    if section is None:
        return None
    if not isinstance(section, dict):
        raise LensError(f'{where}: viewpoint_shift must be a mapping with a model')
    place = f'{where}: viewpoint_shift'
    values = dict(section)
    kind = _registered(values.pop('model', None), VIEWPOINT_SHIFTS, place)
    if 'e' in values:
        e = _vector(values.pop('e'), f'{place}.e')
        values.update({f'e{i}': value for i, value in enumerate(e)})
    _refuse_unknown(values, set(kind.coefficient_names), place)
    try:
        shift: ViewpointShift = kind(**{name: _number(values, name, place) for name in values})
    except TypeError as cause:
        needed = ', '.join(kind.coefficient_names)
        raise LensError(f'{place}: a coefficient is missing; needed are {needed}') from cause
    return shift


def _shift_to_dict(shift: ViewpointShift) -> dict[str, Any]:
    values = dict(zip(shift.coefficient_names, shift.coefficients, strict=True))
    e = [values.pop(name) for name in ('e0', 'e1', 'e2') if name in values]
    return {'model': curve_name(shift), **values, **({'e': e} if e else {})}


def _effects(section: Any, where: str) -> dict[str, Any]:
    if section is None:
        return {}
    if not isinstance(section, dict) or not all(isinstance(v, dict) for v in section.values()):
        raise LensError(f'{where}: effects must map each effect name to its parameters')
    return dict(section)


def _calibration(section: Any, where: str) -> dict[str, Any] | None:
    if section is not None and not isinstance(section, dict):
        raise LensError(f'{where}: calibration must be a mapping, is {section!r}')
    return section


def _section(document: Mapping[str, Any], name: str, where: str) -> Mapping[str, Any]:
    section = document.get(name)
    if not isinstance(section, dict):
        raise LensError(f'{where}: {name} is missing; a mapping is needed')
    return section


def _number(mapping: Mapping[str, Any], name: str, where: str) -> float:
    value = mapping.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise LensError(f'{where}: {name} is {value!r}; a number is needed')
    return float(value)


def _pixels(mapping: Mapping[str, Any], name: str, where: str) -> int:
    value = _number(mapping, name, where)
    if not value.is_integer():
        raise LensError(f'{where}: {name} is {value}; a whole number of pixels is needed')
    return int(value)


def _vector(values: Any, where: str) -> list[float]:
    if not isinstance(values, list) or not all(isinstance(v, int | float) for v in values):
        raise LensError(f'{where} must be a list of numbers, is {values!r}')
    return [float(value) for value in values]


def _registered(name: Any, registry: Mapping[str, Any], where: str) -> Any:
    if not isinstance(name, str) or name not in registry:
        raise LensError(f'{where}.model is {name!r}; known are {", ".join(registry)}')
    return registry[name]


def _refuse_unknown(mapping: Mapping[str, Any], known: set[str], where: str) -> None:
    unknown = sorted(set(map(str, mapping)) - known)
    if unknown:
        raise LensError(f'{where}: unknown field {unknown[0]!r}; known are '
                        + ', '.join(sorted(known)))
