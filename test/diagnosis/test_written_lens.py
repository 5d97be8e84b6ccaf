"""The lens that is written: averaged over the likely models."""

from __future__ import annotations

import pytest
from helpers.water import AIR, photographs

from fisheye_svp_ros.diagnosis import Diagnosis, DiagnosisOptions, Reason, diagnose
from fisheye_svp_ros.diagnosis.averaging import AveragedEffect
from fisheye_svp_ros.diagnosis.lens_evidence import find_lens_rays
from fisheye_svp_ros.diagnosis.model_errors import LensErrors
from fisheye_svp_ros.diagnosis.posterior import EffectPosterior
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.optics.curves import Gennery
from fisheye_svp_ros.reporting.diagnosis_document import diagnosis_document
from fisheye_svp_ros.reporting.wording.first_screen import first_screen


def diagnosed(e0: float, noise: float, seed: int = 0, **settings: object) -> Diagnosis:
    """Diagnose eight photographs through a lens with a shift as those of one without."""
    seen = photographs(AIR.with_shift(Gennery(0.0, e0)), None, 8, noise, seed)
    return diagnose(seen, AIR, free_intrinsics=True, **settings)  # type: ignore[arg-type]


def shift_of(found: Diagnosis) -> AveragedEffect:
    """Return the shift that is written and not named."""
    (shift,) = (
        one
        for one in found.evaluation.averaged_model.effects
        if one.effect.name == 'viewpoint_shift'
    )
    return shift


def test_a_shift_that_is_likely_and_not_named_is_written_in_part() -> None:
    found = diagnosed(0.004, 0.1)
    assert not found.causes
    shift = shift_of(found)
    assert 0.2 < shift.weight < 1
    written = found.lens.viewpoint_shift
    assert isinstance(written, Gennery) and written.e0 == pytest.approx(shift.values[0])
    assert abs(written.e0 - 0.004) < 1.5 * shift.stderr[0] < 6e-3
    known = found.lens.uncertainty
    assert known is not None
    assert known['averaged_effects'][0]['probability'] == pytest.approx(shift.weight)
    at = known['parameters'].index('e0')
    assert known['covariance'][at][at] == pytest.approx(shift.stderr[0] ** 2, rel=1e-6)
    told = diagnosis_document(found)['lens']['averaged_effects'][0]
    assert told['effect'] == 'viewpoint_shift'
    assert told['parameters']['e0']['value'] == pytest.approx(shift.values[0])


def test_the_intrinsics_follow_the_shift_that_is_written() -> None:
    """The mean over all models: of those with a shift, focal lengths that go with it."""
    found = diagnosed(0.004, 0.1)
    averaged, null = found.evaluation.averaged_model, found.evaluation.null
    has = averaged.models.there[:, averaged.posterior.has('viewpoint_shift')].any(axis=1)
    weight = averaged.models.weight
    moved = averaged.linear.state.lens.fx - null.linear.state.lens.fx
    assert moved == pytest.approx(weight @ averaged.changes[:, 0], rel=1e-6)
    with_shift, without = (
        float(weight[rows] @ averaged.changes[rows, 0] / weight[rows].sum())
        for rows in (has, ~has)
    )
    assert abs(with_shift) > 3 * abs(without)


def test_nothing_is_added_where_the_data_speak_against_it_or_the_user_does() -> None:
    clean = diagnosed(0.0, 0.02)
    assert abs(getattr(clean.lens.viewpoint_shift, 'e0', 0.0)) < 5e-5
    options = DiagnosisOptions(left_out=('viewpoint_shift',))
    closed = diagnosed(0.004, 0.1, options=options)
    assert closed.lens.viewpoint_shift is None
    names = [one.effect.name for one in closed.evaluation.averaged_model.effects]
    assert 'viewpoint_shift' not in names


def test_a_named_shift_is_written_about_as_it_is_named() -> None:
    found = diagnosed(0.004, 0.05)
    assert [cause.effect for cause in found.causes] == ['viewpoint_shift']
    named = found.causes[0].parameters['e0']
    written = found.lens.viewpoint_shift
    assert isinstance(written, Gennery)
    assert abs(written.e0 - named['value']) < named['stderr']


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
    assert 'e0' in LensErrors.from_lens(found.lens).model.names
    assert found.lens.uncertainty is not None
    stated = found.ray_error_mrad()
    assert found.lens.uncertainty['ray_error_mrad'] == {
        side: stated[side] for side in ('given', 'extended')
    }


def test_a_refuted_shift_is_in_no_model() -> None:
    null = diagnosed(0.004, 0.1).evaluation.null
    assert EffectPosterior.of_null_model(null).probabilities['viewpoint_shift'] > 0.2
    refuted = EffectPosterior.of_null_model(null, refuted=('viewpoint_shift',))
    assert 'viewpoint_shift' not in refuted.probabilities


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
    assert found.lens.viewpoint_shift is None
