"""A room of tags, and what a camera sees of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.tag_maps import CORNERS, TagMap, map_of_size
from fisheye_svp_ros.optics.curves import KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.scene.observations import Observations, Views, make_observations, views_of

LENS = Lens('made', 1280, 960, 330.0, 331.0, 640.5, 479.5, KannalaBrandt(0.03, -0.01), 1.5)
OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # a camera that looks ahead, in its base
MOUNT = Pose(OPTICAL, np.array([0.15, 0.02, 0.4]))
# The second camera of a rig, in the first one: it looks to the left, about y, which points down
LEFT = Pose(rotation_from_vector(np.array([0.0, -1.2, 0.0])), np.array([-0.2, 0.0, 0.0]))
_MIN_SIDE = 10.0  # px
_MIN_COSINE = 0.35  # of the angle that a tag is seen under


def oval(part: float) -> Pose:
    """Return the camera of a robot that drives an oval; part: of the way, 0 to 1."""
    return oval_base(part).compose(MOUNT)


def oval_base(part: float) -> Pose:
    """Return the base of that robot."""
    a = 2 * np.pi * part
    yaw = np.arctan2(np.cos(a), -1.6 * np.sin(a))
    place = np.array([1.6 * np.cos(a), np.sin(a), 0.0])
    return Pose(rotation_from_vector(np.array([0.0, 0.0, yaw])), place)


@dataclass(frozen=True)
class TagRoom:
    """Tags on the four walls of a room of 7 by 5 m."""

    count: int
    size: float = 0.16
    seed: int = 2
    shifts: tuple[tuple[int, tuple[float, ...]], ...] = ()

    @cached_property
    def tags(self) -> TagMap:
        """The map of the tags as they hang."""
        rng, half, poses = np.random.default_rng(self.seed), (3.5, 2.5), []
        for i in range(self.count):
            normal = np.array([[-1.0, 0, 0], [0, -1, 0], [1, 0, 0], [0, 1, 0]][i % 4])
            right = np.cross([0.0, 0.0, 1.0], normal)
            place = -normal * half[i % 2] + right * rng.uniform(-0.7, 0.7) * half[1 - i % 2]
            place[2] += rng.uniform(0.5, 2.0)
            turn = np.stack([right, [0.0, 0.0, 1.0], normal], axis=-1)
            poses.append(Pose(turn @ rotation_from_vector(rng.normal(0, 0.05, 3)), place))
        pose = Pose.stack(poses)
        for tag, shift in self.shifts:
            pose.position[tag] += shift
        return map_of_size(np.arange(self.count), self.size, pose)

    def move(self, tag: int, shift: Array) -> TagRoom:
        """Return the room with one tag elsewhere, m."""
        return replace(self, shifts=(*self.shifts, (tag, tuple(shift))))

    def project(self, camera: Pose, tags: Index) -> Array:
        """Return image points (T * 4, 2), px, of the corners of some tags."""
        points = views_of(self.tags.corners[tags].reshape(-1, 3))
        return ForwardModel(LENS).predict(camera.take(None), points).uv[0]

    def visible(self, camera: Pose) -> Index:
        """Return the tags that a detector finds."""
        tags = np.arange(self.count)
        uv = self.project(camera, tags).reshape(-1, CORNERS, 2)
        way = camera.position - self.tags.poses.position
        cosine = (self.tags.poses.rotation[..., 2] * way).sum(-1) / np.linalg.norm(way, axis=-1)
        with np.errstate(invalid='ignore'):
            inside = ((uv > 2) & (uv < [LENS.width - 3, LENS.height - 3])).all(axis=(1, 2))
            side = np.linalg.norm(uv[:, 0] - uv[:, 2], axis=-1)
        return tags[inside & (side > _MIN_SIDE) & (cosine > _MIN_COSINE)]

    def views(
        self, camera: Pose, uv: Array, tags: Index, sigma: float, rng: np.random.Generator
    ) -> Views:
        """Return what a camera sees as one view, by the map of this room; boards are tags."""
        noisy = uv + sigma * rng.normal(size=uv.shape)
        views = views_of(
            self.tags.corners[tags].reshape(-1, 3), noisy[None], np.full((1, len(uv)), 1 / sigma)
        )
        landmark = (CORNERS * tags[:, None] + np.arange(CORNERS)).reshape(1, -1)
        return views._replace(landmark=landmark, board=landmark // CORNERS)

    def table(self, cameras: int = 1, frames: int = 4, sigma: float = 0.2) -> Observations:
        """Return what one camera, or two of a rig, see on the way: corners of unknown sigma."""
        rng, columns = np.random.default_rng(7), []
        for frame in range(frames):
            pose = oval(frame / frames)
            for camera in range(cameras):
                place = pose.compose(LEFT) if camera else pose
                tags = self.visible(place)
                uv = self.project(place, tags)
                landmark = (CORNERS * tags[:, None] + np.arange(CORNERS)).ravel()
                here = np.full((len(landmark), 2), [frame, camera])
                columns.append((*here.T, landmark, uv + sigma * rng.normal(size=uv.shape)))
        frame_of, camera_of, landmark, uv = map(np.concatenate, zip(*columns, strict=True))
        names = ('front', 'side') if cameras > 1 else ('',)
        xyz = self.tags.corners.reshape(-1, 3)[landmark]
        return make_observations(frame_of, landmark, uv, xyz, camera=camera_of, cameras=names)
