"""Where p-values of effects come from: each correction by its formula, and its limit."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.mixed_models import mixed_model
from helpers.water import AIR, photographs
from scipy import stats

from fisheye_svp_ros.diagnosis import effect_tests
from fisheye_svp_ros.diagnosis.effect_tests import (
    SIGNIFICANCE,
    EffectTests,
    HeldOutGain,
    _alternative_gain,
    _cluster_p_value,
    _log_marginal,
    random_gain,
    sum_gains,
)
from fisheye_svp_ros.diagnosis.null_model import NullModel
from fisheye_svp_ros.diagnosis.random_effects import NAMES
from fisheye_svp_ros.effects.catalogue import CATALOGUE
from fisheye_svp_ros.mixed_model import Score, eliminate, no_variances, score_columns
from fisheye_svp_ros.solve.bundle_adjustment import adjust
from fisheye_svp_ros.solve.initial_rig import initial_state
from fisheye_svp_ros.solve.rig_state import group_by_frame

NOISE, SKEW = 0.1, 3e-4


@pytest.fixture(scope='module')
def tests():
    """Return the tests beside a camera that has a little skew, which its model has not."""
    seen = photographs(AIR, None, 10, NOISE, 2)
    uv = seen.uv + np.stack([SKEW * (seen.uv[:, 1] - AIR.cy), np.zeros(len(seen))], axis=-1)
    data = group_by_frame(replace(seen, uv=uv))
    state = adjust(data, initial_state(data, AIR), ())
    nothing = replace(no_variances(len(NAMES), len(np.unique(seen.landmark))), sigma=NOISE)
    return EffectTests(NullModel.linearize(data, state, (), nothing, (), False))


def form_of(tests, name):
    return next(i for i, e in enumerate(tests.null.fixed.forms.effects) if e.name == name)


@pytest.mark.parametrize('name', ['skew', 'radial_profile', 'viewpoint_shift'])
def test_p_values_are_corrected_by_the_effects_and_the_forms_of_each(tests, name):
    """Bonferroni: with one of its forms an effect has as many chances as it has forms."""
    forms = tests.null.fixed.forms
    own = sum(effect.name == name for effect in forms.effects)
    testable = len(CATALOGUE) - len(forms.untestable)
    effect = forms.effects[form_of(tests, name)]
    assert tests.effect_count == testable > 10
    assert tests.correct(effect, 1e-6) == pytest.approx(1e-6 * testable * own)
    assert tests.correct(effect, 0.5) == 1.0


def test_some_effects_have_several_forms(tests):
    """Or the test above holds one factor less."""
    forms = tests.null.fixed.forms
    counts = [sum(e.name == name for e in forms.effects) for name in forms.form_counts]
    assert max(counts) > 1 and list(forms.form_counts.values()) == counts


def test_what_the_estimated_parameters_absorb_is_untestable(tests):
    information = tests.null.information.copy()
    remaining = eliminate(information, tests.null.included_columns)
    absorbed = {
        effect.name
        for form, effect in enumerate(tests.null.fixed.forms.effects)
        if not tests.score(remaining, tests.null.form_columns(form)).rank
    }
    tested = {
        effect.name
        for form, effect in enumerate(tests.null.fixed.forms.effects)
        if tests.score(remaining, tests.null.form_columns(form)).rank
    }
    assert set(tests.untestable) == set(tests.null.fixed.forms.untestable) | (absorbed - tested)


def test_odds_are_by_the_number_of_frames_and_of_effects(tests):
    """BIC, a parameter costs log(frames); one effect of all is expected."""
    score = Score(30.0, 2, 1e-6, np.zeros(2), np.inf)
    expected = 30.0 - 2 * np.log(10) - 2 * np.log(tests.effect_count)
    assert tests.log_odds(score) == pytest.approx(expected)
    few = SimpleNamespace(linear=SimpleNamespace(data=SimpleNamespace(frames=1)))
    assert EffectTests(few).parameter_cost == pytest.approx(np.log(3))


def test_a_score_is_that_of_the_columns_beside_what_is_included(tests):
    null = tests.null
    columns = null.form_columns(form_of(tests, 'skew'))
    found = tests.score_beside(null.included_columns, columns)
    remaining = null.remaining_information(null.information, null.included_columns)
    expected = score_columns(remaining, columns, null.scale, null.variances.sigma**2)
    assert found.statistic == expected.statistic > 20
    assert found.estimate[0] == pytest.approx(SKEW, abs=4 * SKEW / np.sqrt(found.statistic))


def test_candidates_are_ranked_by_what_they_explain_beyond_chance(tests):
    null = tests.null
    own = null.included_columns
    found = tests.candidates(own)
    criteria = [one.criterion for one in found]
    assert criteria == sorted(criteria, reverse=True) and criteria[0] > 100
    for one in found:
        score = tests.score_beside(own, null.form_columns(one.form))
        signs = np.array([parameter.positive for parameter in one.effect.parameters])
        assert (score.estimate[signs] >= 0).all()
        expected = score.statistic - score.rank * np.log(null.full.rows)
        assert one.criterion == pytest.approx(expected)
        assert one.corrected == tests.correct(one.effect, one.score.p_value)
    assert {one.score.rank for one in found} >= {1, 2, 3}
    few = tests.candidates(own, worth=lambda score: score.rank == 1)
    assert {one.score.rank for one in few} == {1}
    promising = [one for one in found if one.corrected < SIGNIFICANCE and one.criterion > 0]
    for one in tests.significant_candidates(own):
        assert one.form in {other.form for other in promising}
        assert one.corrected < SIGNIFICANCE


def test_what_is_in_the_model_is_no_candidate(tests):
    """Nothing of it is left to be tested."""
    own, form = tests.null.included_columns, form_of(tests, 'skew')
    with_it = np.concatenate([own, tests.null.form_columns(form)])
    assert form in {one.form for one in tests.candidates(own)}
    assert form not in {one.form for one in tests.candidates(with_it)}


def test_what_is_significant_is_so_at_one_percent_and_beyond_chance(tests, monkeypatch):
    """1 % for all effects together, and a criterion above zero."""
    (some, *_) = tests.candidates(tests.null.included_columns)
    cases = {(0.0099, 1.0): True, (0.0101, 1.0): False, (0.001, -1.0): False, (0.0, 0.1): True}
    for (corrected, criterion), promising in cases.items():
        one = replace(some, corrected=corrected, criterion=criterion)
        monkeypatch.setattr(EffectTests, 'candidates', lambda *_, one=one: [one])
        monkeypatch.setattr(EffectTests, 'adjust_p_value', lambda self, score, *_: score)
        for adjusted, significant in ((0.0099, promising), (0.0101, False)):
            monkeypatch.setattr(EffectTests, 'correct', lambda *_, p=adjusted: p)
            found = list(tests.significant_candidates(np.arange(0)))
            assert bool(found) == significant
            assert [other.corrected for other in found] == [adjusted] * significant


def test_what_is_left_of_a_column_counts_in_units_of_the_noise_variance():
    """Of a normalized column 1e-8 and less is rounding, whatever the noise."""
    null = SimpleNamespace(scale=np.ones(1), variances=SimpleNamespace(sigma=0.01))
    for left, rank in ((5e-9, 0), (5e-8, 1)):
        information = np.array([[left, left], [left, 1.0]]) / null.variances.sigma**2
        assert EffectTests(null).score(information, np.array([0])).rank == rank


@pytest.mark.parametrize('gain', [7.0, -1.0])
def test_what_differs_by_frame_is_one_variance(tests, monkeypatch, gain):
    """Of the boundary: half the tail of chi-square(1), one parameter however many frames."""
    monkeypatch.setattr(effect_tests, 'random_gain', lambda *_: gain)
    null, form = tests.null, form_of(tests, 'skew')
    effects = list(null.fixed.forms.effects)
    effects[form] = type('Flutter', (type(effects[form]),), {'per_frame': True})()
    fixed = replace(null.fixed, forms=replace(null.fixed.forms, effects=tuple(effects)))
    flutter = EffectTests(replace(null, fixed=fixed))
    (one,) = (one for one in flutter.candidates(null.included_columns) if one.form == form)
    assert one.score.p_value == pytest.approx(stats.chi2.sf(max(gain, 0.0), 1) / 2)
    assert one.criterion == pytest.approx(gain - np.log(null.full.rows))
    without = flutter.candidates(null.included_columns, per_frame=False)
    assert form not in {one.form for one in without}


def test_a_named_effect_has_its_best_form_of_few_parameters(tests):
    own = tests.null.included_columns
    every = [one for one in tests.candidates(own, False) if len(one.effect.parameters) <= 2]
    for found in tests.likeliest_forms(own, ('skew', 'radial_profile'), 2):
        best = max(
            (one for one in every if one.effect.name == found.effect.name),
            key=lambda one: one.criterion,
        )
        assert (found.form, found.corrected) == (best.form, best.corrected)


@pytest.fixture
def adjusted(tests, monkeypatch):
    """Return how a p-value is adjusted, with given freedom, alternative and scatter."""
    null = replace(tests.null, variances=replace(tests.null.variances, covariance=np.eye(1)))
    columns = null.form_columns(form_of(tests, 'skew'))

    def adjust_p(statistic, freedom, gain, cluster, effect=None):
        monkeypatch.setattr(effect_tests, 'satterthwaite_freedom', lambda *_: freedom)
        monkeypatch.setattr(effect_tests, '_alternative_gain', lambda *_: gain)
        monkeypatch.setattr(effect_tests, '_cluster_p_value', lambda *_: cluster)
        score = Score(statistic, 1, stats.chi2.sf(statistic, 1), np.ones(1), np.inf)
        return EffectTests(null).adjust_p_value(score, null.included_columns, columns, effect)

    return adjust_p


SMOOTH, ABRUPT = SimpleNamespace(abrupt=False), SimpleNamespace(abrupt=True)


def test_a_p_value_is_of_an_f_distribution(adjusted):
    """With the degrees of freedom of the information, where chi-square has infinitely many."""
    found = adjusted(5.0, 8.0, 1e9, 0.0, SMOOTH)
    assert found.freedom == 8.0
    assert found.p_value == pytest.approx(stats.f.sf(5.0, 1, 8.0))
    assert found.p_value > 2 * stats.chi2.sf(5.0, 1)


def test_where_it_is_doubtful_other_explanations_count(adjusted):
    """The worst of three, once below 1 %; of a field without a name the first two."""
    own = stats.f.sf(30.0, 1, 50.0)
    assert own < 1e-5
    assert adjusted(30.0, 50.0, 9.0, 0.0, SMOOTH).p_value == pytest.approx(stats.chi2.sf(9.0, 1))
    assert adjusted(30.0, 50.0, 50.0, 0.02, SMOOTH).p_value == 0.02
    assert adjusted(30.0, 50.0, 50.0, 0.0, SMOOTH).p_value == pytest.approx(own)
    assert adjusted(30.0, 50.0, 50.0, 0.02, None).p_value == pytest.approx(own)
    # Above 1 % nothing more is asked.
    assert adjusted(5.0, 50.0, 0.0, 0.5, SMOOTH).p_value == pytest.approx(stats.f.sf(5.0, 1, 50))


def test_what_is_beyond_doubt_is_asked_no_more_but_where_it_is_abrupt(adjusted):
    assert adjusted(199.0, 1e6, 0.0, 0.0, SMOOTH).p_value == 1.0
    assert adjusted(201.0, 1e6, 0.0, 0.5, SMOOTH).p_value < 1e-40
    assert adjusted(201.0, 1e6, 0.0, 0.0, ABRUPT).p_value == 1.0


def test_without_a_covariance_of_variances_a_score_stays_as_it_is(tests):
    bare = EffectTests(
        replace(tests.null, variances=replace(tests.null.variances, covariance=None))
    )
    score = Score(12.0, 1, 0.001, np.ones(1), np.inf)
    assert bare.adjust_p_value(score, np.arange(0), np.arange(1)) is score


def test_gains_of_frames_are_summed_the_largest_as_the_next():
    gains = np.array([1.0, -0.5, 2.0, 30.0])
    found = sum_gains(gains)
    clipped = np.array([1.0, -0.5, 2.0, 2.0])
    assert found.value == pytest.approx(4.5)
    assert found.stderr == pytest.approx(2 * np.std(clipped, ddof=1))
    assert sum_gains(np.array([3.0])) == HeldOutGain(3.0, np.inf)


@pytest.mark.parametrize(
    ('value', 'convincing', 'sufficient'),
    [(1.51, True, True), (1.49, False, True), (1.01, False, True), (0.99, False, False)],
)
def test_a_gain_convinces_by_more_than_its_error(value, convincing, sufficient):
    for unit in (1.0, 7.0):
        gain = HeldOutGain(value * unit, unit)
        assert (gain.convincing, gain.sufficient) == (convincing, sufficient)


def test_a_marginal_likelihood_is_the_ratio_of_densities():
    """Of y with columns of a normal prior to y without, the included ones fitted."""
    rng = np.random.default_rng(1)
    columns, prior = rng.normal(size=(20, 4)), np.diag([0.5, 2.0])
    y = columns @ [1.0, -1.0, 0.4, 0.3] + rng.normal(size=20)
    both = np.column_stack([columns, y])
    found = _log_marginal(both.T @ both, np.array([0, 1]), np.array([2, 3]), prior)
    basis = np.linalg.svd(columns[:, :2])[0][:, 2:]  # what included columns leave
    left, x = basis.T @ y, basis.T @ columns[:, 2:]
    wide = np.eye(18) + x @ np.linalg.inv(prior) @ x.T
    ratio = stats.multivariate_normal.logpdf(left, cov=wide) - stats.multivariate_normal.logpdf(
        left, cov=np.eye(18)
    )
    assert found == pytest.approx(ratio - np.linalg.slogdet(prior)[1] / 2)


def dense_null(model, **more):
    """Return a null model of a mixed model's border, none of it included."""
    f = model.factored()
    return SimpleNamespace(
        full=f.equations,
        factorization=f,
        frame_alternatives=(),
        remaining_information=lambda information, included: eliminate(information, included),
        **more,
    )


def test_coefficients_are_random_by_as_much_as_the_likelihood_gains():
    """Of the sizes tried the best: by the dense covariance of y."""
    model = mixed_model(True)
    null = dense_null(model)
    x, columns = model.flat, np.array([1])
    found = random_gain(null, np.array([0]), columns)

    def cost(size):
        v = model.covariance() + size * np.outer(x[:, 1], x[:, 1])
        g, inverse = model.fixed(shared=False), np.linalg.inv(v)
        logs = np.linalg.slogdet(v)[1] + np.linalg.slogdet(g.T @ inverse @ g)[1]
        g = np.column_stack([g, x[:, 0]])
        p = inverse - inverse @ g @ np.linalg.inv(g.T @ inverse @ g) @ g.T @ inverse
        return logs + (null.full.rows - null.full.group_rank) * np.log(model.y @ p @ model.y)

    sizes = (0.5, 2.0, 8.0, 32.0, 128.0, 512.0)
    assert found == pytest.approx(cost(0.0) - min(map(cost, sizes)), abs=1e-5)


def test_an_alternative_is_held_against_the_columns_with_them_and_without():
    """Its best size each time: the likelihood ratio of the columns, never below zero."""
    rng = np.random.default_rng(2)
    columns = rng.normal(size=(40, 3))
    y = columns @ [0.3, 0.5, -0.2] + rng.normal(size=40)
    alternatives, costs = [], []
    for logs, lost in ((0.0, 0), (1.5, 2)):  # the second takes up more rows, at a cost
        some = np.column_stack([columns, y])[lost:]
        alternatives.append((logs, some.T @ some))

        def misfit(part, y=y[lost:]):
            return y @ y - y @ part @ np.linalg.lstsq(part, y, rcond=None)[0]

        whole = columns[lost:]
        costs.append((logs, misfit(whole[:, :1]), misfit(whole)))
    null = SimpleNamespace(
        full=SimpleNamespace(rows=50, group_rank=10),
        field_alternatives=alternatives,
        remaining_information=lambda information, included: eliminate(information, included),
    )
    without, beside = (min(cost[0] + 40 * np.log(cost[i]) for cost in costs) for i in (1, 2))
    found = _alternative_gain(null, np.array([0]), np.array([1, 2]), None)
    assert found == pytest.approx(without - beside)
    null.field_alternatives = [(0.0, alternatives[0][1]), (-1e3, np.diag([1.0, 1, 1, 1]))]
    assert _alternative_gain(null, np.array([0]), np.array([1, 2]), None) == 0.0


@pytest.mark.parametrize('rank', [1, 2])
@pytest.mark.parametrize('scatter', [0.2, 3.0])
def test_a_statistic_is_divided_by_the_scatter_of_landmarks(monkeypatch, scatter, rank):
    """Where that is more than expected; F with landmarks less rank degrees (Liang and Zeger)."""
    rng = np.random.default_rng(3)
    frames, points = 4, 6
    weight = rng.normal(size=(frames, 2 * points))
    landmark = np.tile(np.arange(points), (frames, 1))
    remaining = scatter * rng.normal(size=points).repeat(2) * np.ones((frames, 1))
    monkeypatch.setattr(effect_tests, '_border_rows', lambda *_: (weight, remaining))
    combination, sigma = np.array([0.0, 1.0, 0.0]), 0.5
    info = np.diag([1.0, (weight**2).sum() / 10, 1.0])
    used = np.ones((frames, 2 * points), dtype=bool)
    used[1, 4:6] = False
    null = SimpleNamespace(
        factorization=SimpleNamespace(information=info),
        residual_combination=lambda included: np.array([0.0, 0.0, 1.0]),
        linear=SimpleNamespace(row_mask=used),
        random=SimpleNamespace(columns=SimpleNamespace(unit=landmark)),
        variances=SimpleNamespace(sigma=sigma),
    )
    score = Score(20.0, rank, 1e-5, np.ones(1), np.inf)
    found = _cluster_p_value(null, score, combination, np.array([0]), np.array([1]))
    sums = (np.where(used, weight * remaining, 0.0)).reshape(frames, points, 2).sum(axis=(0, 2))
    ratio = (sums**2).sum() / (info[1, 1] * sigma**2)
    assert (ratio > 1) == (scatter > 1)
    assert found == pytest.approx(stats.f.sf(20.0 / max(ratio, 1.0) / rank, rank, points - rank))
