"""Mirror images of the convention are told, with which one it is; other conventions are not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.flawed_sets import Camera, board, draw_views, observe

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.commands.notes import note_upwards
from fisheye_svp_ros.diagnosis import Flaw, adequacy
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.scene.observations import Observations, group_views
from fisheye_svp_ros.solve.lens_calibration import calibrate
from fisheye_svp_ros.solve.mirrored_points import Mirror, find_mirror, mirror_by_lens

CAMERA = Camera(f=260.0, cx=331.0, cy=226.0, size=(640, 480))
MIRRORS: dict[Mirror, Callable[[Observations], Observations]] = {
    Mirror.V_UPWARDS: lambda table: replace(table, uv=table.uv * [1, -1] + [0, 479]),
    Mirror.UV_EXCHANGED: lambda table: replace(table, uv=table.uv[:, ::-1]),
    Mirror.Y_REVERSED: lambda table: replace(table, xyz=table.xyz * [1, -1, 1]),
    Mirror.U_LEFTWARDS: lambda table: replace(table, uv=table.uv * [-1, 1] + [639, 0]),
    Mirror.X_REVERSED: lambda table: replace(table, xyz=table.xyz * [-1, 1, 1]),
}


def sound(points: Array | None = None, angle: float = 0.5, frames: int = 10) -> Observations:
    rng = np.random.default_rng(3)
    points = board() if points is None else points
    views = draw_views(rng, points, frames, angle)
    return observe(rng, [CAMERA] * frames, views, points)


def lens_of(table: Observations) -> Lens:
    return calibrate(table, 'kannala_brandt', (640, 480)).adjusted.lens


@cache
def known_lens() -> Lens:
    return lens_of(sound(angle=0.8))


@pytest.mark.parametrize('mirror', MIRRORS)
def test_a_mirror_image_is_told_by_a_lens_that_is_known(mirror: Mirror) -> None:
    assert find_mirror(MIRRORS[mirror](sound()), known_lens()) == mirror


@pytest.mark.parametrize('mirror', MIRRORS)
def test_it_is_told_by_the_numbers_where_the_lens_is_fitted_to_it(mirror: Mirror) -> None:
    table = sound(angle=0.5 if mirror == Mirror.UV_EXCHANGED else 0.9)
    if mirror == Mirror.UV_EXCHANGED:  # as far as it lies within the image
        table = table.take((table.uv[:, 0] < 500) & (table.uv[:, 0] > 140))
    mirrored = MIRRORS[mirror](table)
    axis = mirror in (Mirror.V_UPWARDS, Mirror.U_LEFTWARDS)  # the lens is fitted to either
    expected = Mirror.ONE_AXIS if axis else mirror
    assert find_mirror(mirrored, lens_of(mirrored)) == expected


def upwards(points: Array) -> Array:
    return np.asarray(points * [1, -1, 1] + [0, np.ptp(points[:, 1]) + 0.01, 0])


def tags(points: Array) -> Array:
    """Return corners of tags from the lower left, y up, as Kalibr numbers them."""
    side = np.where(np.arange(9) % 2, 0.024, 0.0) + np.arange(9) // 2 * 0.031
    column, row = (np.round(points[:, i] / 0.03).astype(int) for i in (0, 1))
    return np.column_stack([side[column], side[5 - row], np.zeros(len(points))])


def floor(points: Array) -> Array:
    """Return markers on the floor of a room, z up."""
    return np.asarray(20 * points * [1, -1, 1])


@pytest.mark.parametrize(
    ('of', 'mirror'),
    [(np.array, None), (upwards, Mirror.Y_UPWARDS), (tags, None), (floor, None)],
)
def test_a_board_whose_y_points_up_is_no_mirror_image(
    of: Callable[[Array], Array], mirror: Mirror | None
) -> None:
    """A chessboard with z towards the camera is told, since y may have been reversed."""
    rng, points = np.random.default_rng(3), board()
    table = observe(rng, [CAMERA] * 10, draw_views(rng, points, 10), points)
    other = of(points)
    table = replace(table, xyz=other[table.landmark])
    assert find_mirror(table, known_lens()) == mirror


def test_of_mirror_images_only_a_board_whose_y_points_up_leaves_a_diagnosis_sound(
    capsys: pytest.CaptureFixture[str],
) -> None:
    table = sound()

    def flaws(points: Array) -> list[Flaw]:
        evaluation: Any = SimpleNamespace(
            problem=SimpleNamespace(observations=replace(table, xyz=points)),
            simulation=SimpleNamespace(state=SimpleNamespace(lenses=(known_lens(),))),
        )
        return list(adequacy._mirrors(evaluation))

    (flaw,) = flaws(table.xyz * [1, -1, 1])
    assert flaw.mirror == Mirror.Y_REVERSED
    assert not flaws(upwards(table.xyz))
    note_upwards(replace(table, xyz=upwards(table.xyz)), {'': known_lens()})
    note_upwards(table, {'': known_lens()})
    (line,) = capsys.readouterr().err.splitlines()
    assert 'its y points up' in line and 'count y downward' in line


def test_a_view_alone_or_seen_edge_on_has_no_side() -> None:
    table = sound()
    few = table.take(np.isin(table.landmark, [0, 1, 2, 3, 4, 5, 6]))  # on one line
    assert mirror_by_lens(group_views(MIRRORS[Mirror.V_UPWARDS](few)), known_lens()) is None


def test_one_bad_view_hides_no_mirror_image() -> None:
    """The typical view decides: a mean would follow the one with wrong points."""
    mirrored = MIRRORS[Mirror.V_UPWARDS](sound())
    wild = replace(mirrored, uv=mirrored.uv.copy())
    wild.uv[mirrored.frame == 0] += np.random.default_rng(1).uniform(-200, 200, (54, 2))
    assert mirror_by_lens(group_views(wild), known_lens()) == Mirror.V_UPWARDS


@pytest.mark.parametrize(('noise', 'size'), [(0.005, 0.5), (4.0, 0.1)])
def test_small_misfits_and_much_noise_are_no_mirror_image(noise: float, size: float) -> None:
    """Near the axis a small board fits either way, to .1 px or to its noise."""
    rng, points = np.random.default_rng(4), board() * size
    views = draw_views(rng, points, 8, 0.05)
    table = MIRRORS[Mirror.V_UPWARDS](observe(rng, [CAMERA] * 8, views, points, noise))
    assert mirror_by_lens(group_views(table), known_lens()) is None
