"""Ray errors: what a motion of the camera frame does is none, and samples agree with errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.optics.curves import Equidistant, Gennery
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import rotation_from_vector
from fisheye_svp_ros.solve.ray_errors import (
    RANGES,
    SAMPLES,
    RayModel,
    map_rays,
    points_on_rays,
    ray_model,
    without_motion,
)

LENS = Lens('made', 1280, 960, 400.0, 400.0, 640.0, 480.0, Equidistant(), 1.5)
UV = np.stack(np.meshgrid(np.linspace(250, 1030, 12), np.linspace(90, 870, 12)), axis=-1).reshape(
    -1, 2
)


def focal(step: np.ndarray) -> Lens:
    return replace(LENS, fx=LENS.fx + step[0], fy=LENS.fy + step[0])


def test_points_lie_at_their_ranges_also_where_the_viewpoint_moves() -> None:
    shifted = replace(LENS, viewpoint_shift=Gennery(0.0, 0.005, 0.0, 0.0))
    points = points_on_rays(shifted, UV)
    np.testing.assert_allclose(
        np.linalg.norm(points, axis=-1),
        np.broadcast_to(np.array(RANGES)[:, None], points.shape[:2]),
    )


def test_a_motion_of_the_camera_frame_is_no_error() -> None:
    points = points_on_rays(LENS, UV)
    turned = points @ rotation_from_vector(np.array([1e-5, -2e-5, 3e-5])).T + (1e-5, 2e-5, -1e-5)
    assert np.abs(without_motion(points, turned - points)).max() < 1e-8


def test_what_moves_points_along_their_rays_is_no_error() -> None:
    points, near = points_on_rays(LENS, UV), points_on_rays(focal(np.array([4.0])), UV)
    along = 0.02 * points * np.linspace(-1, 1, len(UV))[:, None]
    np.testing.assert_allclose(
        without_motion(points, near - points + along),
        without_motion(points, near - points),
        atol=1e-12,
    )
    # The best motion is that of what is seen: no other leaves less across the rays.
    left = without_motion(points, near - points + along)
    turned = points @ rotation_from_vector(np.array([1e-4, -1e-4, 1e-4])).T + (1e-4, 1e-4, 2e-4)
    distance = np.linalg.norm(points, axis=-1, keepdims=True)
    way = points / distance
    other = (turned - points) / distance
    other = left + other - way * (other * way).sum(axis=-1, keepdims=True)
    assert (left**2).sum() < (other**2).sum()


def test_a_focal_length_off_by_one_percent_costs_a_radial_angle() -> None:
    model, there = ray_model(focal, np.array([[16.0]]), UV)
    assert there.all()
    theta = np.linalg.norm(UV - (640, 480), axis=1) / 400
    # A motion along the axis takes up most of it at the nearest range, a thirteenth at 5 m.
    np.testing.assert_allclose(model.sd[-1], 0.01 * theta, rtol=0.09)
    error = model.errors()[-1]
    rms = np.sqrt(np.mean((0.01 * theta) ** 2))
    assert error.value == pytest.approx(np.sqrt(2 / np.pi) * rms, rel=0.1)
    assert error.low < error.value < error.high
    off = without_motion(model.points, points_on_rays(focal(np.array([8.0])), UV) - model.points)
    both = model.errors(off)[-1]
    # Of two standard deviations and a normal deviate: the mean of |2 + z| over that of |z|.
    assert both.value == pytest.approx(2.017 * np.sqrt(np.pi / 2) * error.value, rel=0.07)


def test_a_map_shows_the_whole_image_and_holds_the_frame_by_the_image_points() -> None:
    """A frame held by extrapolated corners would have them good and the middle bad."""
    near_axis = UV[np.linalg.norm(UV - (640, 480), axis=1) < 250]

    def rays_of(
        uv: Array, ranges: tuple[float, ...] = RANGES, datum: int | None = None
    ) -> tuple[RayModel, Mask]:
        return ray_model(focal, np.array([[16.0]]), uv, ranges, datum=datum)

    found = map_rays(rays_of, near_axis, (1280, 960))
    assert found.sd.shape == (2, len(found.v), len(found.u)) and found.ranges == (0.3, 5.0)
    assert (found.u[[0, -1]] == (0, 1279)).all() and (found.v[[0, -1]] == (0, 959)).all()
    theta = np.hypot(*np.meshgrid(found.u - 640, found.v - 480)) / 400
    np.testing.assert_array_equal(
        np.isnan(found.sd), np.broadcast_to(theta > 1.5, (2, *theta.shape))
    )
    seen = theta < 1.4
    np.testing.assert_allclose(found.sd[1][seen], 0.01 * theta[seen], rtol=0.15, atol=3e-4)
    model, _ = rays_of(near_axis, found.ranges)  # where the points are, as they alone have it
    column, row = (
        np.abs(places - near_axis[:, i, None]).argmin(axis=1)
        for i, places in enumerate((found.u, found.v))
    )
    np.testing.assert_allclose(
        found.sd[:, row, column].max(axis=1), model.sd.max(axis=1), rtol=0.2
    )


def test_what_another_model_says_is_far_off_in_its_share_of_the_draws() -> None:
    """One in twenty, not all of them a little: the interval of the others stays narrow."""
    others = np.where(np.arange(SAMPLES) % 20 == 0, 40.0, 0.0)[None]
    model, _ = ray_model(focal, np.array([[1.0]]), UV, others=others)
    alone, _ = ray_model(focal, np.array([[1.0]]), UV)
    mixed, plain = model.errors()[-1], alone.errors()[-1]
    assert mixed.high > 10 * plain.high and mixed.low < 2 * plain.low
    assert mixed.value == pytest.approx(
        0.95 * plain.value + 0.05 * 40 / 0.8 * plain.value, rel=0.1
    )


def test_an_interval_holds_where_the_size_of_errors_is_of_few_degrees_of_freedom() -> None:
    """With few photographs stated errors were too sure of themselves, both ways."""
    rng, freedom = np.random.default_rng(2), 5.0
    model, _ = ray_model(focal, np.eye(1), UV)
    inside = []
    for known in (np.inf, freedom):
        found = []
        for estimated in rng.chisquare(freedom, 400) / freedom:
            one = model._replace(covariance=np.full((1, 1), estimated), freedom=known).errors()[1]
            size = np.sqrt(((model.columns[1] @ rng.normal(size=1)) ** 2).sum(axis=-1).mean())
            found.append(one.low <= size <= one.high)
        inside.append(np.mean(found))
    assert inside[0] < 0.92 < inside[1] < 0.98


def test_a_viewpoint_shift_costs_more_the_nearer_the_landmark_is() -> None:
    def shifted(step: np.ndarray) -> Lens:
        return replace(LENS, viewpoint_shift=Gennery(0.0, float(step[0]), 0.0, 0.0))

    model, _ = ray_model(shifted, np.array([[1e-6]]), UV)
    near, middle, far = (one.value for one in model.errors())
    assert near > 2.5 * middle > 5 * far


def test_what_is_drawn_follows_the_last_digits_of_a_covariance_no_further() -> None:
    def moved(step: np.ndarray) -> Lens:
        return replace(
            LENS, fx=400 + step[0], fy=400 + step[1], cx=640 + step[2], cy=480 + step[3]
        )

    covariance = np.diag([0.04, 0.04, 0.09, 0.09])  # eigenvalues that are alike
    rounding = 1e-16 * np.random.default_rng(1).standard_normal((4, 4))
    one, other = (
        ray_model(moved, matrix, UV)[0]
        for matrix in (covariance, covariance + rounding + rounding.T)
    )
    np.testing.assert_allclose(one.errors(), other.errors(), rtol=1e-6)
    np.testing.assert_allclose(one.sample(1), other.sample(1), atol=1e-6 * one.sd.max())


def test_a_lens_without_any_ray_has_no_errors_of_rays():
    """Frames of two cameras fit a lens that sees nothing: diagnose ended in a ValueError."""
    left = without_motion(np.zeros((3, 0, 3)), np.zeros((3, 0, 3, 5)))
    assert left.shape == (3, 0, 3, 5)
