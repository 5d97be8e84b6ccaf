"""Standard errors of what is shared: of the model, between frames, of other likely models.

And what is known of the parameters of the lens that is written.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.averaging import AveragedModel, fitted_covariance
from fisheye_svp_ros.diagnosis.null_model import NullModel, cluster_frames
from fisheye_svp_ros.diagnosis.posterior import EffectPosterior
from fisheye_svp_ros.diagnosis.written_lens import CameraField
from fisheye_svp_ros.solve.ray_errors import SAMPLES
from fisheye_svp_ros.solve.rig_state import Linearization

_PRIOR_FREEDOM = 16.0  # frames that say that errors are as the model has them
_SEED = 0


def total_errors(null: NullModel, averaged: AveragedModel | None = None) -> Array:
    """Return the standard errors (K,) of all that is shared, other likely models allowed for.

    averaged: over these, where they are known already.
    """
    if averaged is None:
        averaged = AveragedModel.of_posterior(EffectPosterior.of_null_model(null))
    return np.hypot(standard_errors(null), averaged.added_errors())


def errors_of_named_models(null: NullModel) -> Array:
    """Return what other models with named effects add to standard errors (K,) of what is shared.

    Without smooth fields and walks beside them, which change little of it and take most of the
    time of a search over models.
    """
    return AveragedModel.of_posterior(
        EffectPosterior.of_null_model(null, quick=True)
    ).added_errors()


def standard_errors(null: NullModel, jackknife: bool = True) -> Array:
    """Return the standard errors (K,) of all that is shared: rig, intrinsics, effects.

    From the information of the null model; where estimates without each of the frames change by
    more than that allows, as much larger (a jackknife, beside what it should be: a frame on which
    much depends may change much).  Frames of similar poses, which may err alike, are left out
    together.
    NaN where the data leave a parameter open.
    """
    own, reported = null.included_columns, _reporting_matrix(null)
    estimate, covariance, open_ = _estimate(null.information, own, reported)
    variance = np.diag(covariance).copy()
    if jackknife and null.linear.data.frames > 2:
        changed, allowed = np.zeros(null.column_count), np.zeros(null.column_count)
        for part in null.information_without_poses(np.append(own, len(null.scale))):
            other, wider, lost = _estimate(part, own, reported)
            changed += np.where(lost, 0.0, (other - estimate) ** 2)
            allowed += np.where(lost, 0.0, np.diag(wider - covariance))
        least = np.maximum(1e-9 * variance, 1e-300)  # nothing is known of what the data leave open
        variance = variance * np.maximum(changed / np.maximum(allowed, least), 1.0)
    errors = np.sqrt(variance) / null.scale[: null.column_count]
    return np.where(open_, np.nan, errors)


def _reporting_matrix(null: NullModel) -> Array:
    """Return what makes coefficients (X,), normalized, those that are reported: (X, X)."""
    found = np.eye(len(null.scale))
    for term in null.terms:
        columns, scale = term.columns, null.scale[term.columns]
        own = term.effect.report_values(np.eye(len(columns)))
        found[np.ix_(columns, columns)] = scale[:, None] * own / scale
    return found


def _estimate(information: Array, included: Index, reported: Array) -> tuple[Array, Array, Array]:
    """Return estimates (K,), covariance (K, K) of what is included, normalized, what is open."""
    if not len(included):
        return np.zeros(0), np.zeros((0, 0)), np.zeros(0, dtype=bool)
    values, vectors = np.linalg.eigh(information[np.ix_(included, included)])
    kept = values > 1e-12 * max(float(values[-1]), 1e-300)
    seen = reported[np.ix_(included, included)] @ vectors
    estimate = seen[:, kept] @ (vectors[:, kept].T @ information[included, -1] / values[kept])
    covariance = (seen[:, kept] / values[kept]) @ seen[:, kept].T
    return estimate, covariance, np.asarray((seen[:, ~kept] ** 2).sum(axis=1) > 1e-6)


@dataclass(frozen=True)
class LensCovariance:
    """What is known of the parameters of the lens that is written.

    linear: the written model; covariance (N, N) of all that it shares, by the fitted model; others
    (N, SAMPLES): by what they are off where another model is true, drawn; ratios (K,): by how much
    standard errors are larger than by the fitted model, as frames left out say; place (K,): where
    what that model shares stands among the N; freedom: degrees of freedom of the size of these
    errors.
    """

    linear: Linearization
    covariance: Array
    others: Array
    ratios: Array
    place: Index
    freedom: float = inf

    @classmethod
    def from_model(cls, null: NullModel, averaged: AveragedModel, quick: bool) -> LensCovariance:
        """Gather what is known of a written model; quick: frames left out are not asked.

        What few of them say is a sample, too: it counts beside a prior that the errors are as the
        model has them, worth `_PRIOR_FREEDOM` frames.
        Source: Smyth, Linear models and empirical Bayes methods for assessing differential
        expression, Statistical Applications in Genetics and Molecular Biology 3 (2004).
        """
        least = fitted_covariance(null)
        known = np.maximum(np.sqrt(np.diag(least)), 1e-300)
        errors = np.nan_to_num(standard_errors(null, jackknife=not quick))
        clusters = float(cluster_frames(null.linear).max())  # less one
        freedom = clusters + _PRIOR_FREEDOM
        squares = np.maximum(errors / known, 1.0) ** 2
        ratios = np.sqrt((clusters * squares + _PRIOR_FREEDOM) / freedom)
        ratios = np.where(np.diag(least) > 0, ratios, 0.0)
        others = averaged.draw(np.random.default_rng(_SEED), SAMPLES)
        covariance = np.zeros((len(others), len(others)))
        covariance[np.ix_(averaged.place, averaged.place)] = least * np.outer(ratios, ratios)
        return cls(averaged.linear, covariance, others, ratios, averaged.place, freedom)

    def with_field(self, known: CameraField) -> tuple[Array, Array]:
        """Return the covariance (2 Q, 2 Q), px^2, of a field; with what is shared (N, 2 Q)."""
        cross = np.zeros((len(self.covariance), len(known.root)))
        cross[self.place] = self.ratios[:, None] * known.shared @ known.root.T
        return known.root @ known.root.T, cross
