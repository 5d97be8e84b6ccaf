"""The one step between what came for a set and what is solved: read, compared, filtered."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from fisheye_svp_ros.arrays import Mask
from fisheye_svp_ros.errors import FisheyeSvpError, ObservationError
from fisheye_svp_ros.io.decoding import FramedPose, ImagePoints, LandmarkSet, are_different_frames
from fisheye_svp_ros.io.tag_maps import tags_of
from fisheye_svp_ros.nodes.join import NeighborPair
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.reporting.wording import inputs as wording
from fisheye_svp_ros.study.settings import SolverSettings

Items = Mapping[str, Any]

_UNKNOWN_POINTS = 'points of unknown landmarks'
_FRAME_HOLDS = 5.0  # s without a message of its frame, after which a topic may have another


class SetValidation:
    """Makes of what came for a set what can be solved, and counts what is left out of it.

    image_points: topics without which there is no set; true_poses: topics of these;
    drop: counts a message of a topic that cannot be read, and tells of it.  find: where a frame
    stands in another at a time, ns, as far as that is known.
    """

    def __init__(
        self,
        image_points: Sequence[str],
        true_poses: Sequence[str],
        drop: Callable[[str, Exception], None],
        find: Callable[[str, str, int], Pose | None],
    ) -> None:
        self.rejected: Counter[str] = Counter()  # by topic and reason, since the start
        self._image_points, self._true_poses = image_points, true_poses
        self._drop, self._find = drop, find
        self._frames: dict[str, tuple[str, float]] = {}  # by topic, and when it was last met, s

    def read(self, unread: Items) -> dict[str, Any]:
        """Return what a set holds, by topic, without what cannot be read and need not be there.

        Raises FisheyeSvpError for image points or landmarks that cannot be read.
        """
        items = {}
        for topic, item in unread.items():
            try:
                items[topic] = (
                    _interpolate(item) if isinstance(item, NeighborPair) else item.read()
                )
            except FisheyeSvpError as error:
                self._drop(topic, error)
                if topic in (*self._image_points, 'landmarks'):
                    raise
        return items

    def check(
        self, items: dict[str, Any], landmarks: LandmarkSet, settings: SolverSettings, stamp: int
    ) -> tuple[dict[str, Any], list[str]]:
        """Return what is to be solved, and what was left out of it, as sentences.

        stamp: of the set, ns.  A true pose of another frame is transformed where that is known.
        Raises ObservationError for image points of another camera, where no landmark is known,
        and, with the setting `strict`, where one is not.
        """
        checked, texts = dict(items), []
        for topic in self._image_points:
            self._check_camera(topic, items[topic].frame)
            checked[topic], reasons = self._known_points(topic, items[topic], landmarks, settings)
            texts += reasons
        for topic in self._true_poses:
            if topic not in items:
                continue
            pose, frame = items[topic]
            if not are_different_frames(frame, landmarks.frame):
                checked[topic] = pose
            elif (there := self._find(landmarks.frame, frame, stamp)) is not None:
                checked[topic] = there.compose(pose)
            else:
                del checked[topic]
                self.rejected[f'{topic}: in another frame'] += 1
                texts.append(wording.frames_differ(topic, frame, 'landmarks', landmarks.frame))
        return checked, texts

    def _known_points(
        self, topic: str, seen: ImagePoints, landmarks: LandmarkSet, settings: SolverSettings
    ) -> tuple[ImagePoints, list[str]]:
        if seen.tag is None and landmarks.of_tags:
            seen = seen._replace(tag=tags_of(seen.landmark))
        xyz, known = landmarks.landmarks.lookup(seen.landmark)
        texts = []
        if seen.rejected:
            self.rejected[f'{topic}: points without a value'] += seen.rejected
            count = len(seen.landmark) + seen.rejected
            texts.append(wording.points_without_value(topic, seen.rejected, count))
        if seen.doubtful_tags:
            assert seen.tag is not None
            self.rejected[f'{topic}: tags left out'] += seen.doubtful_tags
            count = len(np.unique(seen.tag)) + seen.doubtful_tags
            texts.append(f'{topic}: {wording.doubtful_tags(seen.doubtful_tags, count)}')
        if np.count_nonzero(known) < known.size:
            texts.append(self._tell_unknown(topic, seen, known, settings.strict))
            seen, xyz = seen.take(known), xyz[known]
        return seen._replace(xyz=xyz), texts

    def _tell_unknown(self, topic: str, seen: ImagePoints, known: Mask, strict: bool) -> str:
        """Count and name the points (N,) that are not known; raise ObservationError, see check."""
        tags = seen.tag is not None
        number = seen.landmark if seen.tag is None else seen.tag
        unknown = np.unique(number[~known]).tolist() if tags else number[~known].tolist()
        # Another camera of a rig may see tags of the map.
        alone = not (tags and len(self._image_points) > 1)
        if strict or (alone and not known.any()):
            raise ObservationError(wording.unknown_landmark(topic, unknown[0], tags))
        self.rejected[f'{topic}: {"unknown tags" if tags else _UNKNOWN_POINTS}'] += len(unknown)
        of = len(np.unique(number)) if tags else len(number)
        return wording.unknown_landmarks(topic, unknown, of, tags)

    def _check_camera(self, topic: str, frame: str) -> None:
        """Raise ObservationError for image points of another camera than those before."""
        now = time.monotonic()
        before, last = self._frames.get(topic, (frame, now))
        if are_different_frames(frame, before) and now - last < _FRAME_HOLDS:
            raise ObservationError(wording.cameras_mixed(topic, frame, before))
        self._frames[topic] = frame, now


def _interpolate(poses: NeighborPair) -> FramedPose:
    (first, frame), (second, other) = poses.first.read(), poses.second.read()
    if are_different_frames(frame, other):
        raise ObservationError(wording.frames_differ('true_pose', frame, 'true_pose', other))
    return FramedPose(Pose(*first.retract(poses.fraction * second.difference(first))), frame)
