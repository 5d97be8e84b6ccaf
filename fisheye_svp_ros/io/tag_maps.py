"""Maps of tags: YAML with the id, size and pose of each; those of apriltag_ros and WPILib, too.

A tag's frame is that of apriltag_ros: the middle of the tag, x right, y up, z out of it.
The errors of all tags stand in a file beside the map, which names it (`covariance`): the inverse
of their covariance, which is sparse.  A map that has `stderr_m` alone has tags with errors of
their own.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple
from zipfile import BadZipFile

import numpy as np
from numpy.linalg import LinAlgError

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.errors import ObservationError
from fisheye_svp_ros.io.files import dump_yaml, read_bytes, read_yaml, replacing, write_text
from fisheye_svp_ros.pose import (
    Pose,
    cross_matrix,
    quaternion_from_rotation,
    rotation_from_quaternion,
)
from fisheye_svp_ros.scene.observations import Landmarks

CORNERS = 4  # of a tag, landmark CORNERS * id + corner: from its lower left, against the clock
CENTER_OFFSET = 100_000_000  # landmark of the middle of a tag, before its id
_FAMILY_PREFIX = re.compile(r'^(dict_)?(april)?_?(tag)?_?')
_MAX_ID = 1_000_000
_MAX_SIZE = 10.0  # m; a larger tag is a slip of the unit
_LAYOUT_SIZE = 0.1651  # m: 6.5 inches, of the tags of FRC since 2024; layouts state no size
# Our axes in those of WPILib's tags: x out of the tag, y to the right of a beholder, z up
_OF_LAYOUT = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
_SIZE_TOLERANCE = 1e-6  # relative
_MAX_STDERR = 10.0  # m
_COVARIANCE_SUFFIX = '.covariance.npz'
_UNIT_CORNERS = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) / 2


class TagMap(NamedTuple):
    """Tags (T,): id, side, m, pose in the frame of the map; family: '' where it is not stated.

    note: what was assumed, '' for nothing.
    covariance (6 T, 6 T), m and rad, of the changes in `Pose.retract` of all tags; None: they
    are exact.
    """

    ids: Index
    sizes: Array
    poses: Pose
    family: str = ''
    note: str = ''
    covariance: Array | None = None

    @property
    def stderr(self) -> Array:
        """Root mean square distances (T,) of tags from where the map has them, m."""
        if self.covariance is None:
            return np.zeros(len(self.ids))
        variances = np.diagonal(self.covariance).reshape(-1, 6)
        return np.asarray(np.sqrt(variances[:, :3].sum(axis=1)))

    @property
    def corners(self) -> Array:
        """The corners (T, CORNERS, 3), m."""
        local = self.sizes[:, None, None] * _UNIT_CORNERS
        turned = local @ np.swapaxes(self.poses.rotation, -1, -2)
        return np.asarray(turned + self.poses.position[:, None])

    def landmarks(self) -> Landmarks:
        """Return corners and middles as landmarks."""
        ids = (CORNERS * self.ids[:, None] + np.arange(CORNERS)).ravel()
        points = self.corners.reshape(-1, 3)
        return Landmarks(
            np.concatenate([ids, CENTER_OFFSET + self.ids]),
            np.concatenate([points, self.poses.position]),
        )

    def landmark_covariance(self, landmark: Index) -> Array | None:
        """Return the covariances (S, N, 3, N, 3), m^2, of landmarks (S, N) of this map.

        None where they are exact.  Those of a number below 0, padding, are those of any tag.
        """
        if self.covariance is None:
            return None
        center, order = landmark >= CENTER_OFFSET, np.argsort(self.ids)
        slot = np.searchsorted(self.ids, tags_of(landmark), sorter=order)
        tag = order[np.minimum(slot, len(order) - 1)]
        arm = self.corners[tag, landmark % CORNERS] - self.poses.position[tag]
        turned = -cross_matrix(np.where(center[..., None], 0.0, arm))
        by_tag = np.concatenate([np.broadcast_to(np.eye(3), turned.shape), turned], axis=-1)
        rows = 6 * tag[..., None] + np.arange(6)
        of_tags = self.covariance[rows[:, :, None, :, None], rows[:, None, :, None]]
        points = by_tag[:, :, None] @ of_tags @ np.swapaxes(by_tag, -1, -2)[:, None]
        return np.asarray(np.swapaxes(points, 2, 3))


def tags_of(landmarks: Index) -> Index:
    """Return the tags (...) that landmarks (...) of `TagMap.landmarks` belong to."""
    corner = landmarks < CENTER_OFFSET
    return np.asarray(np.where(corner, landmarks // CORNERS, landmarks - CENTER_OFFSET))


def are_of_tags(landmarks: Index) -> bool:
    """Say whether landmarks (N,) are those of a map: all corners of some tags, and their middles.

    Those of other targets have no numbers as high as the middles of tags.
    """
    if landmarks.max(initial=0) < CENTER_OFFSET:
        return False
    tags, counts = np.unique(tags_of(landmarks), return_counts=True)
    return bool((counts == CORNERS + 1).all() and np.isin(CENTER_OFFSET + tags, landmarks).all())


def map_of_size(
    ids: Index, size: float, poses: Pose, family: str = '', covariance: Array | None = None
) -> TagMap:
    """Return a map of tags (T,) of one size, m."""
    return TagMap(ids, np.full(len(ids), size), poses, family, '', covariance)


def tag_covariance(information: Array) -> Array:
    """Return the covariance (6 T, 6 T) of tags from its inverse (6 T, 6 T).

    What has no information at all, a tag that is the origin of the map, has no error.
    """
    free = np.flatnonzero(np.diagonal(information) > 0)
    scale = np.sqrt(np.diagonal(information)[free])
    unit = np.linalg.inv(information[np.ix_(free, free)] / np.outer(scale, scale))
    covariance = np.zeros_like(information)
    covariance[np.ix_(free, free)] = (unit + unit.T) / 2 / np.outer(scale, scale)
    return covariance


def read_tag_map(path: str | Path, size: float | None = None) -> TagMap:
    """Read a map of tags, the bundles of a tags.yaml of apriltag_ros, or a layout of WPILib.

    size: side of the tags, m, as stated elsewhere.
    Raises ObservationError, naming file, tag and field, also for another size in the file.
    """
    document = read_yaml(path, ObservationError)
    bundles = document.get('tag_bundles')
    if isinstance(bundles, list):
        entries = [
            _from_bundle(one)
            for bundle in bundles
            if isinstance(bundle, Mapping)
            for one in bundle.get('layout') or ()
        ]
    else:
        entries = document.get('tags') or []
    if not isinstance(entries, list) or not entries:
        raise ObservationError(
            f'{path}: it holds no tags; a list `tags` with id, size and pose, or tag_bundles of '
            'apriltag_ros, is needed'
        )
    unsized = any(_is_of_layout(entry) and 'size' not in entry for entry in entries)
    tags = [
        _read_tag(
            _from_layout(entry, size or _LAYOUT_SIZE, f'{path}: tag {number}')
            if _is_of_layout(entry)
            else entry,
            f'{path}: tag {number}',
        )
        for number, entry in enumerate(entries)
    ]
    ids = np.array([tag[0] for tag in tags], dtype=np.int64)
    if len(np.unique(ids)) < len(ids):
        twice = next(one for one in ids.tolist() if (ids == one).sum() > 1)
        raise ObservationError(f'{path}: tag id {twice} is listed twice; remove one')
    sizes, poses = np.array([tag[1] for tag in tags]), Pose.stack([tag[2] for tag in tags])
    if size and (other := np.abs(sizes / size - 1) > _SIZE_TOLERANCE).any():
        raise ObservationError(
            f'{path}: tag {ids[other][0]} is {1000 * sizes[other][0]:.4g} mm wide, not '
            f'{1000 * size:.4g} mm as stated; leave that size out'
        )
    covariance = _own_errors(np.array([tag[3] for tag in tags]))
    if (name := document.get('covariance')) is not None:
        covariance = _read_covariance(Path(path), name, ids, covariance)
    note = _size_note(path) if unsized and not size else ''
    family, errors = _read_family(document, path), covariance if covariance.any() else None
    return TagMap(ids, sizes, poses, family, note, errors)


def check_family(seen: str, stated: str, where: str) -> None:
    """Raise ObservationError where tags that were seen are of another family than the map's.

    Names as libapriltag and OpenCV have them: tag36h11, 36h11, DICT_APRILTAG_36H11.  What is not
    known passes.
    """
    if seen and stated and _plain_family(seen) != _plain_family(stated):
        raise ObservationError(
            f'{where}: its tags are of family {seen!r}, those of the map of {stated!r}; set the '
            'detector to that family, or map the tags again'
        )


def write_tag_map(
    tags: TagMap, path: str | Path, about: str = '', information: Array | None = None
) -> None:
    """Write a map of tags; about: a line of comment.

    information (6 T, 6 T): the inverse of its covariance, see `tag_covariance`, which is written
    beside the map; without it, tags have standard errors alone.
    """
    entries = [
        {
            'id': int(tags.ids[i]),
            'size': float(tags.sizes[i]),
            'pose': {
                'position': tags.poses.position[i].tolist(),
                'quaternion': quaternion_from_rotation(tags.poses.rotation[i]).tolist(),
            },
            **({} if tags.covariance is None else {'stderr_m': float(tags.stderr[i])}),
        }
        for i in range(len(tags.ids))
    ]
    document: dict[str, Any] = {'tags': entries}
    if information is not None:
        beside = Path(path).with_suffix(_COVARIANCE_SUFFIX)
        _write_information(beside, tags.ids, information)
        document = {'covariance': beside.name, **document}
    head = f'# {about}\n' if about else ''
    family = {'family': tags.family} if tags.family else {}
    write_text(path, head + dump_yaml({**family, **document}))


def _plain_family(name: str) -> str:
    return _FAMILY_PREFIX.sub('', name.lower()).replace('_', '')


def _read_family(document: Mapping[str, Any], path: str | Path) -> str:
    family = document.get('family', document.get('tag_family', ''))
    if not isinstance(family, str):
        raise ObservationError(f'{path}: family is {family!r:.40}; a name such as 36h11 is needed')
    return family


def _is_of_layout(entry: Any) -> bool:
    """Say whether a tag is one of a field layout of WPILib."""
    return isinstance(entry, Mapping) and 'ID' in entry


def _from_layout(entry: Mapping[str, Any], size: float, where: str) -> dict[str, Any]:
    """Return a tag of a field layout of WPILib as one of a map; size: where it states none, m."""
    try:
        place, turn = entry['pose']['translation'], entry['pose']['rotation']['quaternion']
        position = [float(place[axis]) for axis in 'xyz']
        quaternion = np.array([float(turn[axis]) for axis in 'XYZW'])
        if not (np.isfinite(quaternion).all() and quaternion.any()):
            raise ValueError
    except (TypeError, KeyError, ValueError) as cause:
        raise ObservationError(
            f'{where} (ID {entry["ID"]!r:.40}): pose needs translation (x, y, z) and '
            'rotation.quaternion (W, X, Y, Z)'
        ) from cause
    turned = quaternion_from_rotation(rotation_from_quaternion(quaternion) @ _OF_LAYOUT)
    pose = {'position': position, 'quaternion': turned.tolist()}
    return {'id': entry['ID'], 'size': entry.get('size', size), 'pose': pose}


def _size_note(path: str | Path) -> str:
    return (
        f'{path}: a field layout states no size of its tags; {1000 * _LAYOUT_SIZE:.1f} mm is '
        'taken; for another, add "size" in m to each tag'
    )


def _own_errors(stderr: Array) -> Array:
    """Return the covariance (6 T, 6 T) of tags with errors (T,) of their own, m, of places."""
    variances = np.zeros((len(stderr), 6))
    variances[:, :3] = stderr[:, None] ** 2 / 3
    return np.diag(variances.ravel())


def _write_information(path: Path, ids: Index, information: Array) -> None:
    """Write the blocks that are not zero, of tags ids[row] and ids[column]."""
    blocks = np.swapaxes(information.reshape(len(ids), 6, len(ids), 6), 1, 2)
    row, column = np.nonzero(np.triu(blocks.any(axis=(2, 3))))
    with replacing(path) as temporary:
        np.savez_compressed(
            temporary, ids=ids, row=row, column=column, information=blocks[row, column]
        )


def _read_covariance(path: Path, name: Any, ids: Index, own: Array) -> Array:
    """Return the covariance (6 T, 6 T) that a map names; of tags not in that file, their own.

    Raises ObservationError, naming the file.
    """
    if not isinstance(name, str):
        raise ObservationError(f'{path}: covariance is {name!r:.40}; the name of a file is needed')
    data = read_bytes(path.parent / name, ObservationError)
    try:
        known, covariance = _covariance_in(data)
    except (ValueError, KeyError, IndexError, EOFError, BadZipFile, LinAlgError) as cause:
        raise ObservationError(
            f'{path.parent / name}: no covariance of tags; run `fisheye-svp map` again, or remove '
            f'`covariance` from {path.name}'
        ) from cause
    mine, theirs = (
        (6 * found[:, None] + np.arange(6)).ravel()
        for found in np.intersect1d(ids, known, return_indices=True)[1:]
    )
    own[mine] = 0.0
    own[np.ix_(mine, mine)] = covariance[np.ix_(theirs, theirs)]
    return own


def _covariance_in(archive: bytes) -> tuple[Index, Array]:
    """Return ids (T,) and their covariance (6 T, 6 T); raise ValueError where it is none."""
    with np.load(BytesIO(archive), allow_pickle=False) as data:
        ids, row, column = (data[key].astype(np.int64) for key in ('ids', 'row', 'column'))
        upper = data['information'].astype(np.float64)
    blocks = np.zeros((len(ids), len(ids), 6, 6))
    blocks[column, row], blocks[row, column] = np.swapaxes(upper, -1, -2), upper
    information = np.swapaxes(blocks, 1, 2).reshape(6 * len(ids), -1)
    covariance = tag_covariance(information)
    values = np.diagonal(information)
    if not (np.isfinite(covariance).all() and (values >= 0).all()):
        raise ValueError
    np.linalg.cholesky(information[np.ix_(values > 0, values > 0)])
    return ids, covariance


def _from_bundle(entry: Any) -> Any:
    """Return a tag of a bundle, which has its pose as seven numbers, as one of a map."""
    if not isinstance(entry, Mapping):
        return entry
    pose = {
        'position': [entry.get(key, 0.0) for key in ('x', 'y', 'z')],
        'quaternion': [entry.get(key, float(key == 'qw')) for key in ('qx', 'qy', 'qz', 'qw')],
    }
    return {'id': entry.get('id'), 'size': entry.get('size'), 'pose': pose}


def _read_tag(entry: Any, where: str) -> tuple[int, float, Pose, float]:
    if not isinstance(entry, Mapping):
        raise ObservationError(f'{where} is {entry!r:.40}; id, size and pose are needed')
    number, size, pose = (entry.get(key) for key in ('id', 'size', 'pose'))
    if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < _MAX_ID:
        raise ObservationError(f'{where}: id is {number!r:.40}; a whole number is needed')
    where = f'{where} (id {number})'
    if isinstance(size, bool) or not isinstance(size, int | float) or not 0 < size <= _MAX_SIZE:
        raise ObservationError(
            f'{where}: size is {size!r:.40}; meters above 0 and up to {_MAX_SIZE:g} are needed'
        )
    try:
        position = np.array(dict(pose or {})['position'], dtype=np.float64)
        quaternion = np.array(dict(pose or {})['quaternion'], dtype=np.float64)
    except (TypeError, KeyError, ValueError) as cause:
        raise ObservationError(f'{where}: pose needs position and quaternion') from cause
    sound = position.shape == (3,) and quaternion.shape == (4,)
    if not sound or not np.isfinite([*position, *quaternion]).all() or not quaternion.any():
        raise ObservationError(
            f'{where}: pose needs a position of 3 numbers, m, and a quaternion x, y, z, w'
        )
    stderr = entry.get('stderr_m', 0.0)
    if (
        isinstance(stderr, bool)
        or not isinstance(stderr, int | float)
        or not 0 <= stderr <= _MAX_STDERR
    ):
        raise ObservationError(
            f'{where}: stderr_m is {stderr!r:.40}; meters from 0 to {_MAX_STDERR:g} are needed'
        )
    return number, float(size), Pose(rotation_from_quaternion(quaternion), position), float(stderr)
