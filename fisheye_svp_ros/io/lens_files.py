"""Lens files: the lens YAML both ways."""

from __future__ import annotations

import re
from collections.abc import Mapping, Set
from dataclasses import replace
from functools import reduce
from inspect import signature
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from fisheye_svp_ros.effects.catalogue import load_effects
from fisheye_svp_ros.effects.extension import LANDMARKS, Target, extend_lens
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.files import dump_yaml, parse_yaml, read_text, write_text
from fisheye_svp_ros.io.lens_formats import READABLE, Foreign, read_foreign
from fisheye_svp_ros.io.paths import visible_paths
from fisheye_svp_ros.io.share import without_camera
from fisheye_svp_ros.optics.curve_base import Curve, ViewpointShift
from fisheye_svp_ros.optics.curves import IMAGE_HEIGHTS, VIEWPOINT_SHIFTS
from fisheye_svp_ros.optics.image_field import ImageField
from fisheye_svp_ros.optics.lens import (
    IMAGE_FIELD,
    INTRINSICS,
    PORT,
    TANGENTIAL,
    Lens,
    check_lens,
    field_of_view,
)
from fisheye_svp_ros.optics.pinhole import TangentialDistortion
from fisheye_svp_ros.optics.ports import PORTS
from fisheye_svp_ros.registry import Registry

C = TypeVar('C', bound=Curve)

_FIELDS = {
    'name',
    'image',
    'projection',
    'max_incidence_deg',
    'viewpoint_shift',
    'corrections',
    'target',
    'calibration',
    'uncertainty',
    'provenance',
}
MAX_LENS_BYTES = 1 << 26  # bytes; a .cameramodel may hold all that it was fitted to
_MAX_NUMBER = 1e12  # any number of a lens
_DEPTH = 3  # folders, one in the other
_COLMAP_BINARY = 'cameras.bin'
FILES_OF_RIG = ('rig', 'camchain', 'tf_static')  # beside those of its lenses
OWN_SECTIONS = re.compile(r'\b(projection|image)\b')  # of our own lens files
_OF_LENS = (PORT, TANGENTIAL, IMAGE_FIELD)  # corrections that are no effects
_LEGACY_KEY = 'effects'  # what older files call corrections, of the lens and of the target alike


def load_lens(path: str | Path) -> Lens:
    """Read a lens YAML, or what another tool wrote; FILE#cam1: another camera than its first.

    A folder is that of a rig, as `calibrate` and `diagnose` write it: a file a camera.

    Raises LensError, naming file and field, for anything impossible.
    """
    text, camera = _read_text_and_camera(path)
    foreign = read_foreign(path, text)
    if foreign is None and not camera:
        if not OWN_SECTIONS.search(text):
            raise LensError(
                f'{path}: not a lens file: it has no projection, and no format of {READABLE}'
            )
        return lens_from_dict(parse_yaml(text, path, LensError), str(path))
    lenses = foreign.lenses if foreign else {}
    if foreign and not lenses:
        raise LensError(f'{path}: it holds a rig, but no lens')
    camera = camera or next(iter(lenses), '')
    if camera not in lenses:
        raise LensError(
            f'{path}: no camera {camera!r} in it; it has '
            + (', '.join(lenses) or 'one without a name')
        )
    return lenses[camera]


def read_lens_file(path: str | Path) -> Foreign | None:
    """Return the lenses of a file that another tool wrote; None for a lens YAML.

    Raises LensError, naming file and field, for anything impossible.
    """
    return read_foreign(path, _read_text_and_camera(path)[0])


def cameras_in(path: str | Path) -> tuple[str, ...]:
    """Return the cameras of a file or folder that holds several, none where it holds one.

    FILE#cam1 is one.  Raises LensError for a file that cannot be read.
    """
    if Path(path).is_dir():
        names = tuple(_in_folder(Path(path)))
        return names if len(names) > 1 else ()
    text, camera = _read_text_and_camera(path)
    foreign = None if camera else read_foreign(path, text)
    return tuple(foreign.lenses) if foreign and len(foreign.lenses) > 1 else ()


def save_lens(lens: Lens, path: str | Path, note: str = '') -> None:
    """Write a lens YAML that `load_lens` reads back to the same lens; note: a comment above."""
    text = dump_yaml(lens_to_dict(lens), default_flow_style=None, width=99)
    write_text(path, f'# {note}\n{text}' if note else text)


def lens_from_dict(document: Mapping[str, Any], where: str = 'lens') -> Lens:
    """Build a lens from the mapping of its YAML; raise LensError, naming `where` and field."""
    _refuse_unknown(document, _FIELDS, where, {_LEGACY_KEY})
    image = _section(document, 'image', where)
    target = _effects(document, 'target', where)
    corrections = _effects(document, 'corrections', where)
    Target.from_entries(target, where)
    lens = Lens(
        name=str(document.get('name', Path(where).stem)),
        width=_pixel_count(image, 'width', f'{where}: image'),
        height=_pixel_count(image, 'height', f'{where}: image'),
        **_projection_fields(_section(document, 'projection', where), f'{where}: projection'),
        max_incidence=np.nan,
        viewpoint_shift=_viewpoint_shift(document.get('viewpoint_shift'), where),
        port=None
        if PORT not in corrections
        else _curve(corrections[PORT], PORTS, '', 0, f'{where}: corrections.port'),
        tangential=_tangential(corrections.get(TANGENTIAL), where),
        image_field=None
        if IMAGE_FIELD not in corrections
        else ImageField.from_dict(corrections[IMAGE_FIELD], where),
        target=target,
        calibration=_mapping(document, 'calibration', where),
        uncertainty=_mapping(document, 'uncertainty', where),
    )
    wrong = lens.check()
    if wrong:
        raise LensError(f'{where}: {wrong}')
    given = document.get('max_incidence_deg')
    if given is not None:
        degrees = _number_at(document, 'max_incidence_deg', where)
        lens = check_lens(replace(lens, max_incidence=np.radians(degrees).item()), where)
    corrections = {name: entry for name, entry in corrections.items() if name not in _OF_LENS}
    for entries in (_effects(document, _LEGACY_KEY, where), corrections):
        lens = extend_lens(lens, load_effects(entries, where))
    return lens if given is not None else replace(lens, max_incidence=field_of_view(lens))


def lens_to_dict(lens: Lens) -> dict[str, Any]:
    """Return the mapping of the lens's YAML."""
    focal = {'f': lens.fx} if lens.fx == lens.fy else {'fx': lens.fx, 'fy': lens.fy}
    kind, *k = _curve_to_dict(lens.image_height, IMAGE_HEIGHTS, 'k').items()
    document: dict[str, Any] = {
        'name': lens.name,
        'image': {'width': lens.width, 'height': lens.height},
        'projection': dict([kind, *focal.items(), ('cx', lens.cx), ('cy', lens.cy), *k]),
        'max_incidence_deg': float(np.degrees(lens.max_incidence)),
    }
    if lens.viewpoint_shift is not None:
        parts = [
            _curve_to_dict(part, VIEWPOINT_SHIFTS, 'e') for part in lens.viewpoint_shift.summands()
        ]
        document['viewpoint_shift'] = parts if len(parts) > 1 else parts[0]
    corrections = {} if lens.port is None else {PORT: _curve_to_dict(lens.port, PORTS, '')}
    corrections |= lens.corrections
    if lens.tangential is not None:
        corrections[TANGENTIAL] = lens.tangential.values
    if lens.image_field is not None:
        corrections[IMAGE_FIELD] = lens.image_field.to_dict()
    document |= {'corrections': corrections, 'target': dict(lens.target)}
    for name in ('calibration', 'uncertainty'):
        section = getattr(lens, name)
        if section is not None:
            document[name] = dict(section)
    return document


def _read_text_and_camera(path: str | Path) -> tuple[str, str]:
    """Return the text of a file and the camera after its name, as in FILE#cam1."""
    file, camera = without_camera(str(path))
    if Path(file).is_dir():
        lenses = _in_folder(Path(file))
        camera = camera or next(iter(lenses))
        if camera not in lenses:
            raise LensError(
                f'{file}: no lens of camera {camera!r} in it; there are ' + ', '.join(lenses)
            )
        file, camera = str(lenses[camera]), ''
    if Path(file).name == _COLMAP_BINARY and Path(file).is_file():
        raise LensError(
            f"{file}: COLMAP's binary form cannot be read; write cameras.txt with "
            'colmap model_converter --output_type TXT'
        )
    return read_text(file, LensError, MAX_LENS_BYTES), camera


def _in_folder(folder: Path) -> dict[str, Path]:
    """Return the lens files of a rig by camera; raise LensError where there is none."""
    paths: dict[str, Path] = {}
    # Names of cameras may have slashes, and then their files are further down.
    for depth in range(_DEPTH):
        above = '*/' * depth
        paths = (
            paths
            or {
                str(file.relative_to(folder).with_suffix('')): file
                for file in visible_paths(folder.glob(f'{above}*.yaml'))
                if file.stem not in FILES_OF_RIG
            }
            or {
                str(file.parent.relative_to(folder)): file
                for file in sorted(folder.glob(f'{above}*/extended_lens.yaml'))
            }
        )
    if not paths:
        raise LensError(
            f'{folder}: a folder without lenses; those of a rig are CAMERA.yaml or '
            'CAMERA/extended_lens.yaml'
        )
    return paths


def _projection_fields(section: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return what an image height and intrinsics are given by, as fields of a lens."""
    values = dict(section)
    if 'f' in values:
        if 'fx' in values or 'fy' in values:
            raise LensError(f'{where} has both f and fx or fy; keep one of them')
        values['fx'] = values['fy'] = values.pop('f')
    numbers = {name: _number_at(values, name, where) for name in INTRINSICS}
    curve = {name: value for name, value in values.items() if name not in INTRINSICS}
    return {**numbers, 'image_height': _curve(curve, IMAGE_HEIGHTS, 'k', 1, where)}


def _viewpoint_shift(section: Any, where: str) -> ViewpointShift | None:
    """Return a viewpoint shift, or the sum of a list of them."""
    if section is None:
        return None
    parts = section if isinstance(section, list) and section else [section]
    if not all(isinstance(part, dict) for part in parts):
        raise LensError(f'{where}: viewpoint_shift must be a mapping with a model')
    place = f'{where}: viewpoint_shift'
    first, *curves = (_curve(part, VIEWPOINT_SHIFTS, 'e', 0, place) for part in parts)
    return reduce(ViewpointShift.plus, curves, first)


def _tangential(section: Mapping[str, Any] | None, where: str) -> TangentialDistortion | None:
    if section is None:
        return None
    where = f'{where}: corrections.{TANGENTIAL}'
    _refuse_unknown(section, set(TangentialDistortion().values), where)
    return TangentialDistortion(**{name: _number_at(section, name, where) for name in section})


def _curve(
    section: Mapping[str, Any],
    registry: Mapping[str, type[C]],
    listed: str,
    first: int,
    where: str,
) -> C:
    """Return the curve of a section; a list stands for coefficients numbered from `first`."""
    values = dict(section)
    name = values.pop('model', None)
    if not isinstance(name, str) or name not in registry:
        raise LensError(f'{where}.model is {name!r}; choose from {", ".join(registry)}')
    kind = registry[name]
    numbered = _three_numbers(values.pop(listed, []), f'{where}.{listed}')
    names = kind.coefficient_names
    most = sum(name.removeprefix(listed).isdigit() for name in names)
    if len(numbered) > most:
        raise LensError(f'{where}.{listed} has {len(numbered)} values; this model takes {most}')
    values |= {f'{listed}{i}': value for i, value in enumerate(numbered, start=first)}
    _refuse_unknown(values, set(names), where)
    missing = [
        parameter.name
        for parameter in signature(kind).parameters.values()
        if parameter.name in names
        and parameter.default is parameter.empty
        and parameter.name not in values
    ]
    if missing:
        raise LensError(f'{where}: incomplete; add {", ".join(missing)}')
    return kind(**{name: _number_at(values, name, where) for name in values})


def _curve_to_dict(curve: Curve, registry: Registry[Any], listed: str) -> dict[str, Any]:
    values = dict(zip(curve.coefficient_names, curve.coefficients, strict=True))
    numbered = [values.pop(name) for name in tuple(values) if name.removeprefix(listed).isdigit()]
    named = {'model': registry.name_of(type(curve)), **values}
    return {**named, listed: numbered} if numbered else named


def _effects(document: Mapping[str, Any], name: str, where: str) -> dict[str, Any]:
    section = document.get(name) or {}
    wrong = (
        [
            f'.{key}'
            for key, entry in section.items()
            if key != LANDMARKS and not isinstance(entry, dict)
        ]
        if isinstance(section, dict)
        else ['']
    )
    if wrong:
        raise LensError(
            f'{where}: {name}{wrong[0]}: {name} must map each effect name to its '
            'parameters, as in decentering: {parameters: {p1: 0.001, p2: 0.0}}'
        )
    return section


def _mapping(document: Mapping[str, Any], name: str, where: str) -> dict[str, Any] | None:
    section = document.get(name)
    if section is not None and not isinstance(section, dict):
        raise LensError(f'{where}: {name} must be a mapping, is {section!r}')
    return section


def _section(document: Mapping[str, Any], name: str, where: str) -> Mapping[str, Any]:
    section = document.get(name)
    if not isinstance(section, dict):
        raise LensError(f'{where}: {name} is missing; a mapping is needed')
    return section


def _number_at(mapping: Mapping[str, Any], name: str, where: str) -> float:
    value = mapping.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise LensError(f'{where}: {name} is {value!r}; a number is needed')
    if not abs(value) < _MAX_NUMBER:
        raise LensError(
            f'{where}: {name} is {value}; a finite number is needed, below {_MAX_NUMBER:g}'
        )
    return float(value)


def _pixel_count(mapping: Mapping[str, Any], name: str, where: str) -> int:
    value = _number_at(mapping, name, where)
    if not value.is_integer():
        raise LensError(f'{where}: {name} is {value}; a whole number of pixels is needed')
    return int(value)


def _three_numbers(values: Any, where: str) -> list[float]:
    if not isinstance(values, list):
        raise LensError(f'{where} must be a list of numbers, is {values!r}')
    return [_number_at({'value': value}, 'value', where) for value in values]


def _refuse_unknown(
    mapping: Mapping[str, Any], known: set[str], where: str, unsaid: Set[str] = frozenset()
) -> None:
    unknown = sorted(set(map(str, mapping)) - known - unsaid)
    if unknown:
        raise LensError(
            f'{where}: unknown field {unknown[0]!r}; choose from ' + ', '.join(sorted(known))
        )
