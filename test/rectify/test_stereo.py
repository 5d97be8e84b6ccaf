"""Rectified pairs: OpenCV's for an SVP lens; rows that agree at the range where there is none."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.optics.curves import Gennery, KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.rectify.cameras import camera_for, rectified_camera
from fisheye_svp_ros.rectify.errors import pair_error
from fisheye_svp_ros.rectify.maps import rectify_pair
from fisheye_svp_ros.simulate.render import Exposure, Print, render

LEFT = Lens(
    'left', 640, 400, 210.0, 210.0, 318.3, 203.4, KannalaBrandt(-0.02, 0.003), np.radians(95.0)
)
RIGHT = Lens(
    'right', 640, 400, 212.0, 211.0, 322.3, 197.4, KannalaBrandt(-0.025, 0.003), np.radians(95.0)
)
SHIFT = Gennery(e0=0.006, e1=0.002)
RIG = Pose(rotation_from_vector(np.array([0.02, 0.12, -0.05])), np.array([-0.15, 0.012, 0.02]))


def opencv(lens: Lens) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return (
        np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]]),
        np.array(lens.image_height.coefficients),
    )


def test_an_svp_pair_is_that_of_opencv() -> None:
    size = LEFT.width, LEFT.height
    given = (*opencv(LEFT), *opencv(RIGHT), size, RIG.rotation, RIG.position[:, None])
    r1, r2, p1, p2, _ = cv2.fisheye.stereoRectify(*given, 1024)  # zero disparity at infinity
    camera = rectified_camera('pinhole', size, np.radians(100.0), along_baseline=True)
    pair = rectify_pair(LEFT, RIGHT, RIG, camera)
    for side, lens, r, p in ((pair.left, LEFT, r1, p1), (pair.right, RIGHT, r2, p2)):
        assert side.rotation == pytest.approx(r, abs=1e-12)
        assert side.p[0, 3] / side.p[0, 0] == pytest.approx(p[0, 3] / p[0, 0], abs=1e-12)
        theirs = cv2.fisheye.initUndistortRectifyMap(*opencv(lens), r, side.p, size, cv2.CV_32FC1)
        assert side.maps.mask.mean() > 0.95
        for own, other in zip(side.maps[:2], theirs, strict=True):
            assert np.abs(own - other)[side.maps.mask].max() < 1e-3


@pytest.mark.parametrize('projection', ['pinhole', 'cylindrical', 'equirectangular'])
def test_rows_and_depths_at_the_range_are_those_of_one_viewpoint(projection: str) -> None:
    lenses = [replace(lens, viewpoint_shift=SHIFT) for lens in (LEFT, RIGHT)]
    camera = camera_for(lenses, projection, along_baseline=True)
    pair = rectify_pair(*lenses, RIG, camera, 0.5)
    error = pair_error(pair, np.array([0.25, 0.5, 2.0, np.inf]))
    seen = np.isfinite(error.px)
    assert seen.sum(axis=1).min() > 100
    assert np.nanmax(np.abs(error.px[1])) < 1e-6
    assert np.nanmedian(np.abs(error.depth[1])) < 1e-9
    assert np.isnan(error.depth[3]).all()
    for other in (0, 2, 3):
        assert np.nanmax(np.abs(error.px[other])) > 0.1
    assert np.nanmedian(np.abs(error.depth[2])) > 1e-3


def test_the_baseline_is_in_p_and_the_sphere_is_about_its_middle() -> None:
    pair = rectify_pair(LEFT, RIGHT, RIG, camera_for([LEFT], 'pinhole', along_baseline=True))
    length = float(np.linalg.norm(RIG.position))
    assert pair.baseline == pytest.approx(length)
    assert pair.left.p[0, 3] == 0.0
    assert pair.right.p[0, 3] == pytest.approx(-pair.right.camera.f * length)
    point = np.array([[0.1, -0.2, 0.7]])
    for side, local in ((pair.left, point), (pair.right, RIG.transform(point))):
        place = local @ side.rotation.T + [side.offset, 0.0, 0.0]
        assert place == pytest.approx(point @ pair.left.rotation.T + [pair.left.offset, 0, 0])


def test_cameras_that_do_not_stand_side_by_side_are_refused() -> None:
    camera = camera_for([LEFT], 'pinhole', along_baseline=True)
    for place in ([0.0, 0.0, 0.0], [0.0, 0.0, -0.2], [0.01, -0.3, 0.0]):
        with pytest.raises(GeometryError, match='no usable baseline'):
            rectify_pair(LEFT, RIGHT, Pose(np.eye(3), np.array(place)), camera)


def test_cameras_that_are_exchanged_have_a_baseline_below_zero() -> None:
    camera = camera_for([LEFT], 'pinhole', along_baseline=True)
    pair = rectify_pair(RIGHT, LEFT, RIG.inverse(), camera)
    assert pair.baseline < 0 < pair.right.p[0, 3]
    assert pair.left.rotation[0, 0] > 0.9  # images stay upright
    assert np.nanmax(np.abs(pair_error(pair, np.array([1.0])).px)) < 1e-6


class TestRendered:
    """Photographs of a board high above the axes, at one range, rectified; their corners."""

    BOARD = Print(8, 6, 0.03)
    SIDES = tuple(
        replace(
            lens,
            width=1280,
            height=800,
            fx=2 * lens.fx,
            fy=2 * lens.fy,
            cx=2 * lens.cx,
            cy=2 * lens.cy,
        )
        for lens in (LEFT, RIGHT)
    )

    def corners(self) -> NDArray[np.float64]:
        """Return the corners of the board (N, 3), m, in the left camera, which it faces."""
        place = self.place()
        return place.transform(self.BOARD.corners)

    def place(self) -> Pose:
        middle = np.array([0.15, -0.2, 0.22])
        ahead = (middle - [0.075, 0, 0]) / np.linalg.norm(middle - [0.075, 0, 0])
        right = np.cross([0, 1, 0], ahead) / np.hypot(ahead[0], ahead[2])
        turn = np.stack([right, np.cross(ahead, right), ahead], axis=1)
        return Pose(turn, middle - turn @ self.BOARD.corners.mean(axis=0))

    def photographs(self) -> list[NDArray[np.uint8]]:
        camera = self.place().inverse()
        return [
            render(
                replace(lens, viewpoint_shift=SHIFT),
                self.BOARD,
                pose,
                Exposure(noise=0.5),
                np.random.default_rng(3),
            )
            for lens, pose in zip(self.SIDES, (camera, camera.compose(RIG.inverse())), strict=True)
        ]

    def measured(
        self, photographs: list[NDArray[np.uint8]], shift: Gennery | None, range_m: float
    ) -> tuple[float, float]:
        """Return what rows of corners differ by, px, and depths are off by, m; rms."""
        believed = [replace(lens, viewpoint_shift=shift) for lens in self.SIDES]
        camera = rectified_camera('pinhole', (2000, 1600), np.radians(120.0), True)
        pair, points = rectify_pair(*believed, RIG, camera, range_m), self.corners()
        sides, locals_ = (pair.left, pair.right), (points, RIG.transform(points))
        about = [
            side.rectified_points(project(replace(lens, viewpoint_shift=SHIFT), local).uv)
            for side, lens, local in zip(sides, self.SIDES, locals_, strict=True)
        ]
        inside = np.all([(uv > 20) & (uv < [1980, 1580]) for uv in about], axis=(0, 2))
        assert inside.sum() > 30
        found = [
            cv2.cornerSubPix(
                side.remap(image, cv2.INTER_CUBIC),
                uv[inside, None].astype(np.float32),
                (7, 7),
                (-1, -1),
                (3, 100, 1e-4),
            )
            .reshape(-1, 2)
            .astype(float)
            for side, image, uv in zip(sides, photographs, about, strict=True)
        ]
        points = points[inside]
        true = np.hypot(*(points @ pair.left.rotation.T)[:, 1:].T)
        row, depth = found[1][:, 1] - found[0][:, 1], pair.depth(*found) - true
        return float(np.sqrt(np.mean(row**2))), float(np.sqrt(np.mean(depth**2)))

    def test_rows_agree_to_what_the_detection_allows(self) -> None:
        photographs = self.photographs()
        away = float(np.linalg.norm(self.corners() - [0.075, 0, 0], axis=1).mean())
        row, depth = self.measured(photographs, SHIFT, away)
        assert row < 0.06
        svp_row, svp_depth = self.measured(photographs, None, away)
        assert svp_row > 10 * row and svp_depth > 10 * depth
        # Maps for infinity are those of the lens without its shift.
        far_row, far_depth = self.measured(photographs, SHIFT, np.inf)
        assert (far_row, far_depth) == pytest.approx((svp_row, svp_depth), rel=0.02)
