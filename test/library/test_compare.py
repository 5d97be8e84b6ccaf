"""Two lenses compared: what differs is told, and where a lens has its camera frame is not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.lenses import FRONT

import fisheye_svp_ros as fsvp
from fisheye_svp_ros.effects.forward import back_project_corrected
from fisheye_svp_ros.errors import LensError, ParameterError
from fisheye_svp_ros.optics.camera import Rays
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.solve import lens_comparison

FISH = fsvp.load_lens('fish214')


def test_a_lens_does_not_differ_from_itself(tmp_path: Path) -> None:
    fsvp.save_lens(FRONT, tmp_path / 'lens.yaml')
    same = fsvp.compare(FRONT, tmp_path / 'lens.yaml')
    assert same.largest.max() < 1e-12


def test_a_moved_camera_frame_is_no_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    frame = Pose(rotation_from_vector(np.array([0.05, -0.3, 0.2])), np.array([0.01, 0.002, 0.02]))

    def in_its_frame(lens: fsvp.Lens, uv: np.ndarray) -> Rays:
        rays = back_project_corrected(lens, uv)
        if lens.name != 'moved':
            return rays
        return rays._replace(
            origin=frame.inverse().transform(rays.origin),
            direction=rays.direction @ frame.rotation,
        )

    monkeypatch.setattr(lens_comparison, 'back_project_corrected', in_its_frame)
    found = fsvp.compare(FISH, replace(FISH, name='moved'))
    assert found.largest.max() < 1e-9
    assert np.abs(found.motion.difference(frame)).max() < 1e-9


def test_a_viewpoint_shift_is_told_nearby() -> None:
    found = fsvp.compare(FISH, FISH.svp())
    assert found.ranges.tolist() == [0.3, 1.0, 5.0]
    # What a shift of mm leaves falls with the distance, and is 0 far away.
    np.testing.assert_allclose(found.rms * found.ranges, found.rms[1], rtol=0.02)
    assert 1e-3 < found.rms[1] < found.largest[1] < 2e-2
    # Along the axis the camera frame moves, not sideways.
    assert np.abs(found.motion.position[:2]).max() < 1e-9 < 1e-3 < found.motion.position[2]
    table = found.table()
    squares = np.array(table['rms_1m']) ** 2 @ table['points'] / sum(table['points'])
    assert squares**0.5 == pytest.approx(found.rms[1])


def test_a_focal_length_is_off_by_so_much_over_the_angle() -> None:
    found = fsvp.compare(FRONT, replace(FRONT, fx=1.01 * FRONT.fx, fy=1.01 * FRONT.fy))
    # Rays are 1 % of the angle nearer to the axis, but for the step along it that this looks like.
    far = found.angle[2] / (0.01 * found.theta)
    assert 0.3 < np.median(far) < 1.1 and found.rms[2] > found.rms[0]


def test_lenses_of_two_cameras_are_refused() -> None:
    half = fsvp.resize_lens(FISH, scale=0.5)
    with pytest.raises(LensError, match=r'1536x1536 px, those of .* 768x768 px; lenses of one'):
        fsvp.compare(FISH, half)
    aside = replace(FISH, cx=FISH.cx + 1600.0), replace(FISH, cx=FISH.cx - 1600.0)
    with pytest.raises(LensError, match='rays of 0 common image points'):
        fsvp.compare(*aside)


def test_the_picture_shows_numbers_and_image(tmp_path: Path) -> None:
    found = fsvp.compare(FISH, FISH.svp())
    figure = fsvp.plot_comparison(found)
    lines = figure.axes[0].get_legend().get_texts()
    assert [line.get_text() for line in lines] == [
        f'{range_m:g} m: {1e3 * rms:.3g} mrad rms'
        for range_m, rms in zip(found.ranges, found.rms, strict=True)
    ]
    (cells,) = (one for one in figure.axes[1].collections if len(one.get_offsets()) > 100)
    np.testing.assert_allclose(cells.get_array(), 1e3 * found.angle[1])
    with pytest.raises(ParameterError, match=r'the result of fsvp\.compare is needed'):
        fsvp.plot_comparison(FISH)  # type: ignore[arg-type]
