"""The rig file of this package: one camera in the other, and no lenses."""

from __future__ import annotations

import re

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.documents import parse_yaml
from fisheye_svp_ros.io.lens_formats import Foreign, fields

_FIRST_IN_SECOND = re.compile(r'^\w+_in_\w+ *:', re.MULTILINE)


def recognises(text: str) -> bool:
    """Say whether a text is such a file."""
    return _FIRST_IN_SECOND.search(text) is not None


def read(text: str, where: str) -> Foreign:
    """Read position, m, and quaternion x, y, z, w; raises LensError, naming the field."""
    document = parse_yaml(text, where, LensError)
    name = next((name for name in map(str, document) if '_in_' in name), 'left_in_right')
    entry = fields.section(document, name, where)
    where = f'{where}: {name}'
    place = fields.numbers(entry, 'position', 3, where)
    turn = fields.numbers(entry, 'quaternion', 4, where)
    return Foreign('rig', {}, (fields.pose(place, turn, where),), {})
