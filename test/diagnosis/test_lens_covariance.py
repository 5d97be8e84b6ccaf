"""What is known of the rays of a lens, other likely models allowed for."""

from dataclasses import replace
from functools import reduce
from types import SimpleNamespace

import numpy as np
from helpers.scenes import lens, observe, scene

from benchmark.study import ray_error
from fisheye_svp_ros.diagnosis import NullModel, lens_evidence
from fisheye_svp_ros.diagnosis.averaging import AveragedModel
from fisheye_svp_ros.diagnosis.lens_evidence import _distances
from fisheye_svp_ros.diagnosis.null_model import cluster_frames
from fisheye_svp_ros.diagnosis.posterior import EffectPosterior
from fisheye_svp_ros.diagnosis.problem import extended_lenses
from fisheye_svp_ros.diagnosis.uncertainty import LensCovariance, standard_errors, total_errors
from fisheye_svp_ros.effects.base import ModelTerm
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.solve.bundle_adjustment import adjust
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.ray_errors import ray_model, typical_points
from fisheye_svp_ros.solve.rig_state import group_by_frame

SIGMA = 0.01
CENTER = ('cx', 'cy')


def stated_mrad(known, given, table, uv):
    """Return the expected error of the rays at 1 m."""
    frames = np.zeros((known.linear.data.frames, 6))

    def extend_lens(step):
        state = known.linear.state.retract(known.linear.free, frames, step)
        return extended_lenses({'': given}, state, table)['']

    model, _ = ray_model(extend_lens, known.covariance, uv, others=known.others)
    return 1e3 * model.errors()[1].value


def test_effects_that_hide_each_other_move_rays_less_than_parameters():
    """A tilt, which is not named, undoes what its decentering does to the center: not to rays."""
    rng = np.random.default_rng(31)
    pose, views = scene(rng, frames=16)
    terms = [
        ModelTerm(CATALOGUE['decentering'](), np.array([1e-3, 0.0])),
        ModelTerm(CATALOGUE['sensor_tilt'](), np.array([-5e-3, 0.0])),
    ]
    table = observe(lens(), terms, pose, views, SIGMA, rng)
    data = group_by_frame(table)
    begin = replace(initial_state(data, lens()), terms=(ModelTerm(terms[0].effect, np.zeros(2)),))
    null = NullModel.estimate(data, adjust(data, begin, CENTER), CENTER)
    uv = typical_points(data.views.uv[data.views.used])
    truth = reduce(lambda one, term: term.effect.extend(one, term.values), terms, lens())
    averaged = AveragedModel.of_posterior(EffectPosterior.of_null_model(null))
    fitted = extended_lenses({'': lens()}, averaged.linear.state, table)['']
    off = ray_error(fitted, truth, uv, (1.0,))
    known = LensCovariance.from_model(null, averaged, quick=False)
    stated = stated_mrad(known, lens(), table, uv)
    assert off / 3 < stated < 3 * off
    alone = np.zeros(len(known.others))
    alone[averaged.place] = total_errors(null, averaged) ** 2
    parameters_alone = replace(known, covariance=np.diag(alone), others=0 * known.others)
    assert stated_mrad(parameters_alone, lens(), table, uv) > 3 * stated


def test_what_few_frames_left_out_say_is_a_sample_too():
    """With five to eight photographs errors were stated up to 1.7 times as large as they were."""
    rng = np.random.default_rng(5)
    pose, views = scene(rng, frames=6)
    data = group_by_frame(observe(lens(), [], pose, views, SIGMA, rng))
    null = NullModel.estimate(data, adjust(data, initial_state(data, lens()), CENTER), CENTER)
    averaged = AveragedModel.of_posterior(EffectPosterior.of_null_model(null))
    known = LensCovariance.from_model(null, averaged, quick=False)
    said = standard_errors(null) / standard_errors(null, jackknife=False)
    assert known.freedom == cluster_frames(null.linear).max() + 16
    assert said.max() > 1.05 and (known.ratios < said)[said > 1.05].all()
    assert (known.ratios >= 1).all()


def test_without_noise_a_lens_is_as_far_off_as_its_parameters_say():
    """Of a simulator's truth, say: four parameters move all rays, and nothing else does."""
    rng = np.random.default_rng(3)
    columns = rng.normal(size=(300, 3, 4))
    samples = columns @ rng.normal(size=(4, 1000))
    distance, drawn = _distances(3e-3 * columns[..., 0], 1e-3 * samples, 1e-12)
    assert 2 < distance < 4
    assert 1.5 < np.sqrt(np.mean(drawn**2)) < 2.5


def test_a_lens_of_the_same_table_is_not_to_be_calibrated_again():
    """Generalized least squares keeps away from the fit without causes, and is not off for it."""
    rng = np.random.default_rng(0)
    table = replace(observe(lens(), (), *scene(rng), SIGMA, rng), source='a/corners.csv')
    frames = len(table.frames)

    def is_same(source, frames=frames, rms_px=0.2):
        evaluation = SimpleNamespace(
            problem=SimpleNamespace(observations=table),
            figures=SimpleNamespace(base=SimpleNamespace(rms_px=0.2)),
        )
        block = {'source': source, 'frames': frames, 'rms_px': rms_px}
        return lens_evidence._is_of_these_data(evaluation, replace(lens(), calibration=block))

    assert is_same('b/corners.csv') and not is_same('b/corners.csv', frames + 1)
    assert not is_same('other.csv') and is_same('observations')
    assert not is_same('observations', rms_px=0.21)
