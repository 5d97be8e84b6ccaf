"""Diagnosis: what a simulation gets wrong about measured data, in stages.

    problem          Problem        inputs checked, outliers rejected, the simulation fitted
    null_model       NullModel      variances of random effects (REML, `mixed_model`)
    effect_tests     EffectTests    score tests of the catalogue; where p-values come from
    selection        Selection      causes accepted and given up (`stepwise`), round by round
    fitted_model     FittedModel    estimates, residuals, predicted random effects
    evaluation       Evaluation     held-out prediction, shares of variance, uncertainty
    diagnosis        Diagnosis      the answer

Other rooms import what stands here, and nothing else.
"""

from fisheye_svp_ros.diagnosis.advice import DIAGNOSE_AIR as DIAGNOSE_AIR
from fisheye_svp_ros.diagnosis.advice import Advice as Advice
from fisheye_svp_ros.diagnosis.calibration import (
    InAir as InAir,
)
from fisheye_svp_ros.diagnosis.calibration import (
    LensTrust as LensTrust,
)
from fisheye_svp_ros.diagnosis.calibration import (
    assess_lens as assess_lens,
)
from fisheye_svp_ros.diagnosis.calibration import (
    calibrate_without_outliers as calibrate_without_outliers,
)
from fisheye_svp_ros.diagnosis.calibration import (
    with_covariance as with_covariance,
)
from fisheye_svp_ros.diagnosis.causes import Cause as Cause
from fisheye_svp_ros.diagnosis.checks.two_cameras import Transfer as Transfer
from fisheye_svp_ros.diagnosis.checks.two_cameras import TwoCameras as TwoCameras
from fisheye_svp_ros.diagnosis.checks.two_cameras import deviations as deviations
from fisheye_svp_ros.diagnosis.checks.two_datasets import SharedParameter as SharedParameter
from fisheye_svp_ros.diagnosis.checks.two_datasets import TwoDatasets as TwoDatasets
from fisheye_svp_ros.diagnosis.cross_validation import (
    Comparison as Comparison,
)
from fisheye_svp_ros.diagnosis.cross_validation import (
    HeldOut as HeldOut,
)
from fisheye_svp_ros.diagnosis.cross_validation import (
    PointResiduals as PointResiduals,
)
from fisheye_svp_ros.diagnosis.cross_validation import (
    known_errors as known_errors,
)
from fisheye_svp_ros.diagnosis.cross_validation import (
    point_residuals as point_residuals,
)
from fisheye_svp_ros.diagnosis.cross_validation import (
    predict_other_data as predict_other_data,
)
from fisheye_svp_ros.diagnosis.diagnosis import Diagnosis as Diagnosis
from fisheye_svp_ros.diagnosis.diagnosis import diagnose as diagnose
from fisheye_svp_ros.diagnosis.diagnosis import diagnose_against as diagnose_against
from fisheye_svp_ros.diagnosis.effect_forms import simplest_form as simplest_form
from fisheye_svp_ros.diagnosis.effect_forms import with_effect as with_effect
from fisheye_svp_ros.diagnosis.effect_tests import SIGNIFICANCE as SIGNIFICANCE
from fisheye_svp_ros.diagnosis.effect_tests import EffectTests as EffectTests
from fisheye_svp_ros.diagnosis.evaluation import Evaluation as Evaluation
from fisheye_svp_ros.diagnosis.evaluation import FitQuality as FitQuality
from fisheye_svp_ros.diagnosis.evaluation import Intrinsic as Intrinsic
from fisheye_svp_ros.diagnosis.fitted_model import FittedModel as FittedModel
from fisheye_svp_ros.diagnosis.fitted_model import PredictedOffsets as PredictedOffsets
from fisheye_svp_ros.diagnosis.fitted_model import refit as refit
from fisheye_svp_ros.diagnosis.fitted_model import rms_px as rms_px
from fisheye_svp_ros.diagnosis.lens_errors import LensErrors as LensErrors
from fisheye_svp_ros.diagnosis.lens_errors import depth_errors as depth_errors
from fisheye_svp_ros.diagnosis.lens_errors import localize_with_errors as localize_with_errors
from fisheye_svp_ros.diagnosis.null_model import NullModel as NullModel
from fisheye_svp_ros.diagnosis.outliers import FRAME as FRAME
from fisheye_svp_ros.diagnosis.outliers import Outliers as Outliers
from fisheye_svp_ros.diagnosis.outliers import find_outliers as find_outliers
from fisheye_svp_ros.diagnosis.problem import (
    MAX_RIG_RATIO as MAX_RIG_RATIO,
)
from fisheye_svp_ros.diagnosis.problem import (
    MIN_SHARED_FRAMES as MIN_SHARED_FRAMES,
)
from fisheye_svp_ros.diagnosis.problem import (
    DiagnosisOptions as DiagnosisOptions,
)
from fisheye_svp_ros.diagnosis.problem import (
    Problem as Problem,
)
from fisheye_svp_ros.diagnosis.problem import (
    can_be_included as can_be_included,
)
from fisheye_svp_ros.diagnosis.problem import (
    free_parameters as free_parameters,
)
from fisheye_svp_ros.diagnosis.problem import (
    is_unrelated as is_unrelated,
)
from fisheye_svp_ros.diagnosis.problem import (
    posable_observations as posable_observations,
)
from fisheye_svp_ros.diagnosis.problem import (
    poses_by_frame as poses_by_frame,
)
from fisheye_svp_ros.diagnosis.problem import (
    remove_copies as remove_copies,
)
from fisheye_svp_ros.diagnosis.problem import (
    rig_lenses as rig_lenses,
)
from fisheye_svp_ros.diagnosis.random_effects import NAMES as NAMES
from fisheye_svp_ros.diagnosis.random_effects import STAGE_OF as STAGE_OF
from fisheye_svp_ros.diagnosis.selection import Selection as Selection
from fisheye_svp_ros.diagnosis.stepwise import NAMED_P as NAMED_P
from fisheye_svp_ros.diagnosis.stepwise import TraceStep as TraceStep
from fisheye_svp_ros.diagnosis.uncertainty import (
    ErrorParts as ErrorParts,
)
from fisheye_svp_ros.diagnosis.uncertainty import (
    ModelErrors as ModelErrors,
)
from fisheye_svp_ros.diagnosis.uncertainty import (
    pose_maps as pose_maps,
)
from fisheye_svp_ros.diagnosis.uncertainty import (
    pose_summary as pose_summary,
)
from fisheye_svp_ros.diagnosis.uncertainty import (
    standard_errors as standard_errors,
)
from fisheye_svp_ros.diagnosis.variance_budget import (
    Component as Component,
)
from fisheye_svp_ros.diagnosis.variance_budget import (
    Structure as Structure,
)
from fisheye_svp_ros.diagnosis.variance_budget import (
    stage_of as stage_of,
)
from fisheye_svp_ros.diagnosis.variance_budget import (
    stage_shares as stage_shares,
)
