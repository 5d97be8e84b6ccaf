"""BoofCV's YAML of its universal omnidirectional model, by a fit."""

from __future__ import annotations

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.documents import parse_yaml
from fisheye_svp_ros.io.lens_formats import Foreign, radial
from fisheye_svp_ros.io.lens_formats.distortion import Distortion, nearest_lens


def recognises(text: str) -> bool:
    """Say whether a text is such a file."""
    return 'omnidirectional_universal' in text and 'mirror_offset' in text


def read(text: str, where: str) -> Foreign:
    """Read the lens; raises LensError, naming what is missing."""
    document = parse_yaml(text, where, LensError)
    try:
        pinhole, distortion = document['pinhole'], document['radial_tangential']
        size = float(pinhole['width']), float(pinhole['height'])
        intrinsics = [float(pinhole[name]) for name in ('fx', 'fy', 'cx', 'cy')]
        base = radial.omnidirectional(float(document['mirror_offset']))
        skew, t1, t2 = (float(given.get(name, 0.0)) for given, name in (
            (pinhole, 'skew'), (distortion, 't1'), (distortion, 't2')))
        bent = Distortion(base, [float(k) for k in distortion['radial']], (), (t1, t2))
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as cause:
        raise LensError(f'{where}: not a whole BoofCV model ({cause!r})') from cause
    lens, worst = nearest_lens('camera', size, (*intrinsics, skew), bent, where)
    return Foreign('BoofCV', {'camera': lens}, (), {'camera': worst})
