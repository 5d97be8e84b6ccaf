"""Whether a robot in a room of tags is ever told of a wrong pose as of a right one.

A robot drives an oval through a room of 16 tags (16 cm), with a camera on a panning mount, and is
localized in 300 images a drive: image points with .2 px of noise, odometry with 2 % of scale and
noise. In each drive one tag hangs up to .5 m from where the map has it; in 2 % of the images one
tag has another's number. Images show all tags, or two, one, or one far one; there are gaps
without images. The core functions are those of the localizer, with its default parameters:
poses by tags as units, the gate by standard deviation and ambiguity, the innovation against
odometry. Wrong: outside the stated 99.9 % ellipsoid of the base; by noise where every corner that
is shown is within 6 sigma of where the map has it.

Writes docs/results/tag_drive.md.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from benchmark import study
from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.errors import GeometryError
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.io.tag_maps import CORNERS, TagMap, map_of_size
from fisheye_svp_ros.optics.curves import KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, carried_pose, identity, rotation_from_vector
from fisheye_svp_ros.scene.observations import Views, views_of
from fisheye_svp_ros.scene.pose_priors import PlanarPrior
from fisheye_svp_ros.solve.pose_gate import GatedPose, GateLimits, OdometryGate, weakness
from fisheye_svp_ros.solve.poses import solve_poses
from fisheye_svp_ros.solve.solved_poses import SolvedPoses
from fisheye_svp_ros.solve.weak_geometry import CHI2_999, is_ambiguous

IMAGES, SIGMA = 300, 0.2  # a drive; px
TAGS, HALF = 16, (3.5, 2.5)  # m, half the sides of the room
LENS = Lens('made', 1280, 960, 330.0, 331.0, 640.5, 479.5, KannalaBrandt(0.03, -0.01), 1.5)
KINDS = ('all tags', 'two tags', 'one tag', 'one far tag')
_AHEAD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # a camera that looks ahead
_MOVED, _SWAPPED = 0.5, 0.02  # m; share of images
_PLANE = np.array([[0.02, 0.02]])  # m, rad


class Drive(NamedTuple):
    """What became of the images of a drive, each counted by kind and by end."""

    counts: Counter[tuple[str, str]]


def room(rng: np.random.Generator) -> TagMap:
    """Return tags on the four walls."""
    poses = []
    for i in range(TAGS):
        normal = np.array([[-1.0, 0, 0], [0, -1, 0], [1, 0, 0], [0, 1, 0]][i % 4])
        right = np.cross([0.0, 0.0, 1.0], normal)
        place = -normal * HALF[i % 2] + right * rng.uniform(-0.7, 0.7) * HALF[1 - i % 2]
        place[2] += rng.uniform(0.5, 2.0)
        turn = np.stack([right, [0.0, 0.0, 1.0], normal], axis=-1)
        poses.append(Pose(turn @ rotation_from_vector(rng.normal(0, 0.05, 3)), place))
    return map_of_size(np.arange(TAGS), 0.16, Pose.stack(poses))


def displaced(tags: TagMap, rng: np.random.Generator) -> TagMap:
    """Return the room as it is: one tag hangs elsewhere."""
    position, i = tags.poses.position.copy(), rng.integers(TAGS)
    shift = rng.normal(size=3)
    position[i] += rng.uniform(0.02, _MOVED) * shift / np.linalg.norm(shift)
    return tags._replace(poses=Pose(tags.poses.rotation, position))


def base_at(image: int) -> Pose:
    """Return the base on its oval, of which a drive is two rounds."""
    a = 4 * np.pi * image / IMAGES
    yaw = np.arctan2(np.cos(a), -1.6 * np.sin(a))
    return Pose(rotation_from_vector(np.array([0.0, 0.0, yaw])), [1.6 * np.cos(a), np.sin(a), 0.0])


def mount_at(image: int) -> Pose:
    """Return the camera in the base: it pans."""
    pan = rotation_from_vector(np.array([0.0, 0.0, 0.6 * np.sin(0.1 * image)]))
    return Pose(pan @ _AHEAD, [0.15, 0.02, 0.4])


def visible(tags: TagMap, model: ForwardModel, camera: Pose) -> tuple[Index, Array]:
    """Return the tags (T,) that a detector finds, and their corners (T, 4, 2), px."""
    points = views_of(tags.corners.reshape(-1, 3))
    uv = model.predict(camera.take(None), points).uv[0].reshape(-1, CORNERS, 2)
    way = camera.position - tags.poses.position
    cosine = (tags.poses.rotation[..., 2] * way).sum(axis=-1) / np.linalg.norm(way, axis=-1)
    with np.errstate(invalid='ignore'):
        inside = ((uv > 2) & (uv < [LENS.width - 3, LENS.height - 3])).all(axis=(1, 2))
        large = np.linalg.norm(uv[:, 0] - uv[:, 2], axis=-1) > 14
    found = np.flatnonzero(inside & large & (cosine > 0.35))
    return found, uv[found]


def select(kind: str, distance: Array, rng: np.random.Generator) -> Index:
    """Return which of the tags in view, by distance (T,), an image shows."""
    if kind == 'one far tag':
        return np.array([np.argmax(distance)])
    some = {'all tags': len(distance), 'two tags': 2, 'one tag': 1}[kind]
    return rng.permutation(len(distance))[:some]


def see(
    tags: TagMap, actual: TagMap, kind: str, camera: Pose, rng: np.random.Generator
) -> Views | None:
    """Return what an image shows, by the map; None where it shows no tag."""
    found, uv = visible(actual, MODEL, camera)
    if not len(found):
        return None
    distance = np.linalg.norm(actual.poses.position[found] - camera.position, axis=-1)
    chosen = select(kind, distance, rng)
    found, uv = found[chosen], uv[chosen] + SIGMA * rng.normal(size=uv[chosen].shape)
    if rng.uniform() < _SWAPPED:
        other = np.setdiff1d(np.arange(TAGS), found)
        found = np.append(found[1:], rng.choice(other))
        uv = np.roll(uv, -1, axis=0)
    board = np.repeat(found, CORNERS)[None]
    weight = np.full(board.shape, 1 / SIGMA)
    views = views_of(tags.corners[found].reshape(-1, 3), uv.reshape(1, -1, 2), weight)
    return views._replace(board=board, landmark=CORNERS * board + np.arange(board.size) % CORNERS)


def holds_map(views: Views, camera: Pose) -> bool:
    """Say whether all points of a view (1,) are where its map has them, but for noise."""
    off = views.uv - MODEL.predict(camera.take(None), views, limited=False).uv
    return bool((np.linalg.norm(off, axis=-1) < 6 * SIGMA).all())


def odometry(rng: np.random.Generator) -> list[Pose]:
    """Return the base in the frame of the odometry, an image each."""
    scale, poses = 1 + 0.02 * rng.normal(size=2), [identity()]
    for image in range(1, IMAGES):
        step = base_at(image - 1).inverse().compose(base_at(image))
        turn = np.array([0.0, 0.0, np.arctan2(step.rotation[1, 0], step.rotation[0, 0])])
        turn = scale[1] * turn * (1 + 0.05 * rng.normal())
        step = Pose(
            rotation_from_vector(turn), scale[0] * step.position * (1 + 0.05 * rng.normal())
        )
        poses.append(poses[-1].compose(step))
    return poses


def drive(number: int, planar: bool = False) -> Drive:
    """Drive once, with the gate and without."""
    rng = np.random.default_rng(number)
    tags = room(rng)
    actual, odom = displaced(tags, rng), odometry(rng)
    limits, counts, kind, gap = GateLimits(), Counter[tuple[str, str]](), KINDS[0], 0
    gate = OdometryGate(limits)
    for image in range(IMAGES):
        if image % 25 == 0:
            kind = KINDS[rng.choice(4, p=[0.4, 0.2, 0.2, 0.2])]
            gap = image + 15 if image and rng.uniform() < 0.15 else 0
        mount = mount_at(image)
        views = see(tags, actual, kind, base_at(image).compose(mount), rng)
        if image < gap or views is None:
            continue
        if planar:
            prior = PlanarPrior(mount.inverse().take(None), np.zeros(1), _PLANE)
            views = views._replace(prior=prior)
        solved = _localize(views)
        counts[kind, 'images'] += 1
        if solved is None or not solved.result.converged[0]:
            counts[kind, 'no pose'] += 1
            continue
        pose, covariance = carried_pose(
            solved.pose.take(0), solved.cautious_covariance[0], mount.inverse()
        )
        change = pose.difference(base_at(image))
        wrong = not change @ np.linalg.solve(covariance, change) < CHI2_999
        sound = holds_map(views, base_at(image).compose(mount))
        gated = GatedPose(
            pose,
            covariance,
            bool(is_ambiguous(solved.result)[0]),
            float(solved.sigmas[0]),
            solved.suspects[0],
        )
        judge = gate, limits, odom[image]
        _count(counts, kind, solved.reasons[0], gated, (wrong, sound), judge)
    return Drive(counts)


def _localize(views: Views) -> SolvedPoses | None:
    """Return the pose of an image, None where its points fix none."""
    try:
        return solve_poses(MODEL, views, tags=True)
    except GeometryError:  # three corners in the field of view of the lens
        return None


def _count(
    counts: Counter[tuple[str, str]],
    kind: str,
    reason: str,
    pose: GatedPose,
    error: tuple[bool, bool],
    judge: tuple[OdometryGate, GateLimits, Pose],
) -> None:
    """Count what becomes of a pose, see `report`; error: whether it is wrong, and by noise."""
    (gate, limits, odom), (wrong, sound) = judge, error
    counts[kind, 'ambiguous'] += pose.ambiguous
    counts[kind, 'wrong'] += wrong
    counts[kind, 'wrong, OK'] += wrong and not reason
    if weakness(pose, limits):
        counts[kind, 'weak'] += 1
        return
    verdict = gate.judge(pose, odom)
    if verdict.refused:
        counts[kind, 'off odometry'] += 1
        return
    fine = not reason and not verdict.unconfirmed
    counts[kind, '/tf, OK'] += fine
    counts[kind, '/tf, WARN'] += not fine
    counts[kind, 'wrong /tf, OK'] += wrong and fine
    counts[kind, 'by noise'] += wrong and fine and sound
    counts[kind, 'wrong /tf, WARN'] += wrong and not fine


def drive_on_plane(number: int) -> Drive:
    """Drive once, height and tilt of the base being known."""
    return drive(number, planar=True)


ENDS = (
    'images',
    'ambiguous',
    'wrong',
    'wrong, OK',
    'weak',
    'off odometry',
    '/tf, OK',
    '/tf, WARN',
    'wrong /tf, OK',
    'by noise',
    'wrong /tf, WARN',
)
MODEL = ForwardModel(LENS)


def report(free: Sequence[Drive], planar: Sequence[Drive], command: str) -> str:
    """Return the page."""
    parts = []
    for title, drives in (('without a prior', free), ('with `planar`', planar)):
        if not drives:
            continue
        total = sum((one.counts for one in drives), Counter[tuple[str, str]]())
        rows = [(kind, *(total[kind, end] for end in ENDS)) for kind in KINDS]
        whole = {end: sum(total[kind, end] for kind in KINDS) for end in ENDS}
        rows.append(('together', *whole.values()))
        kept, published = whole['weak'] + whole['off odometry'], whole['/tf, OK']
        parts += [
            [
                f'## {len(drives)} drives {title}',
                '',
                f'Wrong transforms with OK: {whole["wrong /tf, OK"]} of {published} '
                f'({whole["images"]} sets, {kept} of them kept back), {whole["by noise"]} of '
                f'these by noise, which puts .1 % outside: {published / 1000:.1f}.',
            ],
            study.table('shown | ' + ' | '.join(ENDS), rows, numbers=True),
        ]
    legend = [
        'wrong: outside the 99.9 % ellipsoid, of all poses; wrong, OK: of these, without a',
        'warning before the gate. weak: kept back for standard deviation, ambiguity or residuals;',
        'off odometry: for the innovation. WARN: a tag was rejected, or no other tag confirms it.',
    ]
    return study.page('A drive among tags', __doc__, command, *parts, legend)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the study and write its page."""
    asked = study.parser(
        'tag_drive',
        __doc__,
        drives=(34, 'drives of 300 images'),
        planar_drives=(34, 'drives with `planar`'),
    ).parse_args(arguments)
    numbers = asked.drives, asked.planar_drives
    free, planar = (
        study.in_processes(label, trial, range(number), asked.workers)
        for label, trial, number in zip(
            ('free', 'planar'), (drive, drive_on_plane), numbers, strict=True
        )
    )
    options = f'--drives {numbers[0]} --planar-drives {numbers[1]}'
    text = report(free, planar, f'make study NAME=tag_drive ARGS="{options}"')
    write_text(asked.output / 'tag_drive.md', text)
    sys.stdout.write(text)


if __name__ == '__main__':
    main()
