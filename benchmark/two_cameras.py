"""Pairs of cameras that see one bent board, as real ones do: `python -m benchmark.two_cameras`.

Two lenses of different image sizes and focal lengths, a board with a smooth bend, stretch and
offsets of single corners, an image field of each lens and of each frame, outliers, frames that
only one camera sees or that the detector numbered from the other end.  Each is calibrated and
diagnosed as a user would, and asked what the two cameras say of each other.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time
from typing import Any, NamedTuple

import numpy as np

from fisheye_svp_ros.arrays import Array, Index
from fisheye_svp_ros.diagnosis.diagnosis import diagnose
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.files import write_text
from fisheye_svp_ros.optics.curves import Gennery, KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose, rotation_from_vector
from fisheye_svp_ros.scene.observations import STEREO, Observations, make_observations
from fisheye_svp_ros.simulate.board_views import board_views
from fisheye_svp_ros.simulate.render import Print
from fisheye_svp_ros.solve.lens_calibration import calibrate

Rng = np.random.Generator


@dataclass(frozen=True)
class Hidden:
    """What a pair hides: shifts e0, m, of the cameras, the bend of the board, m, and background.

    apart: the right camera sees another board.
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


def lenses() -> tuple[Lens, Lens]:
    """Return two fisheyes that have little in common."""
    return (
        Lens('left', 1280, 960, 400.0, 401.0, 645.0, 472.0, KannalaBrandt(-0.012, 0.002), 1.5),
        Lens('right', 1024, 768, 300.0, 299.5, 505.0, 390.0, KannalaBrandt(0.03, -0.004), 1.5),
    )


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
    true = _bent(printed, hidden, rng)
    boards = (true, _bent(printed, hidden, rng) if hidden.apart else true)
    given = lenses()
    rig = Pose(rotation_from_vector(np.array([0.01, 0.08, -0.02])), np.array([0.12, 0.004, -0.01]))
    left = _views(given, printed, rig, hidden.frames, rng)
    parts = []
    for camera, (lens, shift) in enumerate(zip(given, hidden.shift, strict=True)):
        seen = replace(lens, viewpoint_shift=Gennery(0.0, shift))
        pose = left if camera == 0 else left.compose(_repeated(rig, hidden.frames))
        parts.append(_seen(seen, printed, boards[camera], pose, hidden, rng, camera))
    table = _joined(parts)
    wrong = rng.choice(hidden.frames, hidden.reversed_frames, replace=False)
    last = len(printed.corners) - 1
    turn = np.isin(table.frame, wrong) & (table.camera == 1)
    landmark = np.where(turn, last - table.landmark, table.landmark)
    table = replace(table, landmark=landmark, xyz=printed.corners[landmark])
    found = {name: calibrate(replace(table.take(table.camera == i), cameras=(name,),
                                     camera=np.zeros(int((table.camera == i).sum()), dtype=int)),
                             'kannala_brandt', (one.width, one.height)).adjusted.lens
             for i, (name, one) in enumerate(zip(STEREO, given, strict=True))}
    both = np.intersect1d(*(table.frame[table.camera == i] for i in (0, 1)))
    return Pair(table, found, true - printed.corners, sorted(set(wrong) & set(both.tolist())))


def _bent(printed: Print, hidden: Hidden, rng: Rng) -> Array:
    """Return where the corners are: a bend, a smooth stretch along the board, single offsets."""
    flat = printed.corners
    x, y = ((flat[:, :2] - flat[:, :2].mean(axis=0)) / np.ptp(flat[:, 0]) * 2).T
    weights = rng.normal(size=6) * [1.0, 1.0, 1.0, 0.3, 0.3, 0.2]
    shape = np.stack([x * x, x * y, y * y, x**3, x * x * y, np.cos(3 * x + 2 * y)]).T @ weights
    true = flat + rng.normal(size=flat.shape) * hidden.offset
    true[:, 2] += hidden.bend * shape / max(np.ptp(shape), 1e-9)
    true[:, :2] += hidden.offset * np.stack([np.cos(4 * x + y), np.sin(3 * y - x)], axis=-1)
    return true


def _views(
    given: Sequence[Lens], printed: Print, rig: Pose, frames: int, rng: Rng
) -> Pose:
    """Return poses of the left camera; every camera sees the board as a whole in most of them."""
    own = board_views(given[0], printed, frames - frames // 3, (0.25, 0.8), rng)
    other = board_views(given[1], printed, frames // 3, (0.25, 0.8), rng)
    back = other.compose(_repeated(rig.inverse(), frames // 3))
    return Pose(*(np.concatenate(both) for both in zip(own, back, strict=True)))


def _repeated(pose: Pose, count: int) -> Pose:
    return Pose(*(np.repeat(part[None], count, axis=0) for part in pose))


def _seen(
    lens: Lens, printed: Print, true: Array, pose: Pose, hidden: Hidden, rng: Rng, camera: int
) -> Observations:
    count = len(true)
    points = pose.into_body(np.broadcast_to(true, (hidden.frames, count, 3)))
    image = ForwardModel(lens).project(points)
    inside = (image.uv > 4) & (image.uv < np.array([lens.width, lens.height]) - 4)
    whole = (image.valid & inside.all(axis=-1)).all(axis=1) & (rng.random(hidden.frames) > 0.15)
    static, own = _field(lens, rng, 1), _field(lens, rng, hidden.frames)
    uv = image.uv + hidden.field * static(image.uv, np.zeros(hidden.frames, dtype=int))
    uv = uv + hidden.frame_field * own(uv, np.arange(hidden.frames))
    uv = uv + hidden.noise * rng.normal(size=uv.shape)
    far = rng.random(uv.shape[:2]) < hidden.outliers
    uv = uv + (far * 10 ** rng.uniform(0.0, 1.5, far.shape))[..., None] * rng.normal(size=uv.shape)
    frame, landmark = np.nonzero(whole[:, None] & np.ones(count, dtype=bool))
    return make_observations(
        frame, landmark, uv[frame, landmark], printed.corners[landmark],
        camera=np.full(len(frame), camera), cameras=STEREO, source='pair')


def _field(lens: Lens, rng: Rng, count: int) -> Any:
    """Draw smooth fields over the image of 1 px or so, of a few bumps each."""
    size = np.array([lens.width, lens.height])
    centres = rng.uniform(size=(count, 8, 2)) * size
    widths = rng.uniform(0.08, 0.3, (count, 8)) * size.max()
    heights = rng.normal(size=(count, 8, 2))

    def field(uv: Array, which: Index) -> Array:
        off = uv[:, :, None] - centres[which][:, None]
        near = np.exp(-(off**2).sum(axis=-1) / 2 / widths[which][:, None] ** 2)
        return np.asarray(np.einsum('fnb,fbd->fnd', near, heights[which]))

    return field


def _joined(parts: Sequence[Observations]) -> Observations:
    names = ('frame', 'landmark', 'uv', 'xyz', 'camera', 'board', 't', 'sigma')
    return replace(parts[0], **{
        name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


KINDS = {
    'bent board, shifts of 3 and 1.5 mm': Hidden((0.003, 0.0015), 1e-3),
    'bent by 0.3 mm, shifts of 2 and 1 mm': Hidden((0.002, 0.001), 3e-4),
    'bent by 0.5 mm, background as large as the noise': Hidden(
        (0.003, 0.001), 5e-4, 1e-4, 0.1, 0.1, 0.12, 0.01, 3, 25),
    'two boards': Hidden((0.003, 0.0015), 1e-3, apart=True),
}


def tried(kind: str, seed: int) -> dict[str, Any]:
    """Diagnose one pair; return what came of it."""
    seen = pair(KINDS[kind], seed)
    began = process_time()
    found = diagnose(seen.table, seen.lenses)
    said = found.cameras[0]
    return {
        'kind': kind, 'seed': seed, 'seconds': round(process_time() - began, 1),
        'causes': [cause.form for cause in found.causes], 'verdict': found.verdict,
        'heldout_rms_px': [found.base.heldout_rms_px, found.extended.heldout_rms_px],
        'external': said.to_dict(),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the pairs, write those that are done and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__, prog='python -m benchmark.two_cameras')
    parser.add_argument('--pairs', type=int, default=10, help='of each kind')
    parser.add_argument('-o', '--output', type=Path, default=Path('docs/two_cameras.json'))
    asked = parser.parse_args(arguments)
    found = []
    for seed in range(asked.pairs):
        for kind in KINDS:
            found.append(tried(kind, seed))
            lines = [json.dumps(one) for one in found]
            sys.stdout.write(lines[-1] + '\n')
            sys.stdout.flush()
            write_text(asked.output, '[\n' + ',\n'.join(lines) + '\n]\n')


if __name__ == '__main__':
    main()
