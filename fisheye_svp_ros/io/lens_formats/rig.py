"""The rig file of this package: each camera in the next one, and no lenses."""

from __future__ import annotations

import itertools
import re

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.documents import parse_yaml
from fisheye_svp_ros.io.lens_formats import Foreign, fields

_POSE_KEY = re.compile(r'^\w+_in_\w+ *:', re.MULTILINE)


def recognises(text: str) -> bool:
    """Say whether a text is such a file."""
    return _POSE_KEY.search(text) is not None


def read(text: str, where: str) -> Foreign:
    """Read position, m, and quaternion x, y, z, w; raises LensError, naming the field."""
    document = parse_yaml(text, where, LensError)
    names = [name for name in map(str, document) if '_in_' in name] or ['left_in_right']
    rigs = []
    for name in names:
        entry, place = fields.section(document, name, where), f'{where}: {name}'
        rigs.append(fields.pose(fields.numbers(entry, 'position', 3, place),
                                fields.numbers(entry, 'quaternion', 4, place), place))
    for one, other in itertools.pairwise(names):
        if one.partition('_in_')[2] != other.partition('_in_')[0]:
            raise LensError(f'{where}: {other} does not continue where {one} ends')
    cameras = (*(name.partition('_in_')[0] for name in names), names[-1].partition('_in_')[2])
    return Foreign('rig', {}, tuple(rigs), {}, cameras)
