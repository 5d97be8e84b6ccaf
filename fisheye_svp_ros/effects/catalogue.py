"""The registry of effects.

A distribution of the user's own adds effects by entry points in the group
`fisheye_svp_ros.effects`, each under the name that its class has.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fisheye_svp_ros.effects import detection_effects as detection
from fisheye_svp_ros.effects import image_effects as image
from fisheye_svp_ros.effects import pose_effects as pose
from fisheye_svp_ros.effects import ray_effects as ray
from fisheye_svp_ros.effects import recording_effects as recording
from fisheye_svp_ros.effects import target_effects as target
from fisheye_svp_ros.effects.base import Effect, ModelTerm
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.registry import Registry

_KINDS: tuple[type[Effect], ...] = (
    ray.ViewpointShiftEffect,
    ray.RadialProfileEffect,
    image.FocalLengthEffect,
    image.PrincipalPointEffect,
    image.AspectEffect,
    image.SkewEffect,
    image.DecenteringEffect,
    image.SensorTiltEffect,
    ray.PupilDecenteringEffect,
    ray.FlatPortEffect,
    recording.FocalDriftEffect,
    recording.SessionStepEffect,
    target.LandmarkSurveyEffect,
    target.LandmarkScaleEffect,
    target.TargetShapeEffect,
    target.BoardPoseEffect,
    detection.DotCentroidEffect,
    detection.DetectorBiasEffect,
    pose.RollingShutterEffect,
    pose.StereoTimeOffsetEffect,
    pose.RigFlexEffect,
    detection.WrongIdsEffect,
    detection.QuantisationEffect,
    detection.NoiseVsAngleEffect,
)
# Not tested for: only stated by the user, or named as what a cause may be mistaken for.
_LOOK_ALIKES: tuple[type[Effect], ...] = (ray.DomePortEffect,)
CATALOGUE: Registry[type[Effect]] = Registry(
    'effects',
    {kind.name: kind for kind in _KINDS},
    Effect,
    {kind.name: kind for kind in _LOOK_ALIKES},
)


def load_effects(entries: Mapping[str, Any], where: str) -> tuple[ModelTerm, ...]:
    """Return the effects of a lens's mapping and their values.

    Raises LensError, naming `where` and the effect, for an unknown or incomplete one.
    """
    terms = []
    for name, entry in entries.items():
        if name not in CATALOGUE:
            names = ', '.join(CATALOGUE)
            raise LensError(f'{where}: effect {name!r} is unknown; choose from {names}')
        terms.append(ModelTerm(*CATALOGUE[name].from_dict(entry, where)))
    return tuple(terms)
