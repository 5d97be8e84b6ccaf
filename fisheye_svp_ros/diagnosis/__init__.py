"""Diagnosis: what a simulation gets wrong about measured data, in stages.

    problem          Problem        inputs checked, outliers rejected, the simulation fitted
    null_model       NullModel      variances of random effects (REML, `mixed_model`)
    effect_tests     EffectTests    score tests of the catalogue; where p-values come from
    selection        Selection      causes accepted and given up (`stepwise`), round by round
    fitted_model     FittedModel    estimates, residuals, predicted random effects
    evaluation       Evaluation     held-out prediction, shares of variance, uncertainty
    adequacy         Adequacy       what is wrong with the data, asked before any decision
    diagnosis        Diagnosis      the answer
    stages           diagnose       runs the stages one after another

Other rooms import what stands here, and nothing else.
"""

from fisheye_svp_ros.diagnosis.adequacy import Adequacy
from fisheye_svp_ros.diagnosis.causes import Cause
from fisheye_svp_ros.diagnosis.checks.two_cameras import Transfer, TwoCameras, deviations
from fisheye_svp_ros.diagnosis.checks.two_datasets import Travel, TwoDatasets, predict_board
from fisheye_svp_ros.diagnosis.conclusion import (
    RETAKE,
    TURNED,
    UNLIKE,
    Action,
    Advice,
    frames_of,
)
from fisheye_svp_ros.diagnosis.cross_validation import (
    Comparison,
    compare_errors,
    predict_other_data,
)
from fisheye_svp_ros.diagnosis.decision import (
    MIN_FRAMES,
    Decision,
    EffectBound,
    Figure,
    FileFigure,
    LensFacts,
    LensReason,
    PhotographsFacts,
    PhotographsReason,
    TargetError,
    TargetFacts,
    TargetReason,
)
from fisheye_svp_ros.diagnosis.diagnosis import Diagnosis
from fisheye_svp_ros.diagnosis.effect_tests import CONFOUNDED_P, SIGNIFICANCE, EffectTests
from fisheye_svp_ros.diagnosis.evaluation import MAX_RMS_RATIO, Evaluation
from fisheye_svp_ros.diagnosis.findings import (
    CONFIRMED_PROBABILITY,
    Finding,
    Flaw,
    FlawKind,
    Reason,
    Rival,
    Status,
    status_of,
)
from fisheye_svp_ros.diagnosis.fitted_model import PredictedOffsets
from fisheye_svp_ros.diagnosis.lens_evidence import map_lens_rays
from fisheye_svp_ros.diagnosis.model_errors import (
    ErrorParts,
    LensErrors,
    pose_maps,
    pose_summary,
    resize_uncertainty,
)
from fisheye_svp_ros.diagnosis.null_model import NullModel
from fisheye_svp_ros.diagnosis.problem import DiagnosisOptions, can_be_included
from fisheye_svp_ros.diagnosis.stages import diagnose, diagnose_against
from fisheye_svp_ros.diagnosis.stepwise import NAMED_P
from fisheye_svp_ros.diagnosis.uncertainty import errors_of_named_models, standard_errors
from fisheye_svp_ros.diagnosis.variance_budget import noise_px, stage_shares

__all__ = [
    'CONFIRMED_PROBABILITY',
    'CONFOUNDED_P',
    'MAX_RMS_RATIO',
    'MIN_FRAMES',
    'NAMED_P',
    'RETAKE',
    'SIGNIFICANCE',
    'TURNED',
    'UNLIKE',
    'Action',
    'Adequacy',
    'Advice',
    'Cause',
    'Comparison',
    'Decision',
    'Diagnosis',
    'DiagnosisOptions',
    'EffectBound',
    'EffectTests',
    'ErrorParts',
    'Evaluation',
    'Figure',
    'FileFigure',
    'Finding',
    'Flaw',
    'FlawKind',
    'LensErrors',
    'LensFacts',
    'LensReason',
    'NullModel',
    'PhotographsFacts',
    'PhotographsReason',
    'PredictedOffsets',
    'Reason',
    'Rival',
    'Status',
    'TargetError',
    'TargetFacts',
    'TargetReason',
    'Transfer',
    'Travel',
    'TwoCameras',
    'TwoDatasets',
    'can_be_included',
    'compare_errors',
    'deviations',
    'diagnose',
    'diagnose_against',
    'errors_of_named_models',
    'frames_of',
    'map_lens_rays',
    'noise_px',
    'pose_maps',
    'pose_summary',
    'predict_board',
    'predict_other_data',
    'resize_uncertainty',
    'stage_shares',
    'standard_errors',
    'status_of',
]
