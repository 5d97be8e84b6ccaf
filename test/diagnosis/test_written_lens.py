"""The lens that is written: averaged over the models with and without a viewpoint shift."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.water import AIR, photographs

from fisheye_svp_ros.diagnosis import Diagnosis, DiagnosisOptions, Reason, diagnose
from fisheye_svp_ros.diagnosis.lens_evidence import find_lens_rays
from fisheye_svp_ros.diagnosis.model_errors import LensErrors
from fisheye_svp_ros.diagnosis.written_lens import (
    PRIOR_ODDS,
    SHIFT_SIGMA,
    AveragedModel,
    OpenShifts,
)
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.optics.curves import Gennery
from fisheye_svp_ros.reporting.diagnosis_document import diagnosis_document
from fisheye_svp_ros.reporting.wording.first_screen import first_screen


def diagnosed(e0: float, noise: float, seed: int = 0, **settings: object) -> Diagnosis:
    """Diagnose eight photographs through a lens with a shift as those of one without."""
    seen = photographs(AIR.with_shift(Gennery(0.0, e0)), None, 8, noise, seed)
    return diagnose(seen, AIR, free_intrinsics=True, **settings)  # type: ignore[arg-type]


def test_a_shift_that_is_likely_and_not_named_is_written_in_part() -> None:
    found = diagnosed(0.004, 0.1)
    assert not found.causes
    (shift,) = found.evaluation.averaged_model.shifts
    assert PRIOR_ODDS / (1 + PRIOR_ODDS) < shift.weight < 1
    written = found.lens.viewpoint_shift
    assert isinstance(written, Gennery) and written.e0 == pytest.approx(shift.e0)
    assert abs(written.e0 - 0.004) < shift.stderr < SHIFT_SIGMA
    known = found.lens.uncertainty
    assert known is not None and known['averaged_shift']['weight'] == pytest.approx(shift.weight)
    at = known['parameters'].index('e0')
    assert known['covariance'][at][at] == pytest.approx(shift.stderr**2, rel=1e-6)
    assert diagnosis_document(found)['lens']['averaged_shift'][0]['e0'] == pytest.approx(shift.e0)


def test_the_mean_is_that_of_two_models_weighed_by_their_evidence() -> None:
    """Against the marginal likelihoods of whole models, e0 integrated over its prior."""
    found = diagnosed(0.004, 0.1)
    null = found.evaluation.null
    form = next(
        i for i, effect in enumerate(null.fixed.forms.effects) if effect.name == 'viewpoint_shift'
    )
    both = np.append(null.included_columns, null.form_columns(form))
    information = null.information[np.ix_(both, both)].copy()
    score = null.information[both, -1]
    size = SHIFT_SIGMA * null.scale[both[-1]]
    information[-1, -1] += size**-2
    alone = information[:-1, :-1]
    gain = score @ np.linalg.solve(information, score) - score[:-1] @ np.linalg.solve(
        alone, score[:-1]
    )
    logs = np.linalg.slogdet(information)[1] - np.linalg.slogdet(alone)[1] + 2 * np.log(size)
    odds = PRIOR_ODDS * np.exp((gain - logs) / 2)
    (shift,) = found.evaluation.averaged_model.shifts
    assert shift.weight == pytest.approx(odds / (1 + odds), rel=1e-4)
    estimate = np.linalg.solve(information, score) / null.scale[both]
    assert shift.e0 == pytest.approx(shift.weight * estimate[-1], rel=1e-4)
    moved = found.evaluation.averaged_model.linear.state.lens.fx - null.linear.state.lens.fx
    base = np.linalg.solve(alone, score[:-1]) / null.scale[both[:-1]]
    assert moved == pytest.approx(shift.weight * (estimate[0] - base[0]), rel=1e-3)


def test_nothing_is_added_where_the_data_speak_against_a_shift_or_the_user_does() -> None:
    assert not diagnosed(0.0, 0.05).evaluation.averaged_model.shifts
    assert diagnosed(0.0, 0.05).lens.viewpoint_shift is None
    options = DiagnosisOptions(left_out=('viewpoint_shift',))
    assert not diagnosed(0.004, 0.1, options=options).evaluation.averaged_model.shifts


def test_a_named_shift_is_written_as_it_is_named() -> None:
    found = diagnosed(0.004, 0.05)
    assert [cause.effect for cause in found.causes] == ['viewpoint_shift']
    assert not found.evaluation.averaged_model.shifts
    named = found.causes[0].parameters['e0']['value']
    written = found.lens.viewpoint_shift
    assert isinstance(written, Gennery) and written.e0 == pytest.approx(named)


def test_ray_errors_file_figure_and_summary_are_of_the_lens_that_is_written() -> None:
    found = diagnosed(0.004, 0.1)
    closed = diagnosed(0.004, 0.1, options=DiagnosisOptions(left_out=('viewpoint_shift',)))
    assert found.figures.named.rms_px == pytest.approx(closed.figures.named.rms_px, rel=1e-3)
    assert found.file.extended_px < closed.file.extended_px
    rays = find_lens_rays(found.evaluation, found.lenses)[0]['']
    for one, other in zip(rays['given'], rays['extended'], strict=True):
        assert one.value == pytest.approx(other.value, rel=1e-6)  # no difference to itself
    known, bare = (d.evaluation.uncertainty['image_px'] for d in (found, closed))
    assert known['parameters'] > bare['parameters']
    assert LensErrors.from_lens(found.lens).model.names[-1] == 'e0'
    assert found.lens.uncertainty is not None
    stated = found.ray_error_mrad()
    assert found.lens.uncertainty['ray_error_mrad'] == {
        side: stated[side] for side in ('given', 'extended')
    }


def test_a_refuted_shift_is_not_written() -> None:
    selection = diagnosed(0.004, 0.1).evaluation.selection
    assert OpenShifts.from_selection(selection).effects
    refuted = replace(selection, refuted=('viewpoint_shift',))
    assert not OpenShifts.from_selection(refuted).effects
    assert not AveragedModel.from_selection(refuted).shifts


def test_ray_errors_are_stated_at_the_range_that_is_asked_for() -> None:
    found = diagnosed(0.004, 0.05, options=DiagnosisOptions(range_m=0.5))
    assert found.offers_extended
    rays = found.ray_error['']
    assert [one.range_m for one in rays['given']] == [0.3, 1.0, 5.0, 0.5]
    near, far, _, asked = (one.value for one in rays['extended'])
    assert min(near, far) * 0.8 < asked < max(near, far) * 1.1
    assert 'mrad at 0.5 m' in first_screen(found, 'table').accuracy
    with pytest.raises(ParameterError, match='a distance in m'):
        DiagnosisOptions(range_m=0.0)


def test_a_shift_that_no_lens_can_have_is_not_written(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr('fisheye_svp_ros.diagnosis.findings.MAX_SHIFT', 1e-3)
    found = diagnosed(0.006, 0.02, options=DiagnosisOptions(quick=True))
    reasons = {one.effect: one.reason for one in found.candidates}
    assert reasons['viewpoint_shift'] is Reason.IMPLAUSIBLE
    assert found.lens.viewpoint_shift is None and not found.evaluation.averaged_model.shifts
