"""An extended lens means the same to everything that is given it."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.scenes import lens, observe, scene

import fisheye_svp_ros as fsvp
from fisheye_svp_ros.effects.base import ModelTerm
from fisheye_svp_ros.effects.catalogue import CATALOGUE, load_effects
from fisheye_svp_ros.effects.extension import extend_lens
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.lens_files import lens_from_dict, lens_to_dict, load_lens, save_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.optics.camera import unique_range
from fisheye_svp_ros.optics.curves import (
    Equisolid,
    FlatPort,
    Gennery,
    KannalaBrandt,
    Stereographic,
    kannala_brandt_equivalent,
)
from fisheye_svp_ros.pose import Pose, identity
from fisheye_svp_ros.scene.observations import group_views, views_of
from fisheye_svp_ros.scene.rigs import rig
from fisheye_svp_ros.simulate.render import Exposure, Print, render
from fisheye_svp_ros.simulate.scenario import model_of, true_lens
from fisheye_svp_ros.solve.localization import localize
from fisheye_svp_ros.study.budget import Setup, make_budget

SHIFT = ModelTerm(CATALOGUE['viewpoint_shift'](order=2), np.array([0.004, 0.001]))
PORT = ModelTerm(CATALOGUE['flat_port'](1.4), np.array([0.01]))
FISH214 = load_lens(lens_path('fish214'))
KB = replace(lens(), image_height=KannalaBrandt(-0.01, 0.002, 0.0, 0.0))
SEEN = scene(np.random.default_rng(5), frames=4)
SHAPES = {
    'viewpoint_shift': {'order': 2},
    'flat_port': {},
    'radial_profile': {'terms': 4},
    'focal_length': {},
    'aspect': {},
    'principal_point': {},
    'decentering': {},
    'sensor_tilt': {},
    'pupil_decentering': {},
    'skew': {},
    'session_step': {'starts': (0.2,)},
    'focal_drift': {'duration': 0.3},
    'detector_bias': {},
}


def some(*names, size=0.3):
    """Return effects of some size."""
    rng = np.random.default_rng(len(names))
    effects = [CATALOGUE[name](**SHAPES[name]) for name in names]
    return [
        ModelTerm(
            e, size * rng.uniform(0.5, 1.0, len(e.parameters)) * [p.large for p in e.parameters]
        )
        for e in effects
    ]


def bowed(seen, height=0.01):
    """Return the table of a bowed target, and the bow."""
    shape = CATALOGUE['target_shape'].candidates(
        ForwardModel(KB, ()).scene(*seen, ForwardModel(KB, ()).linearize(*seen))
    )[0]
    values = np.full(len(shape.parameters), height)
    term = ModelTerm(shape, values)
    return observe(KB, [term], *seen, 0.0, np.random.default_rng(1)), term


@pytest.mark.parametrize(
    'base',
    [KB, lens(), replace(lens(), image_height=Equisolid()), FISH214],
    ids=['kannala_brandt', 'equidistant', 'equisolid', 'shift'],
)
def test_an_extended_lens_predicts_what_its_effects_do(base):
    terms = some(*SHAPES)
    extended = extend_lens(base, terms)
    expected = ForwardModel(base, terms).predict(*SEEN, False).uv
    found = ForwardModel(extended).predict(*SEEN, False).uv
    # Only aspect times other effects of the image and on the phase of its pixels is left over.
    np.testing.assert_allclose(found, expected, rtol=0, atol=0.1)
    without = [term for term in terms if term.name not in ('aspect', 'detector_bias')]
    np.testing.assert_allclose(
        ForwardModel(extend_lens(base, without)).predict(*SEEN, False).uv,
        ForwardModel(base, without).predict(*SEEN, False).uv,
        rtol=0,
        atol=1e-9,
    )
    assert lens_from_dict(lens_to_dict(extended)) == extended


def test_what_the_lens_has_a_place_for_goes_there():
    extended = extend_lens(KB, some(*SHAPES))
    (relative,), (cx, cy), (aspect,) = (
        term.values
        for name in ('focal_length', 'principal_point', 'aspect')
        for term in some(*SHAPES)
        if term.name == name
    )
    assert extended.fx == pytest.approx(KB.fx * (1 + relative) * (1 + aspect / 2))
    assert extended.fy == pytest.approx(KB.fy * (1 + relative) * (1 - aspect / 2))
    assert (extended.cx, extended.cy) == pytest.approx((KB.cx + cx, KB.cy + cy))
    assert type(extended.image_height) is KannalaBrandt
    assert extended.image_height != KB.image_height
    gennery, port = extended.viewpoint_shift.parts
    assert (type(gennery), type(port)) == (Gennery, FlatPort)
    assert set(extended.corrections) == {
        'decentering',
        'sensor_tilt',
        'pupil_decentering',
        'skew',
        'session_step',
        'focal_drift',
        'detector_bias',
    }
    assert extended.max_incidence <= np.pi / 2
    other = extend_lens(replace(KB, image_height=Stereographic()), some('radial_profile'))
    assert set(other.corrections) == {'radial_profile'}
    assert set(
        extend_lens(KB, [ModelTerm(CATALOGUE['radial_profile'](8), np.ones(8))]).corrections
    ) == {'radial_profile'}


def test_found_coefficients_add_to_those_of_the_lens():
    assert extend_lens(KB, [SHIFT]).viewpoint_shift == Gennery(0.0, 0.004, 0.001, 0.0)
    own = FISH214.viewpoint_shift
    assert extend_lens(FISH214, [SHIFT]).viewpoint_shift == Gennery(
        own.s0, own.e0 + 0.004, own.e1 + 0.001, own.e2
    )
    twice = extend_lens(extend_lens(KB, some('skew')), some('skew'))
    assert twice.corrections['skew']['parameters']['shear'] == pytest.approx(
        2 * some('skew')[0].values[0]
    )
    form = CATALOGUE['detector_bias']
    with pytest.raises(LensError, match=r'already holds detector_bias\(order=1\) in corrections'):
        extend_lens(
            extend_lens(KB, [ModelTerm(form(1), np.ones(1))]), [ModelTerm(form(2), np.ones(4))]
        )


def test_svp_takes_away_whatever_the_shift_is_made_of(tmp_path):
    document = lens_to_dict(FISH214)
    document['max_incidence_deg'] = 85.0
    document['effects'] = {
        t.name: t.effect.to_dict(t.values) for t in (SHIFT, PORT, *some('skew'))
    }
    found = lens_from_dict(document)
    # An older file and a hand-written one mean the same.
    document['corrections'] = document.pop('effects')
    assert lens_from_dict(document) == found
    assert len(found.viewpoint_shift.parts) == 2
    svp = ForwardModel(found.svp()).lens
    assert svp.viewpoint_shift is None
    assert set(found.svp().corrections) == {'skew'}


def test_budget_scale_and_range_mean_the_whole_shift(tmp_path):
    extended = extend_lens(lens(), [SHIFT])
    by_hand = replace(lens(), viewpoint_shift=Gennery(0.0, 0.004, 0.001, 0.0))
    assert unique_range(extended) == unique_range(by_hand) > 0
    budgets = [
        make_budget(Setup(one, rig('parallel'), 0.3), spreads=2, ranges=2)
        for one in (extended, by_hand)
    ]
    np.testing.assert_array_equal(budgets[0].error['depth'], budgets[1].error['depth'])
    several = extend_lens(lens(), [SHIFT, PORT])
    save_lens(several, tmp_path / 'lens.yaml')
    path = str(tmp_path / 'lens.yaml')
    assert true_lens(path, 0.0).viewpoint_shift is None
    half = true_lens(path, 0.5).viewpoint_shift
    assert half.coefficients == (0.0, 0.002, 0.0005, 0.0, 0.005, 1.4)
    assert model_of(path, 1.0, svp=True).lens.viewpoint_shift is None
    assert model_of(path, 1.0, svp=False).lens == several


def test_what_an_svp_user_is_given_has_the_corrected_curve():
    base = replace(lens(), image_height=Equisolid())
    given = kannala_brandt_equivalent(ForwardModel(extend_lens(base, some('radial_profile'))).lens)
    plain = kannala_brandt_equivalent(base)
    assert given.corrections == {}
    theta = np.array(0.8)
    change = given.fx * given.image_height.value_and_slope(theta)[0] - (
        plain.fx * plain.image_height.value_and_slope(theta)[0]
    )
    (term,) = some('radial_profile')
    effect, values = term.effect, term.values
    expected = effect.with_curves(base, values).image_height.value_and_slope(theta)[0]
    expected -= base.image_height.value_and_slope(theta)[0]
    assert change == pytest.approx(base.fx * expected, rel=0.02)
    assert kannala_brandt_equivalent(given) == given


class TestTarget:
    def test_it_is_corrected_where_it_is_seen(self):
        table, term = bowed(SEEN)
        extended = extend_lens(KB, [term], table)
        assert extended.corrections == {}
        assert set(extended.target) == {'landmarks', 'target_shape'}
        read = lens_from_dict(lens_to_dict(extended))
        for model in (ForwardModel(extended), ForwardModel(read)):
            solved = localize(model, group_views(table))
            assert np.nanmax(np.abs(solved.residual)) < 1e-6
        before = localize(ForwardModel(KB), group_views(table))
        assert np.nanmax(np.abs(before.residual)) > 1

    def test_half_of_it_is_enough_and_the_boards_need_not_be_told(self):
        table, term = bowed(SEEN)
        model = ForwardModel(extend_lens(KB, [term], table))
        some_of_it = table.take(table.landmark % 3 > 0)
        as_on_topics = replace(some_of_it, board=np.zeros_like(some_of_it.board))
        solved = localize(model, group_views(as_on_topics))
        assert np.nanmax(np.abs(solved.residual)) < 1e-6

    def test_landmarks_that_it_was_found_without_are_on_the_board_they_lie_on(self):
        table, term = bowed(SEEN)
        found_on = table.take(table.landmark % 7 != 3)
        model = ForwardModel(extend_lens(KB, [term], found_on))
        for board in (table.board, np.zeros_like(table.board)):
            solved = localize(model, group_views(replace(table, board=board)))
            assert np.nanmax(np.abs(solved.residual)) < 1e-6

    def test_another_target_is_left_alone(self):
        table, term = bowed(SEEN)
        model = ForwardModel(extend_lens(KB, [term], table))
        other = scene(np.random.default_rng(6), frames=4)
        np.testing.assert_allclose(
            model.predict(*other).uv, ForwardModel(KB).predict(*other).uv, rtol=0, atol=1e-9
        )
        assert model.seeing(other[1]).is_lens_only and not model.seeing(SEEN[1]).is_lens_only
        assert model.terms_for(other[1]) == () and len(model.terms_for(SEEN[1])) == 1
        # One view of each: every view is judged by itself.
        both = [
            None if a is None else np.concatenate([a[:1], b[:1]])
            for a, b in zip(SEEN[1], other[1], strict=True)
        ]
        pose = type(SEEN[0])(
            *(np.concatenate([a[:1], b[:1]]) for a, b in zip(SEEN[0], other[0], strict=True))
        )
        mixed = model.predict(pose, type(SEEN[1])(*both)).uv
        np.testing.assert_allclose(
            mixed[1], ForwardModel(KB).predict(*other).uv[0], rtol=0, atol=1e-9
        )
        np.testing.assert_allclose(mixed[0], model.predict(*SEEN).uv[0], rtol=0, atol=1e-9)
        assert np.nanmax(np.abs(mixed[0] - ForwardModel(KB).predict(*SEEN).uv[0])) > 0.1

    def test_a_landmark_elsewhere_is_not_the_targets(self):
        table, term = bowed(SEEN)
        model = ForwardModel(extend_lens(KB, [term], table))
        views = SEEN[1]._replace(points=SEEN[1].points.copy())
        views.points[:, 7] += 2e-5
        moved = model.predict(SEEN[0], views).uv - ForwardModel(KB).predict(SEEN[0], views).uv
        assert np.abs(moved[:, 7]).max() < 1e-9
        assert np.nanmin(np.nanmax(np.abs(moved[:, :7]), axis=(0, 2))) > 0

    @pytest.mark.parametrize(('elsewhere', 'shown'), [(30, True), (31, False)])
    def test_half_of_the_landmarks_decide(self, elsewhere, shown):
        table, term = bowed(SEEN)
        model = ForwardModel(extend_lens(KB, [term], table))
        views = SEEN[1]._replace(points=SEEN[1].points.copy())
        assert views.points.shape[1] == 60
        views.points[:, :elsewhere] += 0.01
        assert model.seeing(views).is_lens_only is not shown
        moved = model.predict(SEEN[0], views).uv - ForwardModel(KB).predict(SEEN[0], views).uv
        assert bool(np.nanmax(np.abs(moved)) > 0.1) is shown

    def test_new_corrections_of_another_target_replace_the_old(self):
        table, term = bowed(SEEN)
        extended = extend_lens(KB, [term], table)
        other, new = bowed(scene(np.random.default_rng(6), frames=4))
        assert extend_lens(extended, some('skew'), other).target == extended.target
        again = extend_lens(extended, [new], other)
        assert again.target['landmarks'] != extended.target['landmarks']
        double = extend_lens(extended, [term], table).target['target_shape']['parameters']
        assert set(double.values()) == {0.02}

    def test_one_that_names_no_landmarks_is_any(self):
        table, term = bowed(SEEN)
        old = {**lens_to_dict(KB), 'effects': {'target_shape': term.effect.to_dict(term.values)}}
        model = ForwardModel(lens_from_dict(old))
        solved = localize(model, group_views(table))
        assert np.nanmax(np.abs(solved.residual)) < 1e-6

    def test_dots_are_the_targets(self):
        entry = CATALOGUE['dot_centroid']().to_dict(np.array([1e-4]))
        old = lens_from_dict({**lens_to_dict(KB), 'effects': {'dot_centroid': entry}})
        assert (old.corrections, set(old.target)) == ({}, {'dot_centroid'})


def test_the_order_of_effects_does_not_matter():
    terms = some('decentering', 'radial_profile', 'focal_length', 'viewpoint_shift')
    assert extend_lens(KB, terms) == extend_lens(KB, terms[::-1])


def test_corrections_that_stand_in_the_lens_follow_its_focal_length():
    first = extend_lens(KB, some('decentering'))
    terms = some('focal_length')
    extended = extend_lens(first, terms)
    both = [*load_effects(first.corrections, ''), *terms]
    np.testing.assert_allclose(
        ForwardModel(extended).predict(*SEEN).uv,
        ForwardModel(KB, both).predict(*SEEN).uv,
        rtol=0,
        atol=1e-9,
    )


def test_the_library_projects_with_all_of_the_lens():
    extended = extend_lens(KB, some('decentering', 'viewpoint_shift'))
    rng = np.random.default_rng(3)
    points = rng.uniform([-0.5, -0.5, 0.3], [0.5, 0.5, 1.3], (2, 5, 3))
    image = fsvp.project(extended, points)
    assert image.uv.shape == (2, 5, 2) and image.valid.all()
    linear = ForwardModel(extended).linearize(
        identity(1), views_of(points.reshape(1, 10, 3), np.zeros((1, 10, 2)))
    )
    np.testing.assert_array_equal(image.uv.reshape(1, 10, 2), linear.uv)
    bare = fsvp.project(replace(extended, corrections={}), points)
    assert np.abs(image.uv - bare.uv).max() > 0.1
    rays = fsvp.back_project(extended, image.uv)
    off = points - rays.origin
    np.testing.assert_allclose(np.cross(off, rays.direction), 0, atol=1e-6)


def contrast(photograph, corner):
    """Return how much two opposite quadrants about a place are brighter than the other two."""
    u, v = np.round(corner).astype(int)
    a, b, c, d = (photograph[y - 5 : y, x - 5 : x].mean() for y in (v, v + 6) for x in (u, u + 6))
    return abs(a + d - b - c)


def test_photographs_are_taken_with_all_of_the_lens():
    small = replace(KB, width=160, height=120, fx=40.0, fy=40.0, cx=79.5, cy=59.5)
    extended = extend_lens(small, [ModelTerm(CATALOGUE['decentering'](), np.array([0.1, -0.08]))])
    printed, exposure = Print(4, 3, 0.05), Exposure(noise=0.0, blur=0.0, vignetting=0.0)
    pose = Pose(np.eye(3), np.array([0.075, 0.05, -0.12]))
    photograph = render(extended, printed, pose, exposure, np.random.default_rng(0))
    points = pose.into_body(printed.corners)
    seen, elsewhere = fsvp.project(extended, points).uv, fsvp.project(small, points).uv
    far = np.linalg.norm(seen - elsewhere, axis=-1) > 3
    assert far.sum() > 3
    for corner, wrong in zip(seen[far], elsewhere[far], strict=True):
        assert contrast(photograph, corner) > 1.5 * contrast(photograph, wrong)
