"""Diagnoses with other figures than those that were found; facts that decisions rest on."""

from dataclasses import replace

from fisheye_svp_ros.diagnosis.decision import TargetError, TargetFacts
from fisheye_svp_ros.diagnosis.evaluation import Figures

# A bent board, whose correction is well determined.
TARGET = TargetFacts(
    largest=TargetError('target_shape', 0.81e-3, board=0),
    gain=(0.82, 0.76, 1.0),
    local_px=0.05,
    local_m=4e-5,
    local_p=1e-6,
    pose_error=0.4e-3,
    contradicted=False,
    frames=12,
)


def with_changes(found, **changes):
    """Return a diagnosis with other fields, those of its figures among them."""
    figures = {name: changes.pop(name) for name in Figures._fields if name in changes}
    return replace(found, figures=found.figures._replace(**figures), **changes)
