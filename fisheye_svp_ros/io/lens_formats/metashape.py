"""Agisoft Metashape's XML: fisheye calibrations as they stand or by a fit, frame cameras by a fit.

cx and cy are from the middle of the image, which begins at 0; p1 and p2 are OpenCV's p2 and p1.
Read are calibration files and the cameras of an exported project.
"""

from __future__ import annotations

import re
from xml.etree.ElementTree import Element

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.files import parse_number
from fisheye_svp_ros.io.lens_formats import Foreign, fields, models
from fisheye_svp_ros.optics.lens import Lens

_MARKS = re.compile(r'<calibration[ >].*<(projection|resolution)[ >]', re.DOTALL)
_BASES = {
    'frame': models.PERSPECTIVE,
    'fisheye': models.EQUIDISTANT,
    'equidistant_fisheye': models.EQUIDISTANT,
    'equisolid_fisheye': models.EQUISOLID,
}
_NAMES = ('f', 'cx', 'cy', 'b1', 'b2', 'k1', 'k2', 'k3', 'k4', 'p1', 'p2', 'p3', 'p4')


def recognises(text: str) -> bool:
    """Say whether a text is such a file."""
    return '<opencv_storage>' not in text and _MARKS.search(text) is not None


def read(text: str, where: str) -> Foreign:
    """Read the lens, or those of all sensors; raises LensError, naming the field."""
    root = fields.xml(text, where, 'Metashape calibration')
    values = (
        [root]
        if root.tag == 'calibration'
        else [
            element
            for element in root.iter('calibration')
            if element.get('class', 'adjusted') == 'adjusted'
        ]
    )
    if not values:
        raise LensError(f'{where}: no adjusted calibration in it; align the photographs first')
    names = ['camera'] if len(values) == 1 else [f'sensor{i}' for i in range(len(values))]
    return Foreign.from_lenses(
        'Metashape',
        {
            name: _metashape_lens(name, element, f'{where}: {name}' if len(values) > 1 else where)
            for name, element in zip(names, values, strict=True)
        },
    )


def _metashape_lens(name: str, calibration: Element, where: str) -> tuple[Lens, float]:
    projection = calibration.findtext('projection') or calibration.get('type', '')
    if projection not in _BASES:
        raise LensError(
            f'{where}: projection is {projection!r}; those that can be read are '
            f'{", ".join(_BASES)}'
        )
    resolution = calibration.find('resolution')
    words = (
        {tag: calibration.findtext(tag) for tag in ('width', 'height')}
        if (resolution is None)
        else dict(resolution.attrib)
    )
    words |= {tag: calibration.findtext(tag, '0') for tag in _NAMES}
    values = {}
    for tag in ('width', 'height', *_NAMES):
        try:
            values[tag] = parse_number(words.get(tag) or '')
        except ValueError as cause:
            raise LensError(f'{where}: {tag} is {words.get(tag)!r}; a number is needed') from cause
    width, height = values['width'], values['height']
    f, b1, b2 = values['f'], values['b1'], values['b2']
    distortion = models.Distortion(
        _BASES[projection],
        [values[f'k{i}'] for i in range(1, 5)],
        (),
        (values['p2'], values['p1']),
        (values['p3'], values['p4']),
    )
    middle = width / 2 + values['cx'] - 0.5, height / 2 + values['cy'] - 0.5
    return models.nearest_lens(name, (width, height), (f + b1, f, *middle, b2), distortion, where)
