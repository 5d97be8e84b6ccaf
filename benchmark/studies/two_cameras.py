"""Pairs of cameras that see one bent board, as real ones do: `make study NAME=two_cameras`.

Two lenses of different image sizes and focal lengths, a board with a smooth bend, stretch and
offsets of single corners, an image field of each lens and of each frame, outliers, frames that
only one camera sees or that the detector numbered from the other end.  Each is calibrated and
diagnosed as a user would, and asked what the two cameras say of each other.  Some pairs are
rendered: photographs alone go to `detect`.  Pairs that the output holds already are not run again;
writes docs/results/two_cameras.json and the table in docs/results/two_cameras.md.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from time import process_time
from typing import Any, NamedTuple

import numpy as np

from benchmark import study
from benchmark.studies.boards import draw_fields, joined
from fisheye_svp_ros.arrays import Array, Mask
from fisheye_svp_ros.detect.detection import detect
from fisheye_svp_ros.detect.patterns import parse_pattern
from fisheye_svp_ros.detect.photographs import Photograph
from fisheye_svp_ros.diagnosis import deviations, diagnose
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.optics.curves import Gennery, KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.scene.observations import STEREO, Observations, group_views, make_observations
from fisheye_svp_ros.simulate.render import Exposure, Print, render
from fisheye_svp_ros.simulate.targets import board_views
from fisheye_svp_ros.solve.localization import localize

Rng = np.random.Generator
_ROUNDS, _FAR = 3, 4.0  # of setting aside what lies so many times the median off


@dataclass(frozen=True)
class Hidden:
    """What a pair hides: shifts e0, m, of the cameras, the bend of the board, m, and background.

    apart: the right camera sees another board; late: how far, m, and three times as many rad the
    board moves before the right camera exposes; rendered: what comes from photographs, whose noise
    is that of their pixels.
    """

    shift: tuple[float, float] = (0.0, 0.0)
    bend: float = 0.0
    offset: float = 2e-5
    field: float = 0.04
    frame_field: float = 0.04
    noise: float = 0.08
    outliers: float = 0.003
    reversed_frames: int = 1
    frames: int = 36
    columns: int = 9
    rows: int = 7
    apart: bool = False
    late: float = 0.0
    rendered: bool = False


def lenses() -> tuple[Lens, Lens]:
    """Return two fisheyes that have little in common."""
    return (
        Lens('left', 1280, 960, 400.0, 401.0, 645.0, 472.0, KannalaBrandt(-0.012, 0.002), 1.5),
        Lens('right', 1024, 768, 300.0, 299.5, 505.0, 390.0, KannalaBrandt(0.03, -0.004), 1.5),
    )


def hidden_lenses(hidden: Hidden) -> list[Lens]:
    """Return the lenses that take the pictures."""
    return [
        replace(lens, viewpoint_shift=Gennery(0.0, shift))
        for lens, shift in zip(lenses(), hidden.shift, strict=True)
    ]


class Pair(NamedTuple):
    """What two cameras saw, each one's lens as calibrated, and what was hidden.

    moved (L, 3), m: where the corners are (on the left camera's board), less where they are said
    to be; reversed_frames: those that both cameras saw.
    """

    table: Observations
    lenses: dict[str, Lens]
    moved: Array
    reversed_frames: list[int]


def pair(hidden: Hidden, seed: int) -> Pair:
    """Draw a pair; the same seed gives the same views and background, whatever is hidden."""
    rng = np.random.default_rng([17, seed])
    printed = Print(hidden.columns, hidden.rows, 0.27 / hidden.columns)
    true = bent_print(printed, hidden, rng)
    boards = (true, bent_print(printed, hidden, rng) if hidden.apart else true)
    seen = hidden_lenses(hidden)
    rig = Pose(rotation_from_vector(np.array([0.01, 0.08, -0.02])), np.array([0.12, 0.004, -0.01]))
    left = _views(lenses(), printed, rig, hidden.frames, rng)
    right = left.compose(rig.broadcast_to(hidden.frames))
    if hidden.late:
        right = right.retract(
            hidden.late * rng.normal(size=(hidden.frames, 6)) * [1, 1, 1, 3, 3, 3]
        )
    poses = (left, right)
    wrong: Any = []
    if hidden.rendered:
        photographs = _photographs(seen, printed, boards, poses, rng)
        pattern = parse_pattern(
            f'chessboard:{hidden.columns}x{hidden.rows}:{1000 * printed.size}mm'
        )
        table = detect(photographs, pattern).observations
    else:
        table = joined(
            [
                photograph_print(lens, printed, board, pose, hidden, rng, camera)
                for camera, (lens, board, pose) in enumerate(zip(seen, boards, poses, strict=True))
            ]
        )
        wrong = rng.choice(hidden.frames, hidden.reversed_frames, replace=False)
        turn = np.isin(table.frame, wrong) & (table.camera == 1)
        last = len(printed.corners) - 1
        landmark = np.where(turn, last - table.landmark, table.landmark)
        table = replace(table, landmark=landmark, xyz=printed.corners[landmark])
    found = {
        name: study.calibrated(
            replace(
                table.take(table.camera == i),
                cameras=(name,),
                camera=np.zeros(int((table.camera == i).sum()), dtype=int),
            ),
            (one.width, one.height),
        )
        for i, (name, one) in enumerate(zip(STEREO, seen, strict=True))
    }
    both = np.intersect1d(*(table.frame[table.camera == i] for i in (0, 1)))
    return Pair(
        table,
        found,
        true.true_corners() - printed.corners,
        sorted(set(wrong) & set(both.tolist())),
    )


def bent_print(printed: Print, hidden: Hidden, rng: Rng) -> Print:
    """Return a board with a bend, a smooth stretch along it, single offsets of its corners."""
    flat, size = printed.corners, printed.size
    weights = rng.normal(size=6) * [1.0, 1.0, 1.0, 0.3, 0.3, 0.2]
    single = rng.normal(size=flat.shape) * hidden.offset * (not hidden.rendered)

    def part(place: Array) -> tuple[Array, Array]:
        off = (place - flat[:, :2].mean(axis=0)) / np.ptp(flat[:, 0]) * 2
        return off[..., 0], off[..., 1]

    def shape(place: Array) -> Array:
        x, y = part(place)
        terms = [x * x, x * y, y * y, x**3, x * x * y, np.cos(3 * x + 2 * y)]
        return np.asarray(np.stack(terms, axis=-1) @ weights)

    def of_corner(place: Array) -> Array:
        column, row = np.moveaxis(np.round(place / size).astype(int), -1, 0)
        return np.asarray(
            single[
                np.clip(row, 0, printed.rows - 1) * printed.columns
                + np.clip(column, 0, printed.columns - 1)
            ]
        )

    most = max(float(np.ptp(shape(flat[:, :2]))), 1e-9)

    def bow(place: Array) -> Array:
        return np.asarray(hidden.bend / most * shape(place) + of_corner(place)[..., 2])

    def shift(place: Array) -> Array:
        x, y = part(place)
        smooth = np.stack([np.cos(4 * x + y), np.sin(3 * y - x)], axis=-1)
        return np.asarray(hidden.offset * smooth + of_corner(place)[..., :2])

    return replace(printed, bow=bow, shift=shift)


def _photographs(
    seen: Sequence[Lens], printed: Print, boards: Sequence[Print], poses: Sequence[Pose], rng: Rng
) -> Iterator[Photograph]:
    """Render the frames that show a camera the whole board."""
    for name, lens, board, pose in zip(STEREO, seen, boards, poses, strict=True):
        _, whole = _image(
            lens,
            pose.into_body(
                np.broadcast_to(board.true_corners(), (len(pose.position), *printed.corners.shape))
            ),
        )
        for frame in np.flatnonzero(whole).tolist():
            yield Photograph(
                f'{name}{frame:03d}',
                f'{frame:03d}',
                name,
                np.nan,
                render(lens, board, pose.take(frame), Exposure(), rng),
            )


def _views(given: Sequence[Lens], printed: Print, rig: Pose, frames: int, rng: Rng) -> Pose:
    """Return poses of the left camera; every camera sees the board as a whole in most of them."""
    own = board_views(given[0], printed, frames - frames // 3, (0.25, 0.8), rng)
    other = board_views(given[1], printed, frames // 3, (0.25, 0.8), rng)
    back = other.compose(rig.inverse().broadcast_to(frames // 3))
    return Pose(*(np.concatenate(both) for both in zip(own, back, strict=True)))


def photograph_print(
    lens: Lens, printed: Print, board: Print, pose: Pose, hidden: Hidden, rng: Rng, camera: int
) -> Observations:
    true = board.true_corners()
    count = len(true)
    uv, whole = _image(lens, pose.into_body(np.broadcast_to(true, (hidden.frames, count, 3))))
    whole &= rng.random(hidden.frames) > 0.15
    static, own = (draw_fields(lens, rng, each, 8, (0.08, 0.3)) for each in (1, hidden.frames))
    uv = uv + hidden.field * static(uv, np.zeros(hidden.frames, dtype=int))
    uv = uv + hidden.frame_field * own(uv, np.arange(hidden.frames))
    uv = uv + hidden.noise * rng.normal(size=uv.shape)
    far = rng.random(uv.shape[:2]) < hidden.outliers
    uv = uv + (far * 10 ** rng.uniform(0.0, 1.5, far.shape))[..., None] * rng.normal(size=uv.shape)
    frame, landmark = np.nonzero(whole[:, None] & np.ones(count, dtype=bool))
    return make_observations(
        frame,
        landmark,
        uv[frame, landmark],
        printed.corners[landmark],
        camera=np.full(len(frame), camera),
        cameras=STEREO,
        source='pair',
    )


def _image(lens: Lens, points: Array) -> tuple[Array, Mask]:
    """Return where points (F, N, 3) are seen, and which frames (F,) show them all."""
    image = ForwardModel(lens).project(points)
    inside = (image.uv > 4) & (image.uv < np.array([lens.width, lens.height]) - 4)
    return image.uv, np.asarray((image.valid & inside.all(axis=-1)).all(axis=1))


KINDS = {
    'bent board, shifts of 3 and 1.5 mm': Hidden((0.003, 0.0015), 1e-3),
    'bent by 0.3 mm, shifts of 2 and 1 mm': Hidden((0.002, 0.001), 3e-4),
    'bent by 0.5 mm, background as large as the noise': Hidden(
        (0.003, 0.001), 5e-4, 1e-4, 0.1, 0.1, 0.12, 0.01, 3, 25
    ),
    'bent by 2 mm, background as large as the noise': Hidden(
        (0.003, 0.001), 2e-3, 1e-4, 0.1, 0.1, 0.12, 0.01, 3, 25
    ),
    'bent board, the right camera later, by when the board moved 2 mm': Hidden(
        (0.003, 0.0015), 1e-3, late=0.002
    ),
    'two boards': Hidden((0.003, 0.0015), 1e-3, apart=True),
    'photographs, rendered, of a board bent by 1 mm, shifts of 3 and 1.5 mm': Hidden(
        (0.003, 0.0015), 1e-3, frames=20, rows=6, rendered=True
    ),
}


def reachable(seen: Pair, hidden: Hidden) -> dict[str, float]:
    """Return how far the rig scatters, m and rad, by the true lenses and the true board.

    Noise and what each image has of its own leave that; outliers are faded out.
    """
    poses = []
    table = seen.table.take(~np.isin(seen.table.frame, seen.reversed_frames))
    for camera, lens in enumerate(hidden_lenses(hidden)):
        mine = table.take(table.camera == camera)
        views = group_views(replace(mine, xyz=mine.xyz + seen.moved[mine.landmark]))
        model = ForwardModel(lens)
        pose = localize(model, views).pose
        for _ in range(_ROUNDS):
            off = np.linalg.norm(views.uv - model.linearize(pose, views).uv, axis=-1)
            limit = _FAR * np.nanmedian(np.where(views.used, off, np.nan), axis=1, keepdims=True)
            pose = localize(
                model,
                views._replace(weight=np.where(views.used & (off < limit), views.weight, 0.0)),
                pose,
            ).pose
        poses.append((views.frame, pose))
    _, *both = np.intersect1d(poses[0][0], poses[1][0], return_indices=True)
    left, right = (pose.take(rows) for (_, pose), rows in zip(poses, both, strict=True))
    place, turn = deviations(left.inverse().compose(right))
    return {'translation_m': float(place.mean()), 'rotation_rad': float(turn.mean())}


def tried(kind: str, seed: int) -> dict[str, Any]:
    """Diagnose one pair; return what came of it."""
    seen = pair(KINDS[kind], seed)
    began = process_time()
    found = diagnose(seen.table, seen.lenses)
    said = found.cameras[0]
    return {
        'kind': kind,
        'seed': seed,
        'seconds': round(process_time() - began, 1),
        'causes': [cause.form for cause in found.causes],
        'verdict': found.verdict,
        'heldout_rms_px': [
            quality.heldout_rms_px for quality in (found.figures.base, found.figures.extended)
        ],
        'external': said.to_dict(),
        'reachable': reachable(seen, KINDS[kind]),
    }


def section(found: Sequence[dict[str, Any]]) -> str:
    """Return the table of docs/results/two_cameras.md."""
    rows = []
    for kind in KINDS:
        said = [one['external'] for one in found if one['kind'] == kind]
        if not said:
            continue
        verdicts = [one['verdict'] for one in said]
        counts = [verdicts.count(name) for name in ('agree', 'undecided', 'contradict')]
        maps = [one['maps']['correlation'] for one in said if one['maps']]
        carried = [one for each in said for one in each['target']]
        less = [
            [100 * one['rig'][name]['gain'] for one in said if one['rig']]
            for name in ('translation_m', 'rotation_rad')
        ]
        px = ' → '.join(
            spread([one[name] for one in carried], '.3f') for name in ('without_px', 'with_px')
        )
        rows.append(
            [
                f'{len(said)}: {kind}',
                ', '.join(map(str, counts)),
                spread(maps, '.3f'),
                px,
                *(f'{spread(one, ".0f")} %' for one in less),
                *_bound(found, kind),
            ]
        )
    return '\n'.join(
        study.table(
            'pairs | agree, undecided, contradict | correlation of the maps | rms of the '
            'one that did '
            'not find it, px | less scatter of the rig: translation | rotation | by the truth | '
            'of what can be had',
            rows,
            numbers=True,
        )
    )


def _bound(found: Sequence[dict[str, Any]], kind: str) -> tuple[str, str]:
    """Return by how much less the rig scatters by the true lenses and board, and how near it is.

    How near: what all pairs together gain over what they gain by the truth.
    """
    mine = [one for one in found if one['kind'] == kind and one['external']['rig']]
    if not mine or KINDS[kind].apart or KINDS[kind].late:
        return '-', '-'
    told, near = [], []
    for name in ('translation_m', 'rotation_rad'):
        base, extended, truth = np.array(
            [
                [one['external']['rig'][name][key] for key in ('base', 'extended')]
                + [one['reachable'][name]]
                for one in mine
            ]
        ).T
        told.append(f'{100 * np.median(1 - truth / base):.0f} %')
        near.append(f'{100 * (base - extended).sum() / (base - truth).sum():.0f} %')
    return ', '.join(told), ', '.join(near)


def spread(values: Sequence[float], form: str) -> str:
    """Return the median of some values and, in brackets, the least and the largest."""
    if not values:
        return '-'
    middle, least, most = (
        format(float(value), form) for value in (np.median(values), np.min(values), np.max(values))
    )
    return f'{middle} ({least} to {most})'


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the pairs, write those that are done and print a line for each."""
    asked = study.parser(
        'two_cameras',
        __doc__,
        study.RESULTS / 'two_cameras.json',
        workers=False,
        pairs=(10, 'of each kind'),
    ).parse_args(arguments)
    found = json.loads(asked.output.read_text()) if asked.output.is_file() else []
    done = {(one['kind'], one['seed']) for one in found}
    for seed, kind in product(range(asked.pairs), KINDS):
        if (kind, seed) not in done:
            found.append(tried(kind, seed))
            sys.stdout.write(json.dumps(found[-1]) + '\n')
            sys.stdout.flush()
            write_text(asked.output, study.json_lines(found))
    study.write_section(study.RESULTS / 'two_cameras.md', 'two cameras', section(found))


if __name__ == '__main__':
    main()
