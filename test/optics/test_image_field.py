"""The image field of a lens: a spline over the image, in projection, solvers, maps and files."""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from helpers.differences import derivative
from helpers.lenses import STEPS, make_lens, points_on_rays
from scipy.ndimage import map_coordinates

from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.lens_files import lens_from_dict, lens_to_dict, load_lens, save_lens
from fisheye_svp_ros.optics import engines
from fisheye_svp_ros.optics.camera import (
    back_project,
    lens_columns,
    project,
    project_with_jacobian,
)
from fisheye_svp_ros.optics.engines import numpy_engine
from fisheye_svp_ros.optics.image_field import ImageField
from fisheye_svp_ros.optics.ports import FlatGlass
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.rectify.cameras import RectifiedCamera
from fisheye_svp_ros.rectify.maps import Rectification
from fisheye_svp_ros.scene.observations import views_of
from fisheye_svp_ros.solve.localization import localize


def warp(size=0.4, seed=0, stderr=False):
    """Return a field of so many px, rms, over the middle of an image of 1200 x 1000 px."""
    values = np.random.default_rng(seed).normal(0.0, 1.5 * size, (11, 14, 2))
    known = np.full((11, 14), 0.02) if stderr else None
    return ImageField(np.array([90.0, 80.0]), np.array([75.0, 80.0]), values, known)


def bent(lens, **options):
    return replace(lens, image_field=warp(**options))


@pytest.fixture(params=['svp', 'gennery', 'port'])
def lens(request):
    if request.param == 'port':
        port = FlatGlass(0.02, 1.333, 0.01, -0.02, 0.005, 1.5)
        return replace(make_lens('equidistant', 'svp'), port=port, max_incidence=1.1)
    return make_lens('kannala_brandt', request.param)


def seen_points(lens, count=200):
    points = points_on_rays(replace(lens, port=None), np.random.default_rng(3), count, 0.3)
    return points[project(lens, points).valid]


def test_the_spline_equals_that_of_scipy():
    field, uv = warp(), np.random.default_rng(1).uniform(-100, 1300, (500, 2))
    place = ((uv - field.low) / field.pitch).T[::-1] + 4
    expected = np.stack(
        [
            map_coordinates(np.pad(part, 4), place, order=3, prefilter=False)
            for part in np.moveaxis(field.values, -1, 0)
        ],
        axis=-1,
    )
    np.testing.assert_allclose(field.displacement(uv), expected, rtol=0, atol=1e-13)


def test_it_ends_smoothly_two_nodes_outside_the_grid():
    field, step = warp(), np.array([1e-3, 0.0])
    edge = np.array([field.low[0] - 2 * field.pitch[0], 500.0])
    for outside in (edge, edge - 300, np.array([np.nan, 1.0])):
        assert not field.displacement(outside).any()
        assert not field.slope(outside).any()
    third = np.abs(field.displacement(edge + step)).max()  # grows with the third power
    assert 0 < third < 1e-12
    assert field.displacement(np.array([[[600.0, 500.0]]])).shape == (1, 1, 2)


def test_nodes_are_interpolated():
    there = np.random.default_rng(2).normal(size=(9, 7, 2))
    field = ImageField.interpolate(np.array([3.0, 5.0]), np.array([10.0, 12.0]), there)
    np.testing.assert_allclose(field.displacement(field.nodes), there, rtol=0, atol=1e-12)


@pytest.mark.usefixtures('engine')
def test_projection_is_that_of_the_bare_lens_and_the_field(lens):
    points, field = seen_points(lens), warp()
    ideal, image = project(lens, points), project(replace(lens, image_field=field), points)
    np.testing.assert_array_equal(image.uv, field.apply(ideal.uv))
    assert np.abs(image.uv - ideal.uv).max() > 0.2
    assert image.valid.all()
    through = ForwardModel(replace(lens, image_field=field)).project(points)
    np.testing.assert_array_equal(through.uv, image.uv)


def test_engines_agree(lens):
    points, own = seen_points(lens), bent(lens)
    pytest.importorskip('numba', reason='the engine numba comes with the extra `fast`')
    before = engines._engine
    found = []
    for name in ('numpy', 'numba'):
        engines.use(name)
        linear = project_with_jacobian(own, points)
        found.append((project(own, points).uv, linear.uv, linear.d_point))
    engines.use('numpy' if before is numpy_engine else 'numba')
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12 * np.abs(one).max())


@pytest.mark.usefixtures('engine')
def test_back_projection_returns_to_the_image_point(lens):
    own = bent(lens)
    uv = project(own, seen_points(lens)).uv
    rays = back_project(own, uv)
    assert rays.valid.all()
    again = project(own, rays.origin + 0.7 * rays.direction).uv
    np.testing.assert_allclose(again, uv, rtol=0, atol=1e-9)
    strong = warp(size=12.0)
    np.testing.assert_allclose(strong.apply(strong.invert(uv)), uv, rtol=0, atol=1e-9)


@pytest.mark.usefixtures('engine')
def test_derivatives(lens):
    own, points = bent(lens), seen_points(lens, 60)
    image = project_with_jacobian(own, points)
    for axis in range(3):
        moved = derivative(
            lambda d, axis=axis: project(own, points + d * np.eye(3)[axis], limited=False).uv, 1e-4
        )
        np.testing.assert_allclose(image.d_point[..., axis], moved, rtol=2e-7, atol=1e-5)
    names = [name for name in own.parameters if not name.startswith('port_')]
    columns = lens_columns(own, image, (*names, 'f', *own.port_names))
    for name, column in zip(names, np.moveaxis(columns, -1, 0), strict=False):
        step = 0.01 * STEPS.get(name, 0.5)  # the third derivative jumps at the nodes
        moved = derivative(
            lambda d, name=name: (
                project(
                    own.with_parameters([name], [own.parameters[name] + d]), points, limited=False
                ).uv
            ),
            step,
        )
        np.testing.assert_allclose(column, moved, rtol=1e-6, atol=1e-6 * np.abs(moved).max())
    uv = image.uv
    for axis in range(2):
        moved = derivative(
            lambda d, axis=axis: own.image_field.displacement(uv + d * np.eye(2)[axis]), 1e-3
        )
        np.testing.assert_allclose(own.image_field.slope(uv)[..., axis], moved, atol=1e-9)


@pytest.mark.usefixtures('engine')
@pytest.mark.parametrize('shift', ['svp', 'gennery'])
def test_a_pose_is_solved_with_the_field(shift):
    own = bent(make_lens('equidistant', shift))
    rng = np.random.default_rng(5)
    points = rng.uniform((-0.6, -0.5, 0.4), (0.6, 0.5, 0.7), (60, 3))
    true = Pose(rotation_from_vector(np.array([[0.1, -0.2, 0.3]])), np.array([[0.05, 0.02, 0.1]]))
    uv = project(own, true.into_body(points[None])).uv
    solved = localize(ForwardModel(own), views_of(points[None], uv))
    np.testing.assert_allclose(solved.pose.position, true.position, rtol=0, atol=1e-9)
    assert np.nanmax(np.abs(solved.residual)) < 1e-7
    bare = localize(ForwardModel(replace(own, image_field=None)), views_of(points[None], uv))
    assert np.nanmax(np.abs(bare.residual)) > 0.1


def test_maps_follow_the_field():
    own = bent(make_lens('equidistant', 'gennery'))
    camera = RectifiedCamera('pinhole', 300, 200, 180.0, 149.5, 99.5)
    with_field, bare = (
        Rectification(one, camera, 2.0) for one in (own, replace(own, image_field=None))
    )
    uv = np.stack([bare.maps.u, bare.maps.v], axis=-1)[bare.maps.mask].astype(float)
    moved = np.stack([with_field.maps.u, with_field.maps.v], axis=-1)[bare.maps.mask]
    np.testing.assert_allclose(moved, own.image_field.apply(uv), atol=1e-3)


def test_a_lens_file_keeps_it(tmp_path):
    own = bent(make_lens('equidistant', 'gennery'), stderr=True)
    own = replace(own, corrections={'skew': {'parameters': {'shear': 0.001}}})
    save_lens(own, tmp_path / 'lens.yaml')
    read = load_lens(tmp_path / 'lens.yaml')
    assert read.image_field == own.image_field
    assert read == own
    assert list(yaml.safe_load((tmp_path / 'lens.yaml').read_text())['corrections']) == [
        'skew',
        'image_field',
    ]
    assert 'image_field' not in lens_to_dict(make_lens('equidistant', 'svp'))['corrections']
    assert own.svp().image_field == own.image_field


@pytest.mark.parametrize(
    ('field', 'value', 'reason'),
    [
        ('low', None, 'corrections.image_field.low is missing'),
        ('low', [1.0], 'corrections.image_field.low must be two numbers, along u and v'),
        ('pitch', [75.0, 0.0], 'pitch is [75.0, 0.0]; it must be above 0'),
        (
            'u',
            [[0.0, 1.0], [0.0]],
            'image_field.u must be lists of numbers, as long as each other',
        ),
        ('u', 'much', 'image_field.u must be lists of numbers'),
        ('v', [[0.0] * 14] * 10, 'image_field.v must be rows of numbers, as many as those of u'),
        ('v', [[float('nan')] * 14] * 11, 'image_field.v holds a number that is not finite'),
        ('stderr', [[-1.0] * 14] * 11, 'image_field.stderr has a number below 0'),
        ('width', 3, "image_field: unknown field 'width'; choose from low, pitch, u, v, stderr"),
        ('u', [[0.0] * 6 + [900.0] + [0.0] * 7] * 11, 'image_field folds the image at ('),
    ],
)
def test_a_broken_field_is_refused_with_its_reason(field, value, reason):
    document = lens_to_dict(bent(make_lens('equidistant', 'svp'), stderr=True))
    entry = document['corrections']['image_field']
    entry.pop(field, None)
    if value is not None:
        entry[field] = value
    with pytest.raises(LensError) as refused:
        lens_from_dict(document, 'bent.yaml')
    assert str(refused.value).startswith('bent.yaml: ')
    assert reason in str(refused.value)
    assert '\n' not in str(refused.value)


def test_a_field_of_too_few_or_too_many_nodes_is_refused():
    document = lens_to_dict(make_lens('equidistant', 'svp'))
    for shape in ((3, 9), (4, 401)):
        flat = np.zeros(shape).tolist()
        document['corrections']['image_field'] = {
            'low': [0, 0],
            'pitch': [9, 9],
            'u': flat,
            'v': flat,
        }
        with pytest.raises(LensError, match='4 to 400 are needed of each'):
            lens_from_dict(document, 'bent.yaml')
