"""Maps beside OpenCV's where there is one viewpoint; exact at their range where there is none."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest
from helpers.photographs import LENS as SHIFTED

from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.optics.curves import Gennery, KannalaBrandt, Stereographic
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.optics.ports import FlatGlass
from fisheye_svp_ros.rectify.cameras import PROJECTIONS, camera_for, rectified_camera
from fisheye_svp_ros.rectify.errors import image_error, search_ranges, tolerated_ranges
from fisheye_svp_ros.rectify.maps import Rectification

SVP = Lens(
    'svp',
    1280,
    800,
    420.0,
    421.0,
    633.3,
    404.4,
    KannalaBrandt(-0.02, 0.003, -0.001, 0.0001),
    np.radians(95.0),
)
MOVING = replace(SVP, name='moving', viewpoint_shift=Gennery(e0=0.004, e1=0.001))
CORRECTED = replace(
    SVP, name='corrected', corrections={'decentering': {'parameters': {'p1': 1e-3, 'p2': -2e-3}}}
)
STEREOGRAPHIC = replace(
    SVP, name='stereographic', image_height=Stereographic(), viewpoint_shift=Gennery(0.001, 0.003)
)
LENSES = [SVP, MOVING, CORRECTED, STEREOGRAPHIC]


@pytest.mark.parametrize('degrees', [60.0, 100.0, 150.0])
def test_an_svp_lens_has_the_maps_of_opencv(degrees: float) -> None:
    camera = rectified_camera('pinhole', (900, 700), np.radians(degrees))
    maps = Rectification(SVP, camera).maps
    k = np.array([[SVP.fx, 0, SVP.cx], [0, SVP.fy, SVP.cy], [0, 0, 1]])
    d = np.array(SVP.image_height.coefficients)
    theirs = cv2.fisheye.initUndistortRectifyMap(
        k, d, np.eye(3), camera.k, (900, 700), cv2.CV_32FC1
    )
    assert maps.mask.any() and maps.u.dtype == maps.v.dtype == np.float32
    for own, other in zip(maps[:2], theirs, strict=True):
        assert np.abs(own - other)[maps.mask].max() < 1e-3


@pytest.mark.parametrize('projection', PROJECTIONS)
@pytest.mark.parametrize('along_baseline', [False, True])
def test_pixels_and_directions_there_and_back(projection: str, along_baseline: bool) -> None:
    if projection == 'fisheye' and along_baseline:
        return
    camera = rectified_camera(projection, (64, 48), np.radians(120.0), along_baseline)
    assert np.degrees(camera.field_of_view) == pytest.approx(120.0)
    u, v = np.meshgrid(np.arange(64.0), np.arange(48.0))
    directions = camera.directions(u, v)
    assert np.linalg.norm(directions, axis=-1) == pytest.approx(1.0)
    assert camera.project(2.5 * directions) == pytest.approx(np.stack([u, v], axis=-1))
    middle = camera.directions(np.array(camera.cx), np.array(camera.cy))
    assert middle == pytest.approx([0.0, 0.0, 1.0])
    # The edges of the outer pixels are as far apart as the field of view is wide.
    ends = camera.directions(np.array([-0.5, 63.5]), np.array([camera.cy] * 2))
    assert np.degrees(np.arccos(ends[0] @ ends[1])) == pytest.approx(120.0)


def test_a_whole_turn_and_what_lies_past_the_poles() -> None:
    camera = rectified_camera('equirectangular', (360, 240), np.radians(360.0))
    mask = Rectification(SVP, camera).maps.mask
    assert not mask[:31].any() and not mask[-31:].any()  # beyond 90 degrees up and down
    assert mask[120, 180] and not mask[120, 0]  # ahead, and behind
    u, v = np.meshgrid(np.arange(360.0), np.r_[:29.5, 210.5:240])
    assert np.abs(camera.directions(u, v) - [0, 0, -1]).max() == 0


@pytest.mark.parametrize(
    ('projection', 'along_baseline', 'degrees'),
    [
        ('pinhole', True, 90.0),
        ('cylindrical', True, 90.0),
        ('cylindrical', False, 180.6),
        ('equirectangular', True, 180.0),
    ],
)
def test_where_u_is_a_tangent_the_field_of_view_is_90_degrees(
    projection: str, along_baseline: bool, degrees: float
) -> None:
    camera = camera_for([SVP], projection, along_baseline=along_baseline)
    assert np.degrees(camera.field_of_view) == pytest.approx(degrees, abs=0.1)


def test_errors_near_the_poles_of_a_sphere_are_angles() -> None:
    camera = rectified_camera('equirectangular', (180, 180), np.radians(180.0))
    side = Rectification(replace(SHIFTED, max_incidence=np.radians(95.0)), camera, 0.3)
    error = image_error(side, np.array([np.inf]))
    directions = camera.directions(*error.pixels.T)
    image, seen = side.image_points(directions, np.inf)
    angles = np.arccos((camera.directions(*side.rectified_points(image).T) * directions).sum(1))
    assert error.px[0][seen] == pytest.approx(camera.f * angles[seen], abs=1e-4)


@pytest.mark.parametrize('lens', LENSES, ids=lambda lens: lens.name)
@pytest.mark.parametrize('projection', PROJECTIONS)
def test_what_is_at_the_range_is_where_an_ideal_camera_has_it(lens: Lens, projection: str) -> None:
    side = Rectification(lens, camera_for([lens], projection, (320, 200)), 0.7)
    rows, columns = np.nonzero(side.maps.mask)
    chosen = np.random.default_rng(0).choice(len(rows), 200)
    pixels = np.stack([columns[chosen], rows[chosen]], axis=-1).astype(float)
    points = 0.7 * side.camera.directions(*pixels.T)
    image = side.project(points)
    assert image.valid.all()
    assert np.abs(side.maps.u[rows, columns][chosen] - image.uv[:, 0]).max() < 1e-3
    assert np.abs(side.maps.v[rows, columns][chosen] - image.uv[:, 1]).max() < 1e-3
    assert np.abs(side.rectified_points(image.uv) - pixels).max() < 1e-6


def test_corrections_of_the_lens_are_taken_out() -> None:
    camera = camera_for([SVP], 'pinhole')
    plain, corrected = (Rectification(lens, camera).maps for lens in (SVP, CORRECTED))
    assert np.abs(plain.u - corrected.u)[plain.mask].max() > 1.0


def test_the_mask_is_what_the_lens_and_the_photograph_reach() -> None:
    narrow = replace(SVP, max_incidence=np.radians(30.0))
    camera = rectified_camera('pinhole', (400, 400), np.radians(90.0))
    u, v = np.meshgrid(np.arange(400.0), np.arange(400.0))
    off_axis = np.arccos(camera.directions(u, v)[..., 2])
    maps = Rectification(narrow, camera).maps
    np.testing.assert_array_equal(maps.mask, off_axis <= np.radians(30.0))
    white = np.full((SVP.height, SVP.width), 255, np.uint8)
    image = Rectification(narrow, camera).remap(white, cv2.INTER_LANCZOS4)
    np.testing.assert_array_equal(image > 0, maps.mask)


def test_the_mask_ends_at_the_centers_of_the_outer_pixels() -> None:
    side = Rectification(SVP, rectified_camera('fisheye', (600, 600), np.radians(185.0)))
    directions = side.camera.directions(*np.meshgrid(np.arange(600.0), np.arange(600.0)))
    uv = project(SVP, directions).uv
    inside = ((uv >= 0) & (uv <= [SVP.width - 1, SVP.height - 1])).all(axis=-1)
    np.testing.assert_array_equal(side.maps.mask, inside)
    for near in (uv + 1.0, [SVP.width, SVP.height] - uv):  # there are pixels beside each edge
        assert ((near >= 0) & (near < 1)).any(axis=(0, 1)).all()


def test_photographs_of_another_size_are_refused() -> None:
    side = Rectification(SVP, camera_for([SVP], 'pinhole'))
    with pytest.raises(ParameterError, match="1280x801 px, lens 'svp' is for 1280x800"):
        side.remap(np.zeros((801, 1280), np.uint8))
    color = np.zeros((800, 1280, 3), np.uint16)
    assert side.remap(color).shape == (800, 1280, 3)
    assert side.remap(color).dtype == np.uint16


def test_what_the_shift_leaves_is_measured_in_the_image() -> None:
    """At another range a point's image, looked up in the maps, is as far off as stated."""
    side = Rectification(MOVING, camera_for([MOVING], 'pinhole'), 2.0)
    ranges = np.array([0.3, 2.0, np.inf])
    error = image_error(side, ranges)
    assert np.nanmax(error.px[1]) < 1e-6
    maps = np.stack([side.maps.u, side.maps.v], axis=-1)
    slope = np.stack(np.gradient(maps, axis=(1, 0)), axis=-1)
    u, v = error.pixels.astype(int).T
    for row, range_m in ((0, 0.3), (2, 1e6)):
        image = side.project(range_m * side.camera.directions(u.astype(float), v.astype(float)))
        off = np.linalg.solve(slope[v, u], (image.uv - maps[v, u])[..., None])[..., 0]
        assert np.linalg.norm(off, axis=-1) == pytest.approx(error.px[row], rel=0.05, abs=2e-3)
    assert np.nanmax(error.px[0]) > 1.0


def test_the_ranges_that_are_tolerated_end_where_the_error_is_half_a_pixel() -> None:
    side = Rectification(MOVING, camera_for([MOVING], 'cylindrical'), 2.0)
    ranges = search_ranges(side)
    near, far = tolerated_ranges(ranges, image_error(side, ranges).px, 2.0)
    assert near < 2.0 < far < np.inf
    ends = image_error(side, np.array([near, far])).px
    assert np.nanmax(ends, axis=1) == pytest.approx([0.5, 0.5], abs=0.01)
    for earlier, later in pairwise((1.02 * near, 2.0, 0.98 * far)):
        between = image_error(side, np.linspace(earlier, later, 9)).px
        assert np.nanmax(between) < 0.5
    near, far = tolerated_ranges(ranges, image_error(side, ranges).px, 2.0, limit=100.0)
    assert near == pytest.approx(0.1) and far == np.inf


def test_impossible_cameras_and_ranges_are_refused() -> None:
    for projection, degrees, text in (
        ('pinhole', 180.0, 'above 0 and at most 175'),
        ('fisheye', 361.0, 'at most 360'),
        ('cylindrical', np.nan, 'field of view is nan'),
        ('round', 90.0, "'round' is unknown"),
    ):
        with pytest.raises(ParameterError, match=text):
            rectified_camera(projection, (640, 480), np.radians(degrees))
    with pytest.raises(ParameterError, match='size is 0x480'):
        rectified_camera('pinhole', (0, 480), 1.0)
    with pytest.raises(ParameterError, match='has no straight epipolar rows; choose from pinhole'):
        rectified_camera('fisheye', (640, 480), 1.0, along_baseline=True)
    for range_m in (0.0, -1.0, np.nan, 0.003):
        with pytest.raises(ParameterError, match=r"range is .*lens 'small' needs more than"):
            Rectification(SHIFTED, camera_for([SHIFTED], 'pinhole'), range_m)


def test_behind_a_port_maps_are_exact_at_their_range_too() -> None:
    lens = replace(SHIFTED, max_incidence=np.radians(60.0), port=FlatGlass(0.02, 1.33))
    side = Rectification(lens, rectified_camera('pinhole', (200, 160), np.radians(60.0)), 0.5)
    assert side.maps.mask.mean() > 0.9
    error = image_error(side, np.array([0.3, 0.5]))
    assert np.nanmax(error.px[1]) < 1e-6 < 0.1 < np.nanmax(error.px[0])
