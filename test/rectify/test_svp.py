"""The SVP lens nearest to a lens at a range."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.lenses import HEIGHTS, KITA, SHIFTS, make_lens
from helpers.photographs import LENS

from fisheye_svp_ros.effects.forward import project_corrected
from fisheye_svp_ros.errors import ParameterError
from fisheye_svp_ros.optics.curves import KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.rectify.maps import nearest_svp_lens


def image_error(lens: Lens, svp: Lens, range_m: float) -> float:
    """Return the rms difference, px, of image points at a range in and near the image."""
    theta, azimuth = np.meshgrid(
        np.linspace(0.02, 0.97 * lens.max_incidence, 40), np.linspace(0, 2 * np.pi, 24)
    )
    points = range_m * np.stack(
        [np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)], axis=-1
    )
    off = project_corrected(lens, points).uv - project_corrected(svp, points).uv
    return float(np.sqrt(np.nanmean(np.sum(off**2, axis=-1))))


@pytest.mark.parametrize('lens', [*KITA, LENS], ids=lambda lens: lens.name)
@pytest.mark.parametrize('range_m', [0.3, 1.5])
def test_it_is_near_at_its_range_and_nearer_than_the_lens_without_its_shift(
    lens: Lens, range_m: float
) -> None:
    svp, worst = nearest_svp_lens(lens, range_m)
    assert svp.viewpoint_shift is None and isinstance(svp.image_height, KannalaBrandt)
    assert worst < 0.01
    assert image_error(lens, svp, range_m) < 0.01
    dropped = image_error(lens, lens.svp(), range_m)
    assert dropped > 0.02
    # Between this range and twice it, too, where the shift left out would be as wrong as ever.
    assert image_error(lens, svp, 2 * range_m) < 1.05 * image_error(lens, lens.svp(), 2 * range_m)


def test_a_lens_of_one_viewpoint_is_its_own() -> None:
    lens = LENS.svp()
    svp, worst = nearest_svp_lens(lens, 0.4)
    assert worst < 1e-9
    assert svp.parameters == pytest.approx(lens.parameters, rel=1e-9)


def test_at_infinity_the_shift_makes_no_difference() -> None:
    svp, worst = nearest_svp_lens(LENS, np.inf)
    assert worst < 1e-6
    assert svp.parameters == pytest.approx(LENS.svp().parameters, rel=1e-5, abs=1e-7)


def test_corrections_are_in_it_as_far_as_they_can_be() -> None:
    lens = replace(LENS, corrections={'decentering': {'parameters': {'p1': 2e-3, 'p2': -1e-3}}})
    svp, worst = nearest_svp_lens(lens, 1.0)
    assert not svp.corrections
    assert image_error(lens, svp, 1.0) < 0.85 * image_error(lens, LENS, 1.0)
    assert worst > 0.5  # of a shape that it does not have


@pytest.mark.parametrize(
    'height', [name for name, (_, degrees) in HEIGHTS.items() if degrees > 85]
)
@pytest.mark.parametrize('shift', SHIFTS)
def test_every_curve_of_a_fisheye_has_one(height: str, shift: str) -> None:
    lens = make_lens(height, shift)
    svp, worst = nearest_svp_lens(lens, 1.0)
    assert worst < 0.5
    assert np.degrees(svp.max_incidence) > 85  # as far as the corner of the image


def test_a_range_within_the_lens_is_refused() -> None:
    for range_m in (0.0, 1e-4, np.nan):
        with pytest.raises(ParameterError, match=r"range is .* lens 'small' needs more than"):
            nearest_svp_lens(LENS, range_m)
