"""The registry of effects: one line each.

A distribution of the user's own adds effects by entry points in the group
`fisheye_svp_ros.effects`, each under the name that its class has.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fisheye_svp_ros.effects.aspect import AspectEffect
from fisheye_svp_ros.effects.base import Effect, Term
from fisheye_svp_ros.effects.board_pose import BoardPoseEffect
from fisheye_svp_ros.effects.decentering import DecenteringEffect
from fisheye_svp_ros.effects.detector_bias import DetectorBiasEffect
from fisheye_svp_ros.effects.dot_centroid import DotCentroidEffect
from fisheye_svp_ros.effects.flat_port import FlatPortEffect
from fisheye_svp_ros.effects.focal_drift import FocalDriftEffect
from fisheye_svp_ros.effects.focal_length import FocalLengthEffect
from fisheye_svp_ros.effects.landmark_scale import LandmarkScaleEffect
from fisheye_svp_ros.effects.landmark_survey import LandmarkSurveyEffect
from fisheye_svp_ros.effects.noise_vs_angle import NoiseVsAngleEffect
from fisheye_svp_ros.effects.principal_point import PrincipalPointEffect
from fisheye_svp_ros.effects.quantisation import QuantisationEffect
from fisheye_svp_ros.effects.radial_profile import RadialProfileEffect
from fisheye_svp_ros.effects.rig_flex import RigFlexEffect
from fisheye_svp_ros.effects.rolling_shutter import RollingShutterEffect
from fisheye_svp_ros.effects.sensor_tilt import SensorTiltEffect
from fisheye_svp_ros.effects.session_step import SessionStepEffect
from fisheye_svp_ros.effects.skew import SkewEffect
from fisheye_svp_ros.effects.stereo_time_offset import StereoTimeOffsetEffect
from fisheye_svp_ros.effects.target_shape import TargetShapeEffect
from fisheye_svp_ros.effects.viewpoint_shift import ViewpointShiftEffect
from fisheye_svp_ros.effects.wrong_ids import WrongIdsEffect
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.registry import Registry

CATALOGUE: Registry[type[Effect]] = Registry('effects', {
    effect.name: effect
    for effect in (
        ViewpointShiftEffect,
        RadialProfileEffect,
        FocalLengthEffect,
        PrincipalPointEffect,
        AspectEffect,
        SkewEffect,
        DecenteringEffect,
        SensorTiltEffect,
        FlatPortEffect,
        FocalDriftEffect,
        SessionStepEffect,
        LandmarkSurveyEffect,
        LandmarkScaleEffect,
        TargetShapeEffect,
        BoardPoseEffect,
        DotCentroidEffect,
        DetectorBiasEffect,
        RollingShutterEffect,
        StereoTimeOffsetEffect,
        RigFlexEffect,
        WrongIdsEffect,
        QuantisationEffect,
        NoiseVsAngleEffect,
    )
}, Effect)


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
