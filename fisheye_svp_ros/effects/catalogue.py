"""The registry of effects: one word each.

A distribution of the user's own adds effects by entry points in the group
`fisheye_svp_ros.effects`, each under the name that its class has.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

from fisheye_svp_ros.effects.base import Effect, Term
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.registry import Registry

_MODULES = (  # of this folder, each with the effect of its name: DotCentroidEffect and so on
    'viewpoint_shift', 'radial_profile', 'focal_length', 'principal_point', 'aspect', 'skew',
    'decentering', 'sensor_tilt', 'flat_port', 'focal_drift', 'session_step', 'landmark_survey',
    'landmark_scale', 'target_shape', 'board_pose', 'dot_centroid', 'detector_bias',
    'rolling_shutter', 'stereo_time_offset', 'rig_flex', 'wrong_ids', 'quantisation',
    'noise_vs_angle',
)


def _effect(name: str) -> type[Effect]:
    module = import_module(f'fisheye_svp_ros.effects.{name}')
    kind: type[Effect] = getattr(module, f'{name.title().replace("_", "")}Effect')
    return kind


# Not tested for: only stated by the user, or named as what a cause may be mistaken for.
_LOOK_ALIKES = ('dome_port',)
CATALOGUE: Registry[type[Effect]] = Registry(
    'effects', {name: _effect(name) for name in _MODULES}, Effect,
    {name: _effect(name) for name in _LOOK_ALIKES})


def load_effects(entries: Mapping[str, Any], where: str) -> tuple[Term, ...]:
    """Return the effects of a lens's mapping and their values.

    Raises LensError, naming `where` and the effect, for an unknown or incomplete one.
    """
    terms = []
    for name, entry in entries.items():
        if name not in CATALOGUE:
            known = ', '.join(CATALOGUE)
            raise LensError(f'{where}: effect {name!r} is unknown; known are {known}')
        terms.append(CATALOGUE[name].from_dict(entry, where))
    return tuple(terms)
