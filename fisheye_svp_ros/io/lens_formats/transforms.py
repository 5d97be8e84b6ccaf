"""Static transforms of a robot, which hold a rig and no lens: URDF, and what /tf_static says.

The cameras are the two frames that are called left and right and, where several are, optical.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.errors import LensError
from fisheye_svp_ros.io.files import dump_yaml, parse_number, parse_yaml
from fisheye_svp_ros.io.lens_formats import Foreign, fields
from fisheye_svp_ros.pose import (
    Pose,
    identity,
    quaternion_from_rotation,
    rotation_from_vector,
)

_Joint = tuple[str, str, Pose]  # parent, child, child in parent
_OPTICAL = 'optical'


def recognises(text: str) -> bool:
    """Say whether a text is such a file."""
    return '<robot' in text or ('child_frame_id:' in text and 'translation:' in text)


def read(text: str, where: str) -> Foreign:
    """Read the rig: the left camera in the right one; raises LensError, naming what is missing."""
    joints = list(_urdf(text, where) if '<robot' in text else _messages(text, where))
    left, right = (_joint_camera(side, joints, where) for side in ('left', 'right'))
    (root, left_pose), (right_root, theirs) = (
        _pose_in_root(left, joints),
        _pose_in_root(right, joints),
    )
    if root != right_root:
        raise LensError(f'{where}: no fixed transforms lead from {left} to {right}')
    return Foreign('transforms', {}, (theirs.inverse().compose(left_pose),), {})


def _joint_camera(side: str, joints: list[_Joint], where: str) -> str:
    frames = list(dict.fromkeys(itertools.chain.from_iterable(j[:2] for j in joints)))
    named = [frame for frame in frames if side in frame]
    named = [frame for frame in named if _OPTICAL in frame] or named
    if len(named) != 1:
        raise LensError(
            f'{where}: one frame called {side} and {_OPTICAL} is needed; there are '
            + (', '.join(named or frames) or 'no fixed transforms')
        )
    return named[0]


def _pose_in_root(frame: str, joints: list[_Joint]) -> tuple[str, Pose]:
    """Return the root of a frame's tree, and the frame in it."""
    above = {child: (parent, pose) for parent, child, pose in joints}
    pose = identity()
    for _ in joints:
        if frame not in above:
            break
        frame, step = above[frame]
        pose = step.compose(pose)
    return frame, pose


def _urdf(text: str, where: str) -> Iterator[_Joint]:
    for joint in fields.xml(text, where, 'URDF').iter('joint'):
        ends = joint.find('parent'), joint.find('child')
        if joint.get('type') == 'fixed' and ends[0] is not None and ends[1] is not None:
            origin = joint.find('origin')
            attributes = {} if origin is None else origin.attrib
            place, turn = (
                _split_numbers(attributes.get(name, '0 0 0'), f'{where}: {joint.get("name")}')
                for name in ('xyz', 'rpy')
            )
            roll, pitch, yaw = rotation_from_vector(np.diag(turn))  # about fixed axes
            yield (
                str(ends[0].get('link')),
                str(ends[1].get('link')),
                Pose(np.asarray(yaw @ pitch @ roll), place),
            )


def _split_numbers(text: str, where: str) -> Array:
    words: list[Any] = text.split()
    with suppress(ValueError):
        words = [parse_number(word) for word in words]
    return np.array(fields.numbers({'origin': words}, 'origin', 3, where))


def _messages(text: str, where: str) -> Iterator[_Joint]:
    # `ros2 topic echo` ends each message with a line of its own.
    for part in text.split('\n---'):
        document = parse_yaml(part, where, LensError) if part.strip() else {}
        entries = document.get('transforms', [document] if document else [])
        for entry in entries if isinstance(entries, list) else []:
            try:
                place, turn = (
                    [float(entry['transform'][name][axis]) for axis in axes]
                    for name, axes in (('translation', 'xyz'), ('rotation', 'xyzw'))
                )
                ends = str(entry['header']['frame_id']), str(entry['child_frame_id'])
            except (KeyError, TypeError, ValueError) as cause:
                raise LensError(f'{where}: not a whole transform ({cause!r})') from cause
            yield (*ends, fields.pose(place, turn, f'{where}: {ends[1]}'))


def urdf_text(cameras: Sequence[str], rig: Pose) -> str:
    """Return fixed joints of the cameras' optical frames, a URDF; rig (C,): in the first one."""
    frames = [f'{camera}_{_OPTICAL}_frame' for camera in cameras]
    lines = ['<robot name="rig">', f'  <link name="{frames[0]}"/>']
    for number, frame in enumerate(frames[1:], start=1):
        place, turn = rig.position[number], rig.rotation[number]
        angles = (
            np.arctan2(turn[2, 1], turn[2, 2]),
            -np.arcsin(np.clip(turn[2, 0], -1, 1)),
            np.arctan2(turn[1, 0], turn[0, 0]),
        )
        xyz, rpy = (' '.join(f'{value:.12g}' for value in values) for values in (place, angles))
        lines += [
            f'  <link name="{frame}"/>',
            f'  <joint name="{frames[0]}_to_{frame}" type="fixed">',
            f'    <parent link="{frames[0]}"/><child link="{frame}"/>',
            f'    <origin xyz="{xyz}" rpy="{rpy}"/>',
            '  </joint>',
        ]
    return '\n'.join([*lines, '</robot>', ''])


def static_transforms_text(cameras: Sequence[str], rig: Pose) -> str:
    """Return the same as a tf2_msgs/TFMessage for /tf_static, YAML."""
    frames = [f'{camera}_{_OPTICAL}_frame' for camera in cameras]
    turns = quaternion_from_rotation(rig.rotation)
    return dump_yaml(
        {
            'transforms': [
                {
                    'header': {'frame_id': frames[0]},
                    'child_frame_id': frame,
                    'transform': {
                        'translation': dict(zip('xyz', place.tolist(), strict=True)),
                        'rotation': dict(zip('xyzw', turn.tolist(), strict=True)),
                    },
                }
                for frame, place, turn in zip(frames[1:], rig.position[1:], turns[1:], strict=True)
            ]
        }
    )
