"""How accurate detected corners are, by incidence angle.

On rendered photographs, whose corners are known, and as what a lens fit leaves on real ones.
Writes docs/detectors.md.  Run: python -m benchmark.detectors [--count 60] [--photographs FOLDER]
"""

from __future__ import annotations

import argparse
import itertools
import time
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from fisheye_svp_ros.detect.detection import detect
from fisheye_svp_ros.detect.patterns import parse_pattern
from fisheye_svp_ros.detect.photographs import find_photographs
from fisheye_svp_ros.detect.points import find_points
from fisheye_svp_ros.errors import FisheyeSvpError
from fisheye_svp_ros.optics.camera import project
from fisheye_svp_ros.optics.curves import Gennery, KannalaBrandt
from fisheye_svp_ros.optics.lens import Lens
from fisheye_svp_ros.simulate.board_views import board_views
from fisheye_svp_ros.simulate.render import Exposure, Print, render
from fisheye_svp_ros.solve.lens_calibration import calibrate

PAGE = Path(__file__).parents[1] / 'docs' / 'detectors.md'
DETECTORS = ('saddle', 'sb', 'classic')
ANGLES = (0, 25, 45, 60, 75, 85, 95)
LENS = Lens('benchmark', 848, 800, 285.0, 285.0, 423.6, 399.3,
            KannalaBrandt(-0.01, 0.004, -0.0015, 0.0), np.radians(94.0), Gennery(e0=0.004))
PRINTED, BOARD = Print(9, 6, 0.025), 'chessboard:9x6:25mm'
CONDITIONS = {
    'as it should be': Exposure(),
    'defocus of 1.5 px': Exposure(blur=1.5),
    'uneven light': Exposure(slope=(0.6, -0.4)),
    'noise of 6 grey levels': Exposure(noise=6.0),
}
_MARK = '<!-- figures -->'


@dataclass
class Corners:
    """Errors (N, 2), px, stated sigma, px, and angle, deg, of what a detector found; s a photo."""

    error: list[np.ndarray] = field(default_factory=list)
    sigma: list[np.ndarray] = field(default_factory=list)
    theta: list[np.ndarray] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    found: int = 0


def rendered(count: int) -> dict[tuple[str, str], Corners]:
    """Return what each detector finds under each condition."""
    poses = board_views(LENS, PRINTED, count, (0.1, 0.3), np.random.default_rng(0))
    pattern, results = parse_pattern(BOARD), {}
    for condition, exposure in CONDITIONS.items():
        for name in DETECTORS:
            results[condition, name] = Corners()
        for i in range(count):
            pose = poses.take(i)
            image = render(LENS, PRINTED, pose, exposure, np.random.default_rng(i))
            points = pose.into_body(PRINTED.corners)
            true = project(LENS, points).uv
            theta = np.degrees(np.arccos(points[:, 2] / np.linalg.norm(points, axis=-1)))
            for name in DETECTORS:
                into, start = results[condition, name], time.process_time()
                seen = find_points(image, pattern, name)
                into.seconds.append(time.process_time() - start)
                if isinstance(seen, str):
                    continue
                into.found += 1
                into.error.append(seen.uv - true[seen.ids])
                into.sigma.append(seen.sigma)
                into.theta.append(theta[seen.ids])
    return results


def by_angle(results: dict[tuple[str, str], Corners], count: int) -> list[str]:
    """Return tables, one a condition: bias along the radius is not told from that across."""
    lines = []
    for condition in CONDITIONS:
        lines += ['', f'### {condition[0].upper()}{condition[1:]}', '',
                  '| detector | found | s | ' + ' | '.join(
                      f'{a} to {b}°' for a, b in itertools.pairwise(ANGLES)) + ' |',
                  '|---' * (len(ANGLES) + 2) + '|']
        for name in DETECTORS:
            seen = results[condition, name]
            error, theta = np.concatenate(seen.error), np.concatenate(seen.theta)
            sigma = np.concatenate(seen.sigma)
            cells = []
            for low, high in itertools.pairwise(ANGLES):
                own = (theta >= low) & (theta < high)
                bias = np.linalg.norm(error[own].mean(axis=0))
                scatter = np.sqrt((error[own] ** 2).mean())
                stated = np.sqrt((sigma[own] ** 2).mean())
                cells.append(f'{bias:.4f} / {scatter:.4f}'
                             + (f' / {scatter / stated:.2f}' if name == 'saddle' else ''))
            lines.append(f'| `{name}` | {seen.found} of {count} | {np.median(seen.seconds):.2f} | '
                         + ' | '.join(cells) + ' |')
    return lines


def real(folder: str, board: str) -> list[str]:
    """Return what a Kannala-Brandt fit leaves of each detector's corners."""
    lines = ['', '### Real photographs', '',
             f'`{board}`, a Kannala-Brandt lens without a viewpoint shift fitted to them:', '',
             '| detector | found | rms, px | median, px |', '|---|---|---|---|']
    for name in DETECTORS:
        try:
            seen = detect(find_photographs([folder]), parse_pattern(board), name)
            fitted = calibrate(seen.observations, 'kannala_brandt', seen.image_size)
        except FisheyeSvpError as error:
            lines.append(f'| `{name}` | {error} | | |')
            continue
        residual = np.linalg.norm(fitted.adjusted.residual[fitted.views.used], axis=-1)
        found = sum(one.points is not None for one in seen.searched)
        lines.append(f'| `{name}` | {found} of {len(seen.searched)} | '
                     f'{np.sqrt((residual**2).mean()):.3f} | {np.median(residual):.3f} |')
    return lines


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--count', type=int, default=60)
    parser.add_argument('--photographs')
    parser.add_argument('--board', default='chessboard:4x6:30mm')
    args = parser.parse_args()
    cv2.setNumThreads(1)
    lines = by_angle(rendered(args.count), args.count)
    if args.photographs:
        lines += real(args.photographs, args.board)
    head = PAGE.read_text(encoding='utf-8').partition(_MARK)[0]
    PAGE.write_text(head + _MARK + '\n' + '\n'.join(lines) + '\n', encoding='utf-8')


if __name__ == '__main__':
    main()
