"""How accurate detected corners are, by incidence angle.

On rendered photographs, whose corners are known, and as what a lens fit leaves on real ones.
Writes docs/results/detectors.md.  Run:
python -m benchmark.studies.detectors [--count 60] [--photographs FOLDER]
"""

from __future__ import annotations

import itertools
import os
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from benchmark import study
from benchmark.studies.prints import printed
from fisheye_svp_ros.arrays import Array
from fisheye_svp_ros.detect.detection import detect
from fisheye_svp_ros.detect.finders import UNFITTED_DETECTORS, default_detector
from fisheye_svp_ros.detect.patterns import Pattern, parse_pattern
from fisheye_svp_ros.detect.photographs import find_photographs
from fisheye_svp_ros.detect.points import find_points
from fisheye_svp_ros.errors import FisheyeSvpError
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.optics.curves import Gennery, KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.pose import Pose
from fisheye_svp_ros.simulate.render import Exposure, Print, render
from fisheye_svp_ros.simulate.targets import board_views
from fisheye_svp_ros.solve.lens_calibration import calibrate

DETECTORS = ('saddle', 'sb', 'classic')
ANGLES = (0, 25, 45, 60, 75, 85, 95)
LENS = Lens(
    'benchmark',
    848,
    800,
    285.0,
    285.0,
    423.6,
    399.3,
    KannalaBrandt(-0.01, 0.004, -0.0015, 0.0),
    np.radians(94.0),
    Gennery(e0=0.004),
)
PRINTED, BOARD = Print(9, 6, 0.025), 'chessboard:9x6:25mm'
TARGET = """target_type: aprilgrid
tagCols: 6
tagRows: 5
tagSize: 0.03
tagSpacing: 0.3
"""
# What else than chessboards, all of much the same size
OTHERS = (
    'charuco:9x7:25mm:18mm:DICT_5X5_100',
    'aprilgrid:target.yaml',
    'circles:8x6:25mm',
    'circles:4x9:18mm:asymmetric',
)
CONDITIONS = {
    'as it should be': Exposure(),
    'defocus of 1.5 px': Exposure(blur=1.5),
    'uneven light': Exposure(slope=(0.6, -0.4)),
    'noise of 6 grey levels': Exposure(noise=6.0),
}


@dataclass
class Corners:
    """Errors (N, 2), px, stated sigma, px, and angle, deg, of what a detector found; s a photo."""

    error: list[np.ndarray] = field(default_factory=list)
    sigma: list[np.ndarray] = field(default_factory=list)
    theta: list[np.ndarray] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    found: int = 0
    points: int = 0


def rendered(
    board: Pattern, detectors: Sequence[str], count: int
) -> dict[tuple[str, str], Corners]:
    """Return what detectors find under each condition, of `count` photographs."""
    print_ = printed(board)
    middle = (print_.corners.min(axis=0) + print_.corners.max(axis=0)) / 2
    views = board_views(LENS, PRINTED, count, (0.1, 0.3), np.random.default_rng(0))
    results = {(condition, name): Corners() for condition in CONDITIONS for name in detectors}
    for condition, exposure in CONDITIONS.items():
        for i in range(count):
            pose = views.take(i)
            pose = Pose(pose.rotation, pose.position + middle - PRINTED.corners.mean(axis=0))
            image = render(LENS, print_, pose, exposure, np.random.default_rng(i))
            for name in detectors:
                _add(results[condition, name], image, board, name, pose.into_body(print_.corners))
    return results


def _add(into: Corners, image: Array, board: Pattern, detector: str, points: Array) -> None:
    true = project(LENS, points).uv
    theta = np.degrees(np.arccos(points[:, 2] / np.linalg.norm(points, axis=-1)))
    start = time.process_time()
    seen = find_points(image, board, detector)
    into.seconds.append(time.process_time() - start)
    into.points += len(points)
    if isinstance(seen, str):
        return
    into.found += 1
    # Of boards that look the same when turned any order is right.
    orders = [np.argsort(turn.source) for turn in board.symmetries]
    error = min(
        (seen.uv - true[order][seen.ids] for order in orders),
        key=lambda error: float(np.abs(error).max()),
    )
    into.error.append(error)
    into.sigma.append(seen.sigma)
    into.theta.append(theta[seen.ids])


def by_angle(results: dict[tuple[str, str], Corners], count: int) -> list[str]:
    """Return tables, one a condition: bias along the radius is not told from that across."""
    lines = []
    for condition in CONDITIONS:
        rows = [
            _row(name, seen, count) for (its, name), seen in results.items() if its == condition
        ]
        lines += [
            '',
            f'### {condition[0].upper()}{condition[1:]}',
            '',
            *study.table(
                'detector | found | points | s | '
                + ' | '.join(f'{a} to {b}°' for a, b in itertools.pairwise(ANGLES)),
                rows,
            ),
        ]
    return lines


def _row(name: str, seen: Corners, count: int) -> list[str]:
    if not seen.found:
        return [f'`{name}`', f'0 of {count}', *[''] * (len(ANGLES) + 1)]
    error, theta, sigma = map(np.concatenate, (seen.error, seen.theta, seen.sigma))
    cells = []
    for low, high in itertools.pairwise(ANGLES):
        own = (theta >= low) & (theta < high)
        if not own.any():
            cells.append('')
            continue
        bias = np.linalg.norm(error[own].mean(axis=0))
        scatter = np.sqrt((error[own] ** 2).mean())
        over = np.sqrt(((error[own] / sigma[own, None]) ** 2).mean())
        stated = '' if name in UNFITTED_DETECTORS else f' / {over:.2f}'
        cells.append(f'{bias:.4f} / {scatter:.4f}{stated} ({own.sum()})')
    share = 100 * len(error) / seen.points
    return [
        f'`{name}`',
        f'{seen.found} of {count}',
        f'{share:.0f} %',
        f'{np.median(seen.seconds):.2f}',
        *cells,
    ]


def real(folder: str, board: str) -> list[str]:
    """Return what a Kannala-Brandt fit leaves of each detector's corners."""
    rows = []
    for name in DETECTORS:
        try:
            seen = detect(find_photographs([folder]), parse_pattern(board), name)
            fitted = calibrate(seen.observations, 'kannala_brandt', seen.image_size)
        except FisheyeSvpError as error:
            rows.append([f'`{name}`', error, '', ''])
            continue
        residual = np.linalg.norm(fitted.adjusted.residual[fitted.views.used], axis=-1)
        found = sum(one.points is not None for one in seen.searched)
        rows.append(
            [
                f'`{name}`',
                f'{found} of {len(seen.searched)}',
                f'{np.sqrt((residual**2).mean()):.3f}',
                f'{np.median(residual):.3f}',
            ]
        )
    return [
        '',
        '### Real photographs',
        '',
        f'`{board}`, a Kannala-Brandt lens without a viewpoint shift fitted to them:',
        '',
        *study.table('detector | found | rms, px | median, px', rows),
    ]


def main() -> None:
    """Measure and write."""
    parser = study.parser(
        'detectors',
        __doc__,
        None,
        workers=False,
        count=(60, 'photographs'),
        board=('chessboard:4x6:30mm', 'of --photographs'),
    )
    parser.add_argument('--photographs', help='folder of real ones')
    args = parser.parse_args()
    cv2.setNumThreads(1)
    lines = by_angle(rendered(parse_pattern(BOARD), DETECTORS, args.count), args.count)
    if args.photographs:
        lines += real(args.photographs, args.board)
    lines += ['', '## Other boards']
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        Path('target.yaml').write_text(TARGET, encoding='utf-8')
        others = {}
        for spec in OTHERS:
            board = parse_pattern(spec)
            found = rendered(board, [default_detector(board)], args.count)
            others |= {(condition, spec): seen for (condition, _), seen in found.items()}
    lines += by_angle(others, args.count)
    study.write_figures(study.RESULTS / 'detectors.md', lines)


if __name__ == '__main__':
    main()
