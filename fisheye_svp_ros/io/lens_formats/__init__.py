"""Lenses as other tools write them: recognised by their content, read and written.

A new format is one module with `recognises`, `read` and, where it can be written, `write`, and one
line in FORMATS.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose

FORMATS = ('kalibr', 'ros', 'opencv', 'basalt', 'mrcal', 'boofcv', 'transforms', 'rig')
WRITABLE = FORMATS[:-3]


class Foreign(NamedTuple):
    """What a file of another tool holds.

    form: of the file; lenses by camera; rigs: each camera in the next one; worst_px: how far each
    lens is from what the file says.
    """

    form: str
    lenses: dict[str, Lens]
    rigs: tuple[Pose, ...]
    worst_px: dict[str, float]


def read_foreign(path: str | Path, text: str) -> Foreign | None:
    """Return the lenses in a file of another tool, None where no format knows its content.

    Raises LensError, naming file and field, for a file that is incomplete.
    """
    for name in FORMATS:
        module = import_module(f'{__name__}.{name}')
        if module.recognises(text):
            read: Callable[[str, str], Foreign] = module.read
            return read(text, str(path))
    return None


def write_foreign(lens: Lens, form: str) -> str:
    """Return a lens in another tool's form; a viewpoint shift stays behind, but for mrcal.

    Raises LensError for a lens that the form cannot say to a hundredth of a pixel.
    """
    if form not in WRITABLE:
        raise LensError(f'format {form!r} is unknown; known are {", ".join(WRITABLE)}')
    text: str = import_module(f'{__name__}.{form}').write(lens)
    return text
