"""Rays through ports: Fermat's principle, derivatives, limits, files."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.lens_files import lens_from_dict, lens_to_dict, load_lens
from fisheye_svp_ros.io.share import lens_path
from fisheye_svp_ros.optics import camera, engines
from fisheye_svp_ros.optics.curves import FlatPort, Gennery
from fisheye_svp_ros.optics.engines import port_projection
from fisheye_svp_ros.optics.lens import parameter_values
from fisheye_svp_ros.optics.ports import DomeGlass, FlatGlass
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.scene.observations import views_of
from fisheye_svp_ros.solve.localization import localize

AIR = replace(load_lens(lens_path('fish180')), viewpoint_shift=Gennery(0.001, 0.004, 0.001))
PORTS = {
    'flat': FlatGlass(0.03, 1.333, 0.05, -0.03, 0.006, 1.49),
    'dome': DomeGlass(0.06, 1.333, 0.003, -0.002, 0.01, 0.005, 1.5),
}
each_port = pytest.mark.parametrize('port', PORTS.values(), ids=PORTS)


def points(count=40):
    rng = np.random.default_rng(0)
    return rng.normal(size=(count, 3)) * [0.6, 0.6, 0.2] + [0.0, 0.0, 1.2]


def faces(port, a, b):
    """Points on the inner and the outer face from two numbers each."""
    if isinstance(port, FlatGlass):
        normal = np.array([np.tan(port.tilt_y), -np.tan(port.tilt_x), 1.0])
        normal /= np.linalg.norm(normal)
        one = np.cross(normal, [0.0, 1.0, 0.0])
        one /= np.linalg.norm(one)
        basis = np.stack([one, np.cross(normal, one)])
        return (
            port.distance * normal + a @ basis,
            (port.distance + port.thickness) * normal + b @ basis,
        )
    center = np.array([port.x, port.y, port.z])
    found = []
    for place, radius in ((a, port.radius), (b, port.radius + port.thickness)):
        height = np.sqrt(max(radius**2 - place @ place, 0.0))
        found.append(center + np.append(place, height))
    return found


def test_the_start_is_exact_where_all_rays_leave_one_viewpoint():
    lens = replace(AIR, viewpoint_shift=None, port=PORTS['flat'])
    at, way = port_projection.trace_rays(lens, lens.port.start(points()))
    assert np.abs(np.cross(points() - at.value.T, way.value.T)).max() < 1e-6


@each_port
def test_light_takes_the_shortest_way(port):
    """Fermat: of all ways through the two faces the one that is found is optically shortest."""
    lens = replace(AIR, viewpoint_shift=None, port=port)
    for point in points(3):

        def length(v, point=point):
            inner, outer = faces(port, v[:2], v[2:])
            parts = (inner, outer - inner, point - outer)
            return sum(
                n * np.linalg.norm(part)
                for n, part in zip((1.0, port.glass_index, port.medium_index), parts, strict=True)
            )

        start = 0.03 * np.tile(point[:2] / np.linalg.norm(point), 2)
        best = minimize(length, start, method='BFGS', options={'gtol': 1e-12})
        inner, _ = faces(port, best.x[:2], best.x[2:])
        expected = camera.project(lens.svp(), inner).uv
        np.testing.assert_allclose(camera.project(lens, point).uv, expected, atol=0.01)


@each_port
def test_rays_go_back_through_their_points(port):
    lens, seen = replace(AIR, port=port), points()
    image = camera.project(lens, seen)
    rays = camera.back_project(lens, image.uv)
    assert image.valid.all() and rays.valid.all()
    arm = seen - rays.origin
    off = arm - (arm * rays.direction).sum(axis=-1, keepdims=True) * rays.direction
    assert np.abs(off).max() < 1e-12


@each_port
def test_derivatives_are_those_of_differences(port):
    lens, seen, step = replace(AIR, port=port), points(), 1e-6
    linear = camera.project_with_jacobian(lens, seen)
    for axis in range(3):
        move = step * np.eye(3)[axis]
        slope = camera.project(lens, seen + move).uv - camera.project(lens, seen - move).uv
        np.testing.assert_allclose(linear.d_point[..., axis], slope / (2 * step), atol=1e-4)
    names = ['f', 's0', 'e1', *lens.port_names]
    columns = camera.lens_columns(lens, linear, names)
    for i, name in enumerate(names):
        value = parameter_values(lens, [name])[0]
        ends = [
            camera.project(lens.with_parameters([name], [value + d]), seen).uv
            for d in (-step, step)
        ]
        np.testing.assert_allclose(columns[..., i], (ends[1] - ends[0]) / (2 * step), atol=1e-4)


@each_port
def test_poses_are_found_through_a_port(port):
    """Derivatives by the pose too: they are what finds it."""
    lens, world = replace(AIR, port=port), points()[None]
    pose = Pose(rotation_from_vector(np.array([[0.05, 0.02, 0.3]])), np.array([[0.02, 0.1, -0.1]]))
    uv, valid, _ = engines.linearize_views(lens, *pose, world, True)
    assert valid.all()
    found = localize(ForwardModel(lens), views_of(world, uv))
    assert found.converged.all()
    np.testing.assert_allclose(found.pose.position, pose.position, atol=1e-9)
    assert found.iterations[0] < 12


def test_a_window_in_air_is_the_viewpoint_shift_of_one():
    lens, seen = replace(AIR, viewpoint_shift=None), points()
    window = replace(lens, viewpoint_shift=FlatPort(0.01, 1.5))
    pane = replace(lens, port=FlatGlass(0.04, 1.0, thickness=0.01, glass_index=1.5))
    np.testing.assert_allclose(
        camera.project(pane, seen).uv, camera.project(window, seen).uv, atol=1e-9
    )


def test_a_dome_about_the_viewpoint_changes_nothing():
    lens, seen = replace(AIR, viewpoint_shift=None), points()
    dome = replace(lens, port=DomeGlass(0.06, 1.333, thickness=0.005))
    np.testing.assert_allclose(
        camera.project(dome, seen).uv, camera.project(lens, seen).uv, atol=1e-9
    )


def test_what_no_ray_reaches_is_flagged():
    """Beyond the critical angle, far away; and between the camera and its port."""
    lens = replace(AIR, port=FlatGlass(0.03, 1.333), max_incidence=1.4)
    beyond = np.arcsin(1 / 1.333) + 0.05
    seen = np.array([[np.sin(beyond), 0.0, np.cos(beyond)], [0.0, 0.001, 0.02], [0.0, 0.1, 1.0]])
    image = camera.project(lens, seen * [[100.0], [1.0], [1.0]])
    assert image.valid.tolist() == [False, False, True]
    assert np.isnan(image.uv[:2]).all()
    assert camera.unique_range(lens) >= lens.port.reach == 0.03
    dome = DomeGlass(0.06, 1.333, 0.003, 0.0, 0.004, thickness=0.005)
    assert dome.reach == pytest.approx(0.07)
    edge = np.array([lens.cx + 0.999 * lens.fx * AIR.max_incidence, lens.cy])
    assert not camera.back_project(replace(lens, port=FlatGlass(0.03, 1.3, 0.0, -0.2)), edge).valid


def test_svp_is_the_lens_in_air():
    lens = replace(AIR, port=PORTS['flat'])
    assert lens.svp() == AIR.svp()
    assert lens.parameters['port_distance'] == 0.03


@each_port
def test_a_port_is_read_back(port):
    document = lens_to_dict(replace(AIR, port=port))
    assert set(document['corrections']) == {'port'}
    assert lens_from_dict(document) == replace(AIR, port=port)


@pytest.mark.parametrize(
    ('port', 'reason'),
    [
        ({'model': 'flat', 'distance': 0.03}, 'port: incomplete; add medium_index$'),
        (
            {'model': 'flat', 'distance': 0.03, 'medium_index': 0.7},
            'medium_index is 0.7; it must be',
        ),
        ({'model': 'flat', 'distance': -0.1, 'medium_index': 1.3}, 'distance is -0.1'),
        (
            {'model': 'flat', 'distance': 0.03, 'medium_index': 1.3, 'tilt_x': -2.0},
            'tilt_x is -2.0',
        ),
        ({'model': 'dome', 'radius': 0.03, 'medium_index': 1.3, 'z': 0.04}, 'inside the dome'),
        ({'model': 'oval'}, "corrections.port.model is 'oval'; choose from flat, dome"),
    ],
)
def test_an_impossible_port_is_refused(port, reason):
    document = lens_to_dict(AIR) | {'corrections': {'port': port}}
    with pytest.raises(LensError, match=reason):
        lens_from_dict(document, 'wet.yaml')
