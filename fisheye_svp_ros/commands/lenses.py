"""`--lens`: one lens, or one for each camera of a rig (left=... right=...)."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING

from fisheye_svp_ros.errors import LensError

if TYPE_CHECKING:
    from fisheye_svp_ros.optics.lens import Lens


def add_lens_argument(parser: argparse.ArgumentParser, purpose: str = '') -> None:
    """Declare --lens, which may be given once a camera."""
    parser.add_argument('--lens', required=True, action='append', metavar='[CAMERA=]LENS',
                        help=f'{purpose}a lens file, also of other tools, or the name of one that '
                        'comes with the package; left=LENS and right=LENS for a rig')


def load_lenses(given: Sequence[str]) -> dict[str, Lens]:
    """Return the lenses of --lens by camera; '' is the lens of every camera without its own.

    Raises LensError for a lens that cannot be read, and for two of one camera.
    """
    from fisheye_svp_ros.io.lens_files import load_lens
    from fisheye_svp_ros.io.share import lens_path

    lenses: dict[str, Lens] = {}
    for text in given:
        camera, equals, path = text.partition('=')
        camera, path = (camera, path) if equals else ('', text)
        if camera in lenses:
            raise LensError(f'--lens {text}: there is one {camera or "without a camera"} already')
        lenses[camera] = load_lens(lens_path(path))
    return lenses


def lenses_of(cameras: Sequence[str], lenses: dict[str, Lens]) -> dict[str, Lens]:
    """Return the lens of each camera of the observations.

    Raises LensError for a camera without a lens, and for a name that is no camera of theirs.
    """
    unknown = [camera for camera in lenses if camera and camera not in cameras]
    if unknown:
        held = ', '.join(filter(None, cameras)) or 'one camera without a name'
        raise LensError(f'--lens {unknown[0]}=...: the observations hold {held}')
    for camera in cameras:
        if camera not in lenses and '' not in lenses:
            raise LensError(f'camera {camera or "without a name"} has no lens; add '
                            f'--lens {camera + "=" if camera else ""}LENS')
    return {camera: lenses.get(camera) or lenses[''] for camera in cameras}
