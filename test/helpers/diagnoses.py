"""Diagnoses with other figures than those that were found."""

from dataclasses import replace

from fisheye_svp_ros.diagnosis.evaluation import Figures


def with_changes(found, **changes):
    """Return a diagnosis with other fields, those of its figures among them."""
    figures = {name: changes.pop(name) for name in Figures._fields if name in changes}
    return replace(found, figures=found.figures._replace(**figures), **changes)
