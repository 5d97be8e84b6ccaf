"""A simulated robot in a room of 12 tags: a walk, a map, poses of its base, a filter.

Without --map, somebody walks through the room with the robot's fisheye: its photographs, for
`fisheye-svp map`, and its lens are written.  With the map that comes of these, the robot drives a
loop: the tags in its photographs are found and localized by, and the pose of the base with its
covariance goes into an extended Kalman filter with the formulas of robot_localization (odometry as
twist, the pose as absolute measurement).  The truth then says how large errors are, and whether
covariances are: the normalized squared error (NEES) of a pose has the mean of its dimension.

    python examples/where_is_my_robot.py [DIR] [--images 24] [--seed 0] [--map DIR/tags.yaml]
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

import cv2
import matplotlib.pyplot as plt
import numpy as np

from fisheye_svp_ros.detect.tags import find_tags
from fisheye_svp_ros.effects.forward import ForwardModel, back_project_corrected, project_corrected
from fisheye_svp_ros.io.files import write_json
from fisheye_svp_ros.io.lens_files import save_lens
from fisheye_svp_ros.io.tag_maps import TagMap, read_tag_map, write_tag_map
from fisheye_svp_ros.optics.curves import KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, carried_pose, rotation_from_vector
from fisheye_svp_ros.scene.observations import views_of
from fisheye_svp_ros.solve.poses import solve_poses

LENS = Lens(
    'robot',
    800,
    600,
    210.0,
    210.0,
    399.5,
    299.5,
    KannalaBrandt(0.02, -0.008, 0.002, -0.0003),
    np.radians(90),
)
SIZE, SIGMA = 0.30, 0.10  # m, side of a tag; px, noise of a corner that the detector leaves
ROOM = (3.0, 2.2)  # m, half of length and width
STEP, TWISTS = 0.5, 10  # s between images; odometry in between
MOUNT = Pose(  # the camera in the base: 0.4 m up, looking ahead and a little up
    np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    @ rotation_from_vector(np.array([0.25, 0.0, 0.0])),
    np.array([0.15, 0.0, 0.4]),
)
FINE = 3  # rays along each side of a pixel


def room_tags() -> TagMap:
    """Return 12 tags on four walls, 0.7 to 1.6 m up, none of them quite square to its wall."""
    rng = np.random.default_rng(4)
    poses = []
    for wall in range(4):
        along, across = (ROOM[0], ROOM[1]) if wall % 2 == 0 else (ROOM[1], ROOM[0])
        for place in (-0.6, 0.0, 0.6):
            angle = wall * np.pi / 2
            inward = np.array([np.sin(angle), -np.cos(angle), 0.0])
            right = np.array([np.cos(angle), np.sin(angle), 0.0])
            axes = np.stack([right, [0.0, 0.0, 1.0], inward], axis=-1)
            middle = -across * inward + place * along * right
            middle[2] = rng.uniform(0.7, 1.6)
            poses.append(Pose(axes @ rotation_from_vector(rng.normal(0, 0.05, 3)), middle))
    return TagMap(np.arange(12), np.full(12, SIZE), Pose.stack(poses))


def drive(count: int) -> Pose:
    """Return poses of the base (count,): an oval, heading along it."""
    angle = 2 * np.pi * np.arange(count) / count
    x, y = 1.5 * np.cos(angle), 0.9 * np.sin(angle)
    heading = np.arctan2(0.9 * np.cos(angle), -1.5 * np.sin(angle))
    turn = np.stack([0 * angle, 0 * angle, heading], axis=-1)
    return Pose(rotation_from_vector(turn), np.stack([x, y, 0 * x], axis=-1))


def walk(count: int, rng: np.random.Generator) -> Pose:
    """Return poses of a camera (count,) that somebody carries about where the robot drives."""
    base = drive(count)
    turn = rotation_from_vector(rng.normal(0, 0.1, (count, 3))) @ base.rotation
    carried = Pose(turn, base.position + rng.normal(0, 0.1, (count, 3)))
    return carried.compose(MOUNT.broadcast_to(count))


class Renderer:
    """Photographs of tags: each pixel is the mean of FINE x FINE rays."""

    def __init__(self, tags: TagMap) -> None:
        step = (np.arange(FINE) + 0.5) / FINE - 0.5
        v, u = np.mgrid[: LENS.height, : LENS.width].astype(float)
        uv = np.stack([u, v], axis=-1)[:, None, :, None] + np.stack(
            np.broadcast_arrays(step[:, None, None], step[:, None])[::-1], axis=-1
        ).reshape(1, FINE, 1, FINE, 2)
        uv = np.asarray(uv.reshape(FINE * LENS.height, FINE * LENS.width, 2))
        rays = back_project_corrected(LENS, uv.reshape(-1, 2))
        self._rays = np.where(rays.valid[:, None], rays.direction, np.nan).reshape(
            (*uv.shape[:2], 3)
        )
        family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        # OpenCV prints a tag turned by half.
        self._prints = [
            np.rot90(cv2.aruco.generateImageMarker(family, int(i), 8), 2) for i in tags.ids
        ]
        self._tags = tags

    def photograph(self, camera: Pose, rng: np.random.Generator) -> np.ndarray:
        """Return what a camera sees, in grey."""
        light = np.full(self._rays.shape[:2], 110.0, np.float32)
        for tag, print_ in enumerate(self._prints):
            pose = self._tags.poses.take(tag)
            sheet = pose.transform(
                0.8 * SIZE * np.array([[x, y, 0.0] for x in (-1, 1) for y in (-1, 1)])
            )
            image = project_corrected(LENS, camera.into_body(sheet))
            if not image.valid.all() or pose.into_body(camera.position[None])[0, 2] < 0:
                continue
            low = np.floor(np.clip(image.uv.min(axis=0) - 20, 0, None)).astype(int) * FINE
            high = np.ceil(image.uv.max(axis=0) + 20).astype(int) * FINE
            part = slice(low[1], max(high[1], 0)), slice(low[0], max(high[0], 0))
            origin = pose.into_body(camera.position[None])[0]
            ray = self._rays[part] @ (camera.rotation.T @ pose.rotation)
            with np.errstate(divide='ignore', invalid='ignore'):
                reach = -origin[2] / ray[..., 2]
                place = (origin[:2] + reach[..., None] * ray[..., :2]) / SIZE
            with np.errstate(invalid='ignore'):
                paper = (np.abs(place) < 0.8).all(axis=-1) & (reach > 0)
                ink = (np.abs(place) < 0.5).all(axis=-1) & (reach > 0)
            view = light[part]
            view[paper] = 225.0
            cell = np.floor(8 * (place[ink] * [1, -1] + 0.5)).astype(int).clip(0, 7)
            view[ink] = np.where(print_[cell[:, 1], cell[:, 0]] > 127, 225.0, 25.0)
        grey = light.reshape(LENS.height, FINE, LENS.width, FINE).mean(axis=(1, 3))
        grey = cv2.GaussianBlur(grey, (0, 0), 0.5) + rng.normal(0, 2.0, grey.shape)
        return np.clip(np.round(grey), 0, 255).astype(np.uint8)


class Filter:
    """The extended Kalman filter of robot_localization in the plane: x, y, yaw."""

    step = STEP / TWISTS  # s

    def __init__(self, state: np.ndarray, covariance: np.ndarray) -> None:
        self.state, self.covariance = state, covariance

    def predict(self, twist: np.ndarray, noise: np.ndarray) -> None:
        """Move by a twist (forward m/s, yaw rad/s) over a step, with variances of it."""
        yaw = self.state[2] + 0.5 * twist[1] * self.step
        move = np.array([np.cos(yaw), np.sin(yaw)])
        self.state = self.state + self.step * np.array([*(twist[0] * move), twist[1]])
        f = np.eye(3)
        f[:2, 2] = self.step * twist[0] * np.array([-move[1], move[0]])
        g = self.step * np.array([[move[0], 0], [move[1], 0], [0, 1]])
        g[:2, 1] = 0.5 * self.step**2 * twist[0] * np.array([-move[1], move[0]])
        self.covariance = f @ self.covariance @ f.T + g @ np.diag(noise) @ g.T

    def correct(self, measured: np.ndarray, covariance: np.ndarray) -> None:
        """Take a pose in, as `pose0` with x, y and yaw."""
        gain = self.covariance @ np.linalg.inv(self.covariance + covariance)
        off = measured - self.state
        off[2] = (off[2] + np.pi) % (2 * np.pi) - np.pi
        self.state = self.state + gain @ off
        keep = np.eye(3) - gain
        # Joseph's form, as robot_localization has it.
        self.covariance = keep @ self.covariance @ keep.T + gain @ covariance @ gain.T


class Track(NamedTuple):
    """Errors (F, D) and covariances (F, D, D) of poses."""

    error: np.ndarray
    covariance: np.ndarray

    def nees(self) -> np.ndarray:
        """Return normalized squared errors (F,)."""
        solved = np.linalg.solve(self.covariance, self.error[..., None])[..., 0]
        return np.asarray((self.error * solved).sum(axis=-1))


def photographs(tags: TagMap, cameras: Pose, seed: int) -> list[np.ndarray]:
    """Render what a camera sees from each of its poses."""
    renderer, rng = Renderer(tags), np.random.default_rng(seed)
    return [renderer.photograph(cameras.take(i), rng) for i in range(len(cameras.position))]


def localize_bases(
    tags: TagMap, found: list[tuple[np.ndarray, np.ndarray]]
) -> tuple[np.ndarray, Pose, np.ndarray]:
    """Return which images could be posed, poses of the base and covariances (F, 6, 6)."""
    slots = {int(one): i for i, one in enumerate(tags.ids)}
    uv = np.full((len(found), len(slots), 4, 2), np.nan)
    for i, (ids, corners) in enumerate(found):
        for one, corner in zip(ids.tolist(), corners, strict=True):
            if one in slots:
                uv[i, slots[one]] = corner
    posed = np.flatnonzero(np.isfinite(uv[..., 0, 0]).any(axis=1))
    points = np.tile(tags.corners.reshape(-1, 3), (len(posed), 1, 1))
    uv = uv.reshape(len(found), -1, 2)[posed]
    views = views_of(points, uv, np.full(uv.shape[:2], 1 / SIGMA))
    landmark = np.tile((4 * tags.ids[:, None] + np.arange(4)).ravel(), (len(posed), 1))
    views = views._replace(landmark_covariance=tags.landmark_covariance(landmark))
    solution = solve_poses(ForwardModel(LENS), views)
    carried = [
        carried_pose(solution.pose.take(i), solution.covariance[i], MOUNT.inverse())
        for i in range(len(posed))
    ]
    return posed, Pose.stack([one[0] for one in carried]), np.stack([one[1] for one in carried])


def into_room(frame: Pose, pose: Pose, covariance: np.ndarray) -> tuple[Pose, np.ndarray]:
    """Return poses (F,) and covariances (F, 6, 6) that were in a frame which stands in a room."""
    turn = np.kron(np.eye(2), frame.rotation)
    return frame.broadcast_to(len(covariance)).compose(pose), turn @ covariance @ turn.T


def planar(pose: Pose, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return x, y, yaw of poses (F,) and their covariances (F, 3, 3)."""
    yaw = np.arctan2(pose.rotation[:, 1, 0], pose.rotation[:, 0, 0])
    keep = np.ix_(np.arange(len(yaw)), [0, 1, 5], [0, 1, 5])
    return np.column_stack([pose.position[:, :2], yaw]), covariance[keep]


def run_filter(
    path: Pose, posed: np.ndarray, measured: np.ndarray, covariance: np.ndarray
) -> Track:
    """Filter odometry along a path (TWISTS F,) and poses; return the errors beside each image."""
    true = planar(path, np.zeros((len(path.position), 6, 6)))[0]
    rng, noise = np.random.default_rng(1), np.array([0.03, 0.03])  # m/s, rad/s
    ekf = Filter(measured[0].copy(), covariance[0].copy())
    errors, covariances = [], []
    for i in range(TWISTS * int(posed[0]), len(true)):
        if errors:
            change = true[i] - true[i - 1]
            turn = (change[2] + np.pi) % (2 * np.pi) - np.pi
            twist = np.array([np.linalg.norm(change[:2]), turn]) / ekf.step
            ekf.predict(twist + rng.normal(0, noise), noise**2)
            here = np.flatnonzero(TWISTS * posed == i)
            if here.size:
                ekf.correct(measured[here[0]], covariance[here[0]])
        off = ekf.state - true[i]
        off[2] = (off[2] + np.pi) % (2 * np.pi) - np.pi
        errors.append(off)
        covariances.append(ekf.covariance)
    return Track(np.array(errors)[::TWISTS], np.stack(covariances)[::TWISTS])


def draw(
    path: Path, tags: TagMap, base: Pose, measured: np.ndarray, tracks: dict[str, Track]
) -> None:
    """Draw the drive from above, and the errors of both within their standard errors."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 4))
    left.plot(*base.position[:, :2].T, color='0.6', label='true')
    left.plot(*measured[:, :2].T, '.', color='C0', label='base_pose')
    left.plot(*tags.poses.position[:, :2].T, 's', color='k', label='tags')
    left.set(aspect='equal', xlabel='x (m)', ylabel='y (m)')
    left.legend(fontsize=8)
    for color, (name, track) in zip(('C0', 'C1'), tracks.items(), strict=True):
        stderr = np.sqrt(track.covariance[:, 0, 0] + track.covariance[:, 1, 1])
        right.plot(1e3 * np.linalg.norm(track.error[:, :2], axis=1), color=color, label=name)
        right.plot(2e3 * stderr, ':', color=color, label=f'{name}: two standard errors')
    top = 1.6 * right.get_ylim()[1]  # room for the legend
    right.set(xlabel='image', ylabel='position error (mm)', ylim=(0, top))
    right.legend(fontsize=8, loc='upper center')
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def take_a_walk(tags: TagMap, count: int, seed: int, folder: Path) -> None:
    """Write the photographs of a walk, the lens and the true map."""
    cameras = walk(count, np.random.default_rng(seed))
    (folder / 'walk').mkdir(parents=True, exist_ok=True)
    for i, image in enumerate(photographs(tags, cameras, seed)):
        cv2.imwrite(str(folder / 'walk' / f'{i:04d}.png'), image)
    save_lens(LENS, folder / 'lens.yaml')
    write_tag_map(tags, folder / 'true_tags.yaml')


def drive_by_map(
    tags: TagMap, known: TagMap, count: int, seed: int, folder: Path
) -> dict[str, float]:
    """Drive by a map whose origin is tag 0 of the room; draw it, return what came of it."""
    path = drive(TWISTS * count)
    base = path.take(np.arange(0, TWISTS * count, TWISTS))
    cameras = base.compose(MOUNT.broadcast_to(count))
    found = [find_tags(image) for image in photographs(tags, cameras, 1000 + seed)]
    origin = tags.poses.take(0)  # where the frame of the map stands in the room
    posed, *solved = localize_bases(known, found)
    pose, covariance = into_room(origin, *solved)
    measured, planar_covariance = planar(pose, covariance)
    alone = Track(pose.difference(base.take(posed)), covariance)
    filtered = run_filter(path, posed, measured, planar_covariance)
    flat_error = np.column_stack([alone.error[:, :2], alone.error[:, 5]])
    draw(
        folder / 'where_is_my_robot.png',
        tags,
        base,
        measured,
        {'base_pose': Track(flat_error, planar_covariance), 'filter': filtered},
    )
    true_tags = tags.poses.take(np.searchsorted(tags.ids, known.ids))
    there = origin.broadcast_to(len(known.ids)).compose(known.poses)
    return {
        'images': count,
        'posed': len(posed),
        'tags_mapped': len(known.ids),
        'map_error_mm': 1e3 * rms(there.position - true_tags.position),
        'map_stderr_mm': 1e3 * rms(known.stderr[:, None]),
        'base_error_mm': 1e3 * rms(alone.error[:, :3]),
        'base_nees_of_6': float(alone.nees().mean()),
        'base_within_95': float((alone.nees() < 12.59).mean()),
        'filter_error_mm': 1e3 * rms(filtered.error[:, :2]),
        'filter_nees_of_3': float(filtered.nees().mean()),
    }


def rms(vectors: np.ndarray) -> float:
    """Return the root mean square length of vectors (N, D)."""
    return float(np.sqrt((vectors**2).sum(axis=-1).mean()))


def main() -> None:
    """Walk, or drive by a map; print and write what came of it."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('output', type=Path, nargs='?', default=Path('robot'))
    parser.add_argument('--images', type=int, default=24)
    parser.add_argument('--seed', type=int, default=0, help='of the noise')
    parser.add_argument('--map', type=Path, help='map of the walk, to drive by')
    args = parser.parse_args()
    if args.map is None:
        take_a_walk(room_tags(), args.images, args.seed, args.output)
        return
    known = read_tag_map(args.map)
    figures = drive_by_map(room_tags(), known, args.images, args.seed, args.output)
    write_json(args.output / 'figures.json', figures)
    for name, value in figures.items():
        print(f'{name}: {value:.3g}')


if __name__ == '__main__':
    main()
