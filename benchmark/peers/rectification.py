"""Rectified pairs of a lens whose viewpoint moves: python -m benchmark.peers.rectification.

A board is rendered through both lenses of a rig at several ranges, high above the axes, and
rectified: with our maps, by mrcal's stereo and by OpenCV's.  Corners are refined in the
rectified images: what rows differ by, and what depths by disparity are off by, is what a stereo
matcher would meet.  mrcal refuses lenses with a moving viewpoint and says to set E = 0, which is
done.  Writes docs/results/rectification.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

import fisheye_svp_ros as fsvp
from benchmark import study
from benchmark.studies.boards import facing
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.io.lens_formats import write_foreign
from fisheye_svp_ros.optics.curves import Equidistant, Gennery
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, rotation_from_vector, vector_from_rotation
from fisheye_svp_ros.reporting.terminal import range_text
from fisheye_svp_ros.simulate.render import Exposure, Print, render

# mrcal's CAHVORE with a linearity of 0 is this lens exactly.
_SHIFT = Gennery(e0=0.006, e1=0.002)
LEFT = Lens('left', 1280, 800, 420.0, 420.0, 637.3, 403.4, Equidistant(), np.radians(95.0), _SHIFT)
RIGHT = replace(LEFT, name='right', fx=424.0, fy=424.0, cx=642.3, cy=397.4)
RIG = Pose(rotation_from_vector(np.array([0.02, 0.12, -0.05])), np.array([-0.15, 0.012, 0.02]))
RANGES = (0.3, 0.5, 1.0, 2.0)  # m
_SIZE, _FIELD = (2000, 1600), np.radians(120.0)
_COLUMNS, _ROWS, _SQUARE = 8, 6, 0.075  # inner corners, and squares of this many times the range
_PLACE = np.array([0.05, -0.52, 0.75])  # of the board, in ranges
_HEAD = """# Rectified pairs of a lens whose viewpoint moves

Written by `make peers NAME=rectification`. Rendered photographs of
1280 x 800 px of a board above the axes of a rig with a baseline of {baseline:.0f} mm, equidistant
lenses of 190 degrees, e0 = {e0:g} mm, rectified to pinhole images of 2000 x 1600 px, 120 degrees
wide. Corners are refined in the rectified images (`cv2.cornerSubPix`); all sides know the same
lens and the same rig.

Row: what the rows of a corner differ by, px. Depth: what its distance from the baseline, by
disparity, is off by, mm. Both are rms over the corners. mrcal {mrcal} refuses the lens ("Stereo
rectification is only possible with a central projection") and says to set E = 0; that is what is
shown. OpenCV {opencv} has `cv2.fisheye.stereoRectify` and no viewpoint shift.

"""


class Sides(NamedTuple):
    """What rectifies a pair: maps (2, H, W), float32, and camera matrix (3, 3) of both sides."""

    maps: tuple[NDArray[np.float32], ...]
    k: Array
    rotation: Array  # (3, 3), from the left camera to the rectified one
    baseline: float


def ours(range_m: float) -> Sides:
    """Return our maps at a range."""
    pair = fsvp.rectify_maps(LEFT, RIGHT, RIG, size=_SIZE, field_of_view=_FIELD, range_m=range_m)
    maps = tuple(np.stack(side.maps[:2]) for side in (pair.left, pair.right))
    return Sides(maps, pair.left.k, pair.left.rotation, pair.baseline)


def opencv(_: float) -> Sides:
    """Return OpenCV's maps, of the lens without its shift."""
    k, d = zip(
        *(
            (np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]]), np.zeros(4))
            for lens in (LEFT, RIGHT)
        ),
        strict=True,
    )
    r1, r2, _, p2, _ = cv2.fisheye.stereoRectify(
        k[0],
        d[0],
        k[1],
        d[1],
        (LEFT.width, LEFT.height),
        RIG.rotation,
        RIG.position[:, None],
        1024,
    )
    new = ours(1.0).k  # OpenCV's own choice of it loses most of such an image
    maps = tuple(
        np.stack(cv2.fisheye.initUndistortRectifyMap(k[i], d[i], r, new, _SIZE, cv2.CV_32FC1))
        for i, r in enumerate((r1, r2))
    )
    return Sides(maps, new, r1, -float(p2[0, 3] / p2[0, 0]))


def mrcal_stereo(_: float) -> Sides:
    """Return mrcal's maps; raises ImportError where it is not installed."""
    import mrcal

    models = []
    poses = np.zeros(6), np.concatenate([vector_from_rotation(RIG.rotation), RIG.position])
    with TemporaryDirectory() as folder:
        for lens, pose in zip((LEFT, RIGHT), poses, strict=True):
            path = Path(folder) / f'{lens.name}.cameramodel'
            write_text(path, write_foreign(lens, 'mrcal'))
            model = mrcal.cameramodel(str(path))
            kind, values = model.intrinsics()
            values[-3:] = 0.0  # E
            model.intrinsics(intrinsics=(kind, values))
            model.rt_cam_ref(pose)
            models.append(model)
    per_degree = _SIZE[0] / 2 / np.tan(_FIELD / 2) * np.pi / 180
    rectified = mrcal.rectified_system(
        models,
        az_fov_deg=119.0,
        el_fov_deg=107.0,
        az0_deg=0.0,
        el0_deg=0.0,
        pixels_per_deg_az=per_degree,
        pixels_per_deg_el=per_degree,
        rectification_model='LENSMODEL_PINHOLE',
    )
    maps = tuple(
        np.ascontiguousarray(np.moveaxis(one, -1, 0))
        for one in mrcal.rectification_maps(models, rectified)
    )
    fx, fy, cx, cy = rectified[0].intrinsics()[1]
    turn = mrcal.compose_Rt(rectified[0].Rt_cam_ref(), models[0].Rt_ref_cam())[:3]
    apart = mrcal.compose_rt(rectified[1].rt_cam_ref(), rectified[0].rt_ref_cam())[3:]
    return Sides(maps, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), turn, -float(apart[0]))


WHO: dict[str, Callable[[float], Sides]] = {
    'ours, maps at the range of the board': ours,
    'ours, maps at 0.5 m': lambda _: ours(0.5),
    'mrcal-stereo, E = 0': mrcal_stereo,
    'cv2.fisheye': opencv,
}


def scene(range_m: float) -> tuple[Array, list[NDArray[np.uint8]]]:
    """Return the corners (N, 3), m, in the left camera, and both photographs of them."""
    board = Print(_COLUMNS, _ROWS, _SQUARE * range_m)
    ahead = _PLACE / np.linalg.norm(_PLACE)
    middle = range_m * ahead + [0.075, 0.0, 0.0]
    turn = facing(ahead)
    place = Pose(turn, middle - turn @ board.corners.mean(axis=0))
    camera = place.inverse()
    images = [
        render(lens, board, pose, Exposure(noise=0.5), np.random.default_rng(number))
        for number, (lens, pose) in enumerate(
            ((LEFT, camera), (RIGHT, camera.compose(RIG.inverse())))
        )
    ]
    return place.transform(board.corners), images


def errors(sides: Sides, points: Array, images: list[NDArray[np.uint8]]) -> tuple[float, float]:
    """Return what rows differ by, px, and depths are off by, m; rms."""
    found = []
    for maps, lens, image, local in zip(
        sides.maps, (LEFT, RIGHT), images, (points, RIG.transform(points)), strict=True
    ):
        about = np.array([_inverse(maps, uv) for uv in fsvp.project(lens, local).uv])
        rectified = cv2.remap(image, maps[0], maps[1], cv2.INTER_CUBIC)
        found.append(
            cv2.cornerSubPix(
                rectified, about[:, None].astype(np.float32), (7, 7), (-1, -1), (3, 100, 1e-4)
            )
            .reshape(-1, 2)
            .astype(float)
        )
    directions = [(uv - sides.k[:2, 2]) / np.diag(sides.k)[:2] for uv in found]
    slopes = [xy[:, 0] / np.hypot(xy[:, 1], 1.0) for xy in directions]
    depth = sides.baseline / (slopes[0] - slopes[1])
    true = np.hypot(*(points @ sides.rotation.T)[:, 1:].T)
    row = found[1][:, 1] - found[0][:, 1]
    return float(np.sqrt(np.mean(row**2))), float(np.sqrt(np.mean((depth - true) ** 2)))


def _inverse(maps: NDArray[np.float32], uv: Array) -> Array:
    """Return the rectified pixel (2,) that maps (2, H, W) send to uv (2,), to some tenths."""
    row, column = np.unravel_index(
        np.argmin(np.square(maps - uv[:, None, None]).sum(axis=0)), maps.shape[1:]
    )
    row, column = np.clip(row, 1, maps.shape[1] - 2), np.clip(column, 1, maps.shape[2] - 2)
    slope = (
        np.stack(
            [
                maps[:, row, column + 1] - maps[:, row, column - 1],
                maps[:, row + 1, column] - maps[:, row - 1, column],
            ],
            axis=1,
        )
        / 2
    )
    return np.asarray(np.array([column, row]) + np.linalg.solve(slope, uv - maps[:, row, column]))


def lines() -> list[str]:
    """Return the table."""
    scenes, rows = [scene(range_m) for range_m in RANGES], []
    for name, make in WHO.items():
        try:
            found = [
                errors(make(range_m), *one) for range_m, one in zip(RANGES, scenes, strict=True)
            ]
        except ImportError as cause:
            rows.append([name, f'not measured: {cause}', *[''] * (2 * len(RANGES) - 1)])
            continue
        rows.append([name, *(f'{row:.3f} | {1e3 * depth:.2f}' for row, depth in found)])
    return study.table(
        'maps | '
        + ' | '.join(f'{range_text(range_m)}: row, px | depth, mm' for range_m in RANGES),
        rows,
        numbers=True,
    )


def main() -> None:
    """Measure and write."""

    def known(package: str) -> Any:
        try:
            return version(package)
        except PackageNotFoundError:
            return '(not installed)'

    head = _HEAD.format(
        baseline=1e3 * np.linalg.norm(RIG.position),
        e0=1e3 * _SHIFT.e0,
        mrcal=known('mrcal'),
        opencv=cv2.__version__,
    )
    path = study.RESULTS / 'rectification.md'
    write_text(path, head + '\n'.join(lines()) + '\n')
    print(path)


if __name__ == '__main__':
    main()
