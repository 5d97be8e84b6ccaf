"""OpenCV's pinhole models: as OpenCV projects them, differentiated, inverted, written to files."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from helpers.differences import derivative

from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.lens_files import lens_from_dict, lens_to_dict
from fisheye_svp_ros.io.lens_formats.ros import distortion_lens
from fisheye_svp_ros.optics.camera import (
    back_project,
    lens_columns,
    project,
    project_with_jacobian,
)
from fisheye_svp_ros.optics.image_field import ImageField
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.optics.pinhole import BrownConrady, TangentialDistortion

K = (600.0, 601.0, 640.0, 480.0)
RATIONAL = (0.3, 0.02, 0.001, -0.002, 0.001, 0.5, 0.03, 0.001)
PRISM = (0.01, 0.002, -0.01, 0.003)
MODELS = {
    'plumb_bob, radial': ('plumb_bob', (-0.28, 0.09, 0.0, 0.0, 0.0)),
    'plumb_bob': ('PLUMB_BOB', (-0.28, 0.09, 0.004, -0.003)),
    'rational': ('rational_polynomial', RATIONAL),
    'thin prism': ('rational_polynomial', (*RATIONAL, *PRISM)),
    'tilt': ('rational_polynomial', (*RATIONAL, *PRISM, 0.02, -0.03)),
    'a fold beyond the image': ('plumb_bob', (-0.3, 0.05, 0.001, 0.0, -0.005)),
    'no name': ('', ()),
}


@pytest.fixture(params=MODELS)
def model(request: pytest.FixtureRequest) -> tuple[str, tuple[float, ...]]:
    return MODELS[request.param]


def lens(model: tuple[str, tuple[float, ...]]) -> Lens:
    return distortion_lens(model[0], (1280, 960), K, model[1], 'camera', 'camera_info')


def points(count: int = 300) -> np.ndarray:
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-1, 1, (2, count)) * [[0.95], [0.75]]
    return np.stack([x, y, np.ones(count)], axis=-1) * rng.uniform(0.4, 3.0, (count, 1))


def opencv(d: tuple[float, ...], seen: np.ndarray) -> np.ndarray:
    matrix = np.array([[K[0], 0, K[2]], [0, K[1], K[3]], [0, 0, 1.0]])
    numbers = np.array(d or [0.0] * 4)
    return cv2.projectPoints(seen, np.zeros(3), np.zeros(3), matrix, numbers)[0][:, 0]


def test_it_projects_as_opencv_does_up_to_the_corners(model) -> None:
    image, expected = project(lens(model), points()), opencv(model[1], points())
    inside = ((expected > 0) & (expected < (1279, 959))).all(axis=1)
    assert inside.sum() > 200 and image.valid[inside].all()
    np.testing.assert_allclose(image.uv[image.valid], expected[image.valid], rtol=0, atol=1e-9)


def test_beyond_where_the_image_folds_nothing_is_seen() -> None:
    folded = lens(('plumb_bob', (-0.5, 0.05, 0.0, 0.0, 0.0)))
    theta = np.linspace(0.0, 1.4, 100)
    rays = np.stack([np.sin(theta), 0 * theta, np.cos(theta)], axis=-1)
    image = project(folded, rays)
    assert 30 < np.degrees(theta[image.valid].max()) < 45
    assert (np.diff(image.uv[image.valid, 0]) > 0).all()


def test_a_ray_returns_to_its_image_point(model) -> None:
    one = lens(model)
    image = project(one, points())
    rays = back_project(one, image.uv[image.valid])
    assert rays.valid.all()
    ways = points()[image.valid]
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    np.testing.assert_allclose(rays.direction, ways, rtol=0, atol=1e-11)


def test_its_derivatives_are_those_of_differences(model) -> None:
    field = ImageField(
        np.array([90.0, 80.0]),
        np.array([75.0, 80.0]),
        np.random.default_rng(1).normal(0.0, 0.3, (11, 14, 2)),
    )
    one = replace(lens(model), image_field=field)
    seen = points(40)[project(one, points(40)).valid]
    linear = project_with_jacobian(one, seen)
    for axis in range(3):
        step = np.eye(3)[axis]
        expected = derivative(lambda t, step=step: project(one, seen + t * step).uv, 1e-3)
        np.testing.assert_allclose(linear.d_point[..., axis], expected, rtol=1e-6, atol=1e-5)
    names = [*one.parameters]
    columns = lens_columns(one, linear, names)
    for i, name in enumerate(names):
        value, size = one.parameters[name], 1.0 if name in ('fx', 'fy', 'cx', 'cy') else 1e-3

        def changed(t: float, name: str = name, value: float = value) -> np.ndarray:
            return project(one.with_parameters([name], [value + t]), seen).uv

        expected = derivative(changed, size)
        np.testing.assert_allclose(columns[..., i], expected, rtol=1e-6, atol=2e-5)


def test_a_lens_file_holds_it(model) -> None:
    one = lens(model)
    again = lens_from_dict(lens_to_dict(one))
    np.testing.assert_array_equal(project(again, points()).uv, project(one, points()).uv)


def test_the_angle_of_every_height_is_found() -> None:
    curve = BrownConrady(-0.28, 0.09)
    theta = np.array([0.0, 1e-9, 0.3, 1.2, 1.5, 1.57])
    np.testing.assert_allclose(curve.angle(curve.value_and_slope(theta)[0]), theta, atol=1e-12)
    assert np.isnan(curve.angle(np.array([np.nan]))).all()


@pytest.mark.parametrize(
    ('entry', 'reason'),
    [
        ({'p3': 0.1}, r"corrections.tangential: unknown field 'p3'"),
        ({'p1': 'x'}, 'corrections.tangential: p1 is'),
        ({'tau_x': 2.0}, 'tangential: tau_x is 2.0'),
    ],
)
def test_an_entry_of_no_lens_is_refused(entry: dict, reason: str) -> None:
    document = lens_to_dict(lens(MODELS['plumb_bob']))
    document['corrections'] = {'tangential': entry}
    with pytest.raises(LensError, match=reason):
        lens_from_dict(document)
    assert TangentialDistortion(p1=0.1).check() == ''
