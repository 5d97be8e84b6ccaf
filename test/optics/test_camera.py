"""Projection, back-projection and Jacobians, against independent code."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from helpers import high_precision
from helpers.differences import derivative
from helpers.lenses import (
    KITA,
    LENSES,
    STEPS,
    make_lens,
    place,
    points_around,
    points_on_rays,
)

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.optics.camera import (
    back_project,
    incidence,
    lens_columns,
    project,
    project_with_jacobian,
    unique_range,
)
from fisheye_svp_ros.optics.curves import FlatPort, KannalaBrandt
from fisheye_svp_ros.optics.lens import INTRINSICS

pytestmark = pytest.mark.usefixtures('engine')


def assert_equals_reference(lens, points):
    expected = [high_precision.project(lens, point) for point in points]
    image = project(lens, points)
    assert image.valid.tolist() == [uv is not None for uv in expected]
    assert np.isnan(image.uv[~image.valid]).all()
    seen = np.array([uv for uv in expected if uv is not None], dtype=float).reshape(-1, 2)
    np.testing.assert_allclose(image.uv[image.valid], seen, rtol=0, atol=1e-9)
    return image.valid


@pytest.mark.parametrize('lens', LENSES)
def test_projection_equals_high_precision(lens):
    rng = np.random.default_rng(5)
    points = np.concatenate(
        [
            points_on_rays(lens, rng, 24),
            points_around(rng, 24, 0.05, 0.3, 125.0),
            points_around(rng, 8, 0.3, 3.0, 180.0),
        ]
    )
    valid = assert_equals_reference(lens, points)
    assert valid[:24].all()
    assert 0 < (~valid[24:]).sum() < 32


@pytest.mark.parametrize('lens', KITA, ids=lambda lens: lens.name)
def test_projection_near_the_lens_and_past_105_degrees(lens):
    rng = np.random.default_rng(6)
    near = points_around(rng, 150, 0.05, 0.3, 112.0)
    caustic = points_around(rng, 100, 0.4 * unique_range(lens), 1.5 * unique_range(lens), 100.0)
    past = points_around(rng, 50, 0.1, 0.3, 105.0)
    past[:, 2] = -np.hypot(past[:, 0], past[:, 1]) * np.tan(np.radians(rng.uniform(15, 22, 50)))
    valid = assert_equals_reference(lens, np.concatenate([near, caustic, past]))
    assert 0 < valid[:150].sum() < 150
    assert 0 < valid[150:250].sum() < 250


@pytest.mark.parametrize('lens', KITA, ids=lambda lens: lens.name)
def test_projection_at_the_edges_of_the_domain(lens):
    azimuth, distance = np.array([0.3, 1.2, -2.0]), np.array([0.08, 0.3, 2.0])
    edge = np.full(3, lens.max_incidence)
    inside = place(lens, edge - 1e-7, azimuth, distance)
    outside = place(lens, edge + 1e-7, azimuth, distance)
    assert assert_equals_reference(lens, inside).all()
    assert not assert_equals_reference(lens, outside).any()
    assert project(lens, place(lens, edge, azimuth, distance)).valid.all()
    assert project(lens, outside, limited=False).valid.all()
    axis = np.array(
        [
            [0, 0, 0.3],
            [0, 0, lens.viewpoint_shift.s0 + 1e-6],
            [1e-12, 0, 0.3],
            [0, 0, lens.viewpoint_shift.s0 - 1e-6],
            [0, 0, -0.3],
        ]
    )
    assert assert_equals_reference(lens, axis).tolist() == [True, True, True, False, False]


def test_projection_equals_opencv_for_svp_kannala_brandt():
    lens = make_lens('kannala_brandt', 'svp')
    rng = np.random.default_rng(7)
    points = points_around(rng, 2000, 0.05, 5.0, 89.0)
    camera = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
    expected, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), camera, np.array(lens.image_height.coefficients)
    )
    np.testing.assert_allclose(project(lens, points).uv, expected[:, 0], rtol=0, atol=1e-9)


@pytest.mark.parametrize('lens', LENSES)
def test_jacobians_equal_high_order_differences(lens):
    points = points_on_rays(lens, np.random.default_rng(8), 200, nearest=0.15, edge=0.98)
    image = project_with_jacobian(lens, points)
    assert image.valid.all()
    np.testing.assert_array_equal(image.uv, project(lens, points).uv)
    for axis in np.eye(3):

        def moved(step, axis=axis):
            return project(lens, points + step * axis, limited=False).uv

        column = image.d_point @ axis
        scale = np.abs(image.d_point).max(axis=(1, 2))[:, None]
        step = 4e-3 * np.linalg.norm(points, axis=-1, keepdims=True)
        assert np.max(np.abs(column - derivative(moved, step)) / scale) < 1e-7
    for name, value in lens.parameters.items():

        def changed(step, name=name, value=value):
            return project(lens.with_parameters([name], [value + step]), points, False).uv

        column = lens_columns(lens, image, [name])[..., 0]
        size = np.abs(column).max(axis=1)[:, None]
        scale = np.maximum(size, 1e-3 * size.max())  # columns vanish on the axis
        difference = derivative(changed, STEPS.get(name, 1.0 if name in INTRINSICS else 1e-2))
        assert np.max(np.abs(column - difference) / scale) < 1e-7, name


def test_lens_columns_by_name():
    lens = make_lens('kannala_brandt', 'gennery')
    image = project_with_jacobian(lens, points_on_rays(lens, np.random.default_rng(9), 5))
    columns = lens_columns(lens, image, ['f', 'fx', 'fy'])
    np.testing.assert_allclose(columns[..., 0], columns[..., 1] + columns[..., 2], rtol=1e-14)
    assert lens_columns(lens, image, []).shape == (5, 2, 0)
    with pytest.raises(LensError, match="has no parameter 'thickness'"):
        lens_columns(lens, image, ['thickness'])


def test_jacobian_on_the_axis_is_the_limit_beside_it():
    for lens in KITA:
        on_axis = project_with_jacobian(lens, np.array([0, 0, 0.5]))
        beside = project_with_jacobian(lens, np.array([1e-9, 1e-9, 0.5]))
        np.testing.assert_allclose(on_axis.d_point, beside.d_point, rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize('lens', LENSES)
def test_back_projection_round_trips_up_to_the_edge_of_the_field(lens):
    rng = np.random.default_rng(10)
    edge = lens.image_height.value_and_slope(np.array(lens.max_incidence))[0]
    height = edge * np.concatenate([np.sqrt(rng.uniform(0, 1, 200)), [0.0, 1 - 1e-9, 1.0]])
    azimuth = rng.uniform(-np.pi, np.pi, len(height))
    uv = np.stack(
        [
            lens.cx + lens.fx * height * np.cos(azimuth),
            lens.cy + lens.fy * height * np.sin(azimuth),
        ],
        axis=-1,
    )
    rays = back_project(lens, uv)
    assert rays.valid.all()
    np.testing.assert_allclose(np.linalg.norm(rays.direction, axis=-1), 1.0, rtol=0, atol=1e-15)
    for depth in (0.15, 2.0):
        image = project(lens, rays.origin + depth * rays.direction)
        assert image.valid.all()
        np.testing.assert_allclose(image.uv, uv, rtol=0, atol=1e-9)
    outside = back_project(lens, uv[-1:] + (uv[-1:] - [lens.cx, lens.cy]) * 1e-6)
    assert not outside.valid.any()
    assert all(np.isnan(field).all() for field in outside[:3])


def test_a_curve_that_turns_back_within_the_field_still_has_rays_up_to_there():
    """A fit to some of the frames may do that, while the field is that of all of them."""
    lens = replace(
        KITA[1].svp(),
        max_incidence=2.4,
        image_height=KannalaBrandt(-0.02, 0.0015, 0.0003, -0.0008),
    )
    assert lens.image_height.limit < lens.max_incidence
    theta = np.array([0.1, 0.7, 0.99 * lens.image_height.limit])
    points = np.stack([np.sin(theta), 0 * theta, np.cos(theta)], axis=-1)
    rays = back_project(lens, project(lens, points).uv)
    assert rays.valid.all()
    np.testing.assert_allclose(rays.theta, theta, rtol=0, atol=1e-9)


BOTH = replace(
    KITA[1], viewpoint_shift=KITA[1].viewpoint_shift.plus(FlatPort(0.01, 1.5)), max_incidence=1.4
)


@pytest.mark.parametrize('lens', [KITA[1], KITA[1].svp(), BOTH], ids=['shiftvp', 'svp', 'both'])
@pytest.mark.parametrize('shape', [(), (0,), (4,), (2, 3), (2, 0, 3)])
def test_any_leading_shape(lens, shape):
    points = np.full((*shape, 3), 0.4) + np.arange(3) * 0.1
    image = project_with_jacobian(lens, points)
    assert image.uv.shape == (*shape, 2)
    assert np.shape(image.valid) == shape
    assert image.d_point.shape == (*shape, 2, 3)
    names = ['f', *lens.parameters]
    columns = lens_columns(lens, image, names)
    assert columns.shape == (*shape, 2, len(names))
    of_one = lens_columns(lens, project_with_jacobian(lens, np.array([0.4, 0.5, 0.6])), names)
    np.testing.assert_allclose(columns, np.broadcast_to(of_one, columns.shape), atol=1e-12)
    assert project(lens, points).uv.shape == (*shape, 2)
    rays = back_project(lens, image.uv)
    assert rays.origin.shape == rays.direction.shape == (*shape, 3)
    assert np.shape(rays.theta) == np.shape(rays.valid) == shape
    one = project(lens, np.array([0.4, 0.5, 0.6])).uv
    np.testing.assert_allclose(image.uv, np.broadcast_to(one, image.uv.shape), rtol=0, atol=1e-12)


@pytest.mark.parametrize('lens', [KITA[1], KITA[1].svp()], ids=['shiftvp', 'svp'])
def test_nan_in_is_nan_and_a_flag_out(lens):
    points = np.array(
        [
            [0.1, 0.2, 0.5],
            [np.nan, 0.2, 0.5],
            [0.1, np.nan, 0.5],
            [0.1, 0.2, np.nan],
            [0.1, 0.2, 0.5],
        ]
    )
    image = project_with_jacobian(lens, points)
    assert image.valid.tolist() == [True, False, False, False, True]
    assert np.isnan(image.uv).all(axis=-1).tolist() == [False, True, True, True, False]
    rays = back_project(lens, np.where(image.valid[:, None], image.uv, [np.nan, 400.0]))
    assert rays.valid.tolist() == [True, False, False, False, True]
    assert np.isnan(rays.direction[1:4]).all()
    assert not np.isnan(rays.direction[[0, 4]]).any()


@pytest.mark.parametrize('lens', KITA, ids=lambda lens: lens.name)
def test_at_most_one_ray_beyond_the_unique_range_and_two_within(lens):
    grid = np.linspace(0.0, lens.max_incidence, 4001)
    shift = high_precision.shift(lens, grid, np)

    def count_rays(points):
        r = np.hypot(points[:, 0], points[:, 1])[:, None]
        positive = r * np.cos(grid) - (points[:, 2:] - shift) * np.sin(grid) >= 0
        return (positive[:, 1:] != positive[:, :-1]).sum(axis=1)

    rng = np.random.default_rng(11)
    limit = unique_range(lens)
    assert count_rays(points_around(rng, 2000, 1.001 * limit, 3 * limit, 180.0)).max() == 1
    assert count_rays(points_around(rng, 4000, 0.8 * limit, 0.999 * limit, 120.0)).max() == 2
    assert unique_range(lens.svp()) == 0.0


def test_of_two_rays_the_one_that_continues_to_far_points_is_taken():
    lens = KITA[1]
    far = place(lens, np.radians([60.0]), np.array([0.4]), np.array([2.0]))
    origin = np.array([0, 0, float(high_precision.shift(lens, np.radians(60.0), np))])
    direction = (far[0] - origin) / 2.0
    along = origin + np.linspace(0.03, 2.0, 200)[:, None] * direction
    theta = incidence(lens, along).theta
    np.testing.assert_allclose(theta, np.radians(60.0), rtol=0, atol=1e-9)


def test_two_rays_close_to_each_other_are_not_overlooked():
    lens, rng = KITA[1], np.random.default_rng(3)
    theta = rng.uniform(0.6, 1.75, (1, 400)) + [[0.0], [1.0]] * rng.uniform(1e-3, 1e-2, 400)
    # Where the rays of both angles cross.
    shift, slope = np.asarray(high_precision.shift(lens, theta, np)), np.tan(theta)
    z = (shift[0] * slope[0] - shift[1] * slope[1]) / (slope[0] - slope[1])
    r = (z - shift[0]) * slope[0]
    found = incidence(lens, np.stack([r, 0 * r, z], axis=-1)).theta
    np.testing.assert_allclose(found, theta[0], rtol=0, atol=1e-9)
