"""Single corners: how far they scatter is what is stated, also oblique ones and small ones."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from cv2 import GaussianBlur

from fisheye_svp_ros.detect.corner_fit import Corners, _Problem, edge_clearance, fit_corners
from fisheye_svp_ros.detect.windows import windows

SIDE, COUNT, BLUR, NOISE = 41, 150, 0.6, 1.5


def corners(
    angle: float, clearance: float, square: bool, band: int = 0, gain: float = 0.0
) -> tuple[Corners, float]:
    """Fit a corner seen COUNT times in noise; return it, and how far it scatters, px.

    band: columns of the first image's right edge that something else covers; gain: of a sensor
    whose scale ends at 255.
    """
    rng = np.random.default_rng(0)
    axes = np.array([[1.0, 0.0], [np.cos(np.radians(angle)), np.sin(np.radians(angle))]])
    place = 20 + np.array([0.21, -0.37])
    fine = (np.arange(5 * SIDE) + 0.5) / 5 - 0.5
    x, y = np.meshgrid(fine - place[0], fine - place[1])
    # A blurred corner is a blurred picture of a sharp one: on a grid of fifths of a pixel.
    sides = [np.sign(x * np.sin(np.radians(angle)) - y * np.cos(np.radians(angle))), np.sign(y)]
    sharp = (1 + sides[0]) * (1 + sides[1]) / 2 - 1 if square else sides[0] * sides[1]
    soft = GaussianBlur(sharp, (0, 0), 5 * BLUR).reshape(SIDE, 5, SIDE, 5).mean(axis=(1, 3))
    image = 120 + 95 * np.tile(soft, (1, COUNT))
    image += NOISE * rng.standard_normal(image.shape)
    image[:, SIDE - band : SIDE] = 0.0
    if gain:
        image = np.clip(np.round(gain * image), 0, 255).astype(np.uint8)
    start = np.stack([place[0] + SIDE * np.arange(COUNT), np.full(COUNT, place[1])], axis=-1)
    found = fit_corners(
        image,
        start + rng.uniform(-0.3, 0.3, start.shape),
        np.tile(axes, (COUNT, 1, 1)),
        np.full(COUNT, clearance),
        square,
    )
    error = (found.uv - start)[found.ok]
    return found, float(np.sqrt(((error - error.mean(axis=0)) ** 2).mean()))


@pytest.mark.parametrize(
    ('angle', 'clearance', 'square'),
    [
        (90, 40, False),
        (90, 13, False),
        (70, 20, False),
        (50, 20, False),
        (40, 20, False),
        (70, 9, False),
        (90, 6, False),
        (90, 12, True),
        (60, 20, True),
    ],
)
def test_scatter_is_the_stated_sigma(angle: float, clearance: float, square: bool) -> None:
    found, scatter = corners(angle, clearance, square)
    assert found.ok.mean() > 0.97
    assert scatter / np.sqrt((found.sigma[found.ok] ** 2).mean()) == pytest.approx(1.0, abs=0.2)


def test_light_beyond_the_end_of_the_scale_is_none_that_was_measured() -> None:
    """Brightness above it was taken for noiseless, and sigma came out too small."""
    found, scatter = corners(90, 20, False, gain=1.2)
    assert found.ok.mean() > 0.97
    assert scatter / np.sqrt((found.sigma[found.ok] ** 2).mean()) == pytest.approx(1.0, abs=0.1)


@pytest.mark.filterwarnings('ignore:Mean of empty', 'ignore:invalid value')
@pytest.mark.parametrize('gain', [2.0, 3.0])
def test_a_window_of_which_little_is_not_overexposed_holds_no_corner(gain: float) -> None:
    """Fewer pixels than unknowns were fitted without a residual, and sigma was next to nothing."""
    found, _ = corners(90, 6, False, gain=gain)
    assert not found.ok.any()


def test_sigma_is_that_of_the_photograph_where_a_window_tells_little() -> None:
    found, _ = corners(90, 13, False)
    assert found.sigma.std() < 0.06 * found.sigma.mean()


def test_a_corner_by_the_edge_of_the_field_is_none() -> None:
    found, _ = corners(90, 40, False, band=12)
    assert not found.ok[0]
    assert found.ok[1:].all()


@pytest.mark.parametrize(
    ('bend', 'blur', 'column', 'slope'),
    [(1 / 200, 1.6, 20.3, 0.0), (0.0, 1.0, 6.3, 0.0), (0.0, 1.0, 20.3, 0.012)],
)
def test_bent_edges_the_border_and_slopes_of_light_move_no_corner(
    bend: float, blur: float, column: float, slope: float
) -> None:
    """Blur moves a bent edge inwards; smoothing sees the image's mirror image at its border."""
    fine = (np.arange(5 * SIDE) + 0.5) / 5 - 0.5
    x, y = np.meshgrid(fine - column, fine - 20.2)
    x, y = x + 0.37 * y, y - 0.37 * x
    sharp = np.sign(y + 0.5 * bend * x * x) * np.sign(x + 0.5 * bend * y * y)
    soft = GaussianBlur(sharp, (0, 0), 5 * blur).reshape(SIDE, 5, SIDE, 5).mean(axis=(1, 3))
    axes = np.array([[[1.0, 0.37], [-0.37, 1.0]]])
    light = 1 + slope * (np.arange(SIDE) - column)
    image = (120 + 95 * soft) * light
    found = fit_corners(image, np.array([[column, 20.2]]), axes, np.array([30.0]))
    assert found.ok[0]
    assert found.uv[0] == pytest.approx([column, 20.2], abs=0.006)


def test_windows_of_soft_corners_end_before_the_next_edge() -> None:
    clearance = edge_clearance(np.array([12.0, 40.0]), np.array([0.6, 0.6]))
    assert clearance == pytest.approx([15.1, 60.2], abs=1)
    assert edge_clearance(np.array([12.0]), np.array([2.5])) < 12


def test_wild_states_are_lost_in_silence() -> None:
    image = np.tile([[10.0, 200.0], [200.0, 10.0]], (20, 20))
    cut = windows(image, np.array([[20.0, 20.0]]), 5.0)
    problem = _Problem(cut, np.array([5.0]), np.zeros((1, 2)), False)
    values = problem.start(np.eye(2)[None])
    values[:, 4] = 1e200
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        cost, _ = problem.linearize((values,), np.arange(1))
    assert np.isinf(cost[0])
