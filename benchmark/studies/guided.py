"""The guide tried by somebody who holds a board: `make study NAME=guided`.

A hidden camera (a fisheye with a viewpoint shift) photographs a board, live and rendered; the
detector finds it; the guide knows the data sheet (field of view, to 2 %) and nothing else.
Whoever holds the board sees the guide's picture and knows what the words say: the board goes
where it is wanted, a few centimetres and degrees off, and is then brought nearer to the outline by
eye, with a hand that errs and trembles.  Photographs are those that the guide takes by itself.
Then `calibrate` and `diagnose` are given them.  Writes docs/results/next/guided.json and, of the
first camera, docs/images/guide.jpg.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmark import study
from fisheye_svp_ros.detect.patterns import parse_pattern
from fisheye_svp_ros.detect.points import Points, find_points
from fisheye_svp_ros.diagnosis import DiagnosisOptions, diagnose
from fisheye_svp_ros.effects.forward import ForwardModel
from fisheye_svp_ros.io.files import replacing, write_text
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.optics.curves import Gennery, KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.planning.guide import (
    MIN_SCORE,
    DetectedBoard,
    Guide,
    SessionState,
    evaluate_session,
    observations_of,
    start_session,
)
from fisheye_svp_ros.planning.optimal_design import FlatBoard
from fisheye_svp_ros.planning.plan import nominal_lens
from fisheye_svp_ros.pose import Pose, rotation_from_vector, vector_from_rotation
from fisheye_svp_ros.reporting.shot_plots import draw_guide
from fisheye_svp_ros.scene.observations import views_of
from fisheye_svp_ros.simulate.render import Exposure, Print, render
from fisheye_svp_ros.solve.localization import localize

BOARD, SIZE, ROOM, GOAL = 'chessboard:9x6:25mm', (848, 800), (0.12, 0.6), 2e-4
STEP = 0.25  # s between images
EXPOSURE = Exposure(blur=0.9, noise=4.0)
PICTURE = study.DOCS / 'images' / 'guide.jpg'
LONGEST = 3000  # images, most of them waited through
# What a hand does: off at first, m and rad; off by each correction, and of its length; trembling
OFF, CORRECTION, SHARE, TREMOR = (0.03, 0.1), (0.002, 0.02), 0.2, (0.0002, 0.001)


@dataclass
class Hand:
    """Holds the board: pose in the camera frame; target: where it is on its way to."""

    sheet: Lens
    points: NDArray[np.float64]
    rng: np.random.Generator
    board: Pose = field(default_factory=lambda: Pose(np.eye(3), np.array([0.0, 0.0, 0.35])))
    wanted: Pose | None = None
    way: int = 0

    def move(self, guide: Guide, seen: DetectedBoard | None) -> bool:
        """Move as the guide's picture says; return whether anything has moved."""
        stand, outline = guide.stand, guide.outline
        if stand is None or outline is None:
            return False
        camera = stand.wanted.shots.camera.take(guide.place)
        if self.wanted is None or np.any(self.wanted.position != camera.position):
            self.wanted, self.way = camera, 2
            self.aim = self._shaken(camera.inverse(), OFF)
        if self.way:
            self.board = _between(self.board, self.aim, 1 / self.way)
            self.way -= 1
        elif seen is None:
            return False
        elif guide.score < MIN_SCORE:
            here, there = (self._by_eye(uv, seen.ids) for uv in (seen.uv, outline[seen.ids]))
            change = there.compose(here.inverse())
            size = np.linalg.norm(there.position - here.position)
            self.board = self._shaken(
                _between(self.board, change.compose(self.board), 0.8),
                (CORRECTION[0] + SHARE * size, CORRECTION[1]),
            )
        return True

    @property
    def camera(self) -> Pose:
        """The camera's pose in the board's frame, now."""
        return self._shaken(self.board, TREMOR).inverse()

    def _by_eye(self, uv: NDArray[np.float64], ids: NDArray[np.int64]) -> Pose:
        """Return where a board is in front of the camera, roughly: by the lens of the sheet."""
        posed = localize(ForwardModel(self.sheet), views_of(self.points[ids][None], uv[None]))
        return posed.pose.take(0).inverse()

    def _shaken(self, pose: Pose, size: Sequence[float]) -> Pose:
        turn = rotation_from_vector(size[1] * self.rng.normal(size=3))
        return Pose(turn @ pose.rotation, pose.position + size[0] * self.rng.normal(size=3))


def _between(start: Pose, end: Pose, share: float) -> Pose:
    turn = vector_from_rotation(end.rotation @ start.rotation.T)
    return Pose(
        rotation_from_vector(share * turn) @ start.rotation,
        start.position + share * (end.position - start.position),
    )


def hidden(rng: np.random.Generator) -> Lens:
    """Return a camera: half field 65 to 95 degrees, viewpoint shift of 2 to 5 mm, either sign."""
    half = np.radians(rng.uniform(65, 95))
    curve = KannalaBrandt(rng.normal(scale=0.02), rng.normal(scale=0.004), 0.0, 0.0)
    f = SIZE[0] / 2 / float(curve.value_and_slope(np.array(half))[0])
    shift = float(rng.choice([-1, 1]) * rng.uniform(0.002, 0.005))
    center = (np.array(SIZE) - 1) / 2 + rng.normal(scale=6, size=2)
    return Lens('hidden', *SIZE, f, f, *center.tolist(), curve, half, Gennery(e0=shift))


def camera(number: int, picture: Path | None = None) -> dict[str, Any]:
    """Return what came of one camera; picture: where the guide's is drawn, of its first view."""
    rng = np.random.default_rng([17, number])
    lens, pattern = hidden(rng), parse_pattern(BOARD)
    field_of_view = 2 * lens.max_incidence * float(rng.normal(1, 0.02))
    sheet = nominal_lens(SIZE, field_of_view)
    guide = Guide(
        start_session(sheet, pattern.points, ROOM, 'e0', GOAL),
        np.stack([turn.source for turn in pattern.symmetries]),
    )
    hand = Hand(nominal_lens(SIZE, field_of_view), pattern.points, rng)
    printed, moved = Print(9, 6, 0.025), True
    seen: DetectedBoard | None = None
    board = FlatBoard(np.arange(54), printed.corners, np.zeros(54, dtype=np.int64), np.eye(3))
    rim = board.rim
    images, pixels, near = 0, None, None
    stands: list[SessionState] = []
    refused = 0
    for i in range(LONGEST):
        if guide.thinking:
            refused = len(guide.session.room.taken)
            stand = evaluate_session(guide.session)
            if isinstance(stand, Exception):
                raise stand
            guide.adopt(stand)
            stands.append(stand)
        if guide.is_finished:
            break
        if moved and not np.isfinite(project(lens, hand.camera.into_body(rim)).uv).all():
            seen, moved = None, False  # a board that leaves the field is not found
        elif moved:
            pixels = render(lens, printed, hand.camera, EXPOSURE, rng)
            images += 1
            found = find_points(pixels, pattern, 'quick', near)
            near = found.uv if isinstance(found, Points) else None
            seen = None
            if near is not None:
                seen = DetectedBoard(0.0, found.ids, found.uv, found.sigma)
        t = i * STEP
        seen = seen and seen._replace(t=t)
        guide.look(t, seen)
        first = not guide.session.taken and 0.4 < guide.score < MIN_SCORE
        if picture and pixels is not None and first:
            with replacing(picture) as path:
                cv2.imwrite(
                    str(path), draw_guide(pixels, guide, seen), [cv2.IMWRITE_JPEG_QUALITY, 75]
                )
        moved = hand.move(guide, seen)
    return {
        **judged(guide, lens),
        'half_field_deg': float(np.degrees(lens.max_incidence)),
        'images': images,
        'seconds': t,
        'given_up': refused,
        'settled': bool(guide.stand.settled),
        'guide_named': stands[-1].named,
        'guide_alike': stands[-1].alike,
        'guide_stderr_m': [s.stderr for s in stands],
    }


def judged(guide: Guide, lens: Lens) -> dict[str, Any]:
    """Return what `calibrate` and `diagnose` say of the photographs taken.

    Whoever sees that there is no window before the lens diagnoses `--without flat_port`: e0.
    """
    table = observations_of(guide.session.taken, guide.session.points)
    fitted, found = study.calibrated_and_diagnosed(table, SIZE)
    bare = diagnose(table, fitted, options=DiagnosisOptions(left_out=('flat_port',)))
    e0 = [c.parameters['e0'] for c in bare.causes if c.effect == 'viewpoint_shift']
    true = lens.viewpoint_shift.e0
    return {
        'photographs': len(guide.session.taken),
        'verdict': found.verdict,
        'classes': [[c.effect, *c.indistinguishable_from] for c in found.causes],
        'without_port': [[c.effect, *c.indistinguishable_from] for c in bare.causes],
        'e0_true_m': true,
        'e0_m': e0[0]['value'] if e0 else None,
        'e0_stderr_m': e0[0]['stderr'] if e0 else None,
        'error_over_stderr': (e0[0]['value'] - true) / e0[0]['stderr'] if e0 else None,
    }


def summary(cameras: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return how many were settled, with how many photographs, and how right that was."""
    pulls = np.array([c['error_over_stderr'] for c in cameras if c['e0_m'] is not None])
    counts = [c['photographs'] for c in cameras]
    shift = 'viewpoint_shift'
    return {
        'settled': sum(c['settled'] for c in cameras),
        'cameras': len(cameras),
        'photographs_median': float(np.median(counts)),
        'photographs_most': max(counts),
        'named': sum(any(shift == one[0] for one in c['classes']) for c in cameras),
        'in_class': sum(any(shift in one for one in c['classes']) for c in cameras),
        'named_without_port': len(pulls),
        'error_over_stderr_rms': float(np.sqrt(np.mean(pulls**2))),
        'error_over_stderr_most': float(np.abs(pulls).max()),
        'seconds_median': float(np.median([c['seconds'] for c in cameras])),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the trial, write it, print what came of it."""
    asked = study.parser(
        'guided',
        __doc__,
        study.RESULTS / 'next' / 'guided.json',
        workers=False,
        cameras=(10, 'hidden ones'),
    ).parse_args(arguments)
    cameras = study.in_turn(
        'cameras',
        lambda number: camera(number, PICTURE if not number else None),
        range(asked.cameras),
        lambda some: write_text(asked.output, study.json_lines(some)),
    )
    sys.stdout.write(json.dumps(summary(cameras), indent=1) + '\n')


if __name__ == '__main__':
    main()
